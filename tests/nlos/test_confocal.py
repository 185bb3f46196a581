"""The light-cone transform and f-k migration of confocal scans."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scenes import around, find_refusal, relative_error, scaled_error, see

from nlos import Capture, FKMigration, Grid, LightCone
from nlos.capture import TimeAxis
from nlos.confocal import apply_wiener_filter
from nlos.plane import Plane
from tofclip.errors import InputError

# Odd and unequal sizes; path per bin about the wall's step.
X, Y = np.linspace(-0.5, 0.5, 27), np.linspace(-0.4, 0.45, 22)
AXIS = TimeAxis(bins=200, bin_width=60e-12)
HIDDEN = (0.15, -0.2, 0.65)
# The wall's step is 4 cm: lateral interpolation puts the maximum on the nearest lattice point.
VOXEL, STEP = 0.02, 0.021

named = pytest.mark.parametrize("method", [LightCone(), FKMigration()], ids=["lightcone", "fk"])


def wall_at(depth=0.0):
    return Plane(X, Y, depth).points


def confocal(points=(HIDDEN,), wall=None, axis=AXIS):
    return see(points, wall_at() if wall is None else wall, "confocal", axis, 40e-12)


def near(point=HIDDEN, half=0.12, voxel=VOXEL):
    return around(point, half, voxel)


@named
def test_equal_points_at_two_depths_are_equally_bright(method):
    """Brightness falls by 4 powers of the distance: 0.5 m and 0.8 m differ 6.6-fold before the
    weights undo it. What is left is the cone that the wall fills.
    """
    # On a lattice point, so that interpolation dims neither.
    points = [(X[13], Y[11], depth) for depth in (0.5, 0.8)]
    peaks = [
        method.reconstruct(confocal([point]), near(point, 0.06, 0.01)).values.max()
        for point in points
    ]
    # A peak is as high as the waves that make it are many: along each side of the wall up to the
    # sine of the angle of its edge, or the tangent where all count alike that the wall samples.
    depths, sides = np.array([0.5, 0.8]), np.array([[np.ptp(X)], [np.ptp(Y)]]) / 2
    tangents, sines = sides / depths, sides / np.hypot(sides, depths)
    least, most = (float(np.prod(one[:, 1] / one[:, 0])) for one in (tangents, sines))
    assert least < peaks[1] / peaks[0] < most  # 0.39 and 0.54


@named
def test_the_weights_undo_exactly_four_powers_of_the_distance(method):
    """As if brightness had not fallen at all: the same image from signals times distance^4."""
    assert method.falloff == 4
    capture, grid = confocal([HIDDEN, (0.0, 0.1, 0.45)]), near(HIDDEN, 0.3, 0.03)
    brighter = replace(capture, signal=capture.signal * np.arange(AXIS.bins)[:, None, None] ** 4.0)
    unweighted = replace(method, falloff=0.0).reconstruct(brighter, grid).values
    found = method.reconstruct(capture, grid).values
    assert np.allclose(found / found.max(), unweighted / unweighted.max(), atol=1e-4)


@named
def test_the_order_of_points_the_walls_plane_the_start_and_a_little_noise_do_not_matter(
    method,
):
    capture, grid = confocal(), near()
    expected = method.reconstruct(capture, grid).values
    moved = confocal([HIDDEN + np.array([0, 0, 0.3])], wall_at(0.3))
    again = method.reconstruct(moved, Grid(grid.x, grid.y, grid.z + 0.3)).values
    assert np.allclose(again, expected, atol=1e-4 * expected.max())
    turned = np.swapaxes(capture.wall, 0, 1)
    transposed = Capture(np.swapaxes(capture.signal, 1, 2), turned, turned, AXIS.bin_width)
    assert np.array_equal(method.reconstruct(transposed, grid).values, expected)
    late = TimeAxis(AXIS.bins - 30, AXIS.bin_width, 30 * AXIS.spacing)
    found = method.reconstruct(confocal(axis=late), grid).values
    assert np.allclose(found, expected, rtol=1e-3)
    random = np.random.default_rng(2)
    order = random.permutation(X.size * Y.size)
    exact = wall_at().reshape(-1, 3)[order]
    for noise, error in ((0.0, 0.0), (1e-4, 2e-2)):
        # Points are off by a 400th of their step, and so is the lattice that is found.
        wall = exact + noise * random.normal(size=exact.shape)
        signal = capture.signal.reshape(AXIS.bins, -1)[:, order]
        listed = replace(capture, signal=signal, wall=wall, laser=wall)
        assert relative_error(method.reconstruct(listed, grid).values, expected) <= error
    for start in (20.4, -10.0):  # between bins, before the laser
        axis = TimeAxis(AXIS.bins, AXIS.bin_width, start * AXIS.spacing)
        found = method.reconstruct(confocal(axis=axis), grid).values
        # as between the bins of the light itself, two thirds of a bin wide
        assert scaled_error(found, expected) < 0.2
    wall = wall_at()
    wall[3:5, 20:22] = np.nan  # of 594 points 4 are dark
    masked = method.reconstruct(replace(capture, wall=wall, laser=wall), grid)
    assert masked.find_brightest() == pytest.approx(HIDDEN, abs=STEP)


@named
def test_half_a_wall_beyond_the_wall_is_seen_and_no_more(method):
    outside = (0.6, 0.0, 0.6)
    volume = method.reconstruct(confocal([outside]), near(outside))
    # Seen from one side only, the point is smeared along the ray.
    assert volume.find_brightest() == pytest.approx(outside, abs=0.06)
    wide = Grid.box((-1.2, 0), (-0.4, 0.4), (0.4, 0.8), 0.1)
    assert "half a wall beyond" in find_refusal(method, confocal(), wide)


CURVED, UNEVEN, TWICE = wall_at(), wall_at(), wall_at()
CURVED[..., 2] = 0.1 * CURVED[..., 0] ** 2
UNEVEN[:, 3] += [0.02, 0, 0]
TWICE[0, 1] = TWICE[0, 0]


@named
@pytest.mark.parametrize(
    ("wall", "laser", "reason"),
    [
        (CURVED, CURVED, "lattice"),
        (UNEVEN, UNEVEN, "lattice"),
        (np.zeros_like(CURVED), np.zeros_like(CURVED), "lattice"),
        (TWICE, TWICE, "two wall points stand in one place"),
        (wall_at(), wall_at()[0, 0], "confocal scan is needed"),
        (wall_at(), wall_at()[::-1], "confocal scan is needed"),
    ],
)
def test_what_is_no_confocal_lattice_is_refused(method, wall, laser, reason):
    capture = replace(confocal(), wall=wall, laser=laser)
    assert reason in find_refusal(method, capture, near())
    with pytest.raises(InputError, match=reason):
        method.reconstruct(capture, near())
    assert not find_refusal(method, confocal(), near())


@named
def test_ten_gigabytes_are_refused_before_they_are_allocated(method):
    wall = Plane(*[np.linspace(-1, 1, 80)] * 2, 0.0).points
    # A record that starts 200 m late has as many empty bins before it.
    capture = Capture(np.zeros((2, 80, 80)), wall, wall, 32e-12, start=200.0)
    grid = Grid.box((0, 0.1), (0, 0.1), (0.5, 0.6), 0.1)
    assert "GiB allowed" in find_refusal(method, capture, grid)


def test_the_light_cone_transform_reads_depths_to_a_fraction_of_a_bin():
    """A sample of u = z^2 is the mean over an interval and stands for its middle: half a sample is
    more than half a bin near the wall.
    """
    axis = TimeAxis(bins=48, bin_width=160e-12)
    errors = []
    for depth in np.arange(0.40, 0.60, 0.017):
        depths = depth + 0.002 * np.arange(-40, 41)
        capture, grid = (
            confocal([(X[13], Y[11], depth)], axis=axis),
            Grid(X[13:14], Y[11:12], depths),
        )
        line = LightCone().reconstruct(capture, grid).values[:, 0, 0]
        bright = np.where(line > line.max() / 2, line, 0)
        errors.append(np.sum(bright * depths) / np.sum(bright) - depth)
    assert abs(np.mean(errors)) < 0.2 * axis.spacing / 2


def test_the_filter_is_wiener_s():
    random = np.random.default_rng(0)
    quarter = random.standard_normal((3, 3, 4)) + 1j * random.standard_normal((3, 3, 4))
    spectrum = np.ones((4, 4, 4), np.complex64)
    apply_wiener_filter(spectrum, quarter.astype(np.complex64), 0.5)
    expected = quarter.conj() / (np.abs(quarter) ** 2 + 2)
    assert_allclose(spectrum[:3, :3], expected, rtol=1e-5)
    assert_allclose(spectrum[3, 3], expected[1, 1], rtol=1e-5)


def test_migration_keeps_the_sign_of_signals_below_the_background():
    """A wave of opposite signs on the two halves of the wall cancels in the middle."""
    wall = wall_at() - [X.mean(), 0, 0]
    capture, sides = confocal([(0.0, Y[11], 0.6)], wall), np.sign(np.round(wall[..., 0], 9))
    grid = Grid([0.0], Y[11:12], np.linspace(0.5, 0.7, 11))
    bright, opposed = (
        FKMigration().reconstruct(replace(capture, signal=signal), grid).values.max()
        for signal in (capture.signal, capture.signal * sides)
    )
    assert opposed < 0.01 * bright
