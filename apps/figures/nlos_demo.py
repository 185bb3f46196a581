"""The demonstration around a corner in one picture: the room, what the wall shows, and images
beside the truth.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from apps.figures.nlos_compare import PlaneAxes, draw_outline, draw_view
from apps.figures.style import (
    LINE_COLOUR,
    SMALL_FONT_PT,
    draw_image,
    label_axes,
    make_figure,
    outer_edges,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from apps.verbs.nlos import DemoRun
    from apps.verbs.nlos_imaging import MeasuredVolume
    from nlos import Capture
    from nlos.known_scenes import HiddenTruth

OUTGOING_COLOUR, RETURN_COLOUR, DEVICE_COLOUR = "#d1495b", "#2e6f95", "#8d949b"
WALL_COLOUR, INK_COLOUR = "#c9cdd2", "#20242c"
# x and z, m; the screen stands between the device and everything hidden, and in no way of light
DEVICE_POSITION_M, SCREEN_X_M, SCREEN_Z_M = (1.65, 0.75), 1.16, (0.68, 1.45)
# x of a wall point and x, z of a hidden point, between which a way of light is drawn, m
WALL_POINT_X_M, HIDDEN_POINT_M = -0.8, (0.27, 1.15)
PANEL_ASPECT = 0.63  # of the panels that hold no image, relative to their width: that of an image
# the record is shown from where a row holds this fraction of its brightest bin
LIT_THRESHOLD = 0.02


def make_demo_figure(run: DemoRun) -> Figure:
    """Draw the room from above, one row's streak, and the images: flat, hybrid, back-projection,
    hybrid from above.
    """
    figure = make_figure(13, 6.6)
    panels = figure.subplots(2, 3)
    _draw_room(panels[0, 0], run)
    _draw_streak(panels[0, 1], run.capture)
    hybrid, slow, flat = (run.images[name] for name in ("hybrid", "backprojection", "flat"))
    longer = f"{slow.seconds / hybrid.seconds:.2g} times as long"
    _draw_image(
        panels[0, 2], flat, run.truth, ("x", "y"), "3. hybrid, had the wall been taken for flat"
    )
    _draw_image(
        panels[1, 0], hybrid, run.truth, ("x", "y"), f"4. hybrid: {_format_seconds(hybrid.seconds)}"
    )
    _draw_image(
        panels[1, 1],
        slow,
        run.truth,
        ("x", "y"),
        f"5. back-projection: {_format_seconds(slow.seconds)}, {longer}",
    )
    _draw_image(panels[1, 2], hybrid, run.truth, ("x", "z"), "6. hybrid, seen from above")
    return figure


def _draw_room(axes: Axes, run: DemoRun) -> None:
    """Top view with the wall at the upper edge: who sees what, and the way of light."""
    middle = run.capture.wall[run.capture.wall.shape[0] // 2]
    x, z = middle[:, 0], middle[:, 2]
    behind = float(z.min()) - 0.14
    axes.fill_between(x, z, behind, color=WALL_COLOUR)
    axes.plot(x, z, color=INK_COLOUR, lw=2)
    draw_outline(axes, run.truth, ("x", "z"))
    seen = int(np.argmin(np.abs(x - WALL_POINT_X_M)))
    spot, point = (
        (float(run.capture.laser[0]), float(run.capture.laser[2])),
        (float(x[seen]), float(z[seen])),
    )
    for start, end, colour, style in (
        (DEVICE_POSITION_M, spot, DEVICE_COLOUR, "--"),
        (spot, HIDDEN_POINT_M, OUTGOING_COLOUR, "-"),
        (HIDDEN_POINT_M, point, RETURN_COLOUR, "-"),
        (point, DEVICE_POSITION_M, DEVICE_COLOUR, "--"),
    ):
        axes.annotate(
            "",
            end,
            start,
            arrowprops={"arrowstyle": "-|>", "color": colour, "lw": 1.5, "ls": style},
        )
    axes.plot([SCREEN_X_M] * 2, SCREEN_Z_M, color=INK_COLOUR, lw=5, solid_capstyle="butt")
    axes.plot(*DEVICE_POSITION_M, "s", color=INK_COLOUR, ms=8)
    for place, text in (
        ((1.45, 1.08), "laser,\ncamera"),
        ((0.67, 1.44), "screen"),
        ((-0.16, -0.12), "laser spot"),
        ((-0.31, 1.05), "3"),
        ((0.25, 1.34), "D"),
    ):
        axes.annotate(text, place, fontsize=SMALL_FONT_PT)
    axes.set(xlim=(-1.1, 2.0), ylim=(1.6, behind), aspect="equal", anchor="C")
    label_axes(axes, "1. the room from above: a curved wall", "x (m)", "z, away from the wall (m)")


def _draw_streak(axes: Axes, capture: Capture) -> None:
    """What the middle row of the wall shows over the path length."""
    row = capture.signal[:, capture.wall.shape[0] // 2]
    lit = np.flatnonzero(row.max(axis=1) > LIT_THRESHOLD * row.max())
    paths = capture.axis.paths[lit[0] : lit[-1] + 1]
    left, right = outer_edges(capture.wall[0, :, 0])
    first, last = outer_edges(paths)
    draw_image(axes, row[lit[0] : lit[-1] + 1], (left, right, last, first), aspect="auto")
    axes.set_box_aspect(PANEL_ASPECT)
    for place, text in (((-0.78, 1.98), "3"), ((0.72, 2.4), "D")):
        axes.annotate(text, place, color="white", fontsize=SMALL_FONT_PT)
    label_axes(
        axes,
        f"2. one row of the wall: up to {row.max():.0f} photons in a bin",
        "x on the wall (m)",
        "path spot - hidden - wall (m)",
    )


def _draw_image(
    axes: Axes, image: MeasuredVolume, truth: HiddenTruth, plane: PlaneAxes, title: str
) -> None:
    draw_view(axes, image.volume, plane, truth)
    downwards = "y, down (m)" if plane[1] == "y" else "z, away from the wall (m)"
    label_axes(axes, title, "x (m)", downwards)
    axes.plot([], [], color=LINE_COLOUR, label="truth")
    axes.legend(
        fontsize=SMALL_FONT_PT,
        loc="upper right",
        framealpha=0.3,
        labelcolor="white",
        facecolor=INK_COLOUR,
    )


def _format_seconds(seconds: float) -> str:
    return f"{seconds:.1f} s" if seconds >= 1 else f"{seconds:.2f} s"
