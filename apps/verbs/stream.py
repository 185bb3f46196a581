"""`tofclip stream`: shots to clouds while they come, with every stage's latency."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from contextlib import closing
from itertools import islice
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Annotated, Any

import typer

from apps.options import AsJson, TimeZero
from tofclip.units import NANOSECOND, PICOSECOND

if TYPE_CHECKING:
    from tofclip.sequences.ranger import Ranger
    from tofclip.sequences.streaming import StreamedCloud
    from tofclip.shots import Streak

MOST_REMEMBERED = 10_000  # shots over which medians are taken: a stream may run for days


def stream(
    source: Annotated[
        str,
        typer.Argument(
            metavar="SOURCE",
            help="An instrument's address such as 'sim+remoteex://?seed=1', a folder of shots or an HDF5 stack.",
        ),
    ],
    out: Annotated[
        Path | None, typer.Option(metavar="FOLDER", help="Where the clouds go.", show_default="nowhere")
    ] = None,
    camera: Annotated[
        Path | None, typer.Option(metavar="H5", help="Made by calibrate.", show_default="the one inside the first shot")
    ] = None,
    bin_width_ps: Annotated[
        float | None, typer.Option(metavar="PS", help="Duration of a row in ps; overrides the shots' own time axis.")
    ] = None,
    time_zero_ns: TimeZero = None,
    focus: Annotated[str, typer.Option(metavar="SHEAR", help="depth-locked or fixed:S.")] = "fixed:0",
    shots: Annotated[
        int | None, typer.Option(metavar="N", help="Stop after so many clouds.", show_default="at the source's end")
    ] = None,
    held: Annotated[int, typer.Option(metavar="N", help="Shots that may wait before each stage.")] = 1,
    drop: Annotated[
        bool,
        typer.Option(
            "--drop", help="Drop the oldest waiting shot where they come too fast, instead of letting the source wait."
        ),
    ] = False,
    suffix: Annotated[str, typer.Option(metavar=".EXT", help="Format of the clouds.")] = ".ply",
    as_json: AsJson = False,
) -> None:
    """Make a cloud of each shot by the linear inverse while the next ones come, and tell rate and latencies.

    Photons become a shot for every so many of them, pictures one by one: see records= and frames= of an address.

    Example: tofclip stream 'sim+remoteex://?seed=1' --shots 20 --out clouds/
    """
    from apps.report import report
    from apps.verbs.cloud import require_format
    from tofclip.errors import InputError
    from tofclip.sequences.streaming import stream_clouds

    require_format(suffix)
    if shots is not None and shots < 1:
        raise InputError(f"--shots must be positive, got {shots}")
    if out is not None:
        from apps.files import make_folder

        make_folder(out)
    coming = _coming(source, None if bin_width_ps is None else bin_width_ps * PICOSECOND)
    first = next(coming, None)
    if first is None:
        raise InputError(f"{source}: the source ended before it gave a shot")
    ranger = _ranger(first, camera, None if time_zero_ns is None else time_zero_ns * NANOSECOND, focus)
    with closing(stream_clouds(_again(first, coming), ranger, held, "drop_oldest" if drop else "block")) as made:
        figures = _followed(islice(made, shots), out, suffix)
    report(figures, as_json, [] if out is None else [out])


def _coming(source: str, bin_width: float | None) -> Iterator[Streak]:
    """Shots of an instrument, a folder or a stack."""
    if "://" in source:
        from devices.transients import read_transients

        return read_transients(source, bin_width)
    from tofclip.sequences import shots_in

    return (shot() for shot in shots_in(source, bin_width).values())


def _ranger(first: Streak, camera: Path | None, time_zero: float | None, focus: str) -> Ranger:
    from tofclip.camera import Camera
    from tofclip.errors import InputError
    from tofclip.recovery import SharpestFocus, focus_named
    from tofclip.sequences.ranger import Ranger

    chosen = focus_named(focus)
    if isinstance(chosen, SharpestFocus):
        raise InputError("a stream has one focus for all shots: depth-locked or fixed:S")
    known = first.camera if camera is None else Camera.load(camera)
    if known is not None and time_zero is not None:
        known = known.replace(time_zero=time_zero)
    return Ranger.for_shot(first, known, chosen)


def _again(first: Streak, others: Iterator[Streak]) -> Iterator[Streak]:
    """Put the shot that told the camera back before the others."""
    yield first
    yield from others


def _followed(made: Iterable[StreamedCloud], out: Path | None, suffix: str) -> Mapping[str, Any]:
    """Take the clouds as they come; return what is told at the end."""
    from tofclip.sequences.ranger import cloud_path

    stages: dict[str, deque[float]] = {}
    latency: deque[float] = deque(maxlen=MOST_REMEMBERED)
    clouds = points = last = 0
    started = perf_counter()
    for one in made:
        if out is not None:
            one.cloud.save(cloud_path(out, one.shot, suffix))
        clouds, points, last = clouds + 1, points + len(one.cloud), one.shot
        latency.append(one.latency)
        for name, seconds in one.seconds.items():
            stages.setdefault(name, deque(maxlen=MOST_REMEMBERED)).append(seconds)
    passed = perf_counter() - started
    return {
        "clouds": clouds,
        "dropped": last + 1 - clouds if clouds else 0,
        "points": points,
        "clouds_per_second": clouds / passed,
        "latency_s": _spread(latency),
        "stages_s": {name: _spread(seconds) for name, seconds in stages.items()},
    }


def _spread(seconds: Iterable[float]) -> Mapping[str, float]:
    import numpy as np

    values = np.fromiter(seconds, np.float64)
    return dict(zip(("median", "p95"), np.quantile(values, (0.5, 0.95)).tolist(), strict=True)) if values.size else {}
