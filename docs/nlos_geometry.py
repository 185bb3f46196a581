"""The drawing of coordinates, light paths and time around a corner; `docs/nlos.md` shows it.

``python docs/nlos_geometry.py docs/pictures/nlos_geometry.png`` draws it.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from apps.figures.style import make_figure
from nlos.capture import TimeAxis
from nlos.simulate import HiddenScene, Surface, build_relay_wall
from tofclip.notebook import save_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

WALL_POINT_M, LASER_SPOT_M = (-0.45, 0.0), (0.35, 0.0)
HIDDEN_POINT_M, DEVICE_POSITION_M, SCREEN_M = (
    (-0.1, 0.75),
    (1.15, 0.85),
    ((0.55, 0.65), (0.55, 1.25)),
)
OUTGOING_COLOUR, RETURN_COLOUR, DEVICE_COLOUR = "#d1495b", "#2e6f95", "#9aa0a6"


def draw_geometry(path: Path) -> None:
    """Draw the top view of a capture beside one simulated signal, and write it to `path`."""
    save_figure(_make_geometry_figure(), path)


def _make_geometry_figure() -> Figure:
    figure = make_figure(11, 4.6)
    top, record = figure.subplots(1, 2, width_ratios=[1.25, 1])
    _draw_room(top)
    _draw_signal(record)
    return figure


def _draw_room(axes: Axes) -> None:
    """Top view: x to the right, z away from the wall, which runs along the lower edge."""
    x = np.linspace(-1, 1, 200)
    wall = -0.06 * x**2
    axes.fill_between(x, wall, -0.2, color="#c9cdd2")
    axes.plot(x, wall, color="#20242c", lw=2)
    axes.plot(*zip(*SCREEN_M, strict=True), color="#20242c", lw=5, solid_capstyle="butt")
    spot, point = (
        (LASER_SPOT_M[0], -0.06 * LASER_SPOT_M[0] ** 2),
        (WALL_POINT_M[0], -0.06 * WALL_POINT_M[0] ** 2),
    )
    for start, end, colour, style in (
        (DEVICE_POSITION_M, spot, DEVICE_COLOUR, "--"),
        (spot, HIDDEN_POINT_M, OUTGOING_COLOUR, "-"),
        (HIDDEN_POINT_M, point, RETURN_COLOUR, "-"),
        (point, DEVICE_POSITION_M, DEVICE_COLOUR, "--"),
    ):
        arrow = {"arrowstyle": "-|>", "color": colour, "lw": 1.8, "ls": style}
        axes.annotate("", end, start, arrowprops=arrow)
    for place, text, offset in (
        (spot, "laser spot r_L", (6, -16)),
        (point, "wall point r_p", (-50, -16)),
        (HIDDEN_POINT_M, "hidden point r", (-20, 10)),
        (DEVICE_POSITION_M, "laser and camera", (-55, 10)),
        ((0.55, 1.0), "screen", (-42, 0)),
    ):
        axes.annotate(text, place, offset, textcoords="offset points")
    axes.plot(*HIDDEN_POINT_M, "o", color=OUTGOING_COLOUR, ms=8)
    axes.plot(*DEVICE_POSITION_M, "s", color="#20242c", ms=8)
    axes.annotate("", (-1.25, 0.6), (-1.55, 0.6), arrowprops={"arrowstyle": "-|>", "lw": 2})
    axes.annotate("", (-1.55, 0.9), (-1.55, 0.6), arrowprops={"arrowstyle": "-|>", "lw": 2})
    axes.text(-1.22, 0.58, "x")
    axes.text(-1.6, 0.95, "z, into the hidden scene")
    axes.text(-1.6, 0.45, "y points down, into the page", fontsize=8)
    axes.set_title("Seen from above")
    axes.set(xlim=(-1.65, 1.55), ylim=(-0.2, 1.3), aspect="equal", xticks=[], yticks=[])


def _draw_signal(axes: Axes) -> None:
    """Signal of the drawn wall point over path length."""
    axis = TimeAxis(160, 32e-12, 0.6)
    scene = HiddenScene(
        [Surface.rectangle([HIDDEN_POINT_M[0], 0, HIDDEN_POINT_M[1]], (0.04, 0.04), 0.02)]
    )
    wall = build_relay_wall("planar", 3, 2.0)
    wall[1, 1] = (WALL_POINT_M[0], 0.0, 0.0)
    capture = scene.simulate_capture(wall.reshape(-1, 3), (LASER_SPOT_M[0], 0.0, 0.0), axis, 60e-12)
    signal = capture.signal[:, 4] / capture.signal[:, 4].max()
    path = sum(
        float(np.hypot(HIDDEN_POINT_M[0] - end[0], HIDDEN_POINT_M[1]))
        for end in (LASER_SPOT_M, WALL_POINT_M)
    )
    direct = LASER_SPOT_M[0] - WALL_POINT_M[0]
    axes.step(axis.paths, signal, where="mid", color="#20242c")
    axes.axvline(path, color=OUTGOING_COLOUR, ls=":")
    axes.axvline(direct, color=DEVICE_COLOUR, ls=":")
    axes.text(path + 0.02, 0.9, "|r_L - r| + |r - r_p|", color=OUTGOING_COLOUR)
    axes.text(direct + 0.02, 0.6, "|r_L - r_p|:\nfirst bounce,\ngated", color="#6b7178")
    axes.annotate(
        "bin 0: start", (axis.start, 0), (axis.start, -0.18), arrowprops={"arrowstyle": "->"}
    )
    axes.set(xlabel="path start + i * c * bin_width (m)", ylabel="signal of r_p", ylim=(-0.25, 1.1))
    axes.set_title("Bins of a capture stand for paths from r_L to r_p")


if __name__ == "__main__":
    draw_geometry(Path(sys.argv[1]))
