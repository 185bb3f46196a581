"""What is looked at and how, and which points are shown: the state behind every picture, without any
screen.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from apps.viewer.clock import PlaybackClock
from apps.viewer.look import (
    Colouring,
    Pick,
    Scale,
    colour_points,
    find_full_light,
    find_point_on_ray,
    make_pick,
    make_scale,
    measure_distance,
    project_front,
)
from apps.viewer.source import Gate, Source, TriangleMesh, View
from tofclip.errors import InputError
from tofclip.lidar import PointCloud
from tofclip.lidar.processing import select_points

Limits = tuple[float, float]
NO_LIMITS: Limits = (-np.inf, np.inf)


@dataclass(frozen=True)
class Filters:
    """Limits, all of them inclusive; a point must keep every one."""

    range: Limits = NO_LIMITS  # m
    intensity: Limits = NO_LIMITS  # counts, referred to 1 m
    time: Limits = NO_LIMITS  # time of flight, s
    x: Limits = NO_LIMITS  # sides of the box, m
    y: Limits = NO_LIMITS
    z: Limits = NO_LIMITS

    def __post_init__(self) -> None:
        for name, (low, high) in vars(self).items():
            if not low <= high:
                raise InputError(f"the limits of {name} must rise, got {low:g} and {high:g}")

    def select(self, cloud: PointCloud) -> NDArray[np.bool_]:
        """Return for each point whether it is shown, (n,)."""
        kept = np.ones(len(cloud), bool)
        columns = {"range": cloud.range, "intensity": cloud.intensity, "time": cloud.time}
        columns |= dict(zip("xyz", cloud.xyz.T, strict=True))
        for name, values in columns.items():
            low, high = getattr(self, name)
            # Limits that are not set cost no comparison, and keep NaN.
            if low > -np.inf:
                kept &= values >= np.float32(low)
            if high < np.inf:
                kept &= values <= np.float32(high)
        return kept


GATE_UP_TO_FRAME, GATE_AROUND_FRAME = "up to the frame", "around the frame"
GATE_ALL_TIMES = "all times"
# which points of a transient are shown: those of light that has come back by now, comes back now,
# or ever does
GATE_MODES = (GATE_UP_TO_FRAME, GATE_AROUND_FRAME, GATE_ALL_TIMES)
DIM_NOTE = "dim points are left out (filters, intensity)"

# frames on either side of the current one, in the gate `GATE_AROUND_FRAME`, unless set
HALF_GATE_FRAMES = 12


@dataclass(frozen=True)
class DisplayedFrame:
    """Everything that is drawn of one frame."""

    frame: int
    cloud: PointCloud  # what the filters left
    colours: NDArray[np.uint8]  # (n, 3)
    scale: Scale
    pixels: NDArray[np.int32] | None = None  # (n, 2)
    surface: TriangleMesh | None = None  # drawn instead of the points
    caption: str = ""  # of which frames the points are; empty where there is one only
    # points of which these were drawn by lot while frames pass; 0 where all are here
    thinned_from: int = 0

    @property
    def points(self) -> int:
        """Number of points, of which some may be left out while frames pass."""
        return self.thinned_from or len(self.cloud)


class Session:
    """A source being looked at. Not to be used by two threads at once. Public attributes may be set
    at any time; `frame_at` then draws accordingly.
    """

    def __init__(self, source: Source) -> None:
        self.source = source
        self.clock = PlaybackClock(source.rate)
        self.colouring = Colouring()
        least = source.min_intensity
        self.filters = Filters(intensity=(least, np.inf)) if least > 0 else Filters()
        self.gate, self.half_gate = GATE_UP_TO_FRAME, HALF_GATE_FRAMES
        self.shear: float | None = None
        self.following = source.inflow.is_live
        self.picks: list[Pick] = []
        self.max_playing_points: int | None = None
        self._key: tuple[Any, ...] = ()
        self._displayed: DisplayedFrame | None = None
        self._refocus_cache: tuple[tuple[Any, ...], View] | None = None
        if source.capabilities.times is not None:
            self.clock.position = float(len(source) - 1)  # a transient is complete at its end
            self.clock.loop = False

    @property
    def latest(self) -> DisplayedFrame | None:
        """What was drawn last."""
        return self._displayed

    @property
    def label(self) -> str:
        """``"LIVE"`` while the newest frame of an instrument is shown, ``"REPLAY"`` otherwise."""
        return "LIVE" if self.following and self.source.inflow.is_live else "REPLAY"

    @property
    def title(self) -> str:
        """The source's title with what has to be known about what is shown."""
        return "; ".join((self.source.title, *self.notes))

    @property
    def notes(self) -> tuple[str, ...]:
        """What has to be known about what is shown, each once."""
        refocused = (self.source.refocus_note,) if self.shear is not None else ()
        least = self.source.min_intensity
        dim = (DIM_NOTE,) if least > 0 and self.filters.intensity[0] == least else ()
        return tuple(dict.fromkeys(note for note in (*refocused, *dim, *self.source.notes) if note))

    def play(self) -> None:
        """Run through the frames; a live source from the oldest one that is still there."""
        self.following = False
        self.clock.play(self.source.inflow.oldest, len(self.source))

    def pause(self) -> None:
        """Stand still."""
        self.following = False
        self.clock.pause()

    def jump(self, frame: int) -> None:
        """Go to a frame."""
        self.following = False
        self.clock.jump(frame, self.source.inflow.oldest, len(self.source))

    def step(self, frames: int) -> None:
        """Pause, and move by a number of frames, back where it is negative."""
        self.following = False
        self.clock.step(frames, self.source.inflow.oldest, len(self.source))

    def follow(self) -> None:
        """Show the newest frame from now on."""
        self.following = True
        self.clock.pause()

    def frame_at(self, now: float) -> DisplayedFrame:
        """Return what is to be drawn at time `now`, s of a steady clock; the same object while
        nothing changed.
        """
        if self.following:
            self.clock.position = float(max(0, len(self.source) - 1))
        frame = self.clock.tick(now, self.source.inflow.oldest, len(self.source))
        modes = self.source.display_modes
        key = (
            frame,
            self.colouring,
            self.filters,
            self.gate,
            self.half_gate,
            self.shear,
            modes.current,
            modes.threshold,
            *(setting.value for setting in self.source.settings),
            self._find_point_limit(),
        )
        if self._displayed is None or key != self._key:
            self._key, self._displayed = key, self._render_frame(frame)
        return self._displayed

    def pick(self, origin: ArrayLike, direction: ArrayLike) -> Pick | None:
        """Choose the point that a ray hits, m; the last two choices are kept, and a miss forgets
        them.
        """
        if self._displayed is None:
            return None
        number = find_point_on_ray(self._displayed.cloud.xyz, origin, direction)
        if number is None:
            self.picks = []
            return None
        return self.pick_point(number)

    def pick_point(self, number: int) -> Pick:
        """Choose point `number` of those that are shown."""
        shown = self._displayed
        if shown is None or not 0 <= number < len(shown.cloud):
            raise InputError(f"there is no point {number}")
        pick = make_pick(shown.cloud, number)
        if shown.pixels is not None:
            row, column = shown.pixels[number].tolist()
            beside = np.all(shown.pixels == (row, column), axis=1)
            pick = replace(
                pick,
                pixel=(row, column),
                waveform=self.source.waveform(shown.frame, (row, column)),
                return_times=tuple(shown.cloud.time[beside].astype(float).tolist()),
            )
        self.picks = [*self.picks, pick][-2:]
        return pick

    @property
    def distance(self) -> float | None:
        """Distance of the last two picks, m."""
        return measure_distance(*self.picks) if len(self.picks) == 2 else None

    def gate_at(self, frame: int) -> Gate:
        """Return the frames of a transient whose points are shown."""
        frames = len(self.source)
        if self.gate == GATE_AROUND_FRAME:
            return Gate(max(0, frame - self.half_gate), min(frames, frame + self.half_gate + 1))
        return Gate(0, frame + 1 if self.gate == GATE_UP_TO_FRAME else frames)

    def pictures(self, shown: DisplayedFrame) -> Mapping[str, NDArray[np.float32]]:
        """Return the flat pictures beside the scene; the scene itself seen from the front where
        there are no others.
        """
        return self.source.pictures(shown.frame, self.gate_at(shown.frame)) or project_front(
            shown.cloud
        )

    def _render_frame(self, frame: int) -> DisplayedFrame:
        whole = self._find_view(frame)
        view = _thin_view(whole, self._find_point_limit())
        kept = self._gate_filters(frame).select(view.cloud)
        cloud = view.cloud if kept.all() else select_points(view.cloud, kept)
        # The scale is that of all points, so that colours keep their meaning while time passes; of
        # all but the dim ones, which would have the others shine alike.
        lit = view.cloud.intensity >= self.source.min_intensity
        usual = view.cloud if lit.all() or not lit.any() else select_points(view.cloud, lit)
        scale = make_scale(usual, self.colouring)
        brightest = find_full_light(usual) if self.colouring.shaded else 0.0
        pixels = view.pixels if view.pixels is None or kept.all() else view.pixels[kept]
        return DisplayedFrame(
            frame,
            cloud,
            colour_points(cloud, scale, brightest),
            scale,
            pixels,
            self.source.surface(),
            self._name_frames(frame),
            0 if view is whole else len(whole.cloud),
        )

    def _name_frames(self, frame: int) -> str:
        """Say of which frames the points are: of one, of a transient's gate, or of all."""
        if self.source.whole_name:
            return f"{self.source.whole_name} {self.source.describe_frame(frame)}"
        if self.source.capabilities.times is None:
            return f"{self.source.frame_name} {frame}" if len(self.source) > 1 else ""
        gate = self.gate_at(frame)
        if gate == Gate(0, len(self.source)):
            return f"all {gate.stop} frames"
        return f"frames {gate.first} to {gate.stop - 1}"

    def _find_point_limit(self) -> int | None:
        """Most points of a frame, None for all: while frames pass, the next one has to come soon."""
        return self.max_playing_points if self.clock.playing else None

    def _find_view(self, frame: int) -> View:
        if self.shear is None:
            return self.source.view(frame)
        # Only a gate around the frame changes with it; else all instants are recovered once and
        # filtered.
        gate = self.gate_at(frame) if self.gate == GATE_AROUND_FRAME else Gate(0, len(self.source))
        key = (0 if self.source.capabilities.times is not None else frame, self.shear, gate)
        if self._refocus_cache is None or self._refocus_cache[0] != key:
            self._refocus_cache = key, self.source.refocus(frame, self.shear, gate)
        return self._refocus_cache[1]

    def _gate_filters(self, frame: int) -> Filters:
        times = self.source.capabilities.times
        if times is None or self.gate == GATE_ALL_TIMES:
            return self.filters
        gate = self.gate_at(frame)
        if gate.first == 0 and gate.stop == times.size:
            return self.filters
        half = (times[-1] - times[0]) / (2 * max(1, times.size - 1))
        low, high = times[gate.first] - half, times[gate.stop - 1] + half
        low = -np.inf if gate.first == 0 else low
        return replace(
            self.filters,
            time=(max(low, self.filters.time[0]), max(low, min(high, self.filters.time[1]))),
        )


def _thin_view(view: View, most: int | None) -> View:
    """Return a part of a view's points, drawn by lot; the view itself where it has few enough."""
    points = len(view.cloud)
    if most is None or points <= most:
        return view
    some = np.unique(np.random.default_rng(0).integers(0, points, most))
    pixels = None if view.pixels is None else view.pixels[some]
    return View(select_points(view.cloud, some), pixels)
