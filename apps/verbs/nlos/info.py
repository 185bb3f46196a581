"""`tofclip nlos info`: what a capture can show, and which methods suit it."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from apps.conventions import JsonOption, report
from apps.nlos.imaging import METHODS, ImagingSettings, from_library, to_library
from apps.nlos.truth import HiddenTruth
from apps.settings import SettingsOption, add_setting_flags, load_settings
from nlos.analysis import find_sampling_step, find_shortest_wavelength
from nlos.band import VirtualPulse
from nlos.illumination import group_by_illumination
from nlos.io import read_capture
from nlos.plane import PlanarWall
from nlos.resolution import compute_diffraction_limit
from nlos.settings import settings_for
from tofclip.errors import InputError
from tofclip.units import MILLIMETRE, PICOSECOND

if TYPE_CHECKING:
    from nlos import Capture, Grid, Method

EMPTY_KEYS = {"reasons", "gate_found"}
"""Fields of the library's settings that are found, never given."""

MAX_BLUR_FRACTION = 0.5
"""A wavelength is usable while a point's image is narrower than this share of the wall."""

BLUR_FACTOR = 1.2
"""Width of a point's image in units of wavelength * distance / width of the wall; see
`nlos.resolution`.
"""


@add_setting_flags(ImagingSettings)
def info(
    source: Annotated[
        Path,
        typer.Argument(metavar="CAPTURE", help="Recovered frames of a relay wall, or a capture."),
    ],
    settings: SettingsOption = None,
    as_json: JsonOption = False,
    **flags: Any,
) -> None:
    """Report a capture's geometry and sampling, usable wavelengths, resolution, and which methods
    suit it.

    Resolution is the width of a point's image that a perfect instrument would give in the middle of
    the box. Memory is an estimate for filling the whole box with voxels.

    Example: tofclip nlos info capture.h5
    """
    wanted = load_settings(ImagingSettings, settings, flags)
    recorded = read_capture(source)
    given = to_library(wanted).to_dict()
    chosen = settings_for(recorded, **{key: given[key] for key in given.keys() - EMPTY_KEYS})
    capture, grid = chosen.prepare(recorded), chosen.grid()
    found = from_library(wanted, chosen, [chosen.method or ""])
    figures = {
        "wall": _describe_wall(capture),
        "laser": _describe_laser(capture),
        "record": _describe_time_axis(capture),
        "wavelength_mm": {
            **_find_usable_wavelengths(capture, grid, found.cycles),
            "chosen": found.wavelength_mm,
        },
        "gate": {"m": chosen.gate, "found": chosen.gate_found},
        "bins_together": chosen.bins_together,
        "method": chosen.method,
        "reasons": dict(chosen.reasons),
        "resolution_m": _compute_resolution(capture, grid, found),
        "box_m": {"x": found.x_m, "y": found.y_m, "z": (found.near_m, found.far_m)},
        "voxels": {"size_mm": found.voxel_mm, "shape": grid.shape},
        "truth": HiddenTruth.load(source) is not None,
    }
    methods = {name: _check_method(chosen.make_method(name), capture, grid) for name in METHODS}
    if as_json:
        report({**figures, "methods": methods}, as_json)
        return
    lines = {
        name: f"yes, {one['memory_mib']:.0f} MiB" if one["suits"] else f"no: {one['reason']}"
        for name, one in methods.items()
    }
    report({**figures, **lines}, as_json)


def _describe_wall(capture: Capture) -> dict[str, Any]:
    try:
        # The class refuses any other wall, which is the test wanted here.
        PlanarWall.of(capture.points)
        shape = "planar lattice"
    except InputError:
        shape = "no planar lattice"
    width, height, relief = capture.points.max(axis=0) - capture.points.min(axis=0)
    return {
        "points": len(capture.points),
        "masked": int(capture.valid.size - len(capture.points)),
        "shape": shape,
        "width_m": width,
        "height_m": height,
        "relief_m": relief,
        "step_m": find_sampling_step(capture),
    }


def _describe_laser(capture: Capture) -> str:
    parts = group_by_illumination(capture)
    # Confocal captures have a laser spot for each wall point, and none for the group.
    if parts[0].laser is None:
        return "confocal"
    if len(parts) > 1:
        return f"{len(parts)} spots"
    x, y, z = parts[0].laser
    return f"one spot at ({x:.3g}, {y:.3g}, {z:.3g}) m"


def _describe_time_axis(capture: Capture) -> dict[str, Any]:
    paths = capture.axis.paths
    return {
        "bins": capture.axis.bins,
        "bin_width_ps": capture.bin_width / PICOSECOND,
        "path_per_bin_m": capture.axis.spacing,
        "first_path_m": float(paths[0]),
        "last_path_m": float(paths[-1]),
    }


def _find_usable_wavelengths(capture: Capture, grid: Grid, cycles: float) -> dict[str, float]:
    """Bounds of the carrier: what is sampled finely enough, and what still resolves something, mm."""
    low, high = capture.points.min(axis=0), capture.points.max(axis=0)
    width = float(max(high[0] - low[0], high[1] - low[1]))
    distance = float(grid.z[[0, -1]].mean() - capture.points[:, 2].mean())
    return {
        "shortest": find_shortest_wavelength(capture, cycles) / MILLIMETRE,
        "longest": MAX_BLUR_FRACTION * width**2 / (BLUR_FACTOR * distance) / MILLIMETRE,
    }


def _compute_resolution(capture: Capture, grid: Grid, found: ImagingSettings) -> dict[str, Any]:
    middle = [float(axis[[0, -1]].mean()) for axis in (grid.x, grid.y, grid.z)]
    pulse = VirtualPulse((found.wavelength_mm or 0.0) * MILLIMETRE, found.cycles)
    return {**asdict(compute_diffraction_limit(capture, middle, pulse)), "at": middle}


def _check_method(method: Method, capture: Capture, grid: Grid) -> dict[str, Any]:
    try:
        plan = method.plan(capture, grid)
    except InputError as refused:
        # The refusal itself is the reason to show.
        return {"suits": False, "reason": str(refused)}
    return {"suits": True, "memory_mib": plan.memory_bytes / 2**20}
