"""The scene drawn without a page: pictures and films with the colours' scale, by the graphics library
where it works, by NumPy everywhere; and a window of the graphics library's own.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from apps.figures.style import DOTS_PER_INCH, make_figure, open_film
from apps.viewer.look import Image, Scale, choose_ticks, format_length, load_palette
from apps.viewer.session import DisplayedFrame, Session
from apps.viewer.viewpoint import (
    Box,
    Viewpoint,
    aim_plotter,
    measure_point_spacing,
    place_viewpoint,
)
from tofclip.errors import InputError, MissingDependencyError
from tofclip.notebook import save_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

BACKGROUND = (24, 27, 33)
PROBE_TIMEOUT_S = 60.0  # loading the library takes three on a slow machine
PROBE_SCRIPT = """
import pyvista
plotter = pyvista.Plotter(off_screen=True, window_size=(64, 64))
plotter.add_mesh(pyvista.Sphere())
raise SystemExit(0 if plotter.screenshot(return_img=True).std() > 0 else 1)
"""


class PyvistaRenderer:
    """Draws off screen with VTK, every picture in the same window."""

    name = "pyvista"
    note = ""

    def __init__(self) -> None:
        self._plotter: Any = None

    def draw(
        self, shown: DisplayedFrame, viewpoint: Viewpoint, shape: tuple[int, int], point_px: int
    ) -> Image:
        """Return a picture of `shape` rows and columns; points are `point_px` wide."""
        if self._plotter is None:
            import pyvista
            from vtkmodules.vtkCommonCore import vtkLogger

            # VTK warns that there is no X server, and goes on without one, which is wanted.
            vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_ERROR)
            self._plotter = pyvista.Plotter(off_screen=True)
        plotter = self._plotter
        plotter.window_size = (shape[1], shape[0])
        add_to_plotter(plotter, shown, point_px)
        aim_plotter(plotter, viewpoint)
        return np.ascontiguousarray(plotter.screenshot(return_img=True)[..., :3])


class RasterRenderer:
    """Draws with NumPy; the frame around comes from matplotlib, as always."""

    name = "matplotlib"
    note = "   drawn by matplotlib: no working graphics library here"

    def draw(
        self, shown: DisplayedFrame, viewpoint: Viewpoint, shape: tuple[int, int], point_px: int
    ) -> Image:
        """Return a picture, as `PyvistaRenderer.draw` does; surfaces appear as their points, and
        points as squares, near ones over far ones.
        """
        picture = np.full((*shape, 3), BACKGROUND, np.uint8)
        row, column, depth = viewpoint.project(shown.cloud.xyz, shape)
        middle = shape[0] / 2, shape[1] / 2
        with np.errstate(invalid="ignore"):
            seen = (np.abs(row - middle[0]) < shape[0]) & (np.abs(column - middle[1]) < shape[1])
        order = np.flatnonzero(seen)
        # of writes to one pixel the last one stays
        order = order[np.argsort(-depth[order], kind="stable")]
        corner = np.stack([row[order], column[order]]) - (point_px - 1) / 2
        # All pixels of one point before those of the next, or far points would show at the edges of
        # near ones.
        offsets = np.indices((point_px, point_px)).reshape(2, 1, -1)
        rows, columns = (np.rint(corner).astype(np.intp)[..., np.newaxis] + offsets).reshape(2, -1)
        inside = (rows >= 0) & (rows < shape[0]) & (columns >= 0) & (columns < shape[1])
        colours = shown.colours[order].repeat(point_px**2, axis=0)
        picture[rows[inside], columns[inside]] = colours[inside]
        return picture


Renderer = PyvistaRenderer | RasterRenderer


def choose_renderer() -> Renderer:
    """Return the graphics library's where it works."""
    return PyvistaRenderer() if has_working_graphics() else RasterRenderer()


@cache
def has_working_graphics(probe: str = PROBE_SCRIPT) -> bool:
    """Whether VTK can draw here. Where it cannot it ends its process, so another one tries, once."""
    quietly: Any = {"capture_output": True, "stdin": subprocess.DEVNULL, "check": False}
    try:
        done = subprocess.run([sys.executable, "-c", probe], timeout=PROBE_TIMEOUT_S, **quietly)
    except (OSError, subprocess.TimeoutExpired):
        return False
    return done.returncode == 0


def add_to_plotter(plotter: Any, shown: DisplayedFrame, point_px: int) -> None:
    """Put points, or the surface, into a pyvista plotter, instead of what was shown before."""
    import pyvista

    plotter.set_background([value / 255 for value in BACKGROUND])
    plotter.remove_actor("shown", render=False)
    if shown.surface is not None:
        mesh = pyvista.PolyData.from_regular_faces(shown.surface.vertices, shown.surface.faces)
        plotter.add_mesh(mesh, color="#d8d2c4", name="shown", specular=0.3)
    elif len(shown.cloud):
        points = pyvista.PolyData(shown.cloud.xyz)
        points["colour"] = shown.colours
        look = {"rgb": True, "point_size": point_px, "lighting": False, "name": "shown"}
        plotter.add_mesh(points, scalars="colour", **look)


PICTURE_SHAPE_PX = (640, 960)
BOX_COLOUR, SCALE_BAR_COLOUR = "#8b93a3", "#ebeef5"
SCALE_LABEL_PX = 4
MAX_POINT_PX = 16
FEW_POINTS, MANY_POINTS = 20_000, 200_000


class SceneFigure:
    """A figure around a rendered scene, which pictures of a film share."""

    def __init__(
        self,
        title: str,
        first: DisplayedFrame,
        renderer: Renderer,
        viewpoint: Viewpoint | None = None,
    ) -> None:
        self._title, self._renderer = title, renderer
        rows, columns = PICTURE_SHAPE_PX
        self.viewpoint = viewpoint or place_viewpoint(first.cloud.xyz, columns / rows)
        figure = make_figure(columns / DOTS_PER_INCH + 1.2, rows / DOTS_PER_INCH + 0.4)
        self._figure, self._axes = figure, figure.subplots()
        empty = np.zeros((rows, columns, 3), np.uint8)
        self._image = self._axes.imshow(empty, interpolation="nearest")
        self._axes.set_axis_off()
        if len(first.cloud):
            self._draw_box(Box.around(first.cloud.xyz))
        bar = draw_colour_bar(figure, first.scale, 7, ax=self._axes, shrink=0.8, pad=0.01)
        bar.set_label(choose_ticks(first.scale)[1], fontsize=9)
        self._canvas: Any = None  # matplotlib's own annotations leave most of a canvas untyped
        self._background: Any = None
        self._text = self._axes.set_title("", fontsize=9, loc="left")

    def draw(self, shown: DisplayedFrame) -> Figure:
        """Put what is shown into the figure, and return it."""
        # half of the neighbours on surfaces touch, and few points are large enough to be seen
        point_px, xyz = choose_point_size(len(shown.cloud)), shown.cloud.xyz
        if len(xyz) > 1:
            _, _, depth = self.viewpoint.project(xyz, PICTURE_SHAPE_PX)
            focal_px = PICTURE_SHAPE_PX[0] / 2 / np.tan(self.viewpoint.field_of_view / 2)
            touching = focal_px * measure_point_spacing(xyz) / np.nanmedian(depth)
            point_px = int(min(max(np.ceil(touching), point_px), MAX_POINT_PX))
        image = self._renderer.draw(shown, self.viewpoint, PICTURE_SHAPE_PX, point_px)
        self._image.set_data(image)
        of_frames = f", {shown.caption}" if shown.caption else ""
        points = f"{len(shown.cloud)} points{self._renderer.note}"
        self._text.set_text(f"{self._title}{of_frames}: {points}")
        return self._figure

    def pixels(self, shown: DisplayedFrame) -> Image:
        """Return the whole figure as an image, its sides even numbers of pixels."""
        from matplotlib.backends.backend_agg import FigureCanvasAgg

        self.draw(shown)
        moving = (self._image, *self._axes.lines, *self._axes.texts, self._text)
        if self._canvas is None:  # what stays is laid out and drawn once
            self._canvas = FigureCanvasAgg(self._figure)
            for artist in moving:
                artist.set_animated(True)
            self._canvas.draw()
            self._figure.set_layout_engine("none")
            self._background = self._canvas.copy_from_bbox(self._figure.bbox)
        self._canvas.restore_region(self._background)
        for artist in moving:
            self._axes.draw_artist(artist)
        drawn = np.asarray(self._canvas.buffer_rgba())[..., :3]
        rows, columns = (side - side % 2 for side in drawn.shape[:2])
        return np.ascontiguousarray(drawn[:rows, :columns])

    def _draw_box(self, box: Box) -> None:
        """Draw the box around nearly all points, say how long its sides are, and draw a scale bar."""
        axes, shape = self._axes, PICTURE_SHAPE_PX
        for edge in box.edges:
            row, column, _ = self.viewpoint.project(edge, shape)
            axes.plot(column, row, color=BOX_COLOUR, linewidth=0.6, alpha=0.6)
        row, column, _ = self.viewpoint.project(box.length_marks, shape)
        look: Any = {"color": SCALE_BAR_COLOUR, "fontsize": 7, "va": "bottom", "clip_on": True}
        # over bright points, words in no colour could be read
        look["bbox"] = {"facecolor": np.array(BACKGROUND) / 255, "edgecolor": "none", "pad": 1}
        for name, length_m, x, y in zip("xyz", box.high - box.low, column, row, strict=True):
            axes.text(x, y, f"{name} {format_length(float(length_m))}", ha="center", **look)
        bar = box.scale_bar(self.viewpoint.eye)
        row, column, _ = self.viewpoint.project(bar, shape)
        axes.plot(column, row, color=SCALE_BAR_COLOUR, linewidth=2.5, solid_capstyle="butt")
        look = {"color": SCALE_BAR_COLOUR, "fontsize": 8, "va": "top"}
        words, below = (
            format_length(float(np.linalg.norm(bar[1] - bar[0]))),
            row.mean() + SCALE_LABEL_PX,
        )
        axes.text(column.mean(), below, words, ha="center", **look)
        axes.set_xlim(-0.5, shape[1] - 0.5)
        axes.set_ylim(shape[0] - 0.5, -0.5)
        axes.set_aspect("equal")


def draw_colour_bar(figure: Figure, scale: Scale, ticks: int, **place: Any) -> Any:
    """Add the colours of a scale with some of their values; `place`: as `Figure.colorbar` takes it."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import ListedColormap

    mapped = ScalarMappable(cmap=ListedColormap(load_palette(scale.palette) / 255.0))
    bar = figure.colorbar(mapped, **place)
    places, labels = zip(*choose_ticks(scale, ticks)[0], strict=True)
    bar.set_ticks(places, labels=labels)
    bar.ax.tick_params(labelsize=8)
    return bar


def choose_point_size(points: int) -> int:
    """Return the side of a drawn point: larger where there are few."""
    return 6 if points < FEW_POINTS else 3 if points < MANY_POINTS else 2


def save_picture(session: Session, renderer: Renderer, out: Path) -> int:
    """Write a picture of what is shown, whole or not at all; return its number of points."""
    shown = session.frame_at(0.0)
    figure = SceneFigure(session.title, shown, renderer, session.viewpoint)
    save_figure(figure.draw(shown), out)
    return len(shown.cloud)


MAX_FRAME_RATE_HZ = 15.0
MAX_FILM_FRAMES = 1500  # A minute; live sources never end


def choose_frames(session: Session) -> list[int]:
    """Return the frames of a film at natural speed: at most 15 a second, and none twice."""
    source = session.source
    count = len(source)
    pictures = min(MAX_FILM_FRAMES, count, max(1, round(count / source.rate * MAX_FRAME_RATE_HZ)))
    return [int(frame) for frame in np.linspace(source.inflow.oldest, count - 1, pictures).round()]


def save_film(
    session: Session, renderer: Renderer, out: Path, advance: Callable[[int], None]
) -> int:
    """Write an ``.mp4``, whole or not at all; return the largest number of points in a picture."""
    whole = session.frame_at(0.0)  # a transient begins at its end: with all of its points
    figure, most = SceneFigure(session.title, whole, renderer, session.viewpoint), 0
    frames = choose_frames(session)
    if not frames:
        raise InputError(f"{session.source.title}: there is nothing to film")
    with open_film(out, min(MAX_FRAME_RATE_HZ, session.source.rate)) as add:
        for frame in frames:
            # The clock stands still, so that the frame that is due is the one jumped to.
            session.clock.jump(frame)
            shown = session.frame_at(0.0)
            add(figure.pixels(shown))
            most = max(most, len(shown.cloud))
            advance(1)
    return most


WINDOW_SIZE_PX = (1280, 800)
TICK_MS = 30
DISPLAY_VARIABLES = ("DISPLAY", "WAYLAND_DISPLAY")
KEY_HELP = "space: play or pause    left, right: step    home, end: first, last    q: quit"


class DesktopWindow:
    """A plotter that follows a session."""

    def __init__(self, session: Session, plotter: Any) -> None:
        self.session, self.plotter = session, plotter
        self._drawn: DisplayedFrame | None = None
        first, clock = self.update(), session.clock
        aspect = WINDOW_SIZE_PX[0] / WINDOW_SIZE_PX[1]
        aim_plotter(plotter, place_viewpoint(first.cloud.xyz, aspect))
        plotter.add_text(KEY_HELP, position="lower_left", font_size=8, color="grey")
        self.keys: dict[str, Callable[[], None]] = {
            "space": lambda: clock.pause() if clock.playing else clock.play(),
            "Left": lambda: clock.step(-1),
            "Right": lambda: clock.step(1),
            "Home": lambda: clock.jump(0),
            "End": lambda: clock.jump(len(session.source)),
        }
        for key, act in self.keys.items():
            plotter.add_key_event(key, act)

    def update(self, _: int = 0) -> DisplayedFrame:
        """Draw what is due now, if it is not drawn yet."""
        shown = self.session.frame_at(time.monotonic())
        if shown is not self._drawn:
            self._drawn = shown
            add_to_plotter(self.plotter, shown, choose_point_size(len(shown.cloud)))
            what = f"{self.session.label}  {self.session.source.title}"
            words = f"{what}  frame {shown.frame + 1}, {len(shown.cloud)} points"
            look = {"position": "upper_left", "font_size": 9, "color": "white", "name": "words"}
            self.plotter.add_text(words, **look)
        return shown


def open_window(session: Session) -> None:
    """Show a session in a window until it is closed."""
    # What VTK would answer by ending the process is refused in words.
    if sys.platform.startswith("linux") and not any(map(os.environ.get, DISPLAY_VARIABLES)):
        raise MissingDependencyError(
            "--desktop needs a display, and neither DISPLAY nor WAYLAND_DISPLAY is set here; without --desktop the "
            "page works through ssh, and --png needs nothing"
        )
    if not has_working_graphics():
        raise MissingDependencyError(
            "--desktop needs a working OpenGL, and VTK cannot draw here (on Debian: apt-get install libgl1 libegl1); "
            "the page and --png work without"
        )
    import pyvista

    title = f"tofclip: {session.source.title}"
    plotter = pyvista.Plotter(window_size=list(WINDOW_SIZE_PX), title=title)
    window = DesktopWindow(session, plotter)
    plotter.add_timer_event(max_steps=10**9, duration=TICK_MS, callback=window.update)
    plotter.show()
