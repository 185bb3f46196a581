"""A hidden scene before a relay wall, given by settings, and the capture that an instrument would
make of it.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from apps.nlos.truth import HiddenTruth
from apps.settings import setting_field
from nlos.capture import TimeAxis
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
from tofclip.errors import InputError
from tofclip.units import MILLIMETRE, PICOSECOND, SPEED_OF_LIGHT

if TYPE_CHECKING:
    from nlos import Capture
    from nlos.capture import TimeAxis
    from nlos.simulate import HiddenScene, PointScene, Surface
    from nlos.volume import FloatArray

SCANS = ("single", "confocal")
WALLS = ("planar", "cylinder", "wavy", "relief", "plates")
"""Named here as well as in `nlos.simulate`, which is too heavy to be imported for a verb's help."""

MATERIALS = ("matte", "retroreflecting")
RESPONSE_SIGMAS = 6
"""Room for the instrument's response behind the farthest path, in standard deviations."""


@dataclass(frozen=True)
class SceneSettings:
    """What is hidden, and how it is captured; None is chosen."""

    letters: str | None = setting_field(
        "TEXT", "Flat letters, as read from the wall.", shown="T, if nothing else is given"
    )
    points: str | None = setting_field(
        "'X,Y,Z; ...'", "Points that scatter evenly, in m.", shown="none"
    )
    mesh: str | None = setting_field(
        "FILE", "Triangle mesh (.ply, .obj, .stl) in m, in the wall's frame.", shown="none"
    )
    depth_m: float = setting_field("M", "Depth of the letters.", 1.0)
    height_m: float = setting_field("M", "Height of a capital letter.", 0.7)
    material: str = setting_field(
        "NAME", f"Of letters or mesh: {' or '.join(MATERIALS)}.", "matte", choices=MATERIALS
    )
    facet_mm: float = setting_field(
        "MM", "Size of the facets that letters or mesh are cut into.", 25.0
    )
    wall: str = setting_field(
        "NAME",
        "planar, cylinder, wavy, relief (hills) or plates (two, hanging apart).",
        "cylinder",
        choices=WALLS,
    )
    wall_points: int = setting_field("N", "Rows of wall points, and columns.", 48)
    wall_width_m: float = setting_field("M", "Width and height of the wall.", 2.0)
    scan: str = setting_field(
        "NAME", "single (one laser spot) or confocal.", "single", choices=SCANS
    )
    laser_m: tuple[float, float] = setting_field(
        "X Y", "Where the laser spot is, in m; the nearest wall point is taken.", (0.0, 0.0)
    )
    bin_width_ps: float = setting_field("PS", "Duration of a time bin.", 32.0)
    jitter_ps: float = setting_field("PS", "Standard deviation of the instrument's response.", 30.0)
    peak_counts: float | None = setting_field(
        "N", "Expected photons in the brightest bin.", shown="no noise"
    )
    background: float = setting_field(
        "N", "Expected background counts per bin, with --peak-counts.", 0.0
    )
    seed: int = setting_field("N", "Of the photons' chance.", 0)


def simulate_scene(settings: SceneSettings) -> tuple[Capture, HiddenTruth]:
    """Simulate the capture that settings describe."""
    if settings.scan not in SCANS:
        raise InputError(f"no scan is called '{settings.scan}'; choose {' or '.join(SCANS)}")
    if settings.background and settings.peak_counts is None:
        raise InputError("a background goes with photon noise: give the peak counts as well")
    scene, truth = build_hidden_scene(settings)
    wall = build_relay_wall(settings.wall, settings.wall_points, settings.wall_width_m)
    laser = wall if settings.scan == "confocal" else find_nearest_wall_point(wall, settings.laser_m)
    axis = choose_time_axis(
        wall,
        laser,
        truth.positions,
        settings.bin_width_ps * PICOSECOND,
        settings.jitter_ps * PICOSECOND,
    )
    capture = scene.simulate_capture(wall, laser, axis, settings.jitter_ps * PICOSECOND)
    if settings.peak_counts is None:
        return capture, truth
    return add_poisson_noise(
        capture, settings.peak_counts, settings.background, settings.seed
    ), truth


def build_hidden_scene(settings: SceneSettings) -> tuple[HiddenScene | PointScene, HiddenTruth]:
    """Build what is hidden, and say where it is."""
    given = [name for name in ("letters", "points", "mesh") if getattr(settings, name) is not None]
    if len(given) > 1:
        raise InputError(f"{' and '.join(given)} cannot be hidden together; choose one of them")
    if settings.points is not None:
        points = PointScene(np.array(_parse_points(settings.points)))
        return points, HiddenTruth(points.positions, 0.0)
    surface = _build_surface(settings)
    return HiddenScene([surface]), HiddenTruth(surface.positions, settings.facet_mm * MILLIMETRE)


def find_nearest_wall_point(wall: FloatArray, place: tuple[float, float]) -> FloatArray:
    """Return the wall point whose x and y are nearest to a place, m.

    `wall` (..., 3): metres; NaN where there is no wall; `place`: x and y, m. Returns (3,).
    """
    known = wall[np.isfinite(wall).all(axis=-1)]
    spot: FloatArray = known[np.argmin(np.linalg.norm(known[:, :2] - place, axis=1))]
    return spot


def choose_time_axis(
    wall: FloatArray, laser: FloatArray, hidden: FloatArray, bin_width: float, jitter: float
) -> TimeAxis:
    """Choose a time axis from path 0 on that holds the farthest path over anything hidden, and the
    response behind it.

    A sum of distances is largest at a corner of the box about what is hidden.

    `wall` (..., 3): metres; NaN where there is no wall; `laser` (..., 3): metres; `hidden` (n, 3):
    metres; `bin_width, jitter`: seconds; the jitter is the response's standard deviation.
    """
    if not (math.isfinite(bin_width) and bin_width > 0):
        raise InputError(
            f"the bin width must be a positive number of picoseconds, got {bin_width / PICOSECOND:g}"
        )
    corners = itertools.product(*zip(hidden.min(axis=0), hidden.max(axis=0), strict=True))
    paths = [
        np.nanmax(np.linalg.norm(wall - corner, axis=-1) + np.linalg.norm(laser - corner, axis=-1))
        for corner in corners
    ]
    latest = max(paths) + RESPONSE_SIGMAS * SPEED_OF_LIGHT * jitter
    return TimeAxis(int(np.ceil(latest / (SPEED_OF_LIGHT * bin_width))) + 1, bin_width)


def _build_surface(settings: SceneSettings) -> Surface:
    materials: dict[str, Material] = {"matte": Lambert(), "retroreflecting": Retroreflector()}
    if settings.material not in materials:
        raise InputError(
            f"no material is called '{settings.material}'; choose {' or '.join(MATERIALS)}"
        )
    material, facet = materials[settings.material], settings.facet_mm * MILLIMETRE
    if not (math.isfinite(facet) and facet > 0):
        raise InputError(f"facets need a positive size, got {settings.facet_mm:g} mm")
    if settings.mesh is not None:
        return Surface.load(Path(settings.mesh), facet, material)
    letters = "T" if settings.letters is None else settings.letters
    return Surface.letters(
        letters, (0.0, 0.0, settings.depth_m), settings.height_m, facet, material
    )


def _parse_points(text: str) -> list[list[float]]:
    """Read points written as X,Y,Z with semicolons between them."""
    try:
        points = [
            [float(number) for number in one.split(",")] for one in text.split(";") if one.strip()
        ]
    except ValueError:
        points = []
    if not points or any(len(point) != 3 or not all(map(math.isfinite, point)) for point in points):
        raise InputError(
            f"points are given as X,Y,Z in m with semicolons between them, got '{text}'"
        )
    return points
