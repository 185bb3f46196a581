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
from scipy.spatial.transform import Rotation

from apps.viewer.look import format_length
from apps.viewer.session import DisplayedFrame, Section
from apps.viewer.viewpoint import Box
from tofclip.arrays import AnyArray, Float32Array, FloatArray, IndexArray

if TYPE_CHECKING:
    import viser

Post = Callable[[Callable[[], object]], None]
NO_SHADOWS: Any = {"cast_shadow": False, "receive_shadow": False}
SURFACE_STYLE: Any = {"color": (216, 210, 196), "side": "double", **NO_SHADOWS}
POINT_STYLE: Any = {"point_shape": "square", "point_shading": "flat", "precision": "float32"}

RATE_WINDOW_S = 2.0  # over which frames are counted
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
class FramePacer:
    """Counts frames of two seconds, and sends large clouds less often."""

    _next: float = 0.0
    _sent: deque[float] = field(default_factory=deque)

    def record_sent(self, now: float, points: int) -> None:
        self._next = now + max(1 / MAX_FRAMES_PER_S, points / MAX_POINTS_PER_S)
        self._sent.append(now)

    def can_send(self, now: float) -> bool:
        return now >= self._next

    def per_second(self, now: float) -> float:
        while self._sent and self._sent[0] < now - RATE_WINDOW_S:
            self._sent.popleft()
        return len(self._sent) / RATE_WINDOW_S


@dataclass
class DetailChooser:
    """Says how many points are drawn, by how quickly the slowest browser has drawn others."""

    points_per_s: dict[int, float] = field(default_factory=dict)  # of each browser that was timed

    def count(self, points: int, moving: bool) -> int:
        """Return how many points of a cloud are drawn; fewer while view or cloud moves."""
        slowest = min(self.points_per_s.values(), default=0.0)
        drawable = int((MOVING_FRAME_S if moving else STILL_FRAME_S) * slowest)
        return min(points, max(drawable, MIN_DRAWN_POINTS))

    def is_worthwhile(self, drawn: int, points: int) -> bool:
        """Whether clearly more points of a cloud than are drawn now could be, or have to be fewer."""
        wanted = self.count(points, moving=False)
        return wanted != drawn and not (
            drawn / WORTHWHILE_FACTOR < wanted < drawn * WORTHWHILE_FACTOR and wanted < points
        )


class Points:
    """The points or the surface in the scene. Of a large cloud a part is drawn: fewer while it moves,
    as many as the slowest browser can draw while it stands still. `post`: takes what is to be done
    by the thread that owns the page.
    """

    def __init__(self, server: viser.ViserServer, post: Post) -> None:
        self._server, self._post = server, post
        self.detail = DetailChooser()
        self.drawn = 0  # how many points are drawn while nothing moves
        self._drawn_moving = 0
        self._xyz = np.empty((0, 3), np.float32)
        self._colours: Any = None
        self._opacities: Float32Array | None = None  # of soft balls
        self._points, self._size_m = 0, 0.0
        self._surface: Any = None
        self._order: IndexArray | None = None
        self._still: Any = None
        self._moving: Any = None
        self._moved_at, self._is_held = -np.inf, False
        self._has_to_time, self._timing = False, set[int]()

    @property
    def is_settled(self) -> bool:
        """Whether as much is drawn as the browsers were found to take."""
        known = self._server.get_clients().keys() <= self.detail.points_per_s.keys()
        return self._order is None or (known and not self._has_to_time and not self._timing)

    def draw(self, shown: DisplayedFrame, size_m: float) -> None:
        """Draw a frame; browsers get points and surface of it together."""
        with self._server.atomic():
            mesh, scene = shown.surface, self._server.scene
            if mesh is not None:
                vertices, faces = mesh.vertices, mesh.faces
                self._surface = scene.add_mesh_simple("/surface", vertices, faces, **SURFACE_STYLE)
            elif self._surface is not None:
                self._surface.remove()
                self._surface = None
            # the corners of a surface need no points, but for other layers beside it
            is_bare = mesh is None or shown.layers.size > 0
            self._xyz = shown.cloud.xyz if is_bare else shown.cloud.xyz[:0]
            self._opacities = shown.opacities if is_bare else None
            # the page complains about no colours at all
            self._colours = shown.colours if len(self._xyz) else (0, 0, 0)
            self._points, self._size_m = shown.points, size_m
            # drawn by lot: every n-th point of rows of pixels would make stripes
            is_large = len(self._xyz) > MIN_DRAWN_POINTS and self._opacities is None
            random = np.random.default_rng(0)
            self._order = random.permutation(len(self._xyz)) if is_large else None
            self._send()
        self._server.flush()

    def resize(self, size_m: float) -> None:
        self._size_m = size_m
        if self._opacities is not None:
            self._still = self._add("/points", self.drawn)
            return
        for node, count in ((self._still, self.drawn), (self._moving, self._drawn_moving)):
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
            if self._has_to_time or number not in self.detail.points_per_s:
                self._timing.add(number)
                threading.Thread(target=self._time_browser, args=(client,), daemon=True).start()
        self._has_to_time = False

    @contextlib.contextmanager
    def drawn_whole(self) -> Iterator[None]:
        """Draw all points for as long as a picture is taken, however long it takes."""
        if self._order is None or len(self._xyz) == self.drawn:
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
        self.drawn = self._drawn_moving = points
        if self._order is not None:
            self.drawn = self.detail.count(points, moving=False)
            self._drawn_moving = self.detail.count(points, moving=True)
        self._still = self._add("/points", self.drawn)
        if self._moving is not None:
            self._moving.remove()
            self._moving = None
        if self._drawn_moving < self.drawn:
            self._moving = self._add("/points_moving", self._drawn_moving)
            self._moving.visible = False

    def _add(self, name: str, count: int) -> Any:
        xyz, colours = self._xyz, self._colours
        if self._order is not None and count < len(xyz):
            part = self._order[:count]
            xyz, colours = xyz[part], colours[part]
        scene = self._server.scene
        if self._opacities is not None and len(xyz):
            spreads = np.tile(np.eye(3) * (self._size_m / 2) ** 2, (len(xyz), 1, 1))
            return scene.add_gaussian_splats(
                name, xyz, spreads, colours, self._opacities[:, np.newaxis]
            )
        return scene.add_point_cloud(
            name, xyz, colours, point_size=self._widen(count), **POINT_STYLE
        )

    def _widen(self, count: int) -> float:
        """Side of one of `count` points, m: fewer are larger, so that surfaces stay closed."""
        return self._size_m * float(np.sqrt(max(self._points, 1) / max(count, 1)))

    def _time_browser(self, client: viser.ClientHandle) -> None:
        """Time a browser's frames, on a thread of its own; a movement meanwhile makes it void."""
        started, points, seconds, began = time.monotonic(), self.drawn, np.inf, 0.0
        browser, rates = client.client_id, self.detail.points_per_s
        # a browser that has gone, or keeps no storage, is not waited for
        with contextlib.suppress(RuntimeError, TimeoutError):
            # It is asked for something that it does not have: it answers once in each frame.
            for number in range(WARM_UP_FRAMES + TIMED_FRAMES):
                if number == WARM_UP_FRAMES:
                    began = time.perf_counter()
                client.local_storage.get_item("tofclip-drawn", ANSWER_TIMEOUT_S)
            seconds = (time.perf_counter() - began) / TIMED_FRAMES

        def learn() -> None:
            self._timing.discard(browser)
            if browser not in self._server.get_clients():
                rates.pop(browser, None)
            elif self._moved_at < started and points == self.drawn:
                rates[browser] = points / max(seconds, 1e-3)
                if self._order is not None and self.detail.is_worthwhile(points, len(self._xyz)):
                    self._send()
                    # of more points the time is known more exactly
                    self._has_to_time = points < self.drawn

        self._post(learn)


BOX_COLOUR, SCALE_BAR_COLOUR, CLIP_COLOUR = (139, 147, 163), (235, 238, 245), (255, 176, 32)
AXIS_COLOURS = ((229, 72, 77), (70, 167, 88), (62, 142, 208))
# length of the axes, and of the clip box's handles, of half the box's diagonal
AXES_FRACTION = 0.12
Z_AXIS = (0.0, 0.0, 1.0)
BAR_TURN = 0.03  # of its length that an end has to move for a scale bar to be drawn anew
# quaternions, w x y z: upright, and half a turn after which the arrows at the high corner point
# into the box
UPRIGHT, POINTING_INWARDS = (1.0, 0.0, 0.0, 0.0), (0.0, 0.5**0.5, -(0.5**0.5), 0.0)


def add_lines(
    scene: Any, name: str, ends: AnyArray, colour: tuple[int, int, int], width_px: float = 1.0
) -> Any:
    """Draw lines between ends (n, 2, 3), m."""
    points = ends.astype(np.float32)
    width: Any = {"thickness": width_px, "thickness_units": "screen"}
    return scene.add_line_segments(name, points, colour, **width)


def draw_furniture(server: viser.ViserServer, box: Box) -> Callable[[viser.ClientHandle], None]:
    """Draw what gives the scene its scale: box and axes around a cloud, and a switch. Return what draws
    the scale bar of a browser, to be called when its viewpoint has changed: it faces the viewer.
    """
    scene: Any = server.scene

    def add_label(name: str, text: str, place: AnyArray, anchor: str) -> Any:
        return scene.add_label(name, text, position=place, anchor=anchor, font_screen_scale=0.9)

    drawn = [add_lines(scene, "/box", box.edges, BOX_COLOUR)]
    for name, length_m, place in zip("xyz", box.high - box.low, box.length_marks, strict=True):
        words = f"{name} {format_length(float(length_m))}"
        anchor = "top-right" if name == "z" else "top-left"  # z is written at the right
        drawn.append(add_label(f"/box_{name}", words, place, anchor))
    # x, y and z are named at the far lower left corner, which is nearly always in the picture; small
    origin = np.array([box.low[0], box.high[1], box.high[2]])
    ends = origin + max(box.reach, 0.01) * AXES_FRACTION * np.eye(3)
    for name, colour, end in zip("xyz", AXIS_COLOURS, ends, strict=True):
        axis = np.stack([origin, end])[np.newaxis]
        drawn.append(add_lines(scene, f"/axes_{name}", axis, colour, 2.0))
        drawn.append(add_label(f"/axes_{name}_name", name, end, "center-center"))
    hint = "box with lengths, scale bar and axes of the first cloud"
    switch = server.gui.add_checkbox("box", True, hint=hint)
    bars: dict[int, tuple[FloatArray, list[Any]]] = {}  # by browser: ends, and what is drawn

    def show_bar(client: viser.ClientHandle) -> None:
        bar = box.scale_bar(np.asarray(client.camera.position, float))
        length_m = float(np.linalg.norm(bar[1] - bar[0]))
        known = bars.get(client.client_id)
        if length_m == 0 or (known and np.allclose(known[0], bar, atol=BAR_TURN * length_m)):
            return
        words, own = format_length(length_m), client.scene
        line = add_lines(own, "/scale", bar[np.newaxis], SCALE_BAR_COLOUR, 4.0)
        # written above it: below may be the folded panel of a phone
        look: Any = {"anchor": "bottom-center", "font_screen_scale": 0.9, "visible": switch.value}
        label = own.add_label("/scale_length", words, position=bar.mean(axis=0), **look)
        line.visible = switch.value
        bars[client.client_id] = bar, [line, label]

    @switch.on_update
    def _(_: Any) -> None:
        for node in (*drawn, *(node for _, nodes in bars.values() for node in nodes)):
            node.visible = switch.value

    return show_bar


class ClipBox:
    """A box in the scene whose two opposite corners can be dragged; points outside are not shown."""

    def __init__(self, scene: Any, changed: Callable[[Box], None]) -> None:
        self._scene, self._changed = scene, changed
        self._edges: Any = None
        self._handles: list[Any] = []

    @property
    def is_shown(self) -> bool:
        """Whether there are handles to drag."""
        return bool(self._handles)

    def show(self, box: Box) -> None:
        self.hide()
        self._draw_edges(box)
        look: Any = {"disable_rotations": True, "disable_sliders": True, "depth_test": False}
        look["scale"] = 2 * AXES_FRACTION * max(box.reach, 0.01)
        corners = ("low", box.low, UPRIGHT), ("high", box.high, POINTING_INWARDS)
        for name, corner, turned in corners:
            place: Any = {"position": corner, "wxyz": turned}
            handle = self._scene.add_transform_controls(f"/clip/{name}", **place, **look)
            handle.on_update(lambda _: self._report())
            self._handles.append(handle)

    def hide(self) -> None:
        if self._handles:
            for node in (self._edges, *self._handles):
                node.remove()
        self._handles = []

    def _report(self) -> None:
        corners = np.stack([np.asarray(handle.position, float) for handle in self._handles])
        # a corner may be dragged past the other
        box = Box(corners.min(axis=0), corners.max(axis=0))
        self._draw_edges(box)
        self._changed(box)

    def _draw_edges(self, box: Box) -> None:
        self._edges = add_lines(self._scene, "/clip/box", box.edges, CLIP_COLOUR)


class SectionPlane:
    """A plane in the scene that can be dragged and turned; only points close to it are shown."""

    def __init__(self, scene: Any, changed: Callable[[], None]) -> None:
        self._scene, self._changed = scene, changed
        self._handle: Any = None

    @property
    def is_shown(self) -> bool:
        """Whether there is something to drag."""
        return self._handle is not None

    def show(self, point: AnyArray, normal: AnyArray, reach: float) -> None:
        """Draw the plane through a point; `reach`: half of the side of the square drawn, m."""
        self.hide()
        # a plane has two normals
        turn, _ = Rotation.align_vectors(normal if normal[2] >= 0 else -normal, Z_AXIS)
        turned = turn.as_quat(scalar_first=True)
        look: Any = {"depth_test": False, "scale": 0.4 * reach, "wxyz": turned}
        self._handle = self._scene.add_transform_controls("/section", position=point, **look)
        corners = reach * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
        edges = np.stack([corners, np.roll(corners, -1, axis=0)], axis=1)
        add_lines(self._scene, "/section/edge", edges, CLIP_COLOUR)
        self._handle.on_update(lambda _: self._changed())

    def hide(self) -> None:
        if self._handle is not None:
            self._handle.remove()
        self._handle = None

    def find_section(self, thickness: float) -> Section | None:
        """Return the slab about the plane, m thick; None where it is hidden."""
        if self._handle is None:
            return None
        x, y, z = Rotation.from_quat(self._handle.wxyz, scalar_first=True).apply(Z_AXIS).tolist()
        return Section((x, y, z), float(np.dot((x, y, z), self._handle.position)), thickness)
