from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from exact_phasor_field import compute_exact_phasor_field
from hypothesis import given, settings
from hypothesis import strategies as st
from relay_walls import AXIS, HIDDEN, JITTER, curved_wall, lasers_for, planar_wall

import nlos.backprojection
from nlos import Backprojection, Capture, Grid
from nlos.backprojection import Weighting
from nlos.band import Band
from nlos.capture import TimeAxis
from nlos.simulate import PointScene
from tofclip.errors import InputError

# The walls here are coarser than the shortest of the pulse's waves wants; see test_sampling.py.
pytestmark = pytest.mark.filterwarnings("ignore::nlos.illumination.AliasingWarning")

METHOD = Backprojection(wavelength=0.125, cycles=3)
# Odd sizes, none of them a multiple of the brick, and HIDDEN among the voxels.
GRID = Grid.box((-0.25, 0.35), (-0.4, 0.2), (0.45, 0.8), 0.05)


def relative_error(found: np.ndarray, expected: np.ndarray) -> float:
    return float(np.linalg.norm(found - expected) / np.linalg.norm(expected))


@pytest.mark.parametrize("wall", [planar_wall(), curved_wall()], ids=["planar", "curved"])
@pytest.mark.parametrize("laser", ["single", "confocal", "paired"])
def test_a_hidden_point_comes_back_where_it_is(wall: np.ndarray, laser: str) -> None:
    capture = PointScene([HIDDEN]).simulate_capture(wall, lasers_for(wall)[laser], AXIS, JITTER)
    volume = METHOD.reconstruct(capture, GRID)
    assert volume.values.dtype == np.float32
    assert volume.values.shape == (GRID.z.size, GRID.y.size, GRID.x.size)
    z, y, x = np.unravel_index(volume.values.argmax(), volume.values.shape)
    assert (GRID.x[x], GRID.y[y], GRID.z[z]) == pytest.approx(HIDDEN)


@settings(max_examples=15, deadline=None)
@given(
    x=st.floats(-0.4, 0.4), y=st.floats(-0.35, 0.35), z=st.floats(0.4, 0.9), confocal=st.booleans()
)
def test_any_hidden_point_is_found_to_the_voxel(
    x: float, y: float, z: float, confocal: bool
) -> None:
    wall = curved_wall()
    axis = TimeAxis(500, AXIS.bin_width, 0.4)  # long enough for every path
    capture = PointScene([[x, y, z]]).simulate_capture(
        wall, wall if confocal else [0.12, 0.05, 0.01], axis, JITTER
    )
    around = Grid(
        x + 0.04 * np.arange(-3, 4), y + 0.04 * np.arange(-3, 4), z + 0.03 * np.arange(-3, 4)
    )
    # Voxels of a third and a quarter of a wavelength: neighbours are clearly weaker.
    assert METHOD.reconstruct(capture, around).find_brightest() == pytest.approx((x, y, z))


@pytest.mark.parametrize("laser", ["single", "confocal", "paired"])
@pytest.mark.parametrize("cycles", [3, 5])
def test_it_equals_the_exact_sum_over_frequencies(laser: str, cycles: float) -> None:
    wall = curved_wall(9, 12)
    scene = PointScene([HIDDEN, (-0.2, 0.1, 0.75)], [1.0, 0.6])
    capture = scene.simulate_capture(wall, lasers_for(wall)[laser], AXIS, JITTER)
    method = replace(METHOD, cycles=cycles)
    found = method.phasor_field(capture, GRID).values
    exact = compute_exact_phasor_field(capture, GRID, method.pulse).values
    assert found.dtype == np.complex64
    assert exact.dtype == np.complex128
    # Linear interpolation of 64 samples per wavelength: phase step 0.1, error 0.1^2 * 0.09 at the
    # carrier and some twice that over the band; measured 5e-4 to 7e-4. float32 phases add 1e-5.
    assert relative_error(found, exact) < 1.2e-3


def test_the_exact_sum_is_its_own_definition() -> None:
    wall = curved_wall(3, 3)
    capture = PointScene([HIDDEN]).simulate_capture(wall, [0.1, 0.0, 0.0], AXIS, JITTER)
    voxel = np.array([0.1, -0.1, 0.6])
    grid = Grid([voxel[0]], [voxel[1]], [voxel[2]])
    found = compute_exact_phasor_field(capture, grid, METHOD.pulse).values[0, 0, 0]
    band, expected = Band(METHOD.pulse, AXIS), 0.0j
    for point, trace in zip(capture.points, capture.traces().astype(np.float64), strict=True):
        last_leg = np.linalg.norm(point - voxel)
        path = last_leg + np.linalg.norm(capture.laser - voxel)
        for k, weight in zip(band.wavenumbers, band.weights, strict=True):
            phasor = weight * np.sum(trace * np.exp(-1j * k * AXIS.paths))
            expected += phasor * np.exp(1j * k * path) / last_leg
    assert found == pytest.approx(expected, rel=1e-9)


def test_signals_in_double_precision_give_the_same_picture(capture: Capture) -> None:
    double = replace(capture, signal=capture.signal.astype(np.float64))
    assert np.array_equal(
        METHOD.reconstruct(double, GRID).values, METHOD.reconstruct(capture, GRID).values
    )


def test_the_volume_may_be_cut_into_pieces(capture: Capture) -> None:
    whole = METHOD.phasor_field(capture, GRID).values
    for z in range(GRID.z.size):
        plane = METHOD.phasor_field(capture, Grid(GRID.x, GRID.y, GRID.z[z : z + 1])).values
        assert np.array_equal(plane[0], whole[z])


def test_small_batches_of_wall_points_add_up(
    capture: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = METHOD.phasor_field(capture, GRID).values
    monkeypatch.setattr(nlos.backprojection, "TABLE_BYTES", 1)
    for laser in (capture.laser, capture.wall):
        same_spot = replace(capture, laser=laser)
        one_by_one = METHOD.phasor_field(same_spot, GRID).values
        monkeypatch.setattr(nlos.backprojection, "TABLE_BYTES", 1 << 25)
        assert relative_error(one_by_one, METHOD.phasor_field(same_spot, GRID).values) < 1e-5
        monkeypatch.setattr(nlos.backprojection, "TABLE_BYTES", 1)
    assert np.any(whole)


def test_voxels_that_no_recorded_light_can_come_from_stay_dark(capture: Capture) -> None:
    far = Grid.box((-0.2, 0.2), (-0.2, 0.2), (5.0, 5.2), 0.1)
    assert np.all(METHOD.reconstruct(capture, far).values == 0)


def test_voxels_on_the_wall_stay_finite(capture: Capture) -> None:
    touching = Grid(planar_wall()[0, :, 0], planar_wall()[:, 0, 1], [0.0, 0.1])
    assert np.all(np.isfinite(METHOD.reconstruct(capture, touching).values))


@pytest.mark.parametrize(("wavelength", "cycles"), [(0, 3), (0.1, -1), (np.nan, 3)])
def test_the_pulse_is_checked_at_once(wavelength: float, cycles: float) -> None:
    with pytest.raises(InputError, match="virtual pulse"):
        Backprojection(wavelength, cycles)


def test_a_long_path_keeps_its_phase_in_float32() -> None:
    """A record that begins 300 m down the path: phases of 15 000 rad, of which float32 keeps less
    than 1e-3.
    """
    wall = curved_wall(7, 8)
    near = PointScene([HIDDEN]).simulate_capture(wall, [0.1, 0.0, 0.0], AXIS, JITTER)
    shift = np.array([0.0, 0.0, 150.0])
    far_axis = TimeAxis(AXIS.bins, AXIS.bin_width, 300.0)
    far = PointScene([HIDDEN + shift]).simulate_capture(wall, [0.1, 0.0, 0.0], far_axis, JITTER)
    grid = Grid(GRID.x, GRID.y, HIDDEN[2] + 150.0 + 0.05 * np.arange(-3, 4))
    found = METHOD.phasor_field(far, grid).values
    exact = compute_exact_phasor_field(far, grid, METHOD.pulse).values
    assert near.signal.any()
    assert far.signal.any()
    # Distances of 150 m in float32 are good to 8e-6 m each way, 8e-4 rad at this wavelength.
    assert relative_error(found, exact) < 3e-3


@pytest.mark.parametrize(("falloff", "obliquity"), [(0, 0), (1, 1), (2, 0.5)])
def test_weights_are_powers_of_distance_and_direction(
    falloff: float, obliquity: float, capture: Capture
) -> None:
    """One wall point at a time, so that the weight is a factor of the whole field."""
    weighted = replace(METHOD, weighting=Weighting(falloff, obliquity))
    signal = np.zeros_like(capture.signal)
    signal[:, 4, 7] = capture.signal[:, 4, 7]
    lone = replace(capture, signal=signal)
    plain, found = METHOD.phasor_field(lone, GRID).values, weighted.phasor_field(lone, GRID).values
    z, y, x = np.meshgrid(GRID.z, GRID.y, GRID.x, indexing="ij")
    away = np.stack([x, y, z], axis=-1) - capture.wall[4, 7]
    distance = np.linalg.norm(away, axis=-1)
    expected = plain * distance ** (1 - falloff) * (away[..., 2] / distance) ** obliquity
    assert np.any(expected)
    # Products of float32.
    assert relative_error(found, expected) < 1e-5


def test_weights_are_checked() -> None:
    for wrong in ((np.nan, 0), (1, -1), (1, np.inf)):
        with pytest.raises(InputError, match="weights"):
            Weighting(*wrong)


def test_all_lasers_of_a_grid_are_summed_as_if_each_were_alone() -> None:
    wall = curved_wall(7, 8)
    lasers = np.array([[[0.1, 0.0, 0.0], [-0.2, 0.1, 0.0]], [[0.0, -0.3, 0.0], [0.3, 0.3, 0.0]]])
    alone = [
        PointScene([HIDDEN]).simulate_capture(wall, spot, AXIS, JITTER)
        for spot in lasers.reshape(-1, 3)
    ]
    signal = np.stack([one.signal for one in alone], axis=1).reshape(AXIS.bins, 2, 2, 7, 8)
    together = Capture.exhaustive(signal, wall, lasers, AXIS.bin_width, AXIS.start)
    field = METHOD.phasor_field(together, GRID).values
    assert relative_error(field, sum(METHOD.phasor_field(one, GRID).values for one in alone)) < 1e-5
    assert (
        relative_error(field, compute_exact_phasor_field(together, GRID, METHOD.pulse).values)
        < 1.2e-3
    )
    assert METHOD.reconstruct(together, GRID).find_brightest() == pytest.approx(HIDDEN)
