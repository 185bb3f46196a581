"""Points drawn into an array, without a screen: by the graphics library where it works, by NumPy
everywhere.
"""

from __future__ import annotations

import subprocess
import sys
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from apps.viewer.viewpoint import DOWN, Viewpoint

if TYPE_CHECKING:
    from apps.viewer.session import DisplayedFrame

BACKGROUND = (24, 27, 33)


def rasterise_points(
    xyz: NDArray[np.float32],
    colours: NDArray[np.uint8],
    viewpoint: Viewpoint,
    shape: tuple[int, int],
    size_px: int,
) -> NDArray[np.uint8]:
    """Draw points as squares, near ones over far ones.

    `xyz` (n, 3): m; `colours` (n, 3); `shape`: rows and columns of the picture; `size_px`: side of
    a square. Returns (rows, columns, 3).
    """
    picture = np.empty((*shape, 3), np.uint8)
    picture[:] = BACKGROUND
    row, column, depth = viewpoint.project(xyz, shape)
    with np.errstate(invalid="ignore"):
        seen = (np.abs(row - shape[0] / 2) < shape[0]) & (np.abs(column - shape[1] / 2) < shape[1])
    order = np.flatnonzero(seen)
    order = order[
        np.argsort(-depth[order], kind="stable")
    ]  # of writes to one pixel the last one stays
    first_row = np.rint(row[order] - (size_px - 1) / 2).astype(np.intp)
    first_column = np.rint(column[order] - (size_px - 1) / 2).astype(np.intp)
    ordered = colours[order]
    # All pixels of one point before those of the next, or far points would show at the edges of
    # near ones.
    offsets = np.arange(size_px)
    rows = (
        (first_row[:, np.newaxis, np.newaxis] + offsets[:, np.newaxis])
        .repeat(size_px, axis=2)
        .reshape(-1)
    )
    columns = (
        (first_column[:, np.newaxis, np.newaxis] + offsets).repeat(size_px, axis=1).reshape(-1)
    )
    inside = (rows >= 0) & (rows < shape[0]) & (columns >= 0) & (columns < shape[1])
    picture[rows[inside], columns[inside]] = ordered.repeat(size_px**2, axis=0)[inside]
    return picture


Image = NDArray[np.uint8]
PROBE_TIMEOUT_S = 60.0
"""Seconds; loading the library takes three on a slow machine."""

PROBE_SCRIPT = """
import pyvista
plotter = pyvista.Plotter(off_screen=True, window_size=(64, 64))
plotter.add_mesh(pyvista.Sphere())
raise SystemExit(0 if plotter.screenshot(return_img=True).std() > 0 else 1)
"""


class Renderer(Protocol):
    """Draws what is shown."""

    name: str

    def draw(
        self, shown: DisplayedFrame, viewpoint: Viewpoint, shape: tuple[int, int], point_px: int
    ) -> Image:
        """Return a picture of `shape` rows and columns, (rows, columns, 3); points are `point_px`
        wide.

        `shape`: rows and columns; `point_px`: pixels. Returns (rows, columns, 3).
        """
        ...


class PyvistaRenderer:
    """Draws off screen with VTK, every picture in the same window."""

    name = "pyvista"

    def __init__(self) -> None:
        self._plotter: Any = None

    def draw(
        self, shown: DisplayedFrame, viewpoint: Viewpoint, shape: tuple[int, int], point_px: int
    ) -> Image:
        """Return a picture, drawn by VTK.

        Arguments and result are those of `Renderer.draw`.
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
        """Return a picture, drawn by NumPy; surfaces appear as their points.

        Arguments and result are those of `Renderer.draw`.
        """
        return rasterise_points(shown.cloud.xyz, shown.colours, viewpoint, shape, point_px)


def add_to_plotter(plotter: Any, shown: DisplayedFrame, point_px: int) -> None:
    """Put points, or the surface, into a pyvista plotter.

    `plotter`: what was shown before is removed; `point_px`: width of a point, pixels.
    """
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
