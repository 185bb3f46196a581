"""Back-projection, with a virtual pulse or with a Laplacian, against sums written out."""

from dataclasses import replace

import numpy as np
import pytest
from exact_phasor_field import compute_exact_phasor_field
from scenes import (
    AXIS,
    HIDDEN,
    JITTER,
    SPOTS,
    curved_wall,
    find_refusal,
    planar_wall,
    relative_error,
    see,
)

from nlos import Backprojection, Capture, FilteredBackprojection, Grid
from nlos.backprojection import Weighting, _apply_laplacian
from nlos.capture import TimeAxis

METHOD = Backprojection(wavelength=0.125, cycles=3)
# Odd sizes, none of them a multiple of the brick, and HIDDEN among the voxels.
GRID = Grid.box((-0.25, 0.35), (-0.4, 0.2), (0.45, 0.8), 0.05)


@pytest.mark.parametrize("laser", ["single", "confocal", "paired"])
@pytest.mark.parametrize("cycles", [3, 5])
def test_it_equals_the_exact_sum_over_frequencies(laser, cycles):
    capture = see([HIDDEN, (-0.2, 0.1, 0.75)], curved_wall(9, 12), laser, AXIS, JITTER, [1.0, 0.6])
    method = replace(METHOD, cycles=cycles)
    found = method.phasor_field(capture, GRID).values
    exact = compute_exact_phasor_field(capture, GRID, method.pulse).values
    assert (found.dtype, exact.dtype) == (np.complex64, np.complex128)
    # Linear interpolation of 64 samples per wavelength: phase step 0.1, error 0.1^2 * 0.09 at the
    # carrier and some twice that over the band; measured 5e-4 to 7e-4. float32 phases add 1e-5.
    assert relative_error(found, exact) < 1.2e-3


def test_the_volume_may_be_cut_into_pieces_and_the_signal_be_in_double_precision(
    capture,
):
    whole = METHOD.phasor_field(capture, GRID).values
    double = replace(capture, signal=capture.signal.astype(np.float64))
    assert np.array_equal(METHOD.phasor_field(double, GRID).values, whole)
    for z in range(GRID.z.size):
        plane = METHOD.phasor_field(capture, Grid(GRID.x, GRID.y, GRID.z[z : z + 1])).values
        assert np.array_equal(plane[0], whole[z])


def test_voxels_on_the_wall_stay_finite_and_those_beyond_the_record_dark(capture):
    far = Grid.box((-0.2, 0.2), (-0.2, 0.2), (5.0, 5.2), 0.1)
    assert np.all(METHOD.reconstruct(capture, far).values == 0)
    touching = Grid(planar_wall()[0, :, 0], planar_wall()[:, 0, 1], [0.0, 0.1])
    assert np.all(np.isfinite(METHOD.reconstruct(capture, touching).values))


def test_a_long_path_keeps_its_phase_in_float32():
    """A record that begins 300 m down the path: phases of 15 000 rad, of which float32 keeps less
    than 1e-3.
    """
    far_axis = TimeAxis(AXIS.bins, AXIS.bin_width, 300.0)
    far = see([HIDDEN + np.array([0, 0, 150.0])], curved_wall(7, 8), [0.1, 0.0, 0.0], far_axis)
    grid = Grid(GRID.x[2::4], GRID.y[::4], HIDDEN[2] + 150.0 + 0.1 * np.arange(-1, 2))
    exact = compute_exact_phasor_field(far, grid, METHOD.pulse).values
    assert far.signal.any()
    # Distances of 150 m in float32 are good to 8e-6 m each way, 8e-4 rad at this wavelength.
    assert relative_error(METHOD.phasor_field(far, grid).values, exact) < 3e-3


@pytest.mark.parametrize(("falloff", "obliquity"), [(0, 0), (1, 1), (2, 0.5)])
def test_weights_are_powers_of_distance_and_direction(falloff, obliquity, capture):
    """One wall point at a time, so that the weight is a factor of the whole field."""
    weighted = replace(METHOD, weighting=Weighting(falloff, obliquity))
    signal = np.zeros_like(capture.signal)
    signal[:, 4, 7] = capture.signal[:, 4, 7]
    lone = replace(capture, signal=signal)
    plain, found = (one.phasor_field(lone, GRID).values for one in (METHOD, weighted))
    away = GRID.points - capture.wall[4, 7]
    distance = np.linalg.norm(away, axis=-1)
    expected = plain * distance ** (1 - falloff) * (away[..., 2] / distance) ** obliquity
    assert np.any(expected)
    assert relative_error(found, expected) < 1e-5  # products of float32


def test_all_lasers_of_a_grid_are_summed_as_if_each_were_alone():
    wall = curved_wall(7, 8)
    lasers = np.array([[SPOTS[0], [-0.2, 0.1, 0.0]], [[0.0, -0.3, 0.0], [0.3, 0.3, 0.0]]])
    alone = [see([HIDDEN], wall, spot) for spot in lasers.reshape(-1, 3)]
    signal = np.stack([one.signal for one in alone], axis=1).reshape(AXIS.bins, 2, 2, 7, 8)
    together = Capture.exhaustive(signal, wall, lasers, AXIS.bin_width, AXIS.start)
    field = METHOD.phasor_field(together, GRID).values
    assert relative_error(field, sum(METHOD.phasor_field(one, GRID).values for one in alone)) < 1e-5
    exact = compute_exact_phasor_field(together, GRID, METHOD.pulse).values
    assert relative_error(field, exact) < 1.2e-3
    assert METHOD.reconstruct(together, GRID).find_brightest() == pytest.approx(HIDDEN)


def test_the_laplacian_is_that_of_metres():
    """Of a quadratic volume it is a constant, whatever the voxels' shape."""
    grid = Grid(0.01 * np.arange(41), 0.008 * np.arange(51), 0.005 * np.arange(81))
    values = (grid.points**2 @ np.array([3, 5, 7])).astype(np.float32)
    found = _apply_laplacian(values, grid, 0.02)[40, 25, 20]
    # A Gaussian of two to four voxels, sampled: errs by less than a percent.
    assert found == pytest.approx(-(0.02**2) * 2 * (3 + 5 + 7), rel=0.01)
    flat = _apply_laplacian(values[..., :1], Grid([0.0], grid.y, grid.z), 0.02)[40, 25, 0]
    assert flat == pytest.approx(-(0.02**2) * 2 * 12, rel=0.01)


# --- filtered back-projection


def test_uneven_voxels_are_refused(capture):
    uneven = Grid([0.0, 0.1, 0.3], [0.0, 0.1], [0.5, 0.6])
    assert "evenly spaced voxels" in find_refusal(FilteredBackprojection(0.05), capture, uneven)
