"""What is drawn on the page: the points, as often and in as much detail as browsers can follow; around
them a box with the lengths of its sides, a scale bar, the axes, and the clip box with its handles.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from apps.viewer.look import format_length
from apps.viewer.viewpoint import Box

if TYPE_CHECKING:
    import viser


Post = Callable[[Callable[[], None]], None]
POINT_STYLE: dict[str, Any] = {
    "point_shape": "square",
    "point_shading": "flat",
    "precision": "float32",
}

RATE_WINDOW_S = 2.0  # s over which frames are counted
MAX_FRAMES_PER_S = 30.0
MAX_POINTS_PER_S = 2e6  # what a browser with a software renderer takes without falling behind
# smaller clouds are always drawn whole: this number six times a second by software on two cores
MIN_DRAWN_POINTS = 16_000
# s that a browser may take to draw a large cloud while it moves, and while it stands still:
# browsers draw what stands still once a second
MOVING_FRAME_S, STILL_FRAME_S = 0.08, 0.5
# A cloud is sent again where more points by this factor could be drawn, or have to be fewer by it
WORTHWHILE_FACTOR = 1.5
# browsers answer before they have drawn, and up to three frames are under way
WARM_UP_FRAMES, TIMED_FRAMES = 3, 3
ANSWER_TIMEOUT_S = 30.0

# s after the last movement at which a large cloud is drawn for one who looks at it
STILL_AFTER_S = 0.7


@dataclass
class RateCounter:
    """Counts events of the last two seconds."""

    _events: deque[float] = field(default_factory=deque)

    def add(self, now: float) -> None:
        """Count an event at time `now`, s."""
        self._events.append(now)

    def per_second(self, now: float) -> float:
        """Return how many there were each second."""
        while self._events and self._events[0] < now - RATE_WINDOW_S:
            self._events.popleft()
        return len(self._events) / RATE_WINDOW_S


@dataclass
class FramePacer:
    """Holds frames back so that none pile up in a page: large clouds are sent less often."""

    _next: float = 0.0

    def record_sent(self, now: float, points: int) -> None:
        """Note that a frame was sent."""
        self._next = now + max(1 / MAX_FRAMES_PER_S, points / MAX_POINTS_PER_S)

    def can_send(self, now: float) -> bool:
        """Whether the next frame can go at time `now`, s."""
        return now >= self._next


@dataclass
class DetailChooser:
    """Says how many points of a large cloud are drawn, from how quickly browsers have drawn others;
    the slowest browser decides.
    """

    _points_per_s: dict[int, float] = field(default_factory=dict)

    def record(self, browser: int, points: int, seconds: float) -> None:
        """Note how long a browser took for a frame."""
        self._points_per_s[browser] = points / max(seconds, 1e-3)

    def knows(self, browser: int) -> bool:
        """Whether a browser was measured."""
        return browser in self._points_per_s

    def forget(self, browser: int) -> None:
        """Take no account of a browser that has gone."""
        self._points_per_s.pop(browser, None)

    def count(self, points: int, moving: bool) -> int:
        """Return how many points of a cloud are drawn. `points`: of the cloud; `moving`: whether
        the view or the cloud moves, so that the next frame has to come soon.
        """
        known = self._points_per_s.values()
        longest = MOVING_FRAME_S if moving else STILL_FRAME_S
        drawable = int(longest * min(known)) if known else 0
        return min(points, max(drawable, MIN_DRAWN_POINTS))

    def is_worthwhile(self, drawn: int, points: int) -> bool:
        """Whether clearly more points of a cloud than are drawn now could be, or have to be fewer."""
        wanted = self.count(points, moving=False)
        return wanted != drawn and not (
            drawn / WORTHWHILE_FACTOR < wanted < drawn * WORTHWHILE_FACTOR and wanted < points
        )


def time_frame(client: viser.ClientHandle) -> float:
    """Return how long a browser takes to draw what it shows, s. `client`: asked for something that
    it does not have: it answers once in each frame.
    """
    for _ in range(WARM_UP_FRAMES):
        client.local_storage.get_item("tofclip-drawn", ANSWER_TIMEOUT_S)
    started = time.perf_counter()
    for _ in range(TIMED_FRAMES):
        client.local_storage.get_item("tofclip-drawn", ANSWER_TIMEOUT_S)
    return (time.perf_counter() - started) / TIMED_FRAMES


class Points:
    """The points in the scene. Of a large cloud a part is drawn, larger, so that surfaces stay
    closed: fewer while it moves, as many as the slowest browser can draw while it stands still.
    `post`: takes what is to be done by the thread that owns the page.
    """

    def __init__(self, server: viser.ViserServer, post: Post) -> None:
        self._server, self._post = server, post
        self.detail = DetailChooser()
        self._xyz = np.empty((0, 3), np.float32)
        self._colours: Any = (0, 0, 0)  # the page complains about no colours at all
        self._size_m = 0.0
        self._order: NDArray[np.intp] | None = None
        self._still: Any = None
        self._moving: Any = None
        self._sent_still = self._sent_moving = 0
        self._moved_at, self._is_held = -np.inf, False
        self._has_to_time, self._timing = False, set[int]()

    @property
    def drawn(self) -> int:
        """How many points are drawn while nothing moves."""
        return self._sent_still

    @property
    def is_settled(self) -> bool:
        """Whether as much is drawn as the browsers were found to take."""
        known = all(map(self.detail.knows, self._server.get_clients()))
        return self._order is None or (known and not self._has_to_time and not self._timing)

    def draw(self, xyz: NDArray[np.float32], colours: NDArray[np.uint8], size_m: float) -> None:
        """Draw points."""
        self._xyz, self._size_m = xyz, size_m
        self._colours = colours if len(xyz) else (0, 0, 0)
        # drawn by lot: every n-th point of rows of pixels would make stripes
        self._order = (
            np.random.default_rng(0).permutation(len(xyz)) if len(xyz) > MIN_DRAWN_POINTS else None
        )
        self._send()

    def resize(self, size_m: float) -> None:
        """Give points another size, m."""
        self._size_m = size_m
        for node, count in ((self._still, self._sent_still), (self._moving, self._sent_moving)):
            if node is not None:
                node.point_size = self._widen(count)

    def note_movement(self) -> None:
        """Note that the viewpoint has changed."""
        # a busy machine may have become an idle one
        self._moved_at, self._has_to_time = time.monotonic(), True

    def update(self, now: float) -> None:
        """Draw what suits movement or rest, and measure browsers of which nothing is known."""
        if self._order is None or self._is_held:
            return
        moving = now - self._moved_at < STILL_AFTER_S
        if self._moving is not None and self._moving.visible != moving:
            self._moving.visible, self._still.visible = moving, not moving
        if moving or self._timing:
            return
        for number, client in self._server.get_clients().items():
            if self._has_to_time or not self.detail.knows(number):
                self._timing.add(number)
                threading.Thread(target=self._time_browser, args=(client,), daemon=True).start()
        self._has_to_time = False

    @contextlib.contextmanager
    def drawn_whole(self) -> Iterator[None]:
        """Draw all points for as long as a picture is taken, however long it takes."""
        if self._order is None or len(self._xyz) == self._sent_still:
            yield
            return
        self._is_held = True
        whole = self._add("/points_whole", len(self._xyz))
        self._still.visible = False
        try:
            yield
        finally:
            self._still.visible, self._is_held = True, False
            whole.remove()

    def _send(self) -> None:
        """Send what is drawn at rest, and what is drawn instead of it in movement."""
        points = len(self._xyz)
        still, moving = (self.detail.count(points, moving=one) for one in (False, True))
        self._sent_still, self._sent_moving = still, moving
        self._still = self._add("/points", still)
        if self._moving is not None:
            self._moving.remove()
            self._moving = None
        if moving < still:
            self._moving = self._add("/points_moving", moving)
            self._moving.visible = False

    def _add(self, name: str, count: int) -> Any:
        """Put some of the points into the scene."""
        xyz, colours = self._xyz, self._colours
        if self._order is not None and count < len(xyz):
            some = self._order[:count]
            xyz, colours = xyz[some], colours[some]
        return self._server.scene.add_point_cloud(
            name, xyz, colours, point_size=self._widen(count), **POINT_STYLE
        )

    def _widen(self, count: int) -> float:
        """Side of one of `count` points, m: fewer are larger."""
        return self._size_m * float(np.sqrt(max(len(self._xyz), 1) / max(count, 1)))

    def _time_browser(self, client: viser.ClientHandle) -> None:
        """Time a browser's frames, on a thread of its own; a movement meanwhile makes it void."""
        started, points = time.monotonic(), self._sent_still
        seconds = np.inf
        # a browser that has gone, or keeps no storage, is not waited for
        with contextlib.suppress(RuntimeError, TimeoutError):
            seconds = time_frame(client)
        self._post(lambda: self._learn(client.client_id, points, seconds, started))

    def _learn(self, browser: int, points: int, seconds: float, started: float) -> None:
        """Note how long a browser took, and send more points or fewer where that is worthwhile."""
        self._timing.discard(browser)
        if browser not in self._server.get_clients():
            self.detail.forget(browser)
        elif self._moved_at < started and points == self._sent_still:
            self.detail.record(browser, points, seconds)
            if self._order is not None and self.detail.is_worthwhile(points, len(self._xyz)):
                self._send()
                # of more points the time is known more exactly
                self._has_to_time = points < self._sent_still


BOX_COLOUR, BOX_LINE_PX = (139, 147, 163), 1.0
SCALE_BAR_COLOUR, SCALE_BAR_PX = (235, 238, 245), 4.0
CLIP_COLOUR = (255, 176, 32)
# length of the axes, and of the clip box's handles, of half the box's diagonal
AXES_FRACTION = 0.12
# quaternion, w x y z: half a turn after which the arrows at the high corner point into the box
POINTING_INWARDS = (0.0, 0.5**0.5, -(0.5**0.5), 0.0)
LABEL_SCALE = 0.9
AXIS_COLOURS = ((229, 72, 77), (70, 167, 88), (62, 142, 208))


def draw_furniture(scene: viser.SceneApi, box: Box) -> list[Any]:
    """Draw box, scale bar and axes around a cloud."""
    drawn: list[Any] = [_add_lines(scene, "/box", box.corners[np.array(box.edges)], BOX_COLOUR)]
    for name, length_m, place in zip("xyz", box.high - box.low, box.length_marks, strict=True):
        words = f"{name} {format_length(float(length_m))}"
        anchor = "top-right" if name == "z" else "top-left"  # z is written at the right
        drawn.append(_add_label(scene, f"/box_{name}", words, place, anchor))
    bar = box.scale_bar
    if (length_m := float(bar[1, 0] - bar[0, 0])) > 0:
        drawn.append(_add_lines(scene, "/scale", bar[np.newaxis], SCALE_BAR_COLOUR, SCALE_BAR_PX))
        words = format_length(length_m)
        drawn.append(_add_label(scene, "/scale_length", words, bar.mean(axis=0), "top-center"))
    return drawn + _draw_axes(scene, box)


def _draw_axes(scene: viser.SceneApi, box: Box) -> list[Any]:
    """Name x, y and z at the far lower left corner, which is nearly always in the picture; small."""
    origin = np.array([box.low[0], box.high[1], box.high[2]])
    ends = origin + _measure_reach(box) * AXES_FRACTION * np.eye(3)
    drawn = []
    for axis, (name, colour) in enumerate(zip("xyz", AXIS_COLOURS, strict=True)):
        ray = np.stack([origin, ends[axis]])[np.newaxis]
        drawn.append(_add_lines(scene, f"/axes_{name}", ray, colour, 2.0))
        drawn.append(_add_label(scene, f"/axes_{name}_name", name, ends[axis], "center-center"))
    return drawn


class ClipBox:
    """A box in the scene whose two opposite corners can be dragged; points outside are not shown."""

    def __init__(self, scene: viser.SceneApi, changed: Callable[[Box], None]) -> None:
        self._scene, self._changed = scene, changed
        self._handles: list[Any] = []

    @property
    def is_shown(self) -> bool:
        """Whether there are handles to drag."""
        return bool(self._handles)

    def show(self, box: Box) -> None:
        """Draw the box with its handles."""
        self._draw_edges(box)
        corners = {"low": box.low, "high": box.high}
        turns = {"low": (1.0, 0.0, 0.0, 0.0), "high": POINTING_INWARDS}
        if self._handles:
            for handle, corner in zip(self._handles, corners.values(), strict=True):
                handle.position = corner
            return
        for name, corner in corners.items():
            handle = self._scene.add_transform_controls(
                f"/clip/{name}",
                scale=2 * AXES_FRACTION * _measure_reach(box),
                disable_rotations=True,
                disable_sliders=True,
                depth_test=False,
                position=corner,
                wxyz=turns[name],
            )
            handle.on_update(lambda _: self._report())
            self._handles.append(handle)

    def hide(self) -> None:
        """Take the box and its handles away."""
        for handle in self._handles:
            handle.remove()
        self._handles = []
        if self._scene.get_handle_by_name("/clip/box") is not None:
            self._scene.remove_by_name("/clip/box")

    def _report(self) -> None:
        corners = np.stack([np.asarray(handle.position, float) for handle in self._handles])
        # a corner may be dragged past the other
        box = Box(corners.min(axis=0), corners.max(axis=0))
        self._draw_edges(box)
        self._changed(box)

    def _draw_edges(self, box: Box) -> None:
        _add_lines(self._scene, "/clip/box", box.corners[np.array(box.edges)], CLIP_COLOUR)


def _measure_reach(box: Box) -> float:
    return max(float(np.linalg.norm(box.high - box.low)) / 2, 0.01)


def _add_lines(
    scene: viser.SceneApi,
    name: str,
    ends: NDArray[Any],
    colour: tuple[int, int, int],
    width_px: float = BOX_LINE_PX,
) -> Any:
    points = ends.astype(np.float32)
    return scene.add_line_segments(
        name, points, colour, thickness=width_px, thickness_units="screen"
    )


def _add_label(
    scene: viser.SceneApi, name: str, text: str, position: NDArray[Any], anchor: Any = "top-left"
) -> Any:
    return scene.add_label(
        name, text, position=position, anchor=anchor, font_screen_scale=LABEL_SCALE
    )
