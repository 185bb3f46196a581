"""`tofclip stream`: shots to clouds while they come, with every stage's latency."""

from __future__ import annotations

import sys
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from apps.options import (
    BIN_WIDTH,
    CAMERA,
    FOCUS,
    FRAME_ID,
    JSON,
    SUFFIX,
    TIME_ZERO,
    TOPIC,
    arg,
    flag,
    opt,
)
from apps.progress import EXIT_SOME_FAILED
from apps.report import make_folder, name_options, report, require_new, require_writable
from apps.verbs.recover import require_format
from tofclip.errors import InputError, TofclipError
from tofclip.files import require_apart

if TYPE_CHECKING:
    from devices.transients import ShotStamp, TrackedShots
    from tofclip.lidar import PointCloud
    from tofclip.sequences.streaming import LiveShot, StreamedCloud

MAX_LATENCY_SAMPLES = 10_000  # over which medians are taken: a stream may run for days


def stream(
    source: str = arg(
        "SOURCE",
        "An instrument's address such as 'sim+remoteex://?seed=1', a folder of shots or an HDF5 stack.",
        read=True,
    ),
    out: Path | None = opt(
        "FOLDER",
        "Where the clouds go; a name that ends in .mcap is one file of ROS 2 messages with the instrument's stamps.",
        shown="nowhere",
    ),
    camera: Path | None = CAMERA,
    bin_width: float | None = BIN_WIDTH,
    time_zero: float | None = TIME_ZERO,
    focus: str = FOCUS,
    method: str | None = opt(
        "NAME",
        "Of streak images. l1 or tv: twelve iterations that begin at the last shot's pictures; linear, the "
        "fastest on small pictures, which draws rays around bright objects; or surfaces, the truest and "
        "slowest, which follow those of the last shot.",
        shown="l1",
    ),
    average: int = opt(
        "N", "Streak images averaged at most, as far as nothing changes; histograms always are.", 1
    ),
    shots: int | None = opt("N", "Stop after this number of clouds.", shown="at the source's end"),
    held: int = opt("N", "Shots that may wait for their turn.", 1),
    drop: bool = flag(
        "--drop",
        "Drop the oldest waiting shot where they come too fast, as always for an instrument.",
    ),
    suffix: str = SUFFIX,
    topic: str | None = TOPIC,
    frame_id: str = FRAME_ID,
    as_json: bool = JSON,
) -> None:
    """Make a cloud of each shot while the next ones come; report method, rate and latencies.

    Photons become a shot in batches, pictures one by one: see records= and frames=
    of an address. Of an instrument the newest shot is taken. acquired = delivered + dropped_device
    + dropped_host + failed counts every shot that it took, and clouds bear its numbers. Shots of
    which no cloud can be made are listed as they come, and the exit status is 1. latency_median_s is
    the time from the instrument's own stamp until the cloud is there (latency_from says so;
    "arrival" where it sends no time), taking the shortest message delay as zero.

    Example: tofclip stream 'sim+remoteex://?seed=1' --shots 20 --out clouds/
    """
    from dataclasses import asdict
    from itertools import islice

    from devices.transients import TrackedShots
    from tofclip.lidar import ros
    from tofclip.recovery import parse_focus
    from tofclip.sequences import make_pipeline
    from tofclip.sequences.ranger import build_cloud_path
    from tofclip.sequences.streaming import stream_clouds

    require_format(suffix)
    if shots is not None and shots < 1:
        raise InputError(f"--shots must be positive, got {shots}")
    is_file = out is not None and out.suffix.lower() == ros.MCAP_SUFFIX
    if out is not None and is_file:
        require_writable(out, inputs=(source, camera))
    elif out is not None:
        existing = list(out.glob(f"cloud_*{suffix}"))
        require_apart([out, *existing], [source, camera])
        require_new(*existing)
    coming = TrackedShots(_read_shots(source, bin_width))
    # The first shot brings the camera and the time axis of all.
    first = coming.peek()
    if first is None:
        fault = next(coming, None)
        if isinstance(fault, TofclipError):
            raise fault
        raise InputError(f"{source}: the source ended before it gave a shot")
    pipeline = make_pipeline(first, camera, time_zero, parse_focus(focus), method, average)
    if out is not None and not is_file:  # only now: what cannot be streamed leaves no empty folder
        make_folder(out)
    failed = 0

    def note_failure(number: int, fault: TofclipError) -> None:
        nonlocal failed
        failed += 1
        print(f"tofclip: failed: shot {number}: {name_options(str(fault))}", file=sys.stderr)

    # Instruments do not wait: the newest shot counts. Files do, and lose nothing.
    made = stream_clouds(
        coming,
        pipeline,
        held,
        "drop_oldest" if drop or coming.is_live else "block",
        on_failure=note_failure,
    )
    tally = _Tally()
    with closing(made):
        taken = tally.watch(islice(made, shots), coming)
        if out is None:
            deque(taken, maxlen=0)
        elif is_file:
            stamped = (ros.StampedCloud(cloud, stamp.epoch_ns) for cloud, stamp in taken)
            ros.write_bag(stamped, out, topic or ros.TOPIC, frame_id)
        else:
            for cloud, stamp in taken:
                cloud.save(build_cloud_path(out, stamp.number, suffix))
    # Counted last: only when the instrument has been stopped are its accounts final.
    accounts = coming.count_shots(tally.clouds, failed)
    figures = tally.list_figures() | {
        "method": pipeline.method_name,
        "dropped": accounts.dropped,
        **asdict(accounts),
    }
    report(figures, as_json, [] if out is None else [out], json_only=["latency_s"])
    if failed:
        raise typer.Exit(EXIT_SOME_FAILED)


def _read_shots(
    source: str, bin_width: float | None
) -> Iterator[LiveShot] | Iterator[LiveShot | TofclipError]:
    """Shots of an instrument, a folder or a stack; in the place of one that cannot be read its
    error, which lets those behind it go on.
    """
    from devices.transients import find_address, read_transients
    from tofclip.sequences import list_shots

    address = source if "://" in source else Path(source).is_file() and find_address(source)
    if address:
        return read_transients(address, bin_width)

    def read(shot: Callable[[], LiveShot]) -> LiveShot | TofclipError:
        try:
            return shot()
        except TofclipError as fault:
            return fault

    return map(read, list_shots(source, bin_width).values())


class _Tally:
    """What is reported of clouds as they come."""

    def __init__(self) -> None:
        self.clouds = self.points = 0
        self._stages: dict[str, deque[float]] = {}
        self._latency: deque[float] = deque(maxlen=MAX_LATENCY_SAMPLES)
        self._ages: deque[float] = deque(maxlen=MAX_LATENCY_SAMPLES)
        self._origin, self._seconds = "file", 0.0

    def watch(
        self, made: Iterable[StreamedCloud], shots: TrackedShots
    ) -> Iterator[tuple[PointCloud, ShotStamp]]:
        """Yield every cloud with its shot's stamp."""
        from time import perf_counter

        started = perf_counter()
        for one in made:
            stamp = shots.get_stamp(one.shot)
            age = stamp.compute_age()
            self._ages.append(one.latency if age is None else age)
            known = "instrument" if stamp.taken_at else "arrival" if stamp.received_at else ""
            self._origin = known or self._origin
            self._latency.append(one.latency)
            yield one.cloud, stamp
            self.clouds += 1
            self.points += len(one.cloud)
            for name, seconds in one.seconds.items():
                self._stages.setdefault(name, deque(maxlen=MAX_LATENCY_SAMPLES)).append(seconds)
            self._seconds = perf_counter() - started

    def list_figures(self) -> dict[str, Any]:
        """What is reported at the end."""
        ages = compute_quantiles(self._ages)
        stages = {name: compute_quantiles(seconds) for name, seconds in self._stages.items()}
        return {
            "clouds": self.clouds,
            **{f"latency_{name}_s": value for name, value in ages.items()},
            "latency_from": self._origin,
            "points": self.points,
            "clouds_per_second": self.clouds / self._seconds if self.clouds else 0.0,
            "latency_s": compute_quantiles(self._latency),
            "stages_s": stages,
        }


def compute_quantiles(seconds: Iterable[float]) -> dict[str, float]:
    """Return median and 95th percentile by their names; nothing of nothing."""
    import numpy as np

    values = list(seconds)
    found = np.quantile(values, (0.5, 0.95)).tolist() if values else ()
    return dict(zip(("median", "p95"), found, strict=False))
