"""Shots to clouds while they come."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from concurrent.futures import Future
from contextlib import closing
from dataclasses import dataclass
from time import perf_counter
from typing import Any

from tofclip.lidar.cloud import PointCloud, point_cloud
from tofclip.sequences.ranger import RangingPipeline
from tofclip.sequences.streaming.channel import Policy
from tofclip.sequences.streaming.stages import READ, WAIT, Stage, run_stages
from tofclip.shots import Streak
from tofclip.threads import open_worker_pool


@dataclass(frozen=True)
class StreamedCloud:
    """A cloud as it comes out of a stream.

    Parameters
    ----------
    cloud : PointCloud
    shot : int
        Number of its shot in the source, from 0; what was dropped has been counted.
    seconds : mapping
        What each stage took: ``"read"`` (the source, which is not latency), ``"wait"`` (until its
        turn came), ``"rectify"``, ``"recover"``, ``"range"`` and ``"place"``.
    latency : float
        Time from when the shot was there until its cloud was handed out, s.
    """

    cloud: PointCloud
    shot: int
    seconds: Mapping[str, float]
    latency: float


def stream_clouds(
    shots: Iterable[Streak],
    pipeline: RangingPipeline | None = None,
    queue_size: int = 1,
    policy: Policy = "block",
) -> Generator[StreamedCloud, None, None]:
    """Yield the cloud of every shot by the linear inverse, as soon as it is made.

    A shot is rectified and recovered, its returns are found and placed in space, all on one core,
    while the other cores work on other shots and the next ones are read. Until the stream ends,
    NumPy's products keep to one thread.

    Parameters
    ----------
    shots : iterable of Streak
        A file's, a folder's or an instrument's; it is read on a thread of its own.
    pipeline : RangingPipeline, optional
        By default one for the camera that the first shot carries.
    queue_size : int
        Shots that wait before each stage, at most.
    policy : "block" or "drop_oldest"
        What happens when shots come faster than the clouds are taken; see `run_stages`.

    Yields
    ------
    StreamedCloud

    Raises
    ------
    Whatever reading a shot or making its cloud raises, once the clouds before it have been yielded.

    Notes
    -----
    Memory: ``3 * (held + 1)`` shots, one more for each core with what is recovered of it, and what
    a `RangingPipeline` takes.
    """
    coming = iter(shots)
    if pipeline is None:
        first = next(coming, None)
        if first is None:
            return
        pipeline, coming = RangingPipeline.for_shot(first), _prepend_shot(first, coming)
    own = pipeline

    # A core for each shot: shared out among all, a shot would be done sooner, but cores would wait
    # for each other.
    with open_worker_pool() as cores:
        stages = (
            # The first stage hands a shot to a core, the second waits for it: results come out in
            # order.
            Stage("begin", lambda shot: cores.submit(_make_cloud, shot, own)),
            Stage("end", Future.result),
        )
        with closing(run_stages(coming, stages, queue_size, policy)) as items:
            for item in items:
                cloud, seconds = item.value
                waited = item.latency - sum(seconds.values())
                seconds_by_step = {READ: item.seconds[READ], WAIT: waited, **seconds}
                yield StreamedCloud(cloud, item.number, seconds_by_step, item.latency)


def _make_cloud(shot: Streak, pipeline: RangingPipeline) -> tuple[PointCloud, dict[str, float]]:
    """Make the cloud of a shot; return it and what each step took, s."""
    steps: dict[str, Callable[[Any], Any]] = {
        "rectify": lambda streak: pipeline.rectifier.rectify(streak.counts),
        "recover": pipeline.recover,
        "range": pipeline.search,
        "place": point_cloud,
    }
    value: Any = shot
    seconds, last = {}, perf_counter()
    for name, step in steps.items():
        value = step(value)
        now = perf_counter()
        seconds[name], last = now - last, now
    return value, seconds


def _prepend_shot(first: Streak, others: Iterator[Streak]) -> Iterator[Streak]:
    """Put a shot back before the others; closing this closes them."""
    yield first
    yield from others
