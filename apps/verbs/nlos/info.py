"""`tofclip nlos info`: what a capture can show, and which methods suit it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from apps.nlos.methods import METHODS, ImagingSettings
from apps.options import AsJson
from apps.settings import SettingsFile, takes

if TYPE_CHECKING:
    from nlos import Capture, Grid

WIDEST_BLUR = 0.5
"""A wavelength is usable while a point's image is narrower than this share of the wall."""

BLUR = 1.2
"""Width of a point's image in units of wavelength * distance / width of the wall; see `nlos.resolution`."""


@takes(ImagingSettings)
def info(
    source: Annotated[Path, typer.Argument(metavar="CAPTURE", help="Recovered frames of a relay wall, or a capture.")],
    settings: SettingsFile = None,
    as_json: AsJson = False,
    **flags: Any,
) -> None:
    """Tell a capture's geometry and sampling, usable wavelengths, resolution, and which methods suit it.

    Resolution is the width of a point's image that a perfect instrument would give in the middle of the box. Memory is
    an estimate for filling the whole box with voxels.

    Example: tofclip nlos info capture.h5
    """
    from apps.nlos.imaging import box_of, prepared, scales_of
    from apps.nlos.truth import HiddenTruth
    from apps.report import report
    from apps.settings import told
    from nlos.io import read_capture
    from tofclip.units import MILLIMETRE

    wanted = told(ImagingSettings, settings, flags)
    capture = prepared(read_capture(source), wanted)
    scales = scales_of(wanted, capture)
    found, grid = box_of(replace(wanted, **scales._asdict()), capture, scales.voxel_mm * MILLIMETRE)
    figures = {
        "wall": _wall(capture),
        "laser": _laser(capture),
        "record": _record(capture),
        "wavelength_mm": {**_usable(capture, grid, found.cycles), "chosen": scales.wavelength_mm},
        "resolution_m": _resolution(capture, grid, found),
        "box_m": {"x": found.x_m, "y": found.y_m, "z": (found.near_m, found.far_m)},
        "voxels": {"size_mm": scales.voxel_mm, "shape": grid.shape},
        "truth": HiddenTruth.inside(source) is not None,
    }
    methods = {name: _suitability(name, found, capture, grid) for name in METHODS}
    if as_json:
        report({**figures, "methods": methods}, as_json)
        return
    lines = {
        name: f"yes, {one['memory_mib']:.0f} MiB" if one["suits"] else f"no: {one['reason']}"
        for name, one in methods.items()
    }
    report({**figures, **lines}, as_json)


def _wall(capture: Capture) -> dict[str, Any]:
    from apps.nlos.imaging import sampling_step
    from nlos.rsd.wall import PlanarWall
    from tofclip.errors import InputError

    try:
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
        "step_m": sampling_step(capture),
    }


def _laser(capture: Capture) -> str:
    from nlos.exposure import exposures

    parts = exposures(capture)
    if parts[0].laser is None:
        return "confocal"
    if len(parts) > 1:
        return f"{len(parts)} spots"
    x, y, z = parts[0].laser
    return f"one spot at ({x:.3g}, {y:.3g}, {z:.3g}) m"


def _record(capture: Capture) -> dict[str, Any]:
    from tofclip.units import PICOSECOND

    paths = capture.axis.paths
    return {
        "bins": capture.axis.bins,
        "bin_width_ps": capture.bin_width / PICOSECOND,
        "path_per_bin_m": capture.axis.spacing,
        "first_path_m": float(paths[0]),
        "last_path_m": float(paths[-1]),
    }


def _usable(capture: Capture, grid: Grid, cycles: float) -> dict[str, float]:
    """Bounds of the carrier: what is sampled finely enough, and what still resolves something, mm."""
    from apps.nlos.imaging import shortest_wavelength
    from tofclip.units import MILLIMETRE

    low, high = capture.points.min(axis=0), capture.points.max(axis=0)
    width = float(max(high[0] - low[0], high[1] - low[1]))
    distance = float(grid.z[[0, -1]].mean() - capture.points[:, 2].mean())
    return {
        "shortest": shortest_wavelength(capture, cycles) / MILLIMETRE,
        "longest": WIDEST_BLUR * width**2 / (BLUR * distance) / MILLIMETRE,
    }


def _resolution(capture: Capture, grid: Grid, found: ImagingSettings) -> dict[str, Any]:
    from dataclasses import asdict

    from nlos.band import VirtualPulse
    from nlos.resolution import diffraction_limit
    from tofclip.units import MILLIMETRE

    middle = [float(axis[[0, -1]].mean()) for axis in (grid.x, grid.y, grid.z)]
    pulse = VirtualPulse((found.wavelength_mm or 0.0) * MILLIMETRE, found.cycles)
    return {**asdict(diffraction_limit(capture, middle, pulse)), "at": middle}


def _suitability(name: str, found: ImagingSettings, capture: Capture, grid: Grid) -> dict[str, Any]:
    from apps.nlos.costs import memory_of
    from apps.nlos.methods import built

    imaging = built(name, found)
    support = imaging.supports(capture, grid)
    if not support:
        return {"suits": False, "reason": support.reason}
    return {"suits": True, "memory_mib": memory_of(imaging, capture, grid) / 2**20}
