"""Shots to clouds while they come."""

from __future__ import annotations

from collections.abc import Generator, Iterable, Iterator, Mapping
from dataclasses import dataclass

from numpy import float32
from numpy.typing import NDArray

from tofclip.lidar.cloud import PointCloud, point_cloud
from tofclip.lidar.sequence import Ranger
from tofclip.streaming.channel import Policy
from tofclip.streaming.stages import Stage, in_stages
from tofclip.transient import Streak


@dataclass(frozen=True)
class StreamedCloud:
    """A cloud as it comes out of a stream.

    Parameters
    ----------
    cloud : PointCloud
    shot : int
        Number of its shot in the source, from 0; what was dropped has been counted.
    seconds : mapping
        What each stage took: ``"read"`` (the source, which is no latency), ``"wait"`` (between the stages),
        ``"rectify"``, ``"recover"``, ``"range"`` and ``"place"``.
    latency : float
        Time from when the shot was there until its cloud was handed out, s.
    """

    cloud: PointCloud
    shot: int
    seconds: Mapping[str, float]
    latency: float


def stream_clouds(
    shots: Iterable[Streak], ranger: Ranger | None = None, held: int = 1, policy: Policy = "block"
) -> Generator[StreamedCloud, None, None]:
    """Yield the cloud of every shot by the linear inverse, as soon as it is made.

    A shot is rectified and recovered, its returns are found, and they are placed in space, each on a thread of its own,
    while the next ones are read.

    Parameters
    ----------
    shots : iterable of Streak
        A file's, a folder's or an instrument's; it is read on a thread of its own.
    ranger : Ranger, optional
        By default one for the camera that the first shot carries.
    held : int
        Shots that wait before each stage, at most.
    policy : "block" or "drop_oldest"
        What happens when shots come faster than the clouds are taken; see `in_stages`.

    Raises
    ------
    Whatever reading a shot or making its cloud raises, once the clouds before it have been yielded.

    Notes
    -----
    Memory: ``5 * (held + 1)`` shots, and what a `Ranger` takes.
    """
    coming = iter(shots)
    if ranger is None:
        first = next(coming, None)
        if first is None:
            return
        ranger, coming = Ranger.for_shot(first), _with_first(first, coming)
    own = ranger

    def rectified(shot: Streak) -> NDArray[float32]:
        return own.rectifier.readings(shot.counts)

    # One stage's work on all cores has ends where some of them wait; another stage's fills these.
    ranging = Stage("recover", own.recover), Stage("range", own.search)
    stages = Stage("rectify", rectified), *ranging, Stage("place", point_cloud)
    for passage in in_stages(coming, stages, held, policy):
        yield StreamedCloud(passage.value, passage.number, passage.seconds, passage.latency)


def _with_first(first: Streak, others: Iterator[Streak]) -> Iterator[Streak]:
    """Put a shot back before the others; closing this closes them."""
    yield first
    yield from others
