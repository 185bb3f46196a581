"""Shots that come in while one looks."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing

from apps.viewer.shot_recovery import Readings, make_view
from apps.viewer.shots import ShotSource
from apps.viewer.source import View
from devices.shot_stream import TrackedShots
from tofclip.camera import Camera
from tofclip.errors import InputError, TofclipError
from tofclip.files import format_error_line
from tofclip.sequences.ranger import RangingPipeline
from tofclip.sequences.streaming import stream_clouds
from tofclip.shots import Streak
from tofclip.solvers import Method

MAX_CACHED_SHOTS = 32
STOP_TIMEOUT_S = 10.0
"""s for the shot under way and for letting go of the instrument."""

RATE_WINDOW_SHOTS = 8
"""Arrivals over which the data rate is averaged."""


class LiveShotSource(ShotSource):
    """Shots that an iterator delivers, made into clouds as they come; the last 32 can be looked at
    again.

    Clouds are those of `tofclip.sequences.streaming.stream_clouds`, one shot at a time on all cores,
    so that each is seen soon. Of the shots that come meanwhile only the newest waits, so that what
    one sees is never late; `lost` counts the others wherever it happened, in the instrument, its
    driver or here.

    `shots`: its end, or a fault of an instrument, ends the source; what came can still be looked
    at; `camera`: with its sweep; `method`: the linear inverse by default: others take seconds for a
    shot.

    Memory: the measurements and clouds of 32 shots.
    """

    def __init__(
        self,
        title: str,
        shots: Iterator[Streak] | TrackedShots,
        camera: Camera,
        method: Method | None = None,
    ) -> None:
        self._shots = shots if isinstance(shots, TrackedShots) else TrackedShots(shots)
        first = next(self._shots, None)
        if first is None:
            raise InputError(f"{title}: the source ended before it gave anything")
        if isinstance(first, TofclipError):
            raise first
        super().__init__(title, camera, first.times, method)
        self._cache: deque[tuple[Readings, View]] = deque(maxlen=MAX_CACHED_SHOTS)
        self._arrivals: deque[float] = deque(maxlen=RATE_WINDOW_SHOTS + 1)
        self._count, self._failure_text = 0, ""
        self._latency, self._lost = float("nan"), 0
        self._pipeline = RangingPipeline(camera, first.times)
        self.rectifier = self._pipeline.rectifier  # knows the sweep already
        self._lock, self._stopping = threading.Lock(), threading.Event()
        self._ended = False
        measurements = self.rectify(first)
        self._append_entry(measurements, make_view(self._pipeline.find_returns(measurements)))
        self._thread = threading.Thread(target=self._run, name="live shots", daemon=True)
        self._thread.start()

    def __len__(self) -> int:
        return self._count

    @property
    def oldest(self) -> int:
        return self._count - len(self._cache)

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
    def failure_text(self) -> str:
        return self._failure_text

    def view(self, number: int) -> View:
        return self._find_entry(number)[1]

    def measurements(self, number: int) -> Readings:
        return self._find_entry(number)[0]

    def close(self) -> None:
        self._stopping.set()
        self._thread.join(STOP_TIMEOUT_S)

    def _find_entry(self, number: int) -> tuple[Readings, View]:
        """Return what is kept of a shot, or of the nearest that is."""
        with self._lock:
            place = number - (self._count - len(self._cache))
            return self._cache[min(max(place, 0), len(self._cache) - 1)]

    def _run(self) -> None:
        try:
            with (
                ThreadPoolExecutor(1) as worker,
                closing(
                    stream_clouds(
                        self._shots,
                        self._pipeline,
                        policy="drop_oldest",
                        executor=worker,
                        at_once=1,
                    )
                ) as clouds,
            ):
                for made in clouds:
                    # Leaving the loop closes the generator, which stops its threads and the
                    # instrument.
                    if self._stopping.is_set():
                        break
                    stamp = self._shots.get_stamp(made.shot + 1)  # the first one is shown
                    self._append_entry(made.measurements, make_view(made.returns, made.cloud))
                    age = stamp.compute_age()
                    self._latency = made.latency if age is None else age
                    self._lost = self._shots.count_dropped(stamp, self._count)
        except Exception as fault:
            # Whatever ends it is shown on the page: an exception on this thread would be lost.
            self._failure_text = format_error_line(fault)
        finally:
            self._lost = self._shots.count_shots(self._count).dropped
            self._ended = True

    def _append_entry(self, measurements: Readings, view: View) -> None:
        if not self.recovery.is_linear:
            # seconds of work, meanwhile the newest shot waits and older ones are dropped
            view = self.recovery.view(measurements, 0.0, self._full_gate)
        with self._lock:
            self._cache.append((measurements, view))
            self._count += 1
            self._arrivals.append(time.monotonic())
