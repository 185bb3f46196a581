"""`tofclip nlos reconstruct`: what a relay wall shows of the scene around the corner."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from apps.options import AsJson, completing
from tofclip.units import MILLIMETRE

if TYPE_CHECKING:
    from nlos import Capture, Grid, Volume
    from nlos.method import Reconstructor

PULSED = {"backprojection": "Backprojection", "rsd": "PlanarRSD", "hybrid": "Hybrid"}
"""Methods of `nlos` that image with a virtual pulse, and their classes."""

PLAIN = {"filtered-backprojection": "FilteredBackprojection", "lct": "LightCone", "fk": "FKMigration"}
"""Methods without one."""

METHODS = (*PULSED, *PLAIN)

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
    method: Annotated[
        str, typer.Option(metavar="NAME", help=f"{', '.join(METHODS)}.", autocompletion=completing(*METHODS))
    ] = "backprojection",
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

    backprojection takes every wall, laser and grid, and is slow; hybrid gives the same picture in about a second, rsd
    too if the wall is planar and evenly scanned. These three see through a virtual pulse. filtered-backprojection,
    lct (light-cone transform) and fk (f-k migration) do without; the last two want a confocal scan of a planar wall.

    The space in front of the wall is looked over with voxels of half a wavelength first; then the part that is bright
    is imaged with the voxels asked for.

    Example: tofclip nlos reconstruct wall_frames.h5 --method hybrid --out volume.h5 --png mip.png
    """
    from apps.files import PICTURE_SUFFIXES, RECORD_SUFFIXES, history, require_writable
    from apps.report import report

    wavelength = wavelength_mm * MILLIMETRE
    imaging = _method(method, wavelength, cycles)
    require_writable(out, *RECORD_SUFFIXES, inputs=(source,))
    if png is not None:
        require_writable(png, *PICTURE_SUFFIXES, inputs=(source,))
    capture = _capture(source)
    started = time.perf_counter()
    grid = _grid(imaging, capture, (voxel_mm * MILLIMETRE, wavelength / 2), (near_m, far_m), everywhere)
    volume = _imaged("imaging", imaging, capture, grid)
    seconds = time.perf_counter() - started
    settings = {"verb": "nlos reconstruct", "method": repr(imaging), "voxel_mm": voxel_mm}
    replace(volume, provenance=history(settings, source, earlier=capture.provenance)).save(out)
    if png is not None:
        volume.save_picture(png)
    figures = {
        "method": method,
        "voxels": volume.grid.shape,
        "wall_points": len(capture.points),
        "seconds": seconds,
        "voxels_per_second": volume.grid.size / seconds,
        "peak_m": dict(zip("xyz", volume.brightest(), strict=True)),
    }
    report(figures, as_json, [out] if png is None else [out, png])


def _method(name: str, wavelength: float, cycles: float) -> Reconstructor:
    """Build the method of that name."""
    import nlos
    from tofclip.errors import InputError

    if name in PULSED:
        pulsed: Reconstructor = getattr(nlos, PULSED[name])(wavelength=wavelength, cycles=cycles)
        return pulsed
    if name in PLAIN:
        plain: Reconstructor = getattr(nlos, PLAIN[name])()
        return plain
    raise InputError(f"unknown method '{name}'; choose one of {', '.join(METHODS)}")


def _imaged(title: str, imaging: Reconstructor, capture: Capture, grid: Grid) -> Volume:
    """Image the hidden scene under a progress bar that counts look-ups or voxels, whichever the method does."""
    from apps.progress import progress

    lookups = getattr(imaging, "lookups", None)
    with progress(title, lookups(capture, grid) if lookups else grid.size) as advance:
        return imaging.reconstruct(capture, grid, advance)


def _grid(
    imaging: Reconstructor,
    capture: Capture,
    voxels: tuple[float, float],
    depths: tuple[float | None, float | None],
    everywhere: bool,
) -> Grid:
    """Choose fine voxels: all the space in front of the wall, or what coarse ones find bright there."""
    from nlos import Grid

    fine, coarse = voxels
    if everywhere or fine >= coarse:
        return Grid.in_front_of(capture, fine, *depths)
    overview = Grid.in_front_of(capture, coarse, *depths)
    return Grid.around(_imaged("looking over", imaging, capture, overview), fine)


def _capture(source: Path) -> Capture:
    """Read a capture, or take one out of recovered frames."""
    from nlos import Capture
    from tofclip.storage import Record
    from tofclip.transient import Frames

    record = Record.load(source, "frames", "capture")
    if record.kind == "capture":
        return Capture.from_record(record)
    return Capture.from_frames(Frames.from_record(record))
