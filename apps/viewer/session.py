"""A source that is looked at: what is drawn of it, filters, picked points; and how it is looked at, in a
file that can be handed on.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from itertools import compress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import TypeAdapter

from apps.viewer.look import (
    QUANTITIES,
    Colouring,
    Pick,
    Scale,
    colour_points,
    find_point_on_ray,
    make_scale,
    project_front,
)
from apps.viewer.source import Limits, Picture, Source, View
from apps.viewer.viewpoint import Viewpoint
from tofclip.arrays import BoolArray, Float32Array
from tofclip.errors import FileFormatError, InputError


@dataclass
class PlaybackClock:
    """Says which frame is due, at times in s of any steady clock."""

    rate: float  # frames per second at speed 1
    frames: Callable[[], range]  # those that exist: of a live source, old ones go and new ones come
    speed: float = 1.0  # times faster than that
    # whether the last frame is followed by the first; otherwise the clock stops there
    loop: bool = True
    following: bool = False  # whether the newest frame is shown as soon as it comes
    position: float = 0.0  # frame, and how far it has run
    playing: bool = field(default=False, init=False)
    _last_tick_s: float | None = field(default=None, init=False, repr=False)

    @property
    def frame(self) -> int:
        return int(self.position)

    def play(self) -> None:
        """Run; from the oldest frame on where the last one is reached."""
        frames = self.frames()
        if self.frame >= frames.stop - 1:
            self.position = float(frames.start)
        self.following, self.playing, self._last_tick_s = False, True, None

    def pause(self) -> None:
        self.following = self.playing = False

    def follow(self) -> None:
        """Show the newest frame from now on."""
        self.following, self.playing = True, False

    def jump(self, frame: int) -> None:
        """Go to a frame, or to the nearest that exists."""
        frames = self.frames()
        self.position = float(min(max(frame, frames.start), max(frames.stop - 1, frames.start)))
        self.following, self._last_tick_s = False, None

    def step(self, frames: int) -> None:
        """Pause, and move by a number of frames, back where it is negative."""
        self.pause()
        self.jump(self.frame + frames)

    def tick(self, now: float) -> int:
        """Let time pass and return the frame that is due."""
        frames = self.frames()
        # a clock of the machine may be set back
        passed = 0.0 if self._last_tick_s is None else max(0.0, now - self._last_tick_s)
        self._last_tick_s = now
        if self.following:
            self.position = float(max(0, frames.stop - 1))
        elif self.playing and frames:
            self.position += passed * self.rate * self.speed
            if self.position >= frames.stop:
                # The remainder is kept, so that a loop runs as fast as the frames do.
                beyond = (self.position - frames.start) % len(frames)
                self.position = frames.start + beyond if self.loop else frames.stop - 1.0
                self.playing = self.loop
        self.position = max(self.position, float(frames.start))  # older ones are forgotten
        return self.frame


@dataclass(frozen=True)
class Section:
    """A slab of the scene."""

    normal: tuple[float, float, float]
    offset: float  # of its middle plane from the origin along the normal, m
    thickness: float  # m


@dataclass(frozen=True)
class Filters:
    """Limits by quantity, inclusive; a point must keep every one, and lie within the section."""

    limits: Mapping[str, Limits] = field(default_factory=dict)
    section: Section | None = None

    def __post_init__(self) -> None:
        for name, (low, high) in self.limits.items():
            if not low <= high:
                raise InputError(f"the limits of {name} must rise, got {low:g} and {high:g}")

    def limit(self, name: str, limits: Limits) -> Filters:
        return replace(self, limits={**self.limits, name: limits})

    def select(self, view: View) -> BoolArray:
        """Return for each point whether it is shown, (n,)."""
        kept = np.ones(len(view.cloud), bool)
        for name, (low, high) in self.limits.items():
            values = QUANTITIES[name][1](view)
            if np.isfinite(values).any():  # not every frame may know it
                kept &= (values >= np.float32(low)) & (values <= np.float32(high))
        if self.section is not None:
            away = view.cloud.xyz @ np.array(self.section.normal) - np.float32(self.section.offset)
            kept &= np.abs(away) <= self.section.thickness / 2
        return kept


@dataclass(frozen=True, kw_only=True)
class DisplayedFrame(View):
    """Everything that is drawn of one frame: of its view, what the filters left."""

    frame: int
    colours: NDArray[np.uint8]  # (n, 3)
    scale: Scale
    points: int  # of which some may be left out while frames pass
    whole: View  # before the filters
    opacities: Float32Array | None = None  # (n,) of soft balls


def render_frame(
    source: Source, frame: int, colouring: Colouring, filters: Filters, max_points: int | None
) -> DisplayedFrame:
    """Return what is drawn of a source's frame, of at most `max_points` points drawn by lot."""
    view = source.view(frame)
    whole_points = len(view.cloud)
    if is_thinned := max_points is not None and whole_points > max_points:
        drawn = np.random.default_rng(0).integers(0, whole_points, max_points)
        view = view.select(np.unique(drawn))
    # The scale is that of all points, so that colours keep their meaning while time passes.
    scale = make_scale(view, colouring)
    kept = filters.select(view)
    if view.due is not None:
        kept &= view.due
    shown, opacities = view if kept.all() else view.select(kept), None
    number = f"{source.frame_name} {frame + 1}" if len(source) > 1 else ""
    facts = {**vars(shown), "caption": view.caption or number}
    if view.opacity < 1:
        values = QUANTITIES[scale.quantity][1](shown)
        opacities = view.opacity * np.interp(values, scale.limits, (0, 1)).astype(np.float32)
    colours = colour_points(shown, scale)
    points = whole_points if is_thinned else len(shown.cloud)
    further: Any = {"points": points, "whole": view, "opacities": opacities}
    return DisplayedFrame(**facts, frame=frame, colours=colours, scale=scale, **further)


class Session:
    """A source being looked at, by one thread at a time; public attributes may be set."""

    def __init__(self, source: Source) -> None:
        self.source = source
        self.clock = PlaybackClock(
            source.rate,
            lambda: range(source.inflow.oldest, len(source)),
            following=source.inflow.is_live,
        )
        if source.times is not None:
            self.clock.position = float(len(source) - 1)  # a transient is complete at its end
            self.clock.loop = False
        palette = "inferno" if source.quantity == "brightness" else Colouring.palette
        self.colouring = Colouring(source.quantity, palette)
        self.filters = Filters()
        # by default that from which the scene fills a window
        self.viewpoint: Viewpoint | None = None
        self.point_size: float | None = None  # m; by default neighbours about touch
        # names of the sources and how they are opened
        self.opened: dict[str, Any] = {"sources": []}
        self.picks: list[Pick] = []
        self.max_playing_points: int | None = None
        self.latest: DisplayedFrame | None = None  # what was drawn last
        self._key: tuple[Any, ...] = ()

    @property
    def label(self) -> str:
        """``"LIVE"`` while the newest frame of an instrument is shown, ``"REPLAY"`` otherwise."""
        return "LIVE" if self.clock.following and self.source.inflow.is_live else "REPLAY"

    @property
    def title(self) -> str:
        """The source's title with what has to be known about what is shown."""
        return "; ".join((self.source.title, *self.notes))

    @property
    def notes(self) -> tuple[str, ...]:
        """What has to be known about what is shown, each once."""
        of_view = () if self.latest is None else self.latest.notes
        return tuple(dict.fromkeys((*of_view, *self.source.notes)))

    @property
    def distance(self) -> float | None:
        if len(self.picks) < 2:
            return None
        first, second = (pick.position for pick in self.picks)
        return float(np.linalg.norm(np.subtract(first, second)))

    def frame_at(self, now: float) -> DisplayedFrame:
        """Return what is drawn at a time, s of a steady clock; the same object until a change."""
        frame = self.clock.tick(now)
        set_by_user = tuple(setting.value for setting in self.source.settings)
        # while frames pass, the next one has to come soon
        limit = self.max_playing_points if self.clock.playing else None
        key = (frame, self.colouring, self.filters, set_by_user, limit)
        if self.latest is None or key != self._key:
            self.latest = render_frame(self.source, frame, self.colouring, self.filters, limit)
            if self.picks and set_by_user != self._key[3]:  # it may have been recovered once more
                points = self.latest.whole.cloud.xyz
                there = [(points == pick.point.xyz).all(axis=1).any() for pick in self.picks]
                self.picks = [*compress(self.picks, there)]
            self._key = key
        return self.latest

    def pick(self, origin: ArrayLike, direction: ArrayLike) -> Pick | None:
        """Choose the point that a ray hits; the last two are kept, and a miss forgets them."""
        if self.latest is None:
            return None
        shown = self.latest
        number = find_point_on_ray(shown.cloud.xyz, origin, direction)
        if number is None:
            self.picks = []
            return None
        pick = Pick(shown.cloud[number : number + 1])
        if shown.pixels is not None and shown.pixels[number, 0] >= 0:
            row, column = shown.pixels[number].tolist()
            beside = np.all(shown.pixels == (row, column), axis=1)
            layer, time = 1, float(shown.cloud.time[number])
            if shown.layers.size:
                layer = int(shown.layers[number])
                beside &= shown.layers == layer
            waveform = self.source.waveform(shown.frame, (row, column), time, layer)
            pick = replace(
                pick, pixel=(row, column), waveform=waveform, return_times=shown.cloud.time[beside]
            )
        self.picks = [*self.picks, pick][-2:]
        return pick

    def pictures(self, shown: DisplayedFrame) -> Mapping[str, Picture]:
        """Return the flat pictures beside the scene; without any, the scene from the front."""
        return self.source.pictures(shown.frame) or project_front(shown.cloud)


KIND = "tofclip view"


def write_state(session: Session, viewpoint: Viewpoint) -> str:
    """Return the state of a session, seen from a viewpoint, as JSON."""
    eye, target = viewpoint.eye.tolist(), viewpoint.target.tolist()
    state = {
        "kind": KIND,
        **session.opened,
        "frame": session.clock.frame + 1,
        "settings": [setting.value for setting in session.source.settings],
        "colouring": asdict(session.colouring),
        "filters": asdict(session.filters),
        "point_size_m": session.point_size,
        "viewpoint": [eye, target, viewpoint.field_of_view],
    }
    return json.dumps(state, indent=1, default=str)


def read_state(path: Path) -> dict[str, Any]:
    """Read a state; sources that are not where they were are looked for beside the file."""
    try:
        state = json.loads(path.read_text())
        is_one = state["kind"] == KIND and isinstance(state["sources"], list)
    except (ValueError, KeyError, TypeError):
        is_one = False
    if not is_one:
        raise FileFormatError(path, "is not a state that 'save state' of tofclip view wrote")
    beside = [path.parent / Path(name).name for name in state["sources"]]
    state["sources"] = [
        str(near) if "://" not in name and not Path(name).exists() else name
        for name, near in zip(state["sources"], beside, strict=True)
    ]
    return dict(state)


def restore_state(session: Session, state: dict[str, Any], path: Path) -> None:
    """Bring a session of the same sources into a state."""
    try:
        for setting, value in zip(session.source.settings, state["settings"], strict=True):
            setting.value = value
        session.colouring = TypeAdapter(Colouring).validate_python(state["colouring"])
        session.filters = TypeAdapter(Filters).validate_python(state["filters"])
        session.point_size = state["point_size_m"]
        eye, target, field_of_view = state["viewpoint"]
        session.viewpoint = Viewpoint(np.array(eye), np.array(target), field_of_view)
        session.clock.jump(state["frame"] - 1)
    except (KeyError, TypeError, ValueError) as fault:
        raise FileFormatError(path, f"does not fit its sources: {fault}") from fault
