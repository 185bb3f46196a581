"""The page: what is shown, kept up to date in every browser that looks at it."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from apps.viewer.colouring import format_length
from apps.viewer.controls import Controls
from apps.viewer.export_panel import ExportPanel
from apps.viewer.page_text import Status, format_page_title
from apps.viewer.rates import FramePacer, RateCounter
from apps.viewer.scene_figure import LABELLED_EDGES
from apps.viewer.selection_panel import NO_SHADOWS, SelectionPanel
from apps.viewer.server import LOOPBACK, get_address, start_server, stop_server
from apps.viewer.session import DisplayedFrame, Session
from apps.viewer.side_pictures import render_pictures
from apps.viewer.viewpoint import Box, Viewpoint, make_presets, place_viewpoint
from tofclip.errors import TofclipError

TICK_S = 1 / 60
"""s between two looks at the clock."""

STATUS_PERIOD_S, PICTURES_PERIOD_S = 0.25, 0.5
"""s; words, controls and flat pictures need not follow every frame: they cost the browser more than
the points do.
"""

SCENE_ASPECT = 0.9
"""Width over height of the scene between two panels, on a usual screen."""

PANEL_PX, PICTURES_PANEL_PX = 345, 260
AMBIENT_INTENSITY = 2.0
"""Light from everywhere, so that no side of a surface is black."""

POINT_STYLE: dict[str, Any] = {
    "point_shape": "square",
    "point_shading": "flat",
    "precision": "float32",
}
SURFACE_COLOUR = (216, 210, 196)
BOX_COLOUR, BOX_LINE_PX = (139, 147, 163), 1.0


class Page:
    """Serves a session. One thread, in `run`, owns the session; whatever the browsers ask for waits
    in a queue.

    Parameters
    ----------
    session : Session
    port : int, optional
    host : str
        A loopback address.

    Raises
    ------
    InputError, MissingDependencyError
        As `start_server`.
    """

    def __init__(self, session: Session, port: int | None = None, host: str = LOOPBACK) -> None:
        self.session = session
        self._commands: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._stopping, self._woken = threading.Event(), threading.Event()
        first = session.frame_at(time.monotonic())
        self.viewpoint = place_viewpoint(first.cloud.xyz, SCENE_ASPECT)
        self.server = start_server(port, host)
        self.address = get_address(self.server, host)
        self._pace, self._frames = FramePacer(), RateCounter()
        self._set_up_scene()
        presets = make_presets(first.cloud.xyz) if len(first.cloud) else {}
        self.controls = Controls(self.server, session, self.post, first)
        if len(first.cloud):
            self._draw_box(Box.around(first.cloud.xyz))
        self._selection_panel = SelectionPanel(self.server, session, self.post)
        self._export_panel = ExportPanel(
            self.server, session, self.post, {"start": self.viewpoint, **presets}
        )
        self._pictures: dict[str, Any] = {}
        self._drawn: DisplayedFrame | None = None
        self._status_at = self._pictures_at = 0.0
        self._pictured: DisplayedFrame | None = None

    def post(self, command: Callable[[], None]) -> None:
        """Have a command carried out by the thread that owns the session."""
        self._commands.put(command)
        self._woken.set()

    def run(self) -> None:
        """Keep the page up to date until `close`, or Ctrl-C."""
        while not self._stopping.is_set():
            # Cleared before the work: a command that comes meanwhile wakes the next wait at once.
            self._woken.clear()
            self.update(time.monotonic())
            self._woken.wait(TICK_S)

    def close(self) -> None:
        """Stop serving."""
        self._stopping.set()
        self._woken.set()
        stop_server(self.server)

    def update(self, now: float) -> None:
        """Carry out commands, and send what has changed."""
        try:
            while not self._commands.empty():
                self._commands.get_nowait()()
            shown = self.session.frame_at(now) if self._pace.can_send(now) else self._drawn
            if shown is not None and shown is not self._drawn:
                self._draw(shown, now)
            self._update_status(now)
        except TofclipError as fault:
            self._notify_error(fault)

    def _set_up_scene(self) -> None:
        server = self.server
        server.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)
        server.gui.set_panel_label(format_page_title(self.session.source.title))
        server.gui.main_panel.dock_right()
        server.gui.main_panel.set_width(PANEL_PX)
        server.scene.set_up_direction("-y")
        # Shadows and reflections say nothing here, and take a software renderer ten seconds to
        # prepare for.
        server.scene.configure_default_lights(enabled=True, cast_shadow=False)
        server.scene.configure_environment_map(hdri=None)
        server.scene.add_light_ambient("/light", intensity=AMBIENT_INTENSITY)
        move_camera(server.initial_camera, self.viewpoint)
        server.scene.add_frame("/camera", axes_length=0.1, axes_radius=0.003)
        # The page makes a new material for every frame's points, and forgets the compiled shader
        # with the last old one. Two points that stay keep it: compiling it again for every frame
        # would take twenty times as long as drawing.
        staying = np.zeros((2, 3), np.float32)
        server.scene.add_point_cloud(
            "/camera/staying", staying, staying, point_size=1e-4, **POINT_STYLE
        )
        server.on_client_connect(lambda _: self.post(self._redraw_pictures))

    def _draw_box(self, box: Box) -> None:
        """Draw a box around the first cloud with the lengths of its sides, which is the scale."""
        scene, corners = self.server.scene, box.corners
        segments = corners[np.array(box.edges)].astype(np.float32)
        drawn: list[Any] = [
            scene.add_line_segments(
                "/box", segments, BOX_COLOUR, thickness=BOX_LINE_PX, thickness_units="screen"
            )
        ]
        for axis, edge in enumerate(LABELLED_EDGES):
            length = format_length(float(box.high[axis] - box.low[axis]))
            middle = corners[list(edge)].mean(axis=0)
            drawn.append(
                scene.add_label(f"/box_{'xyz'[axis]}", f"{'xyz'[axis]} {length}", position=middle)
            )
        shown = self.server.gui.add_checkbox("box", True, hint="lengths of the first cloud")

        @shown.on_update
        def _(_: Any) -> None:
            for node in drawn:
                node.visible = shown.value

    def _redraw_pictures(self) -> None:
        """Show the flat pictures at once on a page that has just opened."""
        self._pictures_at, self._pictured = 0.0, None

    def _draw(self, shown: DisplayedFrame, now: float) -> None:
        server = self.server
        # Browsers get points and surface of one frame together.
        with server.atomic():
            self._draw_scene(shown)
        server.flush()
        self._drawn = shown
        self._frames.add(now)
        self._pace.record_sent(now, len(shown.cloud))

    def _draw_scene(self, shown: DisplayedFrame) -> None:
        scene = self.server.scene
        if shown.surface is not None:
            faces, vertices = shown.surface.faces, shown.surface.vertices
            scene.add_mesh_simple(
                "/surface", vertices, faces, color=SURFACE_COLOUR, side="double", **NO_SHADOWS
            )
        elif self._drawn is not None and self._drawn.surface is not None:
            scene.remove_by_name("/surface")
        size, points = self.controls.point_size, shown.cloud.xyz
        if shown.surface is not None:
            points = points[:0]
        colours: Any = (
            shown.colours if len(points) else (0, 0, 0)
        )  # the page complains about no colours at all
        scene.add_point_cloud("/points", points, colours, point_size=size, **POINT_STYLE)

    def _update_status(self, now: float) -> None:
        """Bring words and flat pictures up to date, now and then."""
        shown = self._drawn
        if shown is None:
            return
        if now - self._status_at > STATUS_PERIOD_S:
            self._status_at = now
            self.controls.show(shown, self._status(shown, now))
        if now - self._pictures_at > PICTURES_PERIOD_S and shown is not self._pictured:
            self._pictures_at, self._pictured = now, shown
            self._show_pictures(shown)

    def _status(self, shown: DisplayedFrame, now: float) -> Status:
        source = self.session.source
        times = source.capabilities.times
        return Status(
            self.session.label,
            shown.frame,
            len(source),
            len(shown.cloud),
            source.data_rate,
            self._frames.per_second(now),
            source.latency,
            source.lost,
            source.failure_text,
            float("nan") if times is None else float(times[shown.frame]),
        )

    def _show_pictures(self, shown: DisplayedFrame) -> None:
        images = render_pictures(self.session.pictures(shown), shown.scale)
        if not self._pictures:
            panel = self.server.gui.add_panel()
            with panel.add_tab("pictures"):
                self._pictures = {
                    name: self.server.gui.add_image(one, label=name) for name, one in images.items()
                }
            panel.dock_left()
            panel.set_width(PICTURES_PANEL_PX)
            return
        for name, image in images.items():
            self._pictures[name].image = image

    def _notify_error(self, fault: TofclipError) -> None:
        for client in self.server.get_clients().values():
            client.add_notification(
                "that cannot be", str(fault), auto_close_seconds=6.0, color="red"
            )


def move_camera(camera: Any, viewpoint: Viewpoint) -> None:
    """Move a camera of the page, or the one that pages start with, to a viewpoint.

    Parameters
    ----------
    camera : viser camera handle
    viewpoint : Viewpoint
    """
    camera.position, camera.look_at = viewpoint.eye, viewpoint.target
    camera.fov = max(viewpoint.field_of_view, float(np.deg2rad(5.0)))
