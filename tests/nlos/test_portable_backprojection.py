from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from portable_libraries import LIBRARIES, find_device, relative_error
from relay_walls import AXIS, HIDDEN, JITTER, curved_wall, lasers_for

import nlos.backprojection_arrays
from nlos import Backprojection, Capture, Grid
from nlos.backprojection import Weighting
from nlos.backprojection_arrays import BYTES_PER_PAIR
from nlos.phasor.arrays import ArrayLibrary
from nlos.simulate import PointScene
from tofclip.arrays import to_numpy

pytestmark = pytest.mark.filterwarnings(
    "ignore::nlos.illumination.AliasingWarning"
)  # small walls are coarse ones

# Odd sizes, unevenly spaced; the record (paths up to 1.63 m) ends before the farthest voxels.
GRID = Grid(
    np.array([-0.3, -0.1, 0.05, 0.15, 0.4]),
    np.linspace(-0.4, 0.3, 7),
    np.array([0.05, 0.4, 0.65, 1.2]),
)
METHOD = Backprojection(wavelength=0.15)
AGREEMENT = 2e-5
"""Paths in single precision, to a thousandth of a sample, 1e-4 of a wave; measured 1e-6 to 5e-6."""


def scene(laser: str) -> Capture:
    wall = curved_wall(9, 11)
    return PointScene([HIDDEN, (-0.2, 0.1, 0.5)]).simulate_capture(
        wall, lasers_for(wall)[laser], AXIS, JITTER
    )


@pytest.mark.parametrize("library", LIBRARIES)
@pytest.mark.parametrize("laser", ["single", "confocal", "paired"])
def test_the_field_is_that_of_the_compiled_loop(laser: str, library: str) -> None:
    capture = scene(laser)
    expected, found = (
        METHOD.phasor_field(capture, GRID),
        METHOD.phasor_field(capture.on(find_device(library)), GRID),
    )
    assert found.device == find_device(library)
    assert found.provenance == expected.provenance
    assert relative_error(found.values, expected.values) < AGREEMENT
    brightest = METHOD.reconstruct(capture.on(find_device(library)), GRID).find_brightest()
    assert brightest == METHOD.reconstruct(capture, GRID).find_brightest()


@pytest.mark.parametrize("weighting", [Weighting(0.0), Weighting(1.0, 1.0), Weighting(2.5, 0.5)])
def test_weights_are_those_of_the_compiled_loop(weighting: Weighting) -> None:
    capture, method = scene("paired"), replace(METHOD, weighting=weighting)
    for library in LIBRARIES:
        found = method.phasor_field(capture.on(find_device(library)), GRID).values
        assert relative_error(found, method.phasor_field(capture, GRID).values) < AGREEMENT


def test_a_voxel_on_the_wall_and_masked_points() -> None:
    capture = scene("single")
    wall = capture.wall.copy()
    wall[2, 3] = np.nan
    masked, touching = (
        replace(capture, wall=wall),
        Grid(*(np.array([c]) for c in capture.wall[4, 5])),
    )
    for grid in (GRID, touching):
        found = METHOD.phasor_field(
            masked.on(find_device("torch")), replace(grid, z=np.maximum(grid.z, 0.04))
        )
        expected = METHOD.phasor_field(masked, found.grid)
        # A lone voxel hears the point that it touches and no other, with that one's error.
        assert relative_error(found.values, expected.values) < 5 * AGREEMENT


@pytest.mark.parametrize("laser", ["single", "paired"])
def test_pieces_make_up_the_whole_and_progress_counts_them(
    laser: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    capture = scene(laser).on(find_device("array_api_strict"))
    whole = to_numpy(METHOD.phasor_field(capture, GRID).values)
    counted: list[int] = []
    for table, pairs in ((1 << 20, 40), (1, 1 << 20), (1 << 20, 1)):
        monkeypatch.setattr(nlos.backprojection_arrays, "TABLE_BYTES", table)
        monkeypatch.setattr(ArrayLibrary, "chunk_bytes", pairs * BYTES_PER_PAIR)
        counted.clear()
        found = METHOD.phasor_field(
            capture, Grid(GRID.x, GRID.y, GRID.z[1:2]), counted.append
        ).values
        assert relative_error(found, whole[1:2]) < 1e-6
        assert sum(counted) == len(capture.points) * GRID.size // GRID.z.size
        assert len(counted) > 10
