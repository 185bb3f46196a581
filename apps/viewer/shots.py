"""Raw streak images in a row, recovered as they are looked at."""

from __future__ import annotations

import abc
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from apps.viewer.shot_recovery import SHEAR_LIMITS, Readings, ShotRecovery, list_recovery_notes
from apps.viewer.source import Capabilities, Gate, Source, View, Waveform
from apps.viewer.transient import render_depth
from tofclip.camera import Camera, Rectifier
from tofclip.shots import Frames, Streak
from tofclip.solvers import Method

SHOT_RATE_HZ = 10.0
MAX_CACHED_VIEWS = 16


class ShotSource(Source):
    """Shots of one camera, wherever they come from; frame `n` is the cloud of shot `n`.

    `camera`: with its sweep; `row_times` (rows,): instant of each row, s; `method`: the linear
    inverse by default.
    """

    def __init__(
        self,
        title: str,
        camera: Camera,
        row_times: NDArray[np.float64],
        method: Method | None = None,
    ) -> None:
        self.recovery = ShotRecovery(camera, row_times - camera.time_zero, method)
        super().__init__(
            title,
            SHOT_RATE_HZ,
            Capabilities(shears=SHEAR_LIMITS if camera.views > 1 else None),
            frame_name="shot",
            notes=list_recovery_notes(self.recovery),
        )
        self._views: OrderedDict[int, View] = OrderedDict()

    @cached_property
    def rectifier(self) -> Rectifier:
        """What takes the sweep off a shot."""
        return Rectifier(self.recovery.camera, self.recovery.times.size)

    @abc.abstractmethod
    def measurements(self, number: int) -> Readings:
        """Return the rectified measurements of a shot, (columns, rows)."""

    def rectify(self, streak: Streak) -> Readings:
        """Take dark level and sweep off a shot."""
        return self.rectifier.measure(streak.counts, streak.saturated).values

    def view(self, number: int) -> View:
        if number not in self._views:
            self._views[number] = self.recovery.view(
                self.measurements(number), 0.0, self._full_gate
            )
            if len(self._views) > MAX_CACHED_VIEWS:
                self._views.popitem(last=False)
        return self._views[number]

    def recover_frames(self, number: int) -> Frames:
        """Return all frames of shot `number`."""
        return self.recovery.frames(self.measurements(number), 0.0, self._full_gate)

    def pictures(self, number: int, gate: Gate) -> Mapping[str, NDArray[np.float32]]:
        """Return streak image, intensity and depth of shot `number`; see `Source`.

        `gate`: not used: a shot is shown as a whole. Returns depth in m.
        """
        measurements = self.measurements(number)
        bright = self.recovery.frames(measurements, 0.0, self._find_bright_gate(measurements))
        return {
            "streak": measurements.T,
            "intensity": bright.values.sum(axis=0),
            "depth": render_depth(self.view(number), self.recovery.camera.image_shape),
        }

    def waveform(self, number: int, pixel: tuple[int, int]) -> Waveform:
        """Return the signal of a pixel over the whole shot; see `Source`.

        `pixel`: row and column.
        """
        frames = self.recover_frames(number)
        return Waveform(frames.times, frames.values[:, pixel[0], pixel[1]].copy())

    def refocus(self, number: int, shear: float, gate: Gate) -> View:
        """Recover shot `number` at another shear; see `Source`.

        `shear`: pixels per view step; `gate`: not used: the whole shot is recovered.
        """
        return self.recovery.view(self.measurements(number), shear, self._full_gate)

    @property
    def _full_gate(self) -> Gate:
        return Gate(0, int(self.recovery.times.size))

    def _find_bright_gate(self, measurements: Readings) -> Gate:
        """The 64 frames about the brightest one: a picture of all would cost as much as the cloud."""
        brightest = int(measurements.sum(axis=0).argmax())
        return Gate(max(0, brightest - 32), min(int(self.recovery.times.size), brightest + 32))


class StoredShotSource(ShotSource):
    """Shots in files, read when they are looked at.

    `shots`: each reads its shot; `camera`: with its sweep; `method`: the linear inverse by default.

    Memory: the measurements of the last shot, and the last 16 clouds.
    """

    def __init__(
        self,
        title: str,
        shots: Sequence[Callable[[], Streak]],
        camera: Camera,
        method: Method | None = None,
    ) -> None:
        super().__init__(title, camera, shots[0]().times, method)
        self._shots = shots
        self._last: tuple[int, Readings] | None = None

    def __len__(self) -> int:
        return len(self._shots)

    def measurements(self, number: int) -> Readings:
        if self._last is None or self._last[0] != number:
            self._last = (number, self.rectify(self._shots[number]()))
        return self._last[1]
