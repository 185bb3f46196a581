"""The points on the page: how often and in how much detail they are drawn, so that browsers follow."""

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

if TYPE_CHECKING:
    import viser

Post = Callable[[Callable[[], None]], None]
POINT_STYLE: dict[str, Any] = {
    "point_shape": "square",
    "point_shading": "flat",
    "precision": "float32",
}

RATE_WINDOW_S = 2.0
"""s over which frames are counted."""

MAX_FRAMES_PER_S = 30.0
MAX_POINTS_PER_S = 2e6
"""What a browser with a software renderer takes without falling behind."""

MIN_DRAWN_POINTS = 16_000
"""Smaller clouds are always drawn whole: this number six times a second by software on two cores."""

MOVING_FRAME_S, STILL_FRAME_S = 0.08, 0.5
"""s that a browser may take to draw a large cloud while it moves, and while it stands still: browsers
draw what stands still once a second.
"""

WORTHWHILE_FACTOR = 1.5
"""A cloud is sent again where more points by this factor could be drawn, or have to be fewer by it."""

WARM_UP_FRAMES, TIMED_FRAMES = 3, 3
"""Browsers answer before they have drawn, and up to three frames are under way."""

ANSWER_TIMEOUT_S = 30.0

STILL_AFTER_S = 0.7
"""s after the last movement at which a large cloud is drawn for one who looks at it."""


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
        """Note that a frame was sent.

        `now`: time in s; `points`: of the frame.
        """
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
        """Note how long a browser took for a frame.

        `browser`: its number; `points`: that were drawn.
        """
        self._points_per_s[browser] = points / max(seconds, 1e-3)

    def knows(self, browser: int) -> bool:
        """Whether a browser was measured."""
        return browser in self._points_per_s

    def forget(self, browser: int) -> None:
        """Take no account of a browser that has gone."""
        self._points_per_s.pop(browser, None)

    def count(self, points: int, moving: bool) -> int:
        """Return how many points of a cloud are drawn.

        `points`: of the cloud; `moving`: whether the view or the cloud moves, so that the next
        frame has to come soon.
        """
        known = self._points_per_s.values()
        longest = MOVING_FRAME_S if moving else STILL_FRAME_S
        drawable = int(longest * min(known)) if known else 0
        return min(points, max(drawable, MIN_DRAWN_POINTS))

    def is_worthwhile(self, drawn: int, points: int) -> bool:
        """Whether clearly more points of a cloud than are drawn now could be, or have to be fewer.

        `drawn, points`: now, and of the whole cloud.
        """
        wanted = self.count(points, moving=False)
        return wanted != drawn and not (
            drawn / WORTHWHILE_FACTOR < wanted < drawn * WORTHWHILE_FACTOR and wanted < points
        )


def time_frame(client: viser.ClientHandle) -> float:
    """Return how long a browser takes to draw what it shows, s.

    `client`: asked for something that it does not have: it answers once in each frame.
    """
    for _ in range(WARM_UP_FRAMES):
        client.local_storage.get_item("tofclip-drawn", ANSWER_TIMEOUT_S)
    started = time.perf_counter()
    for _ in range(TIMED_FRAMES):
        client.local_storage.get_item("tofclip-drawn", ANSWER_TIMEOUT_S)
    return (time.perf_counter() - started) / TIMED_FRAMES


class Points:
    """The points in the scene. Of a large cloud a part is drawn, larger, so that surfaces stay closed:
    fewer while it moves, as many as the slowest browser can draw while it stands still.

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
        """Draw points.

        `xyz` (n, 3): m; `colours` (n, 3); `size_m`: side of a point, where all are drawn.
        """
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
        """Draw what suits movement or rest, and measure browsers of which nothing is known.

        `now`: seconds of the monotonic clock.
        """
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
