"""The drawing of a camera's conventions: slit, lines, time, and where a cloud's coordinates begin.

``python docs/camera_geometry.py docs/pictures/camera_geometry.png`` draws it; the guide to
one's own camera shows it.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from apps.figures.style import make_figure
from tofclip.notebook import save_figure
from tofclip.simulate import make_default_camera

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from numpy.typing import NDArray

ON_AXIS_POINT_PX, OFF_AXIS_POINT_PX = (0.0, 0.0), (25.0, 40.0)  # X, Y of two scene points, pixels
NEAR_FRACTION, FAR_FRACTION = 0.35, 0.7  # when their light comes, as a fraction of the sweep
FIRST_COLOUR, SECOND_COLOUR, SLIT_COLOUR, TEXT_COLOUR = "#2e6f95", "#d1495b", "#c9cdd2", "#20242c"
HALF_LINE_PX = 70.0  # length of a drawn line above and below its middle, pixels


def draw_geometry(path: Path) -> None:
    """Draw slit, streak image and cloud axes side by side, and write them to `path`."""
    save_figure(_make_geometry_figure(), path)


def project_to_slit(point: tuple[float, float]) -> NDArray[np.float64]:
    """Where the views of the demonstration's camera put scene point (X, Y) on the slit, (views,)
    px.
    """
    camera = make_default_camera()
    columns: NDArray[np.float64] = camera.centres_px + point[0] - point[1] * np.tan(camera.angles)
    return columns


def _make_geometry_figure() -> Figure:
    figure = make_figure(12, 4.8)
    grid = figure.add_gridspec(2, 2, width_ratios=[2.6, 1])
    _draw_focus_picture(figure.add_subplot(grid[0, 0]))
    _draw_streak(figure.add_subplot(grid[1, 0]))
    _draw_cloud(figure.add_subplot(grid[:, 1]))
    return figure


def _draw_focus_picture(axes: Axes) -> None:
    """Slit open: every lenslet draws a line through each point; slit closed: only the dots on the
    slit are left.
    """
    camera = make_default_camera()
    axes.axhspan(-3, 3, color=SLIT_COLOUR)
    for point, colour, name in (
        (ON_AXIS_POINT_PX, FIRST_COLOUR, "point on the axis"),
        (OFF_AXIS_POINT_PX, SECOND_COLOUR, "point at (X, Y)"),
    ):
        for centre, angle, column in zip(
            camera.centres_px, camera.angles, project_to_slit(point), strict=True
        ):
            rows = point[1] + np.array([-HALF_LINE_PX, HALF_LINE_PX]) * np.cos(angle)
            axes.plot(
                centre + point[0] + (rows - point[1]) * np.tan(angle), rows, color=colour, lw=2
            )
            axes.plot(column, 0, "o", color=colour, ms=5)
        # An empty curve gives the legend one entry for all lines of a point.
        axes.plot([], [], color=colour, lw=2, label=name)
    axes.plot(
        [], [], "o", color=TEXT_COLOUR, ms=5, label="on the slit: column c_k + X - Y tan(a_k)"
    )
    last = camera.centres_px[-1], camera.angles[-1]
    axes.plot([last[0]] * 2, [0, HALF_LINE_PX], ":", color=TEXT_COLOUR)
    axes.annotate("a > 0", (last[0] + 8, 62), fontsize=8)
    axes.annotate("slit", (8, -9), fontsize=8)
    axes.set(
        xlim=(0, camera.slit_width_px),
        ylim=(150, -80),
        xlabel="column (px)",
        ylabel="row (px), down",
    )
    axes.set_aspect("equal")
    axes.set_title(
        "Focus mode, slit open: a line for each lenslet, at the angle a_k from the vertical",
        fontsize=10,
    )
    axes.legend(ncols=3, loc="lower center", fontsize=8, frameon=False)


def _draw_streak(axes: Axes) -> None:
    """Swept: time runs down, the rows of one view being late or early by the sweep's skew."""
    camera = make_default_camera()
    for point, when, colour in (
        (ON_AXIS_POINT_PX, NEAR_FRACTION, FIRST_COLOUR),
        (OFF_AXIS_POINT_PX, FAR_FRACTION, SECOND_COLOUR),
    ):
        columns = project_to_slit(point)
        axes.plot(columns, np.full(columns.shape, when), "o", color=colour, ms=6)
        axes.axhline(when, color=colour, lw=0.6, ls=":")
    axes.vlines(camera.centres_px, 0, 1, color=SLIT_COLOUR, lw=1, zorder=0)
    for view, centre in enumerate(camera.centres_px):
        axes.annotate(f"c_{view}", (centre + 4, 0.07), fontsize=8, color=TEXT_COLOUR)
    axes.annotate("near", (8, NEAR_FRACTION + 0.07), fontsize=8, color=FIRST_COLOUR)
    axes.annotate("far", (8, FAR_FRACTION + 0.07), fontsize=8, color=SECOND_COLOUR)
    axes.set(
        xlim=(0, camera.slit_width_px),
        ylim=(1, 0),
        xlabel="column (px)",
        ylabel="row: time, down",
        yticks=[],
    )
    axes.set_title(
        "Swept: one shot, (rows, columns) = (time, slit); range = c (t - time zero) / 2",
        fontsize=10,
    )


def _draw_cloud(axes: Axes) -> None:
    """The frame of the cloud, in perspective: x right, y down, z forward from the reference
    lenslet.
    """
    forward, point = (0.62, 0.5), (0.45, 0.72)
    for lenslet in np.linspace(-0.27, 0.27, 7):
        axes.plot(
            [lenslet, lenslet],
            [-0.05, 0.05],
            color=FIRST_COLOUR if abs(lenslet) < 0.01 else TEXT_COLOUR,
            lw=4,
        )
    for end, name, shift in (
        ((0.55, 0), "x", (5, -4)),
        ((0, -0.5), "y", (-4, -14)),
        (forward, "z", (4, 4)),
    ):
        axes.annotate(
            "", end, (0, 0), arrowprops={"arrowstyle": "-|>", "lw": 2, "color": TEXT_COLOUR}
        )
        axes.annotate(name, end, shift, textcoords="offset points", fontsize=12)
    axes.plot([0, point[0]], [0, point[1]], "--", color=SECOND_COLOUR)
    axes.plot(*point, "o", color=SECOND_COLOUR, ms=8)
    axes.annotate(
        "point (x, y, z)", point, (-40, 10), textcoords="offset points", color=SECOND_COLOUR
    )
    axes.annotate(
        "range: along\nthe line of sight", (0.2, 0.42), color=SECOND_COLOUR, fontsize=8, ha="right"
    )
    axes.annotate("origin: the\nreference lenslet", (-0.05, -0.2), ha="right", fontsize=8)
    axes.annotate("X = f x / z,  Y = f y / z\nf: --focal-length-px", (0.05, -0.45), fontsize=9)
    axes.set(xlim=(-0.42, 0.78), ylim=(-0.65, 0.9), aspect="equal")
    axes.axis("off")
    axes.set_title("Clouds: metres, x right, y down, z forward", fontsize=10)


if __name__ == "__main__":
    draw_geometry(Path(sys.argv[1]))
