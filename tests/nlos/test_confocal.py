from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from refusals import find_refusal

from nlos import Capture, FKMigration, Grid, LightCone
from nlos.capture import TimeAxis
from nlos.confocal import apply_wiener_filter, build_rebinning_matrix
from nlos.preparation import rebin_capture, remove_first_bounce
from nlos.simulate import PointScene
from tofclip.errors import InputError

# Odd and unequal sizes; path per bin about the wall's step.
X, Y = np.linspace(-0.5, 0.5, 27), np.linspace(-0.4, 0.45, 22)
AXIS = TimeAxis(bins=200, bin_width=60e-12)
HIDDEN = (0.15, -0.2, 0.65)
METHODS = [LightCone(), FKMigration()]
named = pytest.mark.parametrize("method", METHODS, ids=["lightcone", "fk"])


def wall_at(depth: float = 0.0) -> np.ndarray:
    x, y = np.meshgrid(X, Y)
    return np.stack([x, y, np.full_like(x, depth)], axis=-1)


def confocal(positions: object, wall: np.ndarray | None = None, axis: TimeAxis = AXIS) -> Capture:
    wall = wall_at() if wall is None else wall
    return PointScene(positions).simulate_capture(wall, wall, axis, 40e-12)


def around(point: tuple[float, float, float], half: float = 0.12, voxel: float = 0.02) -> Grid:
    steps = voxel * np.arange(-round(half / voxel), round(half / voxel) + 1)
    return Grid(*(c + steps for c in point))


@named
@settings(max_examples=8, deadline=None)
@given(x=st.floats(-0.35, 0.35), y=st.floats(-0.3, 0.3), z=st.floats(0.4, 0.9))
def test_a_hidden_point_comes_back_where_it_is(
    method: LightCone | FKMigration, x: float, y: float, z: float
) -> None:
    volume = method.reconstruct(confocal([[x, y, z]]), around((x, y, z)))
    assert volume.values.dtype == np.float32
    # The wall's step is 4 cm: lateral interpolation puts the maximum on the nearest lattice point.
    assert volume.find_brightest() == pytest.approx((x, y, z), abs=0.021)


@named
def test_two_points_keep_their_sides_and_depths(method: LightCone | FKMigration) -> None:
    points = np.array([(0.25, -0.15, 0.5), (-0.2, 0.25, 0.75)])
    capture = confocal(points)
    volume = method.reconstruct(capture, Grid.box((-0.5, 0.5), (-0.4, 0.4), (0.4, 0.9), 0.02))
    assert volume.values.shape == volume.grid.shape
    for point, other in zip(points, points[::-1], strict=True):
        # Half of the volume around this point, cut halfway to the other.
        nearer = np.linalg.norm(_voxels(volume.grid) - point, axis=-1) < np.linalg.norm(
            _voxels(volume.grid) - other, axis=-1
        )
        z, y, x = np.unravel_index(np.argmax(np.where(nearer, volume.values, 0)), volume.grid.shape)
        found = (volume.grid.x[x], volume.grid.y[y], volume.grid.z[z])
        assert found == pytest.approx(tuple(point), abs=0.03)


def _voxels(grid: Grid) -> np.ndarray:
    z, y, x = np.meshgrid(grid.z, grid.y, grid.x, indexing="ij")
    return np.stack([x, y, z], axis=-1)


@named
def test_equal_points_at_two_depths_are_equally_bright(method: LightCone | FKMigration) -> None:
    """Brightness falls by 4 powers of the distance: 0.5 m and 0.8 m differ 6.6-fold before the
    weights undo it. What is left is the cone that the wall fills.
    """
    peaks = []
    for depth in (0.5, 0.8):
        # On a lattice point, so that interpolation dims neither.
        point = (X[13], Y[11], depth)
        peaks.append(method.reconstruct(confocal([point]), around(point, 0.06, 0.01)).values.max())
    # A peak is as high as the waves that make it are many: along each side of the wall up to the
    # sine of the angle of its edge, or the tangent where all count alike that the wall samples.
    depths, sides = np.array([0.5, 0.8]), np.array([[np.ptp(X)], [np.ptp(Y)]]) / 2
    tangents, sines = sides / depths, sides / np.hypot(sides, depths)
    least, most = (float(np.prod(one[:, 1] / one[:, 0])) for one in (tangents, sines))
    assert least < peaks[1] / peaks[0] < most  # 0.39 and 0.54


@named
def test_the_order_of_wall_points_the_wall_plane_and_the_start_of_the_record_do_not_matter(
    method: LightCone | FKMigration,
) -> None:
    grid = around(HIDDEN)
    expected = method.reconstruct(confocal([HIDDEN]), grid).values
    shifted = np.array([0, 0, 0.3])
    moved = confocal([HIDDEN + shifted], wall_at(0.3))
    again = method.reconstruct(moved, Grid(grid.x, grid.y, grid.z + 0.3)).values
    assert np.allclose(again, expected, atol=1e-4 * expected.max())
    capture = confocal([HIDDEN])
    order = np.random.default_rng(1).permutation(len(capture.points))
    listed = Capture(
        capture.traces()[order].T, capture.points[order], capture.points[order], AXIS.bin_width
    )
    assert np.array_equal(method.reconstruct(listed, grid).values, expected)
    transposed = Capture(
        np.swapaxes(capture.signal, 1, 2),
        np.swapaxes(capture.wall, 0, 1),
        np.swapaxes(capture.wall, 0, 1),
        AXIS.bin_width,
    )
    assert np.array_equal(method.reconstruct(transposed, grid).values, expected)
    late = TimeAxis(AXIS.bins - 30, AXIS.bin_width, 30 * AXIS.spacing)
    assert np.allclose(
        method.reconstruct(confocal([HIDDEN], axis=late), grid).values, expected, rtol=1e-3
    )


@named
def test_a_start_between_bins_is_interpolated(method: LightCone | FKMigration) -> None:
    axis = TimeAxis(AXIS.bins, AXIS.bin_width, 20.4 * AXIS.spacing)
    volume = method.reconstruct(confocal([HIDDEN], axis=axis), around(HIDDEN))
    assert volume.find_brightest() == pytest.approx(HIDDEN, abs=0.021)
    before = TimeAxis(AXIS.bins, AXIS.bin_width, -10 * AXIS.spacing)
    volume = method.reconstruct(confocal([HIDDEN], axis=before), around(HIDDEN))
    assert volume.find_brightest() == pytest.approx(HIDDEN, abs=0.021)


@named
def test_half_a_wall_beyond_the_wall_is_seen_and_no_more(method: LightCone | FKMigration) -> None:
    outside = (0.6, 0.0, 0.6)
    volume = method.reconstruct(confocal([outside]), around(outside))
    # Seen from one side only, the point is smeared along the ray.
    assert volume.find_brightest() == pytest.approx(outside, abs=0.06)
    wide = Grid.box((-1.2, 0), (-0.4, 0.4), (0.4, 0.8), 0.1)
    reason = find_refusal(method, confocal([HIDDEN]), wide)
    assert "half a wall beyond" in reason


@named
def test_what_is_no_confocal_lattice_is_refused(method: LightCone | FKMigration) -> None:
    capture, grid = confocal([HIDDEN]), around(HIDDEN)
    assert not find_refusal(method, capture, grid)
    curved = wall_at()
    curved[..., 2] = 0.1 * curved[..., 0] ** 2
    uneven = wall_at()
    uneven[:, 3] += [0.02, 0, 0]
    for wall in (curved, uneven, np.zeros_like(curved)):
        assert "lattice" in find_refusal(method, replace(capture, wall=wall, laser=wall), grid)
    for laser in (wall_at()[0, 0], wall_at()[::-1]):
        other = replace(capture, laser=laser)
        assert "confocal scan is needed" in find_refusal(method, other, grid)
        with pytest.raises(InputError, match="confocal"):
            method.reconstruct(other, grid)
    assert "behind the hindmost" in find_refusal(
        method, capture, Grid.box((0, 1), (0, 1), (-1, 1), 0.1)
    )


@named
def test_ten_gigabytes_are_refused_before_they_are_allocated(
    method: LightCone | FKMigration,
) -> None:
    x, y = np.meshgrid(np.linspace(-1, 1, 80), np.linspace(-1, 1, 80))
    wall = np.stack([x, y, np.zeros_like(x)], axis=-1)
    # Broadcast in the test only; a record that starts 200 m late has as many empty bins before it.
    capture = Capture(np.zeros((2, 80, 80)), wall, wall, 32e-12, start=200.0)
    assert "GiB allowed" in find_refusal(
        method, capture, Grid.box((0, 0.1), (0, 0.1), (0.5, 0.6), 0.1)
    )


@pytest.mark.parametrize("settings", [{"falloff": -1}, {"falloff": np.nan}])
def test_settings_are_checked(settings: dict[str, float]) -> None:
    for kind in (LightCone, FKMigration):
        with pytest.raises(InputError, match="falloff"):
            kind(**settings)
    with pytest.raises(InputError, match="signal_to_noise"):
        LightCone(signal_to_noise=0)


def test_a_retroreflective_point_needs_the_smaller_power() -> None:
    point = (X[13], Y[11], 0.6)
    capture = confocal([point])
    distance = np.linalg.norm(wall_at() - point, axis=-1)
    bright = replace(capture, signal=capture.signal * distance**2)
    volume = LightCone(falloff=2).reconstruct(bright, around(point))
    assert volume.find_brightest() == pytest.approx(point, abs=0.021)


def test_rebinning_keeps_the_integral_and_means() -> None:
    source, target = np.array([0.0, 0.0, 1.0, 4.0, 9.0]), np.linspace(0, 9, 7)
    matrix = build_rebinning_matrix(source, target)
    values = np.array([5.0, 2.0, 3.0, 7.0])
    found = matrix @ values
    # An interval of length 0 holds nothing.
    assert np.sum(found * np.diff(target)) == pytest.approx(
        np.sum(values * np.diff(source)), rel=1e-6
    )
    assert found[0] == pytest.approx((2 * 1 + 3 * 0.5) / 1.5)
    assert np.allclose(
        build_rebinning_matrix(np.array([0.0, 1.0]), np.array([2.0, 3.0])) @ np.ones(1), 0
    )


@named
def test_the_order_of_the_scan_a_little_noise_and_masked_points_do_not_matter(
    method: LightCone | FKMigration,
) -> None:
    capture, grid = confocal([HIDDEN]), around(HIDDEN)
    expected = method.reconstruct(capture, grid).values
    random = np.random.default_rng(2)
    order = random.permutation(X.size * Y.size)
    wall = (wall_at().reshape(-1, 3) + random.normal(0, 1e-4, (X.size * Y.size, 3)))[order]
    shuffled = replace(
        capture, signal=capture.signal.reshape(AXIS.bins, -1)[:, order], wall=wall, laser=wall
    )
    # Points are off by a 400th of their step, and so is the lattice that is found.
    assert np.linalg.norm(
        method.reconstruct(shuffled, grid).values - expected
    ) < 2e-2 * np.linalg.norm(expected)
    wall = wall_at()
    wall[3:5, 20:22] = np.nan
    masked = replace(capture, wall=wall, laser=wall)
    # Of 594 points 4 are dark.
    assert method.reconstruct(masked, grid).find_brightest() == pytest.approx(HIDDEN, abs=0.021)


@named
def test_two_signals_of_one_place_are_refused(method: LightCone | FKMigration) -> None:
    wall = wall_at().reshape(-1, 3)
    wall[1] = wall[0]
    capture = Capture(np.zeros((AXIS.bins, len(wall))), wall, wall, AXIS.bin_width)
    assert "two wall points stand in one place" in find_refusal(method, capture, around(HIDDEN))


@pytest.fixture(scope="module")
def letter(shared_data: Path) -> Capture:
    with np.load(shared_data / "nlos" / "otoole2018_diffuse_s.npz") as stored:
        raw = Capture(
            stored["H"], stored["wall_xyz"], stored["laser_xyz"], float(stored["delta_t_s"])
        )
    return rebin_capture(remove_first_bounce(raw, 600 * raw.axis.spacing), 8)


@named
def test_the_recorded_letter_s_stands_at_half_a_metre(
    method: LightCone | FKMigration, letter: Capture
) -> None:
    axis = np.linspace(-0.35, 0.35, 64)
    volume = method.reconstruct(letter, Grid(axis, axis, np.arange(0.36, 0.64, 0.005)))
    assert 0.49 <= volume.find_brightest()[2] <= 0.52
    assert 0.49 <= volume.grid.z[volume.values.sum(axis=(1, 2)).argmax()] <= 0.52
    picture = volume.maximum_projection().brightness
    rows = {
        y: picture[np.abs(axis - y) < 0.02].mean(axis=0) for y in (-0.15, -0.06, 0.05, 0.15, 0.25)
    }
    left, right, middle = (
        (axis > -0.2) & (axis < -0.1),
        (axis > 0.06) & (axis < 0.16),
        np.abs(axis) < 0.05,
    )
    # As back-projection shows it: bars at y = -0.15, 0.05 and 0.25, joined right above the middle
    # and left below it.
    assert rows[-0.06][right].mean() > 1.3 * rows[-0.06][left].mean()
    assert rows[0.15][left].mean() > 1.3 * rows[0.15][right].mean()
    for bar, gap in ((-0.15, -0.06), (0.05, -0.06), (0.05, 0.15)):
        assert rows[bar][middle].mean() > 1.15 * rows[gap][middle].mean()


@named
def test_the_weights_undo_exactly_four_powers_of_the_distance(
    method: LightCone | FKMigration,
) -> None:
    """As if brightness had not fallen at all: the same image from signals times distance^4."""
    assert method.falloff == 4
    capture, grid = confocal([HIDDEN, (0.0, 0.1, 0.45)]), around(HIDDEN, 0.3, 0.03)
    brighter = replace(
        capture, signal=capture.signal * np.arange(AXIS.bins)[:, np.newaxis, np.newaxis] ** 4.0
    )
    unweighted = replace(method, falloff=0.0).reconstruct(brighter, grid).values
    found = method.reconstruct(capture, grid).values
    assert np.allclose(found / found.max(), unweighted / unweighted.max(), atol=1e-4)


def test_the_light_cone_transform_reads_depths_to_a_fraction_of_a_bin() -> None:
    """A sample of u = z^2 is the mean over an interval and stands for its middle: half a sample is
    more than half a bin near the wall.
    """
    axis = TimeAxis(bins=48, bin_width=160e-12)
    errors = []
    for depth in np.arange(0.40, 0.60, 0.017):
        point = (X[13], Y[11], depth)
        depths = depth + 0.002 * np.arange(-40, 41)
        grid = Grid(X[13:14], Y[11:12], depths)
        line = LightCone().reconstruct(confocal([point], axis=axis), grid).values[:, 0, 0]
        bright = np.where(line > line.max() / 2, line, 0)
        errors.append(np.sum(bright * depths) / np.sum(bright) - depth)
    assert abs(np.mean(errors)) < 0.2 * axis.spacing / 2


def test_the_filter_is_wiener_s() -> None:
    random = np.random.default_rng(0)
    quarter = random.standard_normal((3, 3, 4)) + 1j * random.standard_normal((3, 3, 4))
    spectrum = np.ones((4, 4, 4), np.complex64)
    apply_wiener_filter(spectrum, quarter.astype(np.complex64), 0.5)
    expected = quarter.conj() / (np.abs(quarter) ** 2 + 2)
    np.testing.assert_allclose(spectrum[:3, :3], expected, rtol=1e-5)
    np.testing.assert_allclose(spectrum[3, 3], expected[1, 1], rtol=1e-5)


def test_migration_keeps_the_sign_of_signals_below_the_background() -> None:
    """A wave of opposite signs on the two halves of the wall cancels in the middle."""
    wall = wall_at()
    wall[..., 0] -= X.mean()
    capture = confocal([(0.0, Y[11], 0.6)], wall)
    sides = np.sign(np.round(wall[..., 0], 9))
    opposed = replace(capture, signal=capture.signal * sides)
    grid = Grid([0.0], Y[11:12], np.linspace(0.5, 0.7, 11))
    bright = FKMigration().reconstruct(capture, grid).values.max()
    assert FKMigration().reconstruct(opposed, grid).values.max() < 0.01 * bright
