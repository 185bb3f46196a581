"""`tofclip nlos film`: the hidden scene while the laser's flash passes through it."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from apps.nlos.methods import ImagingSettings
from apps.options import AsJson
from apps.settings import SettingsFile, setting, takes

if TYPE_CHECKING:
    from nlos import Capture, Grid, TransientImaging, TransientVideo
    from nlos.geometry import FloatArray

METHODS = ("rsd", "hybrid")
"""They keep the band's frequencies apart from the laser's wave, the quicker one first."""

FORMATS = (".mp4", ".gif", ".h5")
PICTURES_PER_SECOND = 12.5
NANOSECOND = 1e-9
SIGMAS_BEFORE = 2.0
"""Before the flash reaches the first voxel, and after it left the last: standard deviations of the virtual pulse."""

HEADING = "tofclip nlos film CAPTURE --settings THIS --out FILM"


@dataclass(frozen=True)
class FilmSettings(ImagingSettings):
    """What is filmed, and when."""

    method: str | None = setting(
        "NAME", f"{' or '.join(METHODS)}.", shown="the quickest that suits the capture", choices=METHODS
    )
    instants: int = setting("N", "How many.", 60)
    first_ns: float | None = setting("NS", "First instant after the flash.", shown="before it meets the first voxel")
    last_ns: float | None = setting("NS", "Last instant.", shown="after it left the last voxel")
    every_depth: bool = setting(None, "Keep every depth, not only the brightest along every line of sight: .h5.", False)


@takes(FilmSettings)
def film(
    source: Annotated[Path, typer.Argument(metavar="CAPTURE", help="Recovered frames of a relay wall, or a capture.")],
    out: Annotated[Path, typer.Option(metavar="FILE", help="The film to write, .mp4 or .gif; or its numbers, .h5.")],
    settings: SettingsFile = None,
    as_json: AsJson = False,
    **flags: Any,
) -> None:
    """Film the hidden scene while the laser's flash passes through it.

    A hidden thing lights up when the flash reaches it, so that near things show before far ones; light that met several
    things shows once more at the last of them. Needs a capture of one laser spot, and rsd or hybrid. Times count from
    the moment when the flash leaves its spot on the wall.

    The part of the box that is bright is found as by nlos reconstruct. The settings that were told or found are written
    beside the film (.toml) and give the same one.

    Example: tofclip nlos film capture.h5 --out flash.gif
    """
    from apps.nlos.imaging import prepared, warnings_in_a_line
    from apps.report import report
    from apps.settings import save, told
    from nlos.io import read_capture

    wanted = told(FilmSettings, settings, flags)
    beside = out.with_suffix(".toml")
    _require_writable(out, beside, (source,) if settings is None else (source, settings))
    _require_sense(wanted, out)
    capture = prepared(read_capture(source), wanted)
    started = time.perf_counter()
    with warnings_in_a_line():
        found, video = _filmed(capture, wanted)
    seconds = time.perf_counter() - started
    _write(replace(video, provenance=_history(video, source, found)), out)
    save(found, beside, HEADING)
    figures = {
        "method": found.method,
        "wavelength_mm": found.wavelength_mm,
        "voxel_mm": found.voxel_mm,
        "voxels": video.grid.shape,
        "instants": len(video.times),
        "first_ns": found.first_ns,
        "last_ns": found.last_ns,
        "seconds": seconds,
    }
    report(figures, as_json, [out, beside])


def _require_writable(out: Path, beside: Path, inputs: tuple[Path, ...]) -> None:
    from apps.files import require_writable

    require_writable(out, *FORMATS, inputs=inputs)
    require_writable(beside, inputs=inputs)


def _require_sense(settings: FilmSettings, out: Path) -> None:
    """Refuse what no capture could be filmed by, before any is read."""
    from apps.mp4 import opencv
    from apps.nlos.methods import built, names_in, require_taken
    from tofclip.errors import InputError

    names = METHODS if settings.method is None else names_in(settings.method)
    if not set(names) <= set(METHODS):
        raise InputError(f"films are made by {' or '.join(METHODS)}, not by {settings.method}")
    require_taken(settings, names)
    for name in names:
        built(name, settings if settings.wavelength_mm is not None else replace(settings, wavelength_mm=1.0))
    if settings.instants < 1:
        raise InputError(f"a film needs at least one instant, got {settings.instants}")
    if settings.every_depth and out.suffix.lower() != ".h5":
        raise InputError(f"{out}: a film shows one picture per instant; write every depth to a .h5 file")
    if out.suffix.lower() == ".mp4":
        opencv()


def _filmed(capture: Capture, wanted: FilmSettings) -> tuple[FilmSettings, TransientVideo]:
    """Find what is not told, and film the capture."""
    from apps.nlos.imaging import boxed, scales_of
    from apps.nlos.methods import built, spelt_out
    from apps.progress import progress
    from nlos import TransientImaging

    found = replace(wanted, **scales_of(wanted, capture)._asdict())
    method = found.method or _quickest(found, capture)
    found = replace(spelt_out(found, [method]), method=method)
    imaging = TransientImaging(built(method, found))  # type: ignore[arg-type]
    found, grid = boxed(found, capture)
    imaging.supports(capture, grid).require()
    found, times = _instants(found, capture, grid, imaging)
    take = imaging.video if found.every_depth else imaging.front_views
    with progress("filming", grid.size) as advance:
        return found, take(capture, grid, times, advance)


def _quickest(settings: FilmSettings, capture: Capture) -> str:
    """Name the quickest of the two methods that takes a capture; where none does, the one that says why."""
    from apps.nlos.imaging import box_of
    from apps.nlos.methods import built
    from tofclip.units import MILLIMETRE

    _, grid = box_of(settings, capture, (settings.voxel_mm or 0.0) * MILLIMETRE)
    return next((name for name in METHODS if built(name, settings).supports(capture, grid)), METHODS[-1])


def _instants(
    settings: FilmSettings, capture: Capture, grid: Grid, imaging: TransientImaging
) -> tuple[FilmSettings, FloatArray]:
    """Return evenly spaced instants, s, and the settings with the first and the last of them."""
    import numpy as np

    from nlos.exposure import leg
    from tofclip.errors import InputError
    from tofclip.units import SPEED_OF_LIGHT

    nearest, farthest = leg(capture.lasers, grid)
    room = SIGMAS_BEFORE * imaging.method.pulse.sigma
    first, last = ((way / SPEED_OF_LIGHT) / NANOSECOND for way in (nearest - room, farthest + room))
    first = first if settings.first_ns is None else settings.first_ns
    last = last if settings.last_ns is None else settings.last_ns
    if last < first:
        raise InputError(f"a film must begin before it ends, got {first:.4g} to {last:.4g} ns")
    found = replace(settings, first_ns=first, last_ns=last)
    return found, NANOSECOND * np.linspace(first, last, settings.instants)


def _history(video: TransientVideo, source: Path, found: FilmSettings) -> dict[str, Any]:
    from apps.files import history
    from apps.settings import plain

    return history({"verb": "nlos film", **plain(found)}, source, earlier=video.provenance)


def _write(video: TransientVideo, out: Path) -> None:
    from apps.mp4 import filming
    from nlos.film import pictures

    if out.suffix.lower() == ".h5":
        video.save(out)
    elif out.suffix.lower() == ".gif":
        video.save_film(out)
    else:
        with filming(out, PICTURES_PER_SECOND) as film:
            for picture in pictures(video):
                film.add(picture)
