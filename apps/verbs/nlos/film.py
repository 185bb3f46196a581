"""`tofclip nlos film`: the hidden scene while the laser's flash passes through it."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from apps.conventions import JsonOption, build_provenance, name_beside, report, require_writable
from apps.mp4 import import_opencv, open_film
from apps.nlos.imaging import (
    ImagingSettings,
    parse_method_names,
    prepare_imaging,
    require_valid_settings,
)
from apps.progress import show_progress
from apps.settings import (
    SettingsOption,
    add_setting_flags,
    load_settings,
    save_settings,
    setting_field,
    settings_to_dict,
)
from nlos import TransientImaging
from nlos.illumination import find_leg_bounds
from nlos.io import read_capture
from nlos.picture import render_frames
from tofclip.errors import InputError
from tofclip.units import SPEED_OF_LIGHT

if TYPE_CHECKING:
    from nlos import Capture, Grid, TransientVideo
    from nlos.volume import FloatArray

FILM_METHODS = ("rsd", "hybrid")
"""They keep the band's frequencies apart from the laser's wave, the quicker one first."""

FILM_SUFFIXES = (".mp4", ".gif", ".h5")
FRAME_RATE_HZ = 12.5
NANOSECOND = 1e-9
MARGIN_SIGMAS = 2.0
"""Before the flash reaches the first voxel, and after it left the last: standard deviations of the
virtual pulse.
"""

SETTINGS_HEADING = "tofclip nlos film CAPTURE --settings THIS --out FILM"


@dataclass(frozen=True)
class FilmSettings(ImagingSettings):
    """What is filmed, and when."""

    method: str | None = setting_field(
        "NAME",
        f"{' or '.join(FILM_METHODS)}.",
        shown="the quickest that suits the capture",
        choices=FILM_METHODS,
    )
    instants: int = setting_field("N", "How many.", 60)
    first_ns: float | None = setting_field(
        "NS", "First instant after the flash.", shown="before it meets the first voxel"
    )
    last_ns: float | None = setting_field(
        "NS", "Last instant.", shown="after it left the last voxel"
    )
    every_depth: bool = setting_field(
        None, "Keep every depth, not only the brightest along every line of sight: .h5.", False
    )


@add_setting_flags(FilmSettings)
def film(
    source: Annotated[
        Path,
        typer.Argument(metavar="CAPTURE", help="Recovered frames of a relay wall, or a capture."),
    ],
    out: Annotated[
        Path,
        typer.Option(metavar="FILE", help="The film to write, .mp4 or .gif; or its numbers, .h5."),
    ],
    settings: SettingsOption = None,
    as_json: JsonOption = False,
    **flags: Any,
) -> None:
    """Film the hidden scene while the laser's flash passes through it.

    A hidden thing lights up when the flash reaches it, so that near things show before far ones;
    light that met several things shows once more at the last of them. Needs a capture of one laser
    spot, and rsd or hybrid. Times count from the moment when the flash leaves its spot on the wall.

    The part of the box that is bright is found as by nlos reconstruct. The settings that were given
    or found are written beside the film (.toml) and give the same one.

    Example: tofclip nlos film capture.h5 --out flash.gif
    """
    wanted = load_settings(FilmSettings, settings, flags)
    beside = name_beside(out, ".toml")
    require_writable(out, *FILM_SUFFIXES, inputs=(source, settings))
    require_writable(beside, inputs=(source, settings))
    _check_settings(wanted, out)
    capture = read_capture(source)
    # Reading the file does not count as imaging.
    started = time.perf_counter()
    found, video = _make_video(capture, wanted)
    seconds = time.perf_counter() - started
    _write_video(replace(video, provenance=_build_video_provenance(video, source, found)), out)
    save_settings(found, beside, SETTINGS_HEADING)
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


def _check_settings(settings: FilmSettings, out: Path) -> None:
    """Refuse what no capture could be filmed by, before any is read."""
    names = FILM_METHODS if settings.method is None else parse_method_names(settings.method)
    if not set(names) <= set(FILM_METHODS):
        raise InputError(f"films are made by {' or '.join(FILM_METHODS)}, not by {settings.method}")
    require_valid_settings(settings, names)
    if settings.instants < 1:
        raise InputError(f"a film needs at least one instant, got {settings.instants}")
    if settings.every_depth and out.suffix.lower() != ".h5":
        raise InputError(
            f"{out}: a film shows one picture per instant; write every depth to a .h5 file"
        )
    if out.suffix.lower() == ".mp4":
        # A missing library is reported before the film is computed.
        import_opencv()


def _make_video(capture: Capture, wanted: FilmSettings) -> tuple[FilmSettings, TransientVideo]:
    """Find what is not given, and film the capture."""
    prepared = prepare_imaging(capture, wanted)
    capture, grid, settings = prepared.capture, prepared.grid, prepared.settings
    method = settings.method
    if method not in FILM_METHODS:  # back-projection is the quickest that remains
        method = FILM_METHODS[-1]
    imaging = TransientImaging(settings.make_method(method))  # type: ignore[arg-type]
    found = replace(prepared.shown, method=method, tolerance=imaging.method.tolerance)
    found, times = _choose_instants(found, capture, grid, imaging)
    take = imaging.video if found.every_depth else imaging.front_views
    with show_progress("filming", grid.size) as advance:
        return found, take(capture, grid, times, advance)


def _choose_instants(
    settings: FilmSettings, capture: Capture, grid: Grid, imaging: TransientImaging
) -> tuple[FilmSettings, FloatArray]:
    """Return evenly spaced instants, s, and the settings with the first and the last of them."""
    nearest, farthest = find_leg_bounds(capture.lasers, grid)
    # The virtual pulse has a width, so that its flank arrives before its middle.
    room = MARGIN_SIGMAS * imaging.method.pulse.sigma
    first, last = (
        (plan / SPEED_OF_LIGHT) / NANOSECOND for plan in (nearest - room, farthest + room)
    )
    first = first if settings.first_ns is None else settings.first_ns
    last = last if settings.last_ns is None else settings.last_ns
    if last < first:
        raise InputError(f"a film must begin before it ends, got {first:.4g} to {last:.4g} ns")
    found = replace(settings, first_ns=first, last_ns=last)
    return found, NANOSECOND * np.linspace(first, last, settings.instants)


def _build_video_provenance(
    video: TransientVideo, source: Path, found: FilmSettings
) -> dict[str, Any]:
    return build_provenance(
        {"verb": "nlos film", **settings_to_dict(found)}, source, earlier=video.provenance
    )


def _write_video(video: TransientVideo, out: Path) -> None:
    if out.suffix.lower() == ".h5":
        video.save(out)
    elif out.suffix.lower() == ".gif":
        video.save_film(out)
    else:
        with open_film(out, FRAME_RATE_HZ) as film:
            for picture in render_frames(video):
                film.add(picture)
