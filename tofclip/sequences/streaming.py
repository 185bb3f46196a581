"""Work on things while they come: a reader, a bounded queue, an executor, results in order.

    source --reader--> queue (drops or blocks) --> executor --> results in order

`run_in_order` serves streams of any kind, such as captures of hidden scenes; `stream_clouds` makes
clouds of shots: a file's, a folder's and an instrument's, on the command line and in a live view.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import AbstractContextManager, closing, nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from threading import Condition, RLock, Thread
from time import perf_counter
from typing import Any, Literal, NamedTuple, Protocol

import numpy as np

from tofclip.arrays import Float32Array
from tofclip.camera import Camera
from tofclip.errors import InputError, TofclipError, require
from tofclip.lidar import PointCloud, point_cloud
from tofclip.lidar.photons import PhotonCube
from tofclip.plugins import METHODS
from tofclip.recovery import Focus, SharpestFocus, SurfaceRecovery
from tofclip.recovery.defects import measure_levels, take_levels
from tofclip.recovery.shot import DEFAULT_FOCUS
from tofclip.sequences.counting import PhotonPipeline
from tofclip.sequences.ranger import (
    ChangedPipeline,
    RangingPipeline,
    StillAverage,
    SurfacePipeline,
)
from tofclip.shots import Returns, Streak
from tofclip.solvers import LinearInverse, ProximalMethod
from tofclip.threads import open_worker_pool, thread_count

LiveShot = Streak | PhotonCube


class CloudPipeline(Protocol):
    """What makes clouds of shots of one camera: `RangingPipeline` and `SurfacePipeline` of streak
    images, `PhotonPipeline` of histograms.
    """

    camera: Camera
    method_name: str

    @property
    def in_order(self) -> bool:
        """Whether what comes out of a shot depends on those before it."""

    def rectify(self, shot: Any, /) -> Any:
        """Do what can be done before anything is recovered; what comes out is for `recover`."""

    def recover(self, rectified: Any, /) -> Any:
        """Do what a shot needs as a whole; what comes out is for `search`."""

    def search(self, found: Any, /) -> Returns:
        """Find the returns in what `recover` returned."""


def make_pipeline(
    shot: LiveShot,
    camera: Path | Camera | None = None,
    time_zero: float | None = None,
    focus: Focus = DEFAULT_FOCUS,
    method: str | LinearInverse | ProximalMethod | SurfaceRecovery | None = None,
    average: int = 1,
) -> CloudPipeline:
    """Prepare for shots like this one: `PhotonPipeline` for histograms of a picture; of streak images
    `SurfacePipeline` by method "surfaces", else `RangingPipeline`.

    Parameters
    ----------
    shot : Streak or PhotonCube
        The first of all.
    camera : Path or Camera, optional
        By default the one that the shot carries; of histograms, `Camera.pinhole`.
    time_zero : float, optional
        Reading of the time axis at which light of range 0 would arrive, s; the camera's by default.
    focus : Focus
        One that needs no look at the shot: ``FixedFocus`` or ``DepthLockedFocus``.
    method : str, LinearInverse, ProximalMethod or SurfaceRecovery, optional
        Of streak images alone: ``"l1"``, the default, ``"tv"``, ``"linear"``, ``"surfaces"``, or another name of
        `tofclip.plugins.METHODS` that stands for one with a prior.
    average : int
        Streak images averaged at most, as far as nothing changes between them; histograms always are.

    Raises
    ------
    InputError
        No such method or focus, a method for histograms, or a streak image without a camera.
    """
    require(average >= 1, f"a stream averages 1 shot or more, not {average}")
    require(
        not isinstance(focus, SharpestFocus),
        "a stream has one focus for all shots: depth-locked or fixed:S",
    )
    if isinstance(shot, PhotonCube):
        require(
            average == 1,
            "photons of histograms are summed wherever nothing moves: leave out the average",
        )
        require(
            method is None,
            "histograms of a picture are ranged by their photons alone: leave out the method",
        )
        return PhotonPipeline.for_shot(shot, camera, time_zero)
    wanted = "l1" if method is None else method
    chosen = METHODS.make(wanted, {}) if isinstance(wanted, str) else wanted
    if not isinstance(chosen, LinearInverse | ProximalMethod | SurfaceRecovery):
        raise InputError(
            "a stream's method is linear, surfaces or one with a prior such as l1 or tv, "
            f"not '{method}'"
        )
    pipeline: RangingPipeline | SurfacePipeline
    if isinstance(chosen, SurfaceRecovery):  # each surface is recovered at the shear of its range
        pipeline = SurfacePipeline.for_shot(shot, camera, time_zero, chosen)
    else:
        pipeline = RangingPipeline.for_shot(shot, camera, focus, time_zero, chosen)
    changes: list[Callable[[Float32Array], Float32Array]] = []
    levels = measure_levels(shot.counts.astype(np.float32))
    if levels.any():
        changes.append(partial(take_levels, levels=levels))
    if average > 1:
        pulse_rows = pipeline.camera.pulse_fwhm / float(np.mean(np.diff(shot.times)))
        changes.append(StillAverage(shot.counts, pulse_rows, average).add)
    in_order = average > 1 or pipeline.in_order
    return ChangedPipeline(pipeline, changes, in_order) if changes else pipeline


Policy = Literal["block", "drop_oldest"]
POLICIES: tuple[Policy, ...] = ("block", "drop_oldest")
OnFailure = Callable[[int, TofclipError], object]

STOP_TIMEOUT_S = 5.0  # that the end of a stream waits for a source that is just being read
STEPS = ("rectify", "recover", "range", "place")  # what is done to a shot, in this order


@dataclass(frozen=True)
class StreamItem:
    """What became of one thing of a stream."""

    number: int  # its place in the source, from 0; those that were dropped have been counted
    value: Any  # what the work made of it
    read_seconds: float  # time that the source took to bring it, which is not latency
    latency: float  # time from when the source brought it until it was handed out, s


class _Arrival(NamedTuple):
    """One thing as the source brought it, `ready` at a reading of `perf_counter`."""

    number: int
    value: Any
    read_seconds: float
    ready: float


_Entry = tuple[_Arrival, Future[Any]]


def run_in_order(
    source: Iterable[Any],
    work: Callable[[Any], Any],
    executor: Executor,
    at_once: int,
    queue_size: int = 1,
    policy: Policy = "block",
    on_failure: OnFailure | None = None,
) -> Generator[StreamItem, None, None]:
    """Yield what `work` makes of everything that `source` brings, in order, while more is read and
    worked on.

    The source is read on a thread of its own; closing the generator stops it, and closes the source
    there if it can be closed. In the place of a thing that cannot be read may come its
    `TofclipError`. At most ``queue_size + at_once + 1`` things are alive besides the one handed out:
    those that wait, those that the executor (threads, processes, a cluster's workers) works on or has
    done before their turn, and the one that the reader holds.

    Policy ``"block"`` lets the source wait: nothing is lost of a file, and an instrument's own buffer
    fills up. ``"drop_oldest"`` keeps the latency low: what has waited longest is dropped, and of
    results that were finished while the consumer was busy it gets the newest.

    `on_failure` is called with the number of a thing of which nothing can be made, and its error; by
    default the error ends the stream.
    """
    for what, number in (("works on", at_once), ("holds", queue_size)):
        require(number >= 1, f"a stream {what} one entry or more, not {number}")
    require(
        policy in POLICIES, f"a stream's policy is one of {', '.join(POLICIES)}, not '{policy}'"
    )
    drops = policy == "drop_oldest"

    def submit(value: Any) -> Future[Any]:
        return executor.submit(_raise_or_work, work, value)

    stream = _Stream(source, submit, at_once, queue_size, drops)
    reader = Thread(target=stream.read, name="stream reader", daemon=True)
    reader.start()
    try:
        while (entry := stream.wait_for_next()) is not None:
            fault = entry[1].exception()
            stream.make_room()
            if fault is not None:
                if on_failure is None or not isinstance(fault, TofclipError):
                    raise fault
                on_failure(entry[0].number, fault)
                continue
            arrival, future = stream.skip_to_newest(entry) if drops else entry
            seconds = perf_counter() - arrival.ready
            yield StreamItem(arrival.number, future.result(), arrival.read_seconds, seconds)
    finally:
        stream.close()
        reader.join(STOP_TIMEOUT_S)


def _raise_or_work(work: Callable[[Any], Any], value: Any) -> Any:
    if isinstance(value, TofclipError):
        raise value
    return work(value)


class _Stream:
    """What reader and consumer share: things that wait and things that the executor has. Nothing
    waits while the executor has room: in its own queue a thing could no longer be dropped, and
    would grow old.
    """

    def __init__(
        self,
        source: Iterable[Any],
        submit: Callable[[Any], Future[Any]],
        at_once: int,
        queue_size: int,
        drops: bool,
    ) -> None:
        self._source, self._submit, self._room = source, submit, at_once
        self._queue_size, self._drops = queue_size, drops
        self._waiting: deque[_Arrival] = deque()
        self._started: deque[_Entry] = deque()
        # One lock for all fields; every change wakes both sides, which test again in a loop. Entered by
        # itself: Ctrl-C between the lines of a condition's `__enter__` would leave it locked.
        self._lock = RLock()
        self._changed = Condition(self._lock)
        self._closed = self._ended = False
        self._fault: BaseException | None = None

    def read(self) -> None:
        """Bring what the source has; the reader's whole life."""
        items = iter(self._source)
        try:
            began = perf_counter()
            for number, value in enumerate(items):
                now = perf_counter()
                self._bring(_Arrival(number, value, now - began, now))
                if self._closed:
                    break
                began = perf_counter()
        except BaseException as fault:  # the consumer gets to see it
            self._fault = fault
        with self._lock:
            self._ended = True
            self._changed.notify_all()
        if self._closed:  # on this thread: a generator cannot be closed while another one runs it
            getattr(items, "close", lambda: None)()

    def _bring(self, arrival: _Arrival) -> None:
        with self._lock:
            while len(self._waiting) >= self._queue_size and not self._closed:
                if self._drops:
                    self._waiting.popleft()
                else:
                    self._changed.wait()
            self._waiting.append(arrival)
            self._start_waiting()

    def _start_waiting(self) -> None:
        while self._waiting and self._room > 0 and not self._closed:
            arrival = self._waiting.popleft()
            self._room -= 1
            # Without its value: the executor alone holds a shot, until its work is done.
            self._started.append((arrival._replace(value=None), self._submit(arrival.value)))
        self._changed.notify_all()

    def wait_for_next(self) -> _Entry | None:
        """Return what was started first; behind the last one None, or the source's fault."""
        with self._lock:
            while not self._started and not self._ended:
                self._changed.wait()
            if self._started:
                return self._started.popleft()
            if self._fault is not None:
                raise self._fault
            return None

    def make_room(self) -> None:
        """Say that a result has been taken."""
        with self._lock:
            self._room += 1
            self._start_waiting()

    def skip_to_newest(self, entry: _Entry) -> _Entry:
        """Drop results that were finished while the consumer was busy; what failed is not newer."""
        with self._lock:
            while self._started and (later := self._started[0][1]).done() and not later.exception():
                entry = self._started.popleft()
                self._room += 1
            self._start_waiting()
        return entry

    def close(self) -> None:
        """Let go of everything; nothing is started from now on."""
        with self._lock:
            self._closed = True
            self._waiting.clear()  # memory is freed even while the reader still runs
            self._changed.notify_all()


@dataclass(frozen=True)
class StreamedCloud:
    """A cloud as it comes out of a stream."""

    cloud: PointCloud
    returns: Returns  # those that the cloud's points are, in the same order
    taken: LiveShot  # the shot
    shot: int  # number of its shot in the source, from 0; what was dropped has been counted
    # what each step took: ``"read"`` (the source, which is not latency), ``"wait"`` (until its turn
    # came), ``"rectify"``, ``"recover"``, ``"range"`` and ``"place"``
    seconds: Mapping[str, float]
    latency: float  # time from when the shot was there until its cloud was handed out, s


def stream_clouds(
    shots: Iterable[LiveShot | TofclipError],
    pipeline: CloudPipeline | None = None,
    queue_size: int = 1,
    policy: Policy = "block",
    executor: Executor | None = None,
    at_once: int | None = None,
    on_failure: OnFailure | None = None,
) -> Generator[StreamedCloud, None, None]:
    """Yield the cloud of every shot as soon as it is made, see `run_in_order`; by that of
    `make_pipeline` for the first shot if no other is given.

    By default a shot has a core: shared out among all, it would be done sooner, but cores would wait
    for each other. Where a shot begins at what the last one showed, all cores work on it. Memory:
    ``queue_size + at_once + 1`` shots, one more for each core with what is recovered of it, and what
    the pipeline takes.
    """
    coming = iter(shots)
    if pipeline is None:
        first = next(coming, None)
        if first is None:
            return
        if isinstance(first, TofclipError):
            raise first
        # streak images on workers of one's own cannot begin at the last one's pictures
        alone = executor is not None and isinstance(first, Streak)
        pipeline = make_pipeline(first, method="linear" if alone else None)
        coming = _prepend_shot(first, coming)
    pool: AbstractContextManager[Executor]
    if executor is not None:
        pool = nullcontext(executor)
    else:
        pool = ThreadPoolExecutor(1, "tofclip") if pipeline.in_order else open_worker_pool()
    if at_once is None:
        # One more than cores: results are taken in order, and a core whose shot was done before its
        # turn has the next one at hand. It grows old there, where the queue would have a newer.
        at_once = (1 if pipeline.in_order else thread_count()) + (policy == "block")
    work = partial(_make_cloud, pipeline)
    with (
        pool as workers,
        closing(
            run_in_order(coming, work, workers, at_once, queue_size, policy, on_failure)
        ) as items,
    ):
        for item in items:
            taken, returns, cloud, seconds = item.value
            waited = item.latency - sum(seconds.values())
            steps = {"read": item.read_seconds, "wait": waited, **seconds}
            yield StreamedCloud(cloud, returns, taken, item.number, steps, item.latency)


def _make_cloud(
    pipeline: CloudPipeline, shot: LiveShot
) -> tuple[LiveShot, Returns, PointCloud, dict[str, float]]:
    """Return a shot with its returns and cloud, and what each step took, s."""
    made, seconds = list[Any]([shot]), dict[str, float]()
    steps = pipeline.rectify, pipeline.recover, pipeline.search, point_cloud
    for name, work in zip(STEPS, steps, strict=True):
        began = perf_counter()
        made.append(work(made[-1]))
        seconds[name] = perf_counter() - began
    return shot, made[-2], made[-1], seconds


def _prepend_shot(
    first: LiveShot, others: Iterator[LiveShot | TofclipError]
) -> Iterator[LiveShot | TofclipError]:
    """Put a shot back before the others; closing this closes them."""
    yield first
    yield from others
