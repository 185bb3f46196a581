"""What is looked at and how: the state behind every picture, without any screen."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from apps.viewer.clock import Clock
from apps.viewer.colouring import Colouring, Scale, colours_of, full_light, scale_for
from apps.viewer.filters import Filters
from apps.viewer.panes import front_pictures
from apps.viewer.picking import Pick, distance, picked, point_on_ray
from apps.viewer.source import Gate, Source, Triangles, View
from tofclip.errors import InputError
from tofclip.lidar import PointCloud
from tofclip.lidar.processing import selected

UP_TO, AROUND, ALL = "up to the frame", "around the frame", "all times"
GATES = (UP_TO, AROUND, ALL)
"""Which points of a transient are shown: those of light that has come back by now, comes back now, or ever does."""

HALF_GATE = 12
"""Frames on either side of the current one, in the gate `AROUND`, unless set."""


@dataclass(frozen=True)
class Shown:
    """Everything that is drawn of one frame.

    Parameters
    ----------
    frame : int
    cloud : PointCloud
        What the filters left.
    colours : (n, 3) uint8 array
    scale : Scale
    pixels : (n, 2) int array, optional
    surface : Triangles, optional
        Drawn instead of the points.
    """

    frame: int
    cloud: PointCloud
    colours: NDArray[np.uint8]
    scale: Scale
    pixels: NDArray[np.int32] | None = None
    surface: Triangles | None = None


class Session:
    """A source being looked at.

    Not to be used by two threads at once. Public attributes may be set at any time; `shown` then draws accordingly.

    Parameters
    ----------
    source : Source
    """

    def __init__(self, source: Source) -> None:
        self.source = source
        self.clock = Clock(source.rate)
        self.colouring, self.filters = Colouring(), Filters()
        self.gate, self.half_gate = UP_TO, HALF_GATE
        self.shear: float | None = None
        self.following = source.is_live
        self.picks: list[Pick] = []
        self._key: tuple[Any, ...] = ()
        self._shown: Shown | None = None
        self._focused: tuple[tuple[Any, ...], View] | None = None
        if source.abilities.times is not None:
            self.clock.position = float(len(source) - 1)  # a transient is complete at its end
            self.clock.loop = False

    @property
    def latest(self) -> Shown | None:
        """What was drawn last."""
        return self._shown

    @property
    def label(self) -> str:
        """``"LIVE"`` while the newest frame of an instrument is shown, ``"REPLAY"`` otherwise."""
        return "LIVE" if self.following and self.source.is_live else "REPLAY"

    def play(self) -> None:
        """Run through the frames; a live source from the oldest one that is still there."""
        self.following = False
        self.clock.play(self.source.oldest, len(self.source))

    def pause(self) -> None:
        """Stand still."""
        self.following = False
        self.clock.pause()

    def jump(self, frame: int) -> None:
        """Go to a frame."""
        self.following = False
        self.clock.jump(frame, self.source.oldest, len(self.source))

    def step(self, frames: int) -> None:
        """Stand still so many frames further on, or back."""
        self.following = False
        self.clock.step(frames, self.source.oldest, len(self.source))

    def follow(self) -> None:
        """Show the newest frame from now on."""
        self.following = True
        self.clock.pause()

    def shown(self, now: float) -> Shown:
        """Return what is to be drawn at time `now`, s of a steady clock; the same object while nothing changed."""
        if self.following:
            self.clock.position = float(max(0, len(self.source) - 1))
        frame = self.clock.tick(now, self.source.oldest, len(self.source))
        ways = self.source.ways
        key = (frame, self.colouring, self.filters, self.gate, self.half_gate, self.shear, ways.chosen, ways.threshold)
        if self._shown is None or key != self._key:
            self._key, self._shown = key, self._drawn(frame)
        return self._shown

    def pick(self, origin: ArrayLike, direction: ArrayLike) -> Pick | None:
        """Choose the point that a ray hits, m; the last two choices are kept, and a miss forgets them."""
        if self._shown is None:
            return None
        number = point_on_ray(self._shown.cloud.xyz, origin, direction)
        if number is None:
            self.picks = []
            return None
        return self.pick_point(number)

    def pick_point(self, number: int) -> Pick:
        """Choose point `number` of those that are shown."""
        shown = self._shown
        if shown is None or not 0 <= number < len(shown.cloud):
            raise InputError(f"there is no point {number}")
        pixel = None if shown.pixels is None else (int(shown.pixels[number, 0]), int(shown.pixels[number, 1]))
        waveform = None if pixel is None else self.source.waveform(shown.frame, pixel)
        pick = picked(shown.cloud, number, pixel, waveform)
        self.picks = [*self.picks, pick][-2:]
        return pick

    @property
    def distance(self) -> float | None:
        """Distance of the last two picks, m."""
        return distance(*self.picks) if len(self.picks) == 2 else None

    def gate_at(self, frame: int) -> Gate:
        """Return the frames of a transient whose points are shown."""
        frames = len(self.source)
        if self.gate == AROUND:
            return Gate(max(0, frame - self.half_gate), min(frames, frame + self.half_gate + 1))
        return Gate(0, frame + 1 if self.gate == UP_TO else frames)

    def pictures(self, shown: Shown) -> Mapping[str, NDArray[np.float32]]:
        """Return the flat pictures beside the scene; the scene itself seen from the front where there are no others."""
        return self.source.pictures(shown.frame, self.gate_at(shown.frame)) or front_pictures(shown.cloud)

    def _drawn(self, frame: int) -> Shown:
        view = self._view(frame)
        kept = self._filters(frame).kept(view.cloud)
        cloud = view.cloud if kept.all() else selected(view.cloud, kept)
        # The scale is that of all points, so that colours keep their meaning while time passes.
        scale = scale_for(view.cloud, self.colouring)
        brightest = full_light(view.cloud) if self.colouring.shaded else 0.0
        pixels = view.pixels if view.pixels is None or kept.all() else view.pixels[kept]
        return Shown(frame, cloud, colours_of(cloud, scale, brightest), scale, pixels, self.source.surface())

    def _view(self, frame: int) -> View:
        if self.shear is None:
            return self.source.view(frame)
        # Only a gate around the frame changes with it; else all instants are recovered once and filtered.
        gate = self.gate_at(frame) if self.gate == AROUND else Gate(0, len(self.source))
        return self._refocused(frame, self.shear, gate)

    def _refocused(self, frame: int, shear: float, gate: Gate) -> View:
        key = (0 if self.source.abilities.times is not None else frame, shear, gate)
        if self._focused is None or self._focused[0] != key:
            self._focused = key, self.source.refocused(frame, shear, gate)
        return self._focused[1]

    def _filters(self, frame: int) -> Filters:
        times = self.source.abilities.times
        if times is None or self.gate == ALL:
            return self.filters
        gate = self.gate_at(frame)
        if gate.first == 0 and gate.stop == times.size:
            return self.filters
        half = (times[-1] - times[0]) / (2 * max(1, times.size - 1))
        low, high = times[gate.first] - half, times[gate.stop - 1] + half
        low = -np.inf if gate.first == 0 else low
        return replace(self.filters, time=(max(low, self.filters.time[0]), max(low, min(high, self.filters.time[1]))))
