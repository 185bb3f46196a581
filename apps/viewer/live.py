"""Shots that come in while one looks."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Iterator
from contextlib import closing

from apps.viewer.linear_path import Readings, view_of
from apps.viewer.shots import ShotSource
from apps.viewer.source import View
from tofclip.camera import Camera
from tofclip.errors import InputError, TofclipError
from tofclip.sequences.ranger import Ranger
from tofclip.sequences.streaming import Stage, in_stages
from tofclip.shots import Streak
from tofclip.storage import one_line

MOST_KEPT = 32
LONGEST_STOP = 10.0
"""s for the shot under way and for letting go of the instrument."""

RATE_OVER = 8
"""Arrivals over which the data rate is averaged."""


class LiveShots(ShotSource):
    """Shots that an iterator delivers, made into clouds as they come; the last 32 can be looked at again.

    Reading, rectifying and ranging are stages side by side (`tofclip.sequences.streaming`). Shots that come
    faster than that are dropped, the oldest that waits first, so that what one sees is never late.

    Parameters
    ----------
    title : str
    shots : iterator of Streak
        Its end, or a fault of an instrument, ends the source; what came can still be looked at. A generator lets go of
        its instrument when it is dropped then.
    camera : Camera
        With its sweep.
    first : Streak
        The shot that was needed to find out about the camera; shown as number 0.

    Notes
    -----
    Memory: 32 shots' readings and clouds.
    """

    def __init__(self, title: str, shots: Iterator[Streak], camera: Camera, first: Streak) -> None:
        super().__init__(title, camera, first.times)
        self._kept: deque[tuple[Readings, View]] = deque(maxlen=MOST_KEPT)
        self._arrivals: deque[float] = deque(maxlen=RATE_OVER + 1)
        self._count, self._trouble = 0, ""
        self._latency, self._lost = float("nan"), 0
        self._ranger = Ranger(camera, first.times)
        self.rectifier = self._ranger.rectifier  # knows the sweep already
        self._lock, self._stopping = threading.Lock(), threading.Event()
        self._ended = False
        self._keep(self._ranged(self.rectified(first)))
        self._thread = threading.Thread(target=self._run, args=(shots,), name="live shots", daemon=True)
        self._thread.start()

    def __len__(self) -> int:
        return self._count

    @property
    def oldest(self) -> int:
        return self._count - len(self._kept)

    @property
    def is_live(self) -> bool:
        return not self._ended

    @property
    def data_rate(self) -> float:
        with self._lock:
            if len(self._arrivals) < 2 or self._ended:
                return 0.0
            return (len(self._arrivals) - 1) / max(self._arrivals[-1] - self._arrivals[0], 1e-9)

    @property
    def latency(self) -> float:
        return self._latency

    @property
    def lost(self) -> int:
        return self._lost

    @property
    def trouble(self) -> str:
        return self._trouble

    def view(self, number: int) -> View:
        return self._entry(number)[1]

    def readings(self, number: int) -> Readings:
        return self._entry(number)[0]

    def close(self) -> None:
        self._stopping.set()
        self._thread.join(LONGEST_STOP)

    def _entry(self, number: int) -> tuple[Readings, View]:
        """Return what is kept of a shot, or of the nearest that is."""
        with self._lock:
            place = number - (self._count - len(self._kept))
            return self._kept[min(max(place, 0), len(self._kept) - 1)]

    def _run(self, shots: Iterator[Streak]) -> None:
        stages = Stage("rectify", self.rectified), Stage("range", self._ranged)
        try:
            with closing(in_stages(shots, stages, policy="drop_oldest")) as made:
                for kept, passage in enumerate(made):
                    if self._stopping.is_set():
                        break
                    self._latency, self._lost = passage.latency, passage.number - kept
                    self._keep(passage.value)
        except TofclipError as fault:
            self._trouble = one_line(fault)
        finally:
            self._ended = True

    def _ranged(self, readings: Readings) -> tuple[Readings, View]:
        return readings, view_of(self._ranger.returns(readings))

    def _keep(self, entry: tuple[Readings, View]) -> None:
        with self._lock:
            self._kept.append(entry)
            self._count += 1
            self._arrivals.append(time.monotonic())


def first_and_rest(shots: Iterator[Streak], title: str) -> tuple[Streak, Iterator[Streak]]:
    """Wait for the first shot."""
    for first in shots:
        return first, shots
    raise InputError(f"{title}: the source ended before it gave anything")
