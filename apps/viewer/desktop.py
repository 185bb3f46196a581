"""The same session in a window of its own, drawn by VTK."""

from __future__ import annotations

import os
import sys
import time
from typing import Any

import numpy as np

from apps.viewer.session import Session
from apps.viewer.still import BACKGROUND, add_to_plotter, choose_point_size, has_working_graphics
from apps.viewer.viewpoint import DOWN, place_viewpoint
from tofclip.errors import MissingDependencyError

WINDOW_SIZE_PX = (1280, 800)
TICK_MS = 30
DISPLAY_VARIABLES = ("DISPLAY", "WAYLAND_DISPLAY")
KEY_HELP = "space: play or pause    left, right: step    home, end: first, last    q: quit"


class DesktopWindow:
    """A plotter that follows a session."""

    def __init__(self, session: Session, plotter: Any) -> None:
        self.session, self.plotter = session, plotter
        first = session.frame_at(time.monotonic())
        self._drawn: Any = None
        viewpoint = place_viewpoint(first.cloud.xyz, WINDOW_SIZE_PX[0] / WINDOW_SIZE_PX[1])
        plotter.set_background([value / 255 for value in BACKGROUND])
        self.update()
        plotter.camera.position, plotter.camera.focal_point = (
            viewpoint.eye.tolist(),
            viewpoint.target.tolist(),
        )
        # VTK turns the picture so that this points up; y of the clouds points down.
        plotter.camera.up = (-DOWN).tolist()
        plotter.camera.view_angle = float(np.rad2deg(viewpoint.field_of_view))
        plotter.renderer.reset_camera_clipping_range()
        plotter.add_text(KEY_HELP, position="lower_left", font_size=8, color="grey")
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
        shown = self.session.frame_at(time.monotonic())
        if shown is self._drawn:
            return
        self._drawn = shown
        add_to_plotter(self.plotter, shown, choose_point_size(len(shown.cloud)))
        words = f"{self.session.label}  {self.session.source.title}  frame {shown.frame}, {len(shown.cloud)} points"
        self.plotter.add_text(
            words, position="upper_left", font_size=9, color="white", name="words"
        )


def open_window(session: Session) -> None:
    """Show a session in a window until it is closed."""
    require_display()
    import pyvista

    plotter: Any = pyvista.Plotter(
        window_size=list(WINDOW_SIZE_PX), title=f"tofclip: {session.source.title}"
    )
    window = DesktopWindow(session, plotter)
    plotter.add_timer_event(max_steps=10**9, duration=TICK_MS, callback=window.update)
    plotter.show()


def require_display() -> None:
    """Refuse in words what VTK would answer by ending the process."""
    if sys.platform.startswith("linux") and not any(
        os.environ.get(name) for name in DISPLAY_VARIABLES
    ):
        raise MissingDependencyError(
            "--desktop needs a display, and neither DISPLAY nor WAYLAND_DISPLAY is set here; without --desktop the "
            "page works through ssh, and --png needs nothing"
        )
    if not has_working_graphics():
        raise MissingDependencyError(
            "--desktop needs a working OpenGL, and VTK cannot draw here (on Debian: apt-get install libgl1 libegl1); "
            "the page and --png work without"
        )
