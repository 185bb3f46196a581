"""Shots to clouds while they come."""

from __future__ import annotations

from collections.abc import Generator, Iterable, Iterator, Mapping
from concurrent.futures import Future
from contextlib import closing
from dataclasses import dataclass
from itertools import pairwise
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from tofclip.lidar.cloud import PointCloud, point_cloud
from tofclip.sequences.ranger import RangingPipeline
from tofclip.sequences.streaming.channel import Policy
from tofclip.sequences.streaming.stages import READ, WAIT, Stage, run_stages
from tofclip.shots import Returns, Streak
from tofclip.threads import open_worker_pool

STEPS = ("rectify", "recover", "range", "place")
"""What is done to a shot on its core."""


@dataclass(frozen=True)
class StreamedCloud:
    """A cloud as it comes out of a stream.

    Parameters
    ----------
    cloud : PointCloud
    returns : Returns
        Those that the cloud's points are, in the same order.
    measurements : (columns, rows) float32 array
        The shot, rectified.
    shot : int
        Number of its shot in the source, from 0; what was dropped has been counted.
    seconds : mapping
        What each stage took: ``"read"`` (the source, which is not latency), ``"wait"`` (until its
        turn came), ``"rectify"``, ``"recover"``, ``"range"`` and ``"place"``.
    latency : float
        Time from when the shot was there until its cloud was handed out, s.
    """

    cloud: PointCloud
    returns: Returns
    measurements: NDArray[np.float32]
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
    Memory: ``3 * (queue_size + 1)`` shots, one more for each core with what is recovered of it, and what
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
                measurements, returns, cloud, seconds = item.value
                waited = item.latency - sum(seconds.values())
                told = {READ: item.seconds[READ], WAIT: waited, **seconds}
                yield StreamedCloud(cloud, returns, measurements, item.number, told, item.latency)


def _make_cloud(
    shot: Streak, pipeline: RangingPipeline
) -> tuple[NDArray[np.float32], Returns, PointCloud, dict[str, float]]:
    """Make the cloud of a shot; return its measurements, returns and cloud, and what each step
    took, s.
    """
    ends = [perf_counter()]
    measurements = pipeline.rectifier.rectify(shot.counts)
    ends.append(perf_counter())
    traces = pipeline.recover(measurements)
    ends.append(perf_counter())
    returns = pipeline.search(traces)
    ends.append(perf_counter())
    cloud = point_cloud(returns)
    ends.append(perf_counter())
    seconds = [last - first for first, last in pairwise(ends)]
    return measurements, returns, cloud, dict(zip(STEPS, seconds, strict=True))


def _prepend_shot(first: Streak, others: Iterator[Streak]) -> Iterator[Streak]:
    """Put a shot back before the others; closing this closes them."""
    yield first
    yield from others
