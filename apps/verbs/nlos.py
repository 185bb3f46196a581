"""`tofclip nlos reconstruct`: what a relay wall shows of the scene around the corner."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from apps.options import AsJson
from tofclip.units import MILLIMETRE

if TYPE_CHECKING:
    from nlos import Backprojection, Capture, Grid, Volume

METHODS = ("backprojection",)

app = typer.Typer()


@app.callback(invoke_without_command=True)
def _without_verb(context: typer.Context) -> None:
    """Image the scene hidden around a corner."""
    if context.invoked_subcommand is None:
        print(context.get_help())


@app.command()
def reconstruct(
    source: Annotated[Path, typer.Argument(metavar="FILE", help="Recovered frames of a relay wall, or a capture.")],
    out: Annotated[Path, typer.Option(metavar="H5", help="The volume to write.")],
    png: Annotated[Path | None, typer.Option(metavar="PNG", help="Picture of the volume, three views.")] = None,
    method: Annotated[str, typer.Option(metavar="NAME", help="backprojection.")] = "backprojection",
    wavelength_mm: Annotated[float, typer.Option(metavar="MM", help="Carrier of the virtual pulse.")] = 48.0,
    cycles: Annotated[float, typer.Option(metavar="N", help="Length of the virtual pulse in wavelengths.")] = 3.0,
    voxel_mm: Annotated[float, typer.Option(metavar="MM", help="Distance of neighbouring voxels.")] = 6.0,
    near_m: Annotated[
        float | None,
        typer.Option(metavar="M", help="First depth.", show_default="one voxel beyond the middle of the wall's relief"),
    ] = None,
    far_m: Annotated[
        float | None, typer.Option(metavar="M", help="Last depth.", show_default="as far as the record reaches")
    ] = None,
    everywhere: Annotated[
        bool, typer.Option("--everywhere", help="Fill all the space in front of the wall with such voxels; slow.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Image the hidden scene from the transients on a relay wall.

    The space in front of the wall is looked over with voxels of half a wavelength first; then the part that is bright
    is imaged with the voxels asked for.
    """
    from apps.files import PICTURE_SUFFIXES, RECORD_SUFFIXES, history, require_writable
    from apps.report import report
    from nlos import Backprojection
    from tofclip.errors import InputError

    if method not in METHODS:
        raise InputError(f"unknown method '{method}'; choose one of {', '.join(METHODS)}")
    require_writable(out, *RECORD_SUFFIXES, inputs=(source,))
    if png is not None:
        require_writable(png, *PICTURE_SUFFIXES, inputs=(source,))
    imaging = Backprojection(wavelength=wavelength_mm * MILLIMETRE, cycles=cycles)
    capture = _capture(source)
    volume, speed = _imaged(imaging, capture, voxel_mm * MILLIMETRE, (near_m, far_m), everywhere)
    settings = {"verb": "nlos reconstruct", "method": repr(imaging), "voxel_mm": voxel_mm}
    replace(volume, provenance=history(settings, source, earlier=capture.provenance)).save(out)
    if png is not None:
        volume.save_picture(png)
    figures = {
        "method": method,
        "voxels": volume.grid.shape,
        "wall_points": len(capture.points),
        **speed,
        "peak_m": dict(zip("xyz", volume.brightest(), strict=True)),
    }
    report(figures, as_json, [out] if png is None else [out, png])


def _imaged(
    imaging: Backprojection,
    capture: Capture,
    voxel: float,
    depths: tuple[float | None, float | None],
    everywhere: bool,
) -> tuple[Volume, dict[str, float]]:
    """Image the hidden scene, and say how long it took altogether and how fast the fine picture was made."""
    from apps.progress import progress

    started = time.perf_counter()
    grid = _grid(imaging, capture, voxel, depths, everywhere)
    lookups = imaging.lookups(capture, grid)
    looked_over = time.perf_counter()
    with progress("imaging", lookups) as advance:
        volume = imaging.reconstruct(capture, grid, advance)
    finished = time.perf_counter()
    return volume, {"seconds": finished - started, "lookups_per_second": lookups / (finished - looked_over)}


def _grid(
    imaging: Backprojection,
    capture: Capture,
    voxel: float,
    depths: tuple[float | None, float | None],
    everywhere: bool,
) -> Grid:
    """Choose the voxels: all the space in front of the wall, or what a coarse look finds bright there."""
    from apps.progress import progress
    from nlos import Grid

    coarse_voxel = imaging.wavelength / 2
    if everywhere or voxel >= coarse_voxel:
        return Grid.in_front_of(capture, voxel, *depths)
    coarse = Grid.in_front_of(capture, coarse_voxel, *depths)
    with progress("looking over", imaging.lookups(capture, coarse)) as advance:
        return Grid.around(imaging.reconstruct(capture, coarse, advance), voxel)


def _capture(source: Path) -> Capture:
    """Read a capture, or take one out of recovered frames."""
    from nlos import Capture
    from tofclip.storage import Record
    from tofclip.transient import Frames

    record = Record.load(source, "frames", "capture")
    if record.kind == "capture":
        return Capture.from_record(record)
    return Capture.from_frames(Frames.from_record(record))
