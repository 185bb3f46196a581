from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from exact_phasor_field import compute_exact_phasor_field
from hypothesis import given, settings
from hypothesis import strategies as st
from refusals import find_refusal
from relay_walls import AXIS, HIDDEN, JITTER, curved_wall, planar_wall
from sampled_diffraction import diffract_by_convolution

import nlos.phasor.depth_steps
import nlos.phasor.to_depths_compiled
from nlos import Backprojection, Capture, Grid, PlanarRSD
from nlos.capture import TimeAxis
from nlos.illumination import build_waves, choose_unaliased_band, group_by_illumination
from nlos.phasor.propagate import CompiledBackend
from nlos.plane import Plane
from nlos.simulate import PointScene
from tofclip.errors import InputError, ShapeError

# Not centred on the wall, voxels finer than the wall's points along x and coarser along y, depths
# unevenly spaced. Longer than any path of GRID, so that the exact sum sees no echo of the record.
LONG = TimeAxis(560, AXIS.bin_width, 0.4)
GRID = Grid(np.arange(-0.3, 0.42, 0.05), np.arange(-0.4, 0.25, 0.06), [0.45, 0.5, 0.56, 0.65, 0.8])
pytestmark = pytest.mark.filterwarnings(
    "ignore::nlos.illumination.AliasingWarning"
)  # small walls are coarse ones
METHOD = PlanarRSD(wavelength=0.125, cycles=3)
SPOTS = np.array([[0.12, 0.05, 0.0], [-0.3, 0.2, 0.0]])


def relative_error(found: np.ndarray, expected: np.ndarray) -> float:
    return float(np.linalg.norm(found - expected) / np.linalg.norm(expected))


def scene(laser: str, wall: np.ndarray | None = None) -> Capture:
    """Three hidden points before a wall, lit from one spot, from two, or confocally."""
    wall = planar_wall() if wall is None else wall
    points = PointScene([HIDDEN, (-0.2, 0.1, 0.75), (0.05, -0.05, 0.5)], [1.0, 0.6, 0.3])
    if laser == "single":
        return points.simulate_capture(wall, SPOTS[0], LONG, JITTER)
    if laser == "confocal":
        return points.simulate_capture(wall, wall, LONG, JITTER)
    walls = np.stack([wall, wall])
    return points.simulate_capture(
        walls, np.broadcast_to(SPOTS[:, None, None], walls.shape), LONG, JITTER
    )


@pytest.mark.parametrize("laser", ["single", "two spots", "confocal"])
@pytest.mark.parametrize("tolerance", [1e-2, 1e-3])
def test_it_equals_the_exact_sum_within_the_tolerance(laser: str, tolerance: float) -> None:
    capture = scene(laser)
    found = replace(METHOD, tolerance=tolerance).phasor_field(capture, GRID).values
    exact = compute_exact_phasor_field(capture, GRID, METHOD.pulse).values
    assert found.dtype == np.complex64
    # No scale factor is fitted: amplitude and phase are those of the definition.
    assert relative_error(found, exact) < tolerance


def test_it_shows_what_backprojection_shows() -> None:
    capture = scene("single")
    found, expected = (
        METHOD.reconstruct(capture, GRID),
        Backprojection(0.125, 3).reconstruct(capture, GRID),
    )
    assert found.values.dtype == np.float32
    assert found.find_brightest() == expected.find_brightest()
    assert relative_error(found.values, expected.values) < 1e-2


@settings(max_examples=10, deadline=None)
@given(
    x=st.floats(-0.4, 0.4), y=st.floats(-0.35, 0.35), z=st.floats(0.4, 0.9), confocal=st.booleans()
)
def test_any_hidden_point_is_found_to_the_voxel(
    x: float, y: float, z: float, confocal: bool
) -> None:
    wall = planar_wall()
    axis = TimeAxis(500, AXIS.bin_width, 0.4)  # long enough for every path
    capture = PointScene([[x, y, z]]).simulate_capture(
        wall, wall if confocal else SPOTS[0], axis, JITTER
    )
    around = Grid(
        x + 0.04 * np.arange(-3, 4), y + 0.04 * np.arange(-3, 4), z + 0.03 * np.arange(-3, 4)
    )
    assert METHOD.reconstruct(capture, around).find_brightest() == pytest.approx((x, y, z))


def test_the_sampled_wave_is_the_exact_sum() -> None:
    wall = planar_wall(9, 11)
    capture = PointScene([HIDDEN]).simulate_capture(
        wall, wall, TimeAxis(900, AXIS.bin_width, 0.4), JITTER
    )
    grid = Grid(wall[0, :8, 0] + 0.31, wall[:7, 0, 1] - 0.1, [0.3, 0.6])
    band, (part,) = (
        choose_unaliased_band(capture, grid, METHOD.pulse),
        group_by_illumination(capture),
    )
    plane = Plane(wall[0, :, 0], wall[:, 0, 1], 0.0)
    values = CompiledBackend(band).compute_phasors(capture, part).reshape(9, 11, -1)
    found = diffract_by_convolution(
        values, plane, grid, build_waves(part, band, continued=False)
    ).sum(axis=0)
    # The phasors are float32.
    assert (
        relative_error(found, compute_exact_phasor_field(capture, grid, METHOD.pulse).values) < 1e-5
    )
    assert relative_error(METHOD.phasor_field(capture, grid).values, found) < 1e-2
    with pytest.raises(InputError, match="as far from each other"):
        diffract_by_convolution(values, plane, GRID, build_waves(part, band, continued=False))


def test_a_coarse_wall_shows_the_same_ghosts_as_the_exact_sum() -> None:
    """Points two wavelengths apart: the spectrum repeats itself inside the waves that travel."""
    wall = planar_wall(5, 6)
    capture = PointScene([HIDDEN]).simulate_capture(wall, SPOTS[0], LONG, JITTER)
    found = METHOD.phasor_field(capture, GRID).values
    assert (
        relative_error(found, compute_exact_phasor_field(capture, GRID, METHOD.pulse).values) < 1e-2
    )


def test_a_wide_field_of_view_needs_no_wider_wall() -> None:
    capture = PointScene([HIDDEN]).simulate_capture(
        planar_wall(), SPOTS[0], TimeAxis(1100, AXIS.bin_width, 0.4), JITTER
    )
    wide = Grid(np.linspace(-1.2, 1.2, 13), np.linspace(-1.2, 1.2, 13), [0.5, 0.7])
    found = METHOD.phasor_field(capture, wide).values
    assert (
        relative_error(found, compute_exact_phasor_field(capture, wide, METHOD.pulse).values) < 1e-2
    )


def test_light_from_outside_the_record_stays_dark() -> None:
    capture = scene("single")
    far = Grid(np.linspace(-0.2, 0.2, 5), np.linspace(-0.2, 0.2, 5), [5.0, 5.2])
    brightest = METHOD.reconstruct(capture, GRID).values.max()
    # The band's edge, where the pulse's spectrum is cut at 1 %, rings that far.
    assert METHOD.reconstruct(capture, far).values.max() < 2e-2 * brightest


def test_a_single_voxel_and_a_single_row() -> None:
    capture = scene("single")
    whole = METHOD.phasor_field(capture, GRID).values
    row = METHOD.phasor_field(capture, Grid(GRID.x, GRID.y[3:4], GRID.z[3:4])).values
    voxel = METHOD.phasor_field(capture, Grid(GRID.x[9:10], GRID.y[3:4], GRID.z[3:4])).values
    size = np.abs(whole).max()
    assert np.abs(row[0, 0] - whole[3, 3]).max() < 1e-2 * size
    assert abs(voxel[0, 0, 0] - whole[3, 3, 9]) < 1e-2 * size


def test_both_ways_back_from_the_spectrum_agree(monkeypatch: pytest.MonkeyPatch) -> None:
    capture = scene("single")
    for grid in (
        GRID,
        Grid(GRID.x[::4], GRID.y[::3], GRID.z),
        Grid(np.arange(-0.2, 0.2, 0.01), GRID.y, GRID.z[:1]),
    ):
        fields = []
        # Matrix products, Fourier transforms, and a few spectra of these at a time.
        for rate, cache in ((0, 1 << 19), (np.inf, 1 << 19), (0, 12_000), (np.inf, 12_000)):
            monkeypatch.setattr(nlos.phasor.to_depths_compiled, "PRODUCT_SPEEDUP", rate)
            monkeypatch.setattr(nlos.phasor.to_depths_compiled, "CACHE_BYTES", cache)
            fields.append(METHOD.phasor_field(capture, grid).values)
        assert all(relative_error(field, fields[0]) < 1e-5 for field in fields)


def paired(wall: np.ndarray) -> Capture:
    return PointScene([HIDDEN]).simulate_capture(
        wall, wall[::-1] + np.array([0.01, 0.0, 0.0]), LONG, JITTER
    )


UNEVEN = planar_wall()
UNEVEN[:, 4, 0] += 0.02


@pytest.mark.parametrize(
    ("capture", "grid", "reason"),
    [
        (scene("single", curved_wall()), GRID, "not a plane"),
        (scene("single", UNEVEN), GRID, "not evenly spaced along x"),
        (paired(planar_wall()), GRID, "laser spots"),
        (
            scene("single"),
            Grid([0.0, 0.1, 0.3], GRID.y, GRID.z),
            "voxels are not evenly spaced along x",
        ),
        (scene("single"), Grid(GRID.x, GRID.y, [0.0, 0.5]), "must begin in front of the wall"),
        (scene("single", planar_wall(1, 30)), GRID, "two different y"),
    ],
)
def test_what_cannot_be_imaged_is_refused(capture: Capture, grid: Grid, reason: str) -> None:
    assert reason in find_refusal(METHOD, capture, grid)
    with pytest.raises(InputError, match=reason):
        METHOD.reconstruct(capture, grid)


def test_too_many_plane_waves_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(nlos.phasor.depth_steps, "MEMORY_LIMIT_BYTES", 1 << 16)
    assert "plane waves" in find_refusal(METHOD, scene("single"), GRID)


def test_a_senseless_tolerance_is_refused() -> None:
    for tolerance in (0, 1, np.nan):
        with pytest.raises(InputError, match="tolerance"):
            PlanarRSD(0.125, tolerance=tolerance)


def test_planes_are_checked() -> None:
    with pytest.raises(ShapeError, match="axis x"):
        Plane([0.0], [0.0, 1.0], 0.0)
    for x in ([0.0, 1.0, 3.0], [1.0, 0.0], [0.0, np.nan]):
        with pytest.raises(InputError, match="evenly spaced"):
            Plane(x, [0.0, 1.0], 0.0)
    with pytest.raises(InputError, match="finite z"):
        Plane([0.0, 1.0], [0.0, 1.0], np.inf)
    assert Plane([0.0, 1.0], [0.0, 2.0, 4.0], 0.5).points[2, 1].tolist() == [1.0, 4.0, 0.5]
