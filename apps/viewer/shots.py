"""Shots that are looked at: from files, or while they come in."""

from __future__ import annotations

import functools
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from apps.viewer.source import Inflow, KeptFrames, View
from devices.transients import TrackedShots
from tofclip.errors import InputError
from tofclip.files import format_error_line
from tofclip.lidar import PointCloud, Returns, point_cloud
from tofclip.sequences.streaming import CloudPipeline, LiveShot, stream_clouds
from tofclip.shots import Streak

MAX_CACHED_SHOTS = 32


def make_view(returns: Returns, cloud: PointCloud | None = None) -> View:
    """Return the points of returns and which pixel saw them; `cloud`: of these, where it is known."""
    points = point_cloud(returns) if cloud is None else cloud
    return View(points, np.stack([returns.y, returns.x], axis=-1))


@dataclass(frozen=True)
class TakenShot:
    """A shot, and what is to be seen of it where that was made when it came."""

    shot: LiveShot
    view: View | None = None


class StoredShots:
    """Streak images in files, each read when it is looked at; the last one is kept."""

    inflow, method_name = Inflow(), ""

    def __init__(self, shots: Sequence[Callable[[], Streak]]) -> None:
        self._shots = shots
        self._read = functools.lru_cache(1)(lambda number: TakenShot(shots[number]()))

    def __len__(self) -> int:
        return len(self._shots)

    def get(self, number: int) -> TakenShot:
        return self._read(number)

    def close(self) -> None:
        """Nothing is held."""


STOP_TIMEOUT_S = 10.0  # for the shot under way and for letting go of the instrument
RATE_WINDOW_SHOTS = 8  # arrivals over which the data rate is averaged
MAX_CACHED_BYTES = 1 << 28  # of shots that can be looked at again, of which at least 32 are kept


class LiveShots:
    """Shots that an iterator delivers, made into clouds by a pipeline as they come; the last ones can
    be looked at again.

    Of the shots that come while one is worked on only the newest waits, so that what one sees is
    never late; `lost` counts the others wherever it happened, in the instrument, its driver or here.
    A file's wait. The end of `shots`, or a fault of an instrument, ends the flow; what came can still
    be looked at.
    """

    def __init__(
        self, title: str, shots: Iterator[LiveShot] | TrackedShots, pipeline: CloudPipeline
    ) -> None:
        self._shots = shots if isinstance(shots, TrackedShots) else TrackedShots(shots)
        self._pipeline, self._inflow = pipeline, Inflow(is_live=True)
        self.method_name = pipeline.method_name
        self._kept = KeptFrames[TakenShot]()
        self.get = self._kept.get
        self._arrivals: deque[float] = deque(maxlen=RATE_WINDOW_SHOTS + 1)
        self._stopping, self._began = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._run, name="live shots", daemon=True)
        self._thread.start()
        self._began.wait()
        if not len(self):
            said = self._inflow.failure_text or "the source ended before it gave anything"
            raise InputError(f"{title}: {said}")

    def __len__(self) -> int:
        return len(self._kept)

    @property
    def inflow(self) -> Inflow:
        arrivals, rate = [*self._arrivals], 0.0
        if len(arrivals) > 1 and self._inflow.is_live:
            rate = (len(arrivals) - 1) / max(arrivals[-1] - arrivals[0], 1e-9)
        return replace(self._inflow, oldest=self._kept.oldest, data_rate=rate)

    def close(self) -> None:
        self._stopping.set()
        self._thread.join(STOP_TIMEOUT_S)

    def _run(self) -> None:
        try:
            with ThreadPoolExecutor(1) as worker:
                self._shots.peek()  # only then it is known whether an instrument is read
                policy: Any = "block" if self._shots.is_file else "drop_oldest"
                how: Any = {"policy": policy, "executor": worker, "at_once": 1}
                stream = stream_clouds(self._shots, self._pipeline, **how)
                # closing the generator stops its threads and the instrument
                with closing(stream) as clouds:
                    for made in clouds:
                        if self._stopping.is_set():
                            break
                        stamp = self._shots.get_stamp(made.shot)
                        most = max(MAX_CACHED_SHOTS, MAX_CACHED_BYTES // made.taken.counts.nbytes)
                        view = make_view(made.returns, made.cloud)
                        self._kept.append(TakenShot(made.taken, view), most)
                        self._arrivals.append(time.monotonic())
                        age = stamp.compute_age()
                        latency = made.latency if age is None else age
                        lost = self._shots.count_dropped(stamp, len(self))
                        self._inflow = replace(self._inflow, latency=latency, lost=lost)
                        self._began.set()
        except Exception as fault:
            # Whatever ends it is shown on the page: an exception on this thread would be lost.
            self._inflow = replace(self._inflow, failure_text=format_error_line(fault))
        finally:
            lost = self._shots.count_shots(len(self)).dropped
            self._inflow = replace(self._inflow, is_live=False, lost=lost)
            self._began.set()


Shots = StoredShots | LiveShots
