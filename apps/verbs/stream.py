"""`tofclip stream`: shots to clouds while they come, with every stage's latency."""

from __future__ import annotations

import sys
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import closing
from dataclasses import asdict
from itertools import islice
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
import typer

from apps.conventions import JsonOption, TimeZeroOption, make_folder, report
from apps.sequences import EXIT_SOME_FAILED
from apps.verbs.cloud import require_format
from devices.shot_stream import TrackedShots, read_transients
from tofclip.errors import InputError, TofclipError
from tofclip.files import require_apart
from tofclip.recovery import SharpestFocus, SurfaceRecovery, parse_focus
from tofclip.sequences import list_shots
from tofclip.sequences.following import SurfacePipeline
from tofclip.sequences.ranger import CloudPipeline, RangingPipeline, build_cloud_path
from tofclip.sequences.streaming import stream_clouds
from tofclip.solvers import LinearInverse, ProximalMethod, Sparse, TotalVariation
from tofclip.units import NANOSECOND, PICOSECOND

if TYPE_CHECKING:
    from tofclip.sequences.inputs import Shot
    from tofclip.sequences.streaming import StreamedCloud
    from tofclip.shots import Streak

STREAM_METHODS: Mapping[str, Callable[[], LinearInverse | ProximalMethod]] = {
    "linear": LinearInverse,
    "l1": Sparse,
    "tv": TotalVariation,
}

MAX_LATENCY_SAMPLES = 10_000  # shots over which medians are taken: a stream may run for days


def stream(
    source: Annotated[
        str,
        typer.Argument(
            metavar="SOURCE",
            help="An instrument's address such as 'sim+remoteex://?seed=1', a folder of shots or an HDF5 stack.",
        ),
    ],
    out: Annotated[
        Path | None,
        typer.Option(metavar="FOLDER", help="Where the clouds go.", show_default="nowhere"),
    ] = None,
    camera: Annotated[
        Path | None,
        typer.Option(
            metavar="H5", help="Made by calibrate.", show_default="the one inside the first shot"
        ),
    ] = None,
    bin_width_ps: Annotated[
        float | None,
        typer.Option(
            metavar="PS", help="Duration of a row in ps; overrides the shots' own time axis."
        ),
    ] = None,
    time_zero_ns: TimeZeroOption = None,
    focus: Annotated[
        str, typer.Option(metavar="SHEAR", help="depth-locked or fixed:S.")
    ] = "fixed:0",
    method: Annotated[
        str,
        typer.Option(
            metavar="NAME",
            help="linear, which is the fastest and draws rays around bright objects, or l1 or tv, "
            "which leave them out: few iterations that begin at the last shot's pictures; or surfaces, "
            "the truest and slowest, which follow those of the last shot.",
        ),
    ] = "linear",
    shots: Annotated[
        int | None,
        typer.Option(
            metavar="N",
            help="Stop after this number of clouds.",
            show_default="at the source's end",
        ),
    ] = None,
    held: Annotated[int, typer.Option(metavar="N", help="Shots that may wait for their turn.")] = 1,
    drop: Annotated[
        bool,
        typer.Option(
            "--drop",
            help="Drop the oldest waiting shot where they come too fast, as always for an instrument.",
        ),
    ] = False,
    suffix: Annotated[str, typer.Option(metavar=".EXT", help="Format of the clouds.")] = ".ply",
    as_json: JsonOption = False,
) -> None:
    """Make a cloud of each shot while the next ones come; report method, rate and latencies.

    Photons become a shot in batches, pictures one by one: see records= and frames=
    of an address. Of an instrument the newest shot is taken. acquired = delivered + dropped_device
    + dropped_host + failed counts every shot that it took, and clouds bear its numbers. Shots of
    which no cloud can be made are listed as they come, and the exit status is 1. latency_median_s is
    the time from the instrument's own stamp until the cloud is there (latency_from says so;
    "arrival" where it sends no time), with the least delay of its messages taken for none.

    Example: tofclip stream 'sim+remoteex://?seed=1' --shots 20 --out clouds/
    """
    require_format(suffix)
    if shots is not None and shots < 1:
        raise InputError(f"--shots must be positive, got {shots}")
    if out is not None:
        require_apart([out, *out.glob(f"cloud_*{suffix}")], [source, camera])
    coming = TrackedShots(
        _read_shots(source, None if bin_width_ps is None else bin_width_ps * PICOSECOND)
    )
    # The first shot brings the camera and the time axis of all.
    first = coming.peek()
    if first is None:
        fault = next(coming, None)
        if isinstance(fault, TofclipError):
            raise fault
        raise InputError(f"{source}: the source ended before it gave a shot")
    pipeline = _make_pipeline(
        first, camera, None if time_zero_ns is None else time_zero_ns * NANOSECOND, focus, method
    )
    if out is not None:  # only now: what cannot be streamed leaves no empty folder
        make_folder(out)
    # Instruments do not wait: the newest shot counts. Files do, and lose nothing.
    policy: Literal["drop_oldest", "block"] = "drop_oldest" if drop or coming.is_live else "block"
    failed = 0

    def note_failure(number: int, fault: TofclipError) -> None:
        nonlocal failed
        failed += 1
        print(f"tofclip: failed: shot {number}: {fault}", file=sys.stderr)

    with closing(stream_clouds(coming, pipeline, held, policy, on_failure=note_failure)) as made:
        figures = _consume_clouds(islice(made, shots), out, suffix, coming)
    # Counted last: only when the instrument has been stopped are its accounts final.
    accounts = coming.count_shots(figures["clouds"], failed)
    figures |= {"method": method, "dropped": accounts.dropped, **asdict(accounts)}
    report(figures, as_json, [] if out is None else [out])
    if failed:
        raise typer.Exit(EXIT_SOME_FAILED)


def _read_shots(
    source: str, bin_width: float | None
) -> Iterator[Streak] | Iterator[Streak | TofclipError]:
    """Shots of an instrument, a folder or a stack."""
    if "://" in source:
        return read_transients(source, bin_width)
    return map(_read_or_fail, list_shots(source, bin_width).values())


def _read_or_fail(shot: Shot) -> Streak | TofclipError:
    """Return the error of a shot that cannot be read, which lets those behind it go on."""
    try:
        return shot()
    except TofclipError as fault:
        return fault


def _make_pipeline(
    first: Streak, camera: Path | None, time_zero: float | None, focus: str, method: str
) -> CloudPipeline:
    chosen = parse_focus(focus)
    if isinstance(chosen, SharpestFocus):
        raise InputError("a stream has one focus for all shots: depth-locked or fixed:S")
    if method == SurfaceRecovery.name:  # each surface is recovered at the shear of its range
        return SurfacePipeline.for_shot(first, camera, time_zero)
    if method not in STREAM_METHODS:
        names = ", ".join((*STREAM_METHODS, SurfaceRecovery.name))
        raise InputError(f"a stream's method is one of {names}, not '{method}'")
    return RangingPipeline.for_shot(first, camera, chosen, time_zero, STREAM_METHODS[method]())


def _consume_clouds(
    made: Iterable[StreamedCloud], out: Path | None, suffix: str, shots: TrackedShots
) -> dict[str, Any]:
    """Take the clouds as they come; return what is reported of them at the end."""
    stages: dict[str, deque[float]] = {}
    latency: deque[float] = deque(maxlen=MAX_LATENCY_SAMPLES)
    ages: deque[float] = deque(maxlen=MAX_LATENCY_SAMPLES)
    clouds = points = 0
    origin = "file"
    started = perf_counter()
    for one in made:
        stamp = shots.get_stamp(one.shot)
        age = stamp.compute_age()
        ages.append(one.latency if age is None else age)
        origin = "instrument" if stamp.taken_at else "arrival" if stamp.received_at else origin
        latency.append(one.latency)
        if out is not None:
            one.cloud.save(build_cloud_path(out, stamp.number, suffix))
        clouds += 1
        points += len(one.cloud)
        for name, seconds in one.seconds.items():
            stages.setdefault(name, deque(maxlen=MAX_LATENCY_SAMPLES)).append(seconds)
    passed = perf_counter() - started
    return {
        "clouds": clouds,
        **{f"latency_{name}_s": value for name, value in _compute_quantiles(ages).items()},
        "latency_from": origin,
        "points": points,
        "clouds_per_second": clouds / passed,
        "latency_s": _compute_quantiles(latency),
        "stages_s": {name: _compute_quantiles(seconds) for name, seconds in stages.items()},
    }


def _compute_quantiles(seconds: Iterable[float]) -> Mapping[str, float]:
    values = np.fromiter(seconds, np.float64)
    return (
        dict(zip(("median", "p95"), np.quantile(values, (0.5, 0.95)).tolist(), strict=True))
        if values.size
        else {}
    )
