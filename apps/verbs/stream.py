"""`tofclip stream`: shots to clouds while they come, with every stage's latency."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from contextlib import closing
from itertools import islice
from pathlib import Path
from time import monotonic, perf_counter
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
import typer

from apps.options import JsonOption, TimeZeroOption
from apps.report import report
from apps.verbs.cloud import require_format
from devices.transients import TransientStream, read_transients
from tofclip.errors import InputError
from tofclip.recovery import SharpestFocus, parse_focus
from tofclip.sequences import list_shots
from tofclip.sequences.ranger import RangingPipeline, build_cloud_path
from tofclip.sequences.streaming import stream_clouds
from tofclip.units import NANOSECOND, PICOSECOND

if TYPE_CHECKING:
    from tofclip.sequences.streaming import StreamedCloud
    from tofclip.shots import Streak

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
    shots: Annotated[
        int | None,
        typer.Option(
            metavar="N", help="Stop after so many clouds.", show_default="at the source's end"
        ),
    ] = None,
    held: Annotated[
        int, typer.Option(metavar="N", help="Shots that may wait before each stage.")
    ] = 1,
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
    """Make a cloud of each shot by the linear inverse while the next ones come, and tell rate and
    latencies.

    Photons become a shot for every so many of them, pictures one by one: see records= and frames=
    of an address.

    Example: tofclip stream 'sim+remoteex://?seed=1' --shots 20 --out clouds/
    """
    require_format(suffix)
    if shots is not None and shots < 1:
        raise InputError(f"--shots must be positive, got {shots}")
    if out is not None:
        from apps.files import make_folder

        make_folder(out)
    coming = _read_shots(source, None if bin_width_ps is None else bin_width_ps * PICOSECOND)
    # The first shot brings the camera and the time axis of all.
    first = next(coming, None)
    if first is None:
        raise InputError(f"{source}: the source ended before it gave a shot")
    pipeline = _make_ranger(
        first, camera, None if time_zero_ns is None else time_zero_ns * NANOSECOND, focus
    )
    clock = _ShotClock(coming)
    # Instruments do not wait: the newest shot counts. Files do, and lose nothing.
    policy: Literal["drop_oldest", "block"] = "drop_oldest" if drop or clock.is_live else "block"
    with closing(stream_clouds(clock.prepend(first), pipeline, held, policy)) as made:
        figures = _consume_clouds(islice(made, shots), out, suffix, clock)
    report(figures, as_json, [] if out is None else [out])


def _read_shots(source: str, bin_width: float | None) -> Iterator[Streak]:
    """Shots of an instrument, a folder or a stack."""
    if "://" in source:
        return read_transients(source, bin_width)
    return (shot() for shot in list_shots(source, bin_width).values())


def _make_ranger(
    first: Streak, camera: Path | None, time_zero: float | None, focus: str
) -> RangingPipeline:
    chosen = parse_focus(focus)
    if isinstance(chosen, SharpestFocus):
        raise InputError("a stream has one focus for all shots: depth-locked or fixed:S")
    return RangingPipeline.for_shot(first, camera, chosen, time_zero)


class _ShotClock:
    """Notes when each shot's data came from the instrument, and how many there were.

    Parameters
    ----------
    coming : iterator of Streak
        Behind the first one, which has been taken already.
    """

    def __init__(self, coming: Iterator[Streak]) -> None:
        self._coming = coming
        self._stream = coming if isinstance(coming, TransientStream) else None
        self._received: dict[int, float] = {}
        self._taken = 0
        self._note()

    @property
    def is_live(self) -> bool:
        """Whether an instrument is read, so that what comes too late is dropped."""
        return self._stream is not None and self._stream.is_live

    def prepend(self, first: Streak) -> Iterator[Streak]:
        """Put the shot that told the camera back before the others."""
        yield first
        for shot in self._coming:
            self._note()
            yield shot

    def get_age(self, shot: int) -> float | None:
        """Return the seconds since a shot's data came, None where that is not known."""
        received = self._received.pop(shot, 0.0)
        return monotonic() - received if received else None

    def count_shots(self, clouds: int) -> dict[str, int]:
        """Return where every shot went, given how many became clouds."""
        acquired, lost = self._taken, 0
        if self._stream is not None:
            # The instrument knows of shots that never reached this program.
            acquired = max(self._stream.shots_acquired, self._taken)
            lost = self._stream.shots_lost
        return {
            "acquired": acquired,
            "delivered": clouds,
            "dropped_device": lost,
            "dropped_host": acquired - lost - clouds,
        }

    def _note(self) -> None:
        if self._stream is not None and self._stream.received_at:
            self._received[self._taken] = self._stream.received_at
            self._received.pop(self._taken - MAX_LATENCY_SAMPLES, None)  # it was dropped
        self._taken += 1


def _consume_clouds(
    made: Iterable[StreamedCloud], out: Path | None, suffix: str, clock: _ShotClock
) -> Mapping[str, Any]:
    """Take the clouds as they come; return what is told at the end."""
    stages: dict[str, deque[float]] = {}
    latency: deque[float] = deque(maxlen=MAX_LATENCY_SAMPLES)
    ages: deque[float] = deque(maxlen=MAX_LATENCY_SAMPLES)
    clouds = points = 0
    started = perf_counter()
    for one in made:
        if out is not None:
            one.cloud.save(build_cloud_path(out, one.shot, suffix))
        clouds += 1
        points += len(one.cloud)
        latency.append(one.latency)
        age = clock.get_age(one.shot)
        ages.append(one.latency if age is None else age)
        for name, seconds in one.seconds.items():
            stages.setdefault(name, deque(maxlen=MAX_LATENCY_SAMPLES)).append(seconds)
    passed = perf_counter() - started
    shots = clock.count_shots(clouds)
    return {
        "clouds": clouds,
        "dropped": shots["dropped_device"] + shots["dropped_host"],
        **shots,
        **{f"latency_{name}_s": value for name, value in _compute_quantiles(ages).items()},
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
