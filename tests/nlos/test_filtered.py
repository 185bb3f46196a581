from __future__ import annotations

import numpy as np
import pytest
from refusals import find_refusal
from relay_walls import AXIS, HIDDEN, JITTER, curved_wall, lasers_for

from nlos import Capture, FilteredBackprojection, Grid
from nlos.backprojection import Weighting, _apply_laplacian, backproject_signals
from nlos.band import Waveforms
from nlos.method import ignore_progress
from nlos.simulate import PointScene
from tofclip.errors import InputError

GRID = Grid.box((-0.25, 0.35), (-0.4, 0.2), (0.45, 0.8), 0.05)
METHOD = FilteredBackprojection(sigma=0.05)


@pytest.mark.parametrize("laser", ["single", "confocal", "paired"])
def test_a_hidden_point_comes_back_where_it_is(laser: str) -> None:
    wall = curved_wall()
    capture = PointScene([HIDDEN]).simulate_capture(wall, lasers_for(wall)[laser], AXIS, JITTER)
    done: list[int] = []
    volume = METHOD.reconstruct(capture, GRID, done.append)
    assert volume.values.dtype == np.float32
    assert volume.values.min() == 0
    assert volume.find_brightest() == pytest.approx(HIDDEN)
    assert sum(done) == METHOD.plan(capture, GRID).cost
    assert volume.provenance["imaging"]["sigma_m"] == 0.05


def test_unfiltered_signals_are_read_between_bins_and_nowhere_else() -> None:
    """One wall point, one voxel: the signal at the path between them, interpolated by hand."""
    wall = np.array([[0.0, 0, 0], [5.0, 0, 0]])
    signal = np.random.default_rng(1).uniform(1, 2, (AXIS.bins, 2)).astype(np.float32)
    signal[:, 1] = 0
    capture = Capture(signal, wall, [0.2, 0, 0], AXIS.bin_width, AXIS.start)
    depths = 0.2 + 0.01 * np.arange(120)
    grid = Grid([0.0], [0.0], depths)
    path = depths + np.hypot(depths, 0.2)
    expected = np.interp(path, AXIS.paths, signal[:, 0])
    inside = (path > AXIS.start) & (path < AXIS.paths[-1])

    def unfiltered(traces: np.ndarray) -> Waveforms:
        values = np.pad(traces, ((0, 0), (1, 2))).astype(np.complex64)
        return Waveforms(values, AXIS.start - AXIS.spacing, AXIS.spacing)

    found = backproject_signals(capture, grid, unfiltered, 10, Weighting(0.0), ignore_progress)[
        :, 0, 0
    ].real
    # float32 paths are good to 1e-7 m of 5e-3.
    assert found[inside] == pytest.approx(expected[inside], abs=1e-3)
    far = (path < AXIS.start - AXIS.spacing) | (path > AXIS.paths[-1] + AXIS.spacing)
    assert np.all(found[far] == 0)


def test_the_laplacian_is_that_of_metres() -> None:
    """Of a quadratic volume it is a constant, whatever the voxels' shape."""
    grid = Grid(0.01 * np.arange(41), 0.008 * np.arange(51), 0.005 * np.arange(81))
    z, y, x = np.meshgrid(grid.z, grid.y, grid.x, indexing="ij")
    values = (3 * x**2 + 5 * y**2 + 7 * z**2).astype(np.float32)
    found = _apply_laplacian(values, grid, 0.02)[40, 25, 20]
    # A Gaussian of two to four voxels, sampled: errs by less than a percent.
    assert found == pytest.approx(-(0.02**2) * 2 * (3 + 5 + 7), rel=0.01)
    single = Grid([0.0], grid.y, grid.z)
    assert _apply_laplacian(values[..., :1], single, 0.02)[40, 25, 0] == pytest.approx(
        -(0.02**2) * 2 * 12, rel=0.01
    )


def test_uneven_voxels_and_nonsense_are_refused(capture: Capture) -> None:
    uneven = Grid([0.0, 0.1, 0.3], [0.0, 0.1], [0.5, 0.6])
    assert "evenly spaced voxels" in find_refusal(METHOD, capture, uneven)
    with pytest.raises(InputError, match="evenly spaced"):
        METHOD.reconstruct(capture, uneven)
    for sigma in (0, -1, np.nan):
        with pytest.raises(InputError, match="sigma"):
            FilteredBackprojection(sigma)
