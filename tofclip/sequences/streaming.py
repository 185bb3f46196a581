"""Shots to clouds while they come: a reader, a bounded channel, an executor, results in order.

    source --reader--> channel (drops or blocks) --dispatcher--> executor --> results in order

The one road from many shots to clouds in this process: a file's, a folder's and an instrument's
shots take it, on the command line and in a live view.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import AbstractContextManager, closing, nullcontext
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import pairwise
from threading import Condition, Semaphore, Thread
from time import perf_counter
from typing import Any, Generic, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from tofclip.camera import Rectifier
from tofclip.errors import InputError, TofclipError
from tofclip.lidar import PointCloud, point_cloud
from tofclip.sequences.ranger import CloudPipeline, RangingPipeline
from tofclip.shots import Returns, Streak
from tofclip.threads import open_worker_pool, thread_count

Policy = Literal["block", "drop_oldest"]
"""What happens to a full channel: the producer waits, or what has waited longest is dropped."""

POLICIES: tuple[Policy, ...] = ("block", "drop_oldest")
STOP_TIMEOUT_S = 5.0
"""Seconds that the end of a stream waits for a source that is just being read."""

READ, WAIT = "read", "wait"
STEPS = ("rectify", "recover", "range", "place")
"""What is done to a shot, in this order."""

Entry = TypeVar("Entry")


class ChannelClosedError(Exception):
    """No consumer takes entries any more."""


class Channel(Generic[Entry]):
    """Hands entries from one thread to another, in order.

    `capacity`: entries held at most.
    """

    def __init__(self, capacity: int, policy: Policy = "block") -> None:
        if capacity < 1:
            raise InputError(f"a channel holds one entry or more, not {capacity}")
        if policy not in POLICIES:
            raise InputError(
                f"a full channel's policy is one of {', '.join(POLICIES)}, not '{policy}'"
            )
        self._capacity, self._policy = capacity, policy
        self._entries: deque[Entry] = deque()
        # One lock for all fields; every change wakes both sides, which test again in a loop.
        self._changed = Condition()
        self._finished = self._closed = False
        self._fault: BaseException | None = None
        self.dropped = 0

    def put(self, entry: Entry) -> None:
        """Hand one entry over."""
        with self._changed:
            while len(self._entries) >= self._capacity and not self._closed:
                if self._policy == "drop_oldest":
                    self._entries.popleft()
                    self.dropped += 1
                else:
                    self._changed.wait()
            if self._closed:
                raise ChannelClosedError
            self._entries.append(entry)
            self._changed.notify_all()

    def finish(self, fault: BaseException | None = None) -> None:
        """Say that no further entry will come, because of a fault or because that was all."""
        with self._changed:
            self._finished, self._fault = True, fault
            self._changed.notify_all()

    def get(self) -> Entry | None:
        """Return the next entry, or None behind the last one; there a fault is raised."""
        with self._changed:
            while not self._entries and not self._finished and not self._closed:
                self._changed.wait()
            if self._entries and not self._closed:
                entry = self._entries.popleft()
                self._changed.notify_all()
                return entry
            # Raised only when the queue is empty, so that what came before the fault is still
            # delivered.
            if self._fault is not None:
                raise self._fault
            return None

    def peek(self) -> Entry | None:
        """Return what `get` would return next, without taking it; None where that has to come."""
        with self._changed:
            return self._entries[0] if self._entries else None

    def close(self) -> None:
        """Let go of everything; `put` fails from now on and `get` returns None."""
        with self._changed:
            self._closed = True
            # Cleared so that memory is freed even while a thread still holds the channel.
            self._entries.clear()
            self._changed.notify_all()


@dataclass(frozen=True)
class StreamItem:
    """What became of one thing of a stream."""

    number: int  # its place in the source, from 0; those that were dropped have been counted
    value: Any  # what the work made of it
    read_seconds: float  # time that the source took to bring it, which is not latency
    latency: float  # time from when the source brought it until it was handed out, s


@dataclass(frozen=True)
class _Arrival:
    """One thing as the source brought it, `ready` at a reading of `perf_counter`."""

    number: int
    value: Any
    read_seconds: float
    ready: float


_Started = tuple[_Arrival, "Future[Any]"]


def run_in_order(
    source: Iterable[Any],
    work: Callable[[Any], Any],
    executor: Executor,
    at_once: int,
    queue_size: int = 1,
    policy: Policy = "block",
) -> Generator[StreamItem, None, None]:
    """Yield what `work` makes of everything that `source` brings, in order, while more is read and
    worked on.

    The source is read on a thread of its own. When the consumer is slow the work waits for it, then
    the channel behind the source is full, and there the policy decides. With ``"drop_oldest"`` the
    consumer gets the newest of the results that were finished meanwhile, which is about as old as
    its own work on the one before takes; at most ``at_once - 1`` things were worked on in vain. At most
    ``queue_size + at_once + 1`` things are alive besides the one handed out: those that wait, those
    that are worked on or done before their turn, and the one that the reader holds. Closing the
    generator stops the threads, and closes the source on its own thread if it can be closed.

    `work`: called by the executor; must not depend on the order in which things are done;
    `executor`: threads, processes or a cluster's workers; where they are processes, work and things
    have to survive pickling; `at_once`: things that the executor has at a time, at most;
    `queue_size`: things that wait before it, at most; `policy`: ``"block"`` lets the source wait:
    nothing is lost of a file, and an instrument's own buffer fills up. ``"drop_oldest"`` keeps the
    latency low: a live view takes the newest.
    """
    if at_once < 1:
        raise InputError(f"a stream works on one thing or more at once, not {at_once}")
    waiting = Channel[_Arrival](queue_size, policy)
    started = Channel[_Started](at_once)
    # A thing is taken out of the channel only when the executor has room: in the executor's own
    # queue it could no longer be dropped, and would grow old.
    room = Semaphore(at_once)
    threads = [
        Thread(target=_read_source, args=(source, waiting), name="stream reader", daemon=True),
        Thread(
            target=_dispatch,
            args=(waiting, started, room, lambda value: executor.submit(work, value)),
            name="stream dispatcher",
            daemon=True,
        ),
    ]
    for thread in threads:
        thread.start()
    try:
        while (entry := started.get()) is not None:
            value = entry[1].result()
            room.release()
            if policy == "drop_oldest":
                # Results that were finished while the consumer was busy: only the newest is news.
                while (later := started.peek()) is not None and _has_result(later[1]):
                    started.get()
                    room.release()
                    entry, value = later, later[1].result()
            arrival = entry[0]
            yield StreamItem(
                arrival.number, value, arrival.read_seconds, perf_counter() - arrival.ready
            )
    finally:
        # First both channels and the room, then the threads: one that waits for a neighbour must
        # wake up.
        waiting.close()
        started.close()
        room.release()
        for thread in threads:
            thread.join(STOP_TIMEOUT_S)


def _dispatch(
    source: Channel[_Arrival],
    target: Channel[_Started],
    room: Semaphore,
    submit: Callable[[Any], Future[Any]],
) -> None:
    """Hand things to the executor as it has room; the dispatcher's whole life."""
    try:
        while room.acquire() and (arrival := source.get()) is not None:
            # Without its value: the executor alone holds a shot, until its work is done.
            target.put((replace(arrival, value=None), submit(arrival.value)))
        target.finish()
    except ChannelClosedError:
        pass
    except BaseException as fault:  # the consumer gets to see it
        target.finish(fault)


def _has_result(future: Future[Any]) -> bool:
    """Whether work is done and went well: what failed is not newer than what did not."""
    if not future.done() or future.exception() is not None:
        return False
    return not isinstance(future.result(), TofclipError)


def _read_source(source: Iterable[Any], target: Channel[_Arrival]) -> None:
    """Bring what the source has; the reader's whole life."""
    items = iter(source)
    try:
        began = perf_counter()
        for number, value in enumerate(items):
            now = perf_counter()
            target.put(_Arrival(number, value, now - began, now))
            began = perf_counter()
        target.finish()
    except ChannelClosedError:
        # Closed on this thread, because a generator cannot be closed while another thread runs it.
        getattr(items, "close", lambda: None)()
    except BaseException as fault:  # the consumer gets to see it
        target.finish(fault)


@dataclass(frozen=True)
class StreamedCloud:
    """A cloud as it comes out of a stream."""

    cloud: PointCloud
    returns: Returns  # those that the cloud's points are, in the same order
    streak: Streak  # the shot
    rectifier: Rectifier  # of its camera
    shot: int  # number of its shot in the source, from 0; what was dropped has been counted
    # what each step took: ``"read"`` (the source, which is not latency), ``"wait"`` (until its turn
    # came), ``"rectify"``, ``"recover"``, ``"range"`` and ``"place"``
    seconds: Mapping[str, float]
    latency: float  # time from when the shot was there until its cloud was handed out, s

    @cached_property
    def measurements(self) -> NDArray[np.float32]:
        """The shot, rectified, (columns, rows). Worked out when it is asked for: memory that every
        shot takes anew takes longer to get than to fill.
        """
        return self.rectifier.rectify(self.streak.counts)


def stream_clouds(
    shots: Iterable[Streak | TofclipError],
    pipeline: CloudPipeline | None = None,
    queue_size: int = 1,
    policy: Policy = "block",
    executor: Executor | None = None,
    at_once: int | None = None,
    on_failure: Callable[[int, TofclipError], object] | None = None,
) -> Generator[StreamedCloud, None, None]:
    """Yield the cloud of every shot, as soon as it is made.

    A shot is rectified and recovered, its returns are found and placed in space, while other shots
    are worked on and the next ones are read.

    `shots`: A file's, a folder's or an instrument's; it is read on a thread of its own. In the
    place of a shot that cannot be read may come its error; `pipeline`: by default a
    `RangingPipeline` for the camera that the first shot carries; `queue_size`: shots that wait for
    their turn, at most; `policy`: what happens when shots come faster than the clouds are taken;
    see `run_in_order`; `executor`: where the work is done; `at_once`: shots that the executor has
    at a time; by default as many as there are cores, and one more where all shots are worth waiting
    for; `on_failure`: called with the number of a shot of which no cloud can be made, and its
    error; the stream goes on. By default the error ends it.

    Memory: ``queue_size + at_once + 1`` shots, one more for each core with what is recovered of it,
    and what a `RangingPipeline` takes.
    """
    coming = iter(shots)
    if pipeline is None:
        first = next(coming, None)
        if first is None:
            return
        if isinstance(first, TofclipError):
            raise first
        pipeline, coming = RangingPipeline.for_shot(first), _prepend_shot(first, coming)
    # A core for each shot: shared out among all, a shot would be done sooner, but cores would wait
    # for each other.
    pool: AbstractContextManager[Executor]
    if executor is None:
        # Where a shot begins at what the last one showed, all cores work on it.
        pool = ThreadPoolExecutor(1, "tofclip") if pipeline.in_order else open_worker_pool()
    else:
        pool = nullcontext(executor)
    with pool as workers:
        # One more than cores: results are taken in order, and a core whose shot was done before its
        # turn has the next one at hand. It grows old there, where the channel would have a newer.
        cores = 1 if pipeline.in_order else thread_count()
        room = cores + (policy == "block") if at_once is None else at_once
        work = partial(_make_cloud_or_fail, pipeline)
        with closing(run_in_order(coming, work, workers, room, queue_size, policy)) as items:
            for item in items:
                if isinstance(item.value, TofclipError):
                    if on_failure is None:
                        raise item.value
                    on_failure(item.number, item.value)
                    continue
                streak, returns, cloud, seconds = item.value
                waited = item.latency - sum(seconds.values())
                steps = {READ: item.read_seconds, WAIT: waited, **seconds}
                yield StreamedCloud(
                    cloud, returns, streak, pipeline.rectifier, item.number, steps, item.latency
                )


_Made = tuple[Streak, Returns, PointCloud, dict[str, float]]


def _make_cloud_or_fail(
    pipeline: CloudPipeline, shot: Streak | TofclipError
) -> _Made | TofclipError:
    """Return the error of a shot as a result, which lets those behind it go on."""
    try:
        return shot if isinstance(shot, TofclipError) else _make_cloud(pipeline, shot)
    except TofclipError as fault:
        return fault


def _make_cloud(pipeline: CloudPipeline, shot: Streak) -> _Made:
    """Return a shot with its returns and cloud, and what each step took, s."""
    ends = [perf_counter()]
    rectified = pipeline.rectify(shot)
    ends.append(perf_counter())
    found = pipeline.recover_shot(shot, rectified)
    ends.append(perf_counter())
    returns = pipeline.search(found)
    ends.append(perf_counter())
    cloud = point_cloud(returns)
    ends.append(perf_counter())
    seconds = [end - begin for begin, end in pairwise(ends)]
    return shot, returns, cloud, dict(zip(STEPS, seconds, strict=True))


def _prepend_shot(
    first: Streak, others: Iterator[Streak | TofclipError]
) -> Iterator[Streak | TofclipError]:
    """Put a shot back before the others; closing this closes them."""
    yield first
    yield from others
