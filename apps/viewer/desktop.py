"""The same session in a window of its own, drawn by VTK."""

from __future__ import annotations

import os
import sys
import time
from typing import Any

import numpy as np

from apps.viewer.picture import point_px
from apps.viewer.raster import BACKGROUND
from apps.viewer.render import add_to_plotter, graphics_work
from apps.viewer.session import Session
from apps.viewer.viewpoint import DOWN, in_front_of
from tofclip.errors import MissingDependencyError

WINDOW = (1280, 800)
TICK_MS = 30
DISPLAYS = ("DISPLAY", "WAYLAND_DISPLAY")
KEYS = "space: play or pause    left, right: step    home, end: first, last    q: quit"


class Window:
    """A plotter that follows a session.

    Parameters
    ----------
    session : Session
    plotter : pyvista.Plotter
    """

    def __init__(self, session: Session, plotter: Any) -> None:
        self.session, self.plotter = session, plotter
        first = session.shown(time.monotonic())
        self._drawn: Any = None
        viewpoint = in_front_of(first.cloud.xyz, WINDOW[0] / WINDOW[1])
        plotter.set_background([value / 255 for value in BACKGROUND])
        self.update()
        plotter.camera.position, plotter.camera.focal_point = viewpoint.eye.tolist(), viewpoint.target.tolist()
        plotter.camera.up = (-DOWN).tolist()
        plotter.camera.view_angle = float(np.rad2deg(viewpoint.field_of_view))
        plotter.renderer.reset_camera_clipping_range()
        plotter.add_text(KEYS, position="lower_left", font_size=8, color="grey")
        for key, act in self.keys().items():
            plotter.add_key_event(key, act)

    def keys(self) -> dict[str, Any]:
        """Return what each key does."""
        session = self.session
        return {
            "space": lambda: session.pause() if session.clock.playing else session.play(),
            "Left": lambda: session.step(-1),
            "Right": lambda: session.step(1),
            "Home": lambda: session.jump(0),
            "End": lambda: session.jump(len(session.source)),
        }

    def update(self, _: int = 0) -> None:
        """Draw what is due now, if it is not drawn yet."""
        shown = self.session.shown(time.monotonic())
        if shown is self._drawn:
            return
        self._drawn = shown
        add_to_plotter(self.plotter, shown, point_px(len(shown.cloud)))
        words = f"{self.session.label}  {self.session.source.title}  frame {shown.frame}, {len(shown.cloud)} points"
        self.plotter.add_text(words, position="upper_left", font_size=9, color="white", name="words")


def open_window(session: Session) -> None:
    """Show a session in a window until it is closed.

    Raises
    ------
    MissingDependencyError
        There is no display, or no working graphics library; says which.
    """
    require_display()
    import pyvista

    plotter: Any = pyvista.Plotter(window_size=list(WINDOW), title=f"tofclip: {session.source.title}")
    window = Window(session, plotter)
    plotter.add_timer_event(max_steps=10**9, duration=TICK_MS, callback=window.update)
    plotter.show()


def require_display() -> None:
    """Refuse in words what VTK would answer by ending the process."""
    if sys.platform.startswith("linux") and not any(os.environ.get(name) for name in DISPLAYS):
        raise MissingDependencyError(
            "--desktop needs a display, and neither DISPLAY nor WAYLAND_DISPLAY is set here; without --desktop the "
            "page works through ssh, and --png needs nothing"
        )
    if not graphics_work():
        raise MissingDependencyError(
            "--desktop needs a working OpenGL, and VTK cannot draw here (on Debian: apt-get install libgl1 libegl1); "
            "the page and --png work without"
        )
