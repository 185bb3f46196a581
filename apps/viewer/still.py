"""The scene as a picture or a film with its colours' scale, made without a screen: by the graphics
library where it works, by NumPy everywhere.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from apps.figures.style import make_figure, save_figure
from apps.mp4 import open_film
from apps.viewer.look import PALETTE_SIZE, choose_ticks, format_length, load_palette
from apps.viewer.session import Session
from apps.viewer.viewpoint import DOWN, Box, Viewpoint, measure_point_spacing, place_viewpoint
from tofclip.errors import InputError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from apps.viewer.look import Scale
    from apps.viewer.session import DisplayedFrame


BACKGROUND = (24, 27, 33)


def rasterise_points(
    xyz: NDArray[np.float32],
    colours: NDArray[np.uint8],
    viewpoint: Viewpoint,
    shape: tuple[int, int],
    size_px: int,
) -> NDArray[np.uint8]:
    """Draw points (n, 3) as squares, near ones over far ones, into a picture (rows, columns, 3)."""
    picture = np.empty((*shape, 3), np.uint8)
    picture[:] = BACKGROUND
    row, column, depth = viewpoint.project(xyz, shape)
    with np.errstate(invalid="ignore"):
        seen = (np.abs(row - shape[0] / 2) < shape[0]) & (np.abs(column - shape[1] / 2) < shape[1])
    order = np.flatnonzero(seen)
    order = order[
        np.argsort(-depth[order], kind="stable")
    ]  # of writes to one pixel the last one stays
    corner = np.stack([row[order], column[order]]) - (size_px - 1) / 2
    # All pixels of one point before those of the next, or far points would show at the edges of
    # near ones.
    offsets = np.indices((size_px, size_px)).reshape(2, 1, -1)
    rows, columns = (np.rint(corner).astype(np.intp)[..., np.newaxis] + offsets).reshape(2, -1)
    inside = (rows >= 0) & (rows < shape[0]) & (columns >= 0) & (columns < shape[1])
    picture[rows[inside], columns[inside]] = colours[order].repeat(size_px**2, axis=0)[inside]
    return picture


Image = NDArray[np.uint8]
PROBE_TIMEOUT_S = 60.0  # seconds; loading the library takes three on a slow machine
PROBE_SCRIPT = """
import pyvista
plotter = pyvista.Plotter(off_screen=True, window_size=(64, 64))
plotter.add_mesh(pyvista.Sphere())
raise SystemExit(0 if plotter.screenshot(return_img=True).std() > 0 else 1)
"""


class PyvistaRenderer:
    """Draws off screen with VTK, every picture in the same window."""

    name = "pyvista"

    def __init__(self) -> None:
        self._plotter: Any = None

    def draw(
        self, shown: DisplayedFrame, viewpoint: Viewpoint, shape: tuple[int, int], point_px: int
    ) -> Image:
        """Return a picture of `shape` rows and columns, (rows, columns, 3); points are `point_px`
        wide.
        """
        import pyvista

        if self._plotter is None:
            _silence_missing_screen()
            self._plotter = pyvista.Plotter(off_screen=True)
            self._plotter.set_background([value / 255 for value in BACKGROUND])
        plotter, camera = self._plotter, self._plotter.camera
        plotter.window_size = (shape[1], shape[0])
        add_to_plotter(plotter, shown, point_px)
        camera.position, camera.focal_point = viewpoint.eye.tolist(), viewpoint.target.tolist()
        camera.up, camera.view_angle = (-DOWN).tolist(), float(np.rad2deg(viewpoint.field_of_view))
        plotter.renderer.reset_camera_clipping_range()
        return np.ascontiguousarray(plotter.screenshot(return_img=True)[..., :3])


def _silence_missing_screen() -> None:
    """Keep VTK from warning that there is no X server: it goes on without one, which is wanted."""
    from vtkmodules.vtkCommonCore import vtkLogger

    vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_ERROR)


class RasterRenderer:
    """Draws with NumPy; the frame around comes from matplotlib, as always."""

    name = "matplotlib"

    def draw(
        self, shown: DisplayedFrame, viewpoint: Viewpoint, shape: tuple[int, int], point_px: int
    ) -> Image:
        """Return a picture, as `PyvistaRenderer.draw` does; surfaces appear as their points."""
        return rasterise_points(shown.cloud.xyz, shown.colours, viewpoint, shape, point_px)


Renderer = PyvistaRenderer | RasterRenderer


def add_to_plotter(plotter: Any, shown: DisplayedFrame, point_px: int) -> None:
    """Put points, or the surface, into a pyvista plotter, instead of what was shown before."""
    import pyvista

    plotter.remove_actor("shown", render=False)
    if shown.surface is not None:
        faces = np.column_stack([np.full(len(shown.surface.faces), 3), shown.surface.faces]).ravel()
        plotter.add_mesh(
            pyvista.PolyData(shown.surface.vertices, faces),
            color="#d8d2c4",
            name="shown",
            specular=0.3,
        )
    elif len(shown.cloud):
        points = pyvista.PolyData(shown.cloud.xyz)
        points["colour"] = shown.colours
        look = {"rgb": True, "point_size": point_px, "lighting": False, "name": "shown"}
        plotter.add_mesh(points, scalars="colour", **look)


def choose_renderer() -> Renderer:
    """Return the graphics library's where it works."""
    return PyvistaRenderer() if has_working_graphics() else RasterRenderer()


def has_working_graphics(probe: str = PROBE_SCRIPT) -> bool:
    """Whether VTK can draw here. Where it cannot it ends its process, so another one tries."""
    try:
        done = subprocess.run(
            [sys.executable, "-c", probe],
            capture_output=True,
            timeout=PROBE_TIMEOUT_S,
            check=False,
            stdin=subprocess.DEVNULL,
        )
    except (OSError, subprocess.TimeoutExpired):
        return False
    return done.returncode == 0


PICTURE_SHAPE_PX = (640, 960)
DOTS_PER_INCH = 100
COLOUR_BAR_TICKS = 7
BOX_COLOUR, SCALE_BAR_COLOUR = "#8b93a3", "#ebeef5"
SCALE_LABEL_PX = 4

MAX_POINT_PX = 16
FEW_POINTS, MANY_POINTS = 20_000, 200_000


class SceneFigure:
    """A figure around a rendered scene: box, colours, words. Pictures of a film share one. `first`:
    says from where one looks.
    """

    def __init__(self, title: str, first: DisplayedFrame, renderer: Renderer) -> None:
        self._title, self._renderer = title, renderer
        self.viewpoint = place_viewpoint(first.cloud.xyz, PICTURE_SHAPE_PX[1] / PICTURE_SHAPE_PX[0])
        self._figure, self._axes, self._image = _make_axes()
        if len(first.cloud):
            _draw_box(self._axes, self.viewpoint, first.cloud.xyz)
            self._axes.set_aspect("equal")
        self._draw_colours(first.scale)
        self._canvas: Any = None  # matplotlib's own annotations leave most of a canvas untyped
        self._background: Any = None
        self._text = self._axes.set_title("", fontsize=9, loc="left")

    def draw(self, shown: DisplayedFrame) -> Figure:
        """Put what is shown into the figure, and return it."""
        image = self._renderer.draw(
            shown, self.viewpoint, PICTURE_SHAPE_PX, self._choose_point_size(shown)
        )
        self._image.set_data(image)
        note = (
            ""
            if self._renderer.name == "pyvista"
            else "   drawn by matplotlib: no working graphics library here"
        )
        of_frames = f", {shown.caption}" if shown.caption else ""
        self._text.set_text(f"{self._title}{of_frames}: {len(shown.cloud)} points{note}")
        return self._figure

    def pixels(self, shown: DisplayedFrame) -> Image:
        """Return the whole figure as an image, (rows, columns, 3), its sides even numbers of
        pixels.
        """
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

    def _choose_point_size(self, shown: DisplayedFrame) -> int:
        """Return the side of a drawn point, pixels: such that half of the neighbours on surfaces
        touch, and no less than few points need to be seen.
        """
        least, xyz = choose_point_size(len(shown.cloud)), shown.cloud.xyz
        if len(xyz) < 2:
            return least
        _, _, depth = self.viewpoint.project(xyz, PICTURE_SHAPE_PX)
        focal_px = PICTURE_SHAPE_PX[0] / 2 / np.tan(self.viewpoint.field_of_view / 2)
        touching = focal_px * measure_point_spacing(xyz) / float(np.nanmedian(depth))
        return int(min(max(np.ceil(touching), least), MAX_POINT_PX))

    def _draw_colours(self, scale: Scale) -> None:
        from matplotlib.cm import ScalarMappable
        from matplotlib.colors import ListedColormap

        mapped = ScalarMappable(cmap=ListedColormap(load_palette(scale.palette) / 255.0))
        mapped.set_clim(0, PALETTE_SIZE - 1)
        ticks, title = choose_ticks(scale, COLOUR_BAR_TICKS)
        places = [place * (PALETTE_SIZE - 1) for place, _ in ticks]
        bar = self._figure.colorbar(mapped, ax=self._axes, shrink=0.8, pad=0.01, ticks=places)
        bar.set_ticklabels([label for _, label in ticks])
        bar.set_label(title, fontsize=9)
        bar.ax.tick_params(labelsize=8)


def save_picture(title: str, shown: DisplayedFrame, renderer: Renderer, out: Path) -> None:
    """Write a picture of what is shown, whole or not at all, in the format of its suffix."""
    save_figure(SceneFigure(title, shown, renderer).draw(shown), out)


def _make_axes() -> tuple[Figure, Any, Any]:
    """An empty figure, its axes, and the image in them."""
    figure = make_figure(
        PICTURE_SHAPE_PX[1] / DOTS_PER_INCH + 1.2, PICTURE_SHAPE_PX[0] / DOTS_PER_INCH + 0.4
    )
    axes = figure.subplots()
    image = axes.imshow(np.zeros((*PICTURE_SHAPE_PX, 3), np.uint8), interpolation="nearest")
    axes.set_axis_off()
    return figure, axes, image


def _draw_box(axes: Any, viewpoint: Viewpoint, xyz: NDArray[np.float32]) -> None:
    """Draw the box around nearly all points, and say how long its sides are."""
    box = Box.around(xyz)
    row, column, _ = viewpoint.project(box.corners, PICTURE_SHAPE_PX)
    for edge in box.edges:
        ends = list(edge)
        axes.plot(column[ends], row[ends], color=BOX_COLOUR, linewidth=0.6, alpha=0.6)
    row, column, _ = viewpoint.project(box.length_marks, PICTURE_SHAPE_PX)
    for name, length_m, x, y in zip("xyz", box.high - box.low, column, row, strict=True):
        words = f"{name} {format_length(float(length_m))}"
        axes.text(x, y, words, color=BOX_COLOUR, fontsize=7, ha="center", va="bottom", clip_on=True)
    bar = box.scale_bar
    row, column, _ = viewpoint.project(bar, PICTURE_SHAPE_PX)
    axes.plot(column, row, color=SCALE_BAR_COLOUR, linewidth=2.5, solid_capstyle="butt")
    length = float(bar[1, 0] - bar[0, 0])
    axes.text(
        float(column.mean()),
        float(row.mean()) + SCALE_LABEL_PX,
        format_length(length),
        color=SCALE_BAR_COLOUR,
        fontsize=8,
        ha="center",
        va="top",
    )
    axes.set_xlim(-0.5, PICTURE_SHAPE_PX[1] - 0.5)
    axes.set_ylim(PICTURE_SHAPE_PX[0] - 0.5, -0.5)


def choose_point_size(points: int) -> int:
    """Return the side of a drawn point: larger where there are few."""
    return 6 if points < FEW_POINTS else 3 if points < MANY_POINTS else 2


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
    """Write a film, whole or not at all. `out`: ends in ``.mp4``; `advance`: called with 1 after
    every picture. Returns the largest number of points in a picture.
    """
    whole = session.frame_at(0.0)  # a transient begins at its end: with all of its points
    still, most, frames = (
        SceneFigure(session.title, whole, renderer),
        0,
        choose_frames(session),
    )
    rate = min(MAX_FRAME_RATE_HZ, session.source.rate)
    if not frames:
        raise InputError(f"{session.source.title}: there is nothing to film")
    with open_film(out, rate) as film:
        for frame in frames:
            # The clock stands still, so that the frame that is due is the one jumped to.
            session.jump(frame)
            shown = session.frame_at(0.0)
            film.add(still.pixels(shown))
            most = max(most, len(shown.cloud))
            advance(1)
    return most
