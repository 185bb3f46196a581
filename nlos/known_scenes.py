"""Known hidden scenes: their settings, the capture that an instrument would make of them, the truth
that travels in its file, and how well an image shows it.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from nlos.capture import Capture, TimeAxis
from nlos.settings import MATERIALS, SCANS, SceneSettings
from nlos.simulate import (
    HiddenScene,
    Lambert,
    Material,
    PointScene,
    Retroreflector,
    Surface,
    add_poisson_noise,
    build_relay_wall,
)
from nlos.volume import Grid, Volume
from tofclip.arrays import BoolArray, FloatArray
from tofclip.errors import InputError, require, require_positive
from tofclip.storage import Record, Storable, is_own_file, stored_array, stored_value
from tofclip.units import SPEED_OF_LIGHT

# Room for the instrument's response behind the farthest path, in standard deviations.
RESPONSE_SIGMAS = 6
# m; light so close to a hidden thing counts as its own, if voxels are not larger.
TRUTH_RADIUS_M = 0.04


def simulate_scene(settings: SceneSettings) -> tuple[Capture, HiddenTruth]:
    """Simulate the capture that settings describe, and say where things are hidden."""
    if settings.scan not in SCANS:
        raise InputError(f"no scan is called '{settings.scan}'; choose {' or '.join(SCANS)}")
    if settings.background and settings.peak_counts is None:
        raise InputError("a background goes with photon noise: give the peak counts as well")
    scene, truth = _build_hidden_scene(settings)
    wall = build_relay_wall(settings.wall, settings.wall_points, settings.wall_width)
    laser = wall if settings.scan == "confocal" else find_nearest_wall_point(wall, settings.laser)
    axis = _choose_time_axis(wall, laser, truth.positions, settings)
    capture = scene.simulate_capture(wall, laser, axis, settings.jitter)
    if settings.peak_counts is not None:
        noise = settings.peak_counts, settings.background, settings.seed
        capture = add_poisson_noise(capture, *noise)
    return capture, truth


def _build_hidden_scene(settings: SceneSettings) -> tuple[HiddenScene | PointScene, HiddenTruth]:
    """Build what is hidden, and say where it is."""
    given = [name for name in ("letters", "points", "mesh") if getattr(settings, name) is not None]
    require(len(given) <= 1, f"{' and '.join(given)} cannot be hidden together; choose one of them")
    if settings.points is not None:
        points = PointScene(np.array(_parse_points(settings.points)))
        return points, HiddenTruth(points.positions, 0.0)
    materials: dict[str, Material] = {"matte": Lambert(), "retroreflecting": Retroreflector()}
    if settings.material not in materials:
        raise InputError(
            f"no material is called '{settings.material}'; choose {' or '.join(MATERIALS)}"
        )
    material, facet = materials[settings.material], settings.facet
    require_positive("the size of facets", 1e3 * facet, "number of millimetres")
    if settings.mesh is not None:
        surface = Surface.load(Path(settings.mesh), facet, material)
    else:
        letters = "T" if settings.letters is None else settings.letters
        centre = (0.0, 0.0, settings.depth)
        surface = Surface.letters(letters, centre, settings.height, facet, material)
    return HiddenScene([surface]), HiddenTruth(surface.positions, facet)


def _parse_points(text: str) -> list[list[float]]:
    """Read points written as X,Y,Z with semicolons between them."""
    try:
        points = [[*map(float, one.split(","))] for one in text.split(";") if one.strip()]
    except ValueError:
        points = []
    if not points or any(len(point) != 3 or not all(map(math.isfinite, point)) for point in points):
        raise InputError(
            f"points are given as X,Y,Z in m with semicolons between them, got '{text}'"
        )
    return points


def find_nearest_wall_point(wall: FloatArray, place: tuple[float, float]) -> FloatArray:
    """Return the point (3,) of a wall (..., 3), m, whose x and y are nearest to a place."""
    known = wall[np.isfinite(wall).all(axis=-1)]
    return known[np.argmin(np.linalg.norm(known[:, :2] - place, axis=1))]


def _choose_time_axis(
    wall: FloatArray, laser: FloatArray, hidden: FloatArray, settings: SceneSettings
) -> TimeAxis:
    """Choose a time axis from path 0 to beyond the farthest by way of anything hidden (n, 3), which
    leads by a corner of the box about it.
    """
    bin_width = settings.bin_width
    require_positive("the bin width", 1e12 * bin_width, "number of picoseconds")
    corners = itertools.product(*zip(hidden.min(axis=0), hidden.max(axis=0), strict=True))
    paths = [
        np.nanmax(np.linalg.norm(wall - corner, axis=-1) + np.linalg.norm(laser - corner, axis=-1))
        for corner in corners
    ]
    latest = max(paths) + RESPONSE_SIGMAS * SPEED_OF_LIGHT * settings.jitter
    return TimeAxis(int(np.ceil(latest / (SPEED_OF_LIGHT * bin_width))) + 1, bin_width)


@dataclass(frozen=True, eq=False)
class HiddenTruth(Storable):
    """Where hidden things scatter light; it travels inside the file of a simulated capture."""

    RECORD_KIND = "hidden_scene"

    # (n, 3), points, or the centres of facets, m
    positions: FloatArray = field(metadata=stored_array("m", "point", "xyz"))
    # distance of neighbouring facets, m; 0 for points
    spacing: float = field(metadata=stored_value("spacing_m"))

    def attach_to_record(self, capture: Capture) -> Record:
        """Put the truth into the record of its capture."""
        return replace(capture.to_record(), children={self.RECORD_KIND: self.to_record()})

    @classmethod
    def find(cls, path: Path) -> HiddenTruth | None:
        """Read the truth that a capture's file carries; None where there is none."""
        found = Record.load(path).children.get(cls.RECORD_KIND) if is_own_file(path) else None
        return None if found is None else cls.from_record(found)

    def mask_near(self, grid: Grid, reach: float) -> BoolArray:
        """Voxels (z, y, x) whose centres lie within `reach` m of something hidden."""
        require_positive("the reach about hidden things", reach, "number of metres")
        found, _ = cKDTree(self.positions).query(grid.points, distance_upper_bound=reach)
        return np.isfinite(found)


def compare_with_truth(volume: Volume, truth: HiddenTruth) -> dict[str, float]:
    """Fraction of the energy near hidden things (``energy_near_truth``), how much brighter it is
    there (``contrast_to_truth``), and how far near is (``truth_reach_m``).
    """
    axes = (volume.grid.x, volume.grid.y, volume.grid.z)
    # coarse voxels may have no centre within the radius
    reach = max([TRUTH_RADIUS_M, *(float(axis[1] - axis[0]) for axis in axes if axis.size > 1)])
    near, magnitude = truth.mask_near(volume.grid, reach), volume.magnitude.astype(np.float64)
    energy = float(np.sum(magnitude**2))
    around, elsewhere = (
        float(magnitude[some].mean()) if some.any() else math.nan for some in (near, ~near)
    )
    share = float(np.sum(magnitude[near] ** 2)) / energy if energy > 0 else math.nan
    contrast = around / elsewhere if elsewhere > 0 else math.nan
    return {"energy_near_truth": share, "contrast_to_truth": contrast, "truth_reach_m": reach}


def measure_sharpness(volume: Volume) -> float:
    """How far the light of the front view is gathered: 1 where it is even, the number of pixels
    where one has it all.

    ``pixels * sum(I^2) / sum(I)^2``: the first sharpness of R. A. Muller and A. Buffington, J. Opt.
    Soc. Am. 64, 1200 (1974), made free of scale. It compares images of one scene on one grid; it
    does not separate right from wrong.
    """
    front = volume.maximum_projection().brightness.astype(np.float64)
    total = float(front.sum())
    return front.size * float(np.sum(front**2)) / total**2 if total > 0 else math.nan


def correlate_views(one: Volume, other: Volume) -> float:
    """Pearson correlation of two volumes' front views, on grids of the same lateral shape."""
    first, second = (volume.maximum_projection().brightness.ravel() for volume in (one, other))
    return float(np.corrcoef(first, second)[0, 1])
