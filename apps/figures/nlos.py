"""Images of one hidden scene by several methods beside each other, and the demonstration around a corner:
the room, what the wall shows, and images beside the truth.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from scipy.ndimage import gaussian_filter
from scipy.spatial import cKDTree

from apps.figures.style import (
    LINE_COLOUR,
    SMALL_FONT_PT,
    add_colour_bar,
    draw_image,
    label_axes,
    make_figure,
    outer_edges,
)
from nlos import Capture, Volume
from nlos.known_scenes import HiddenTruth
from tofclip.notebook import letter_panels

COLUMN_INCHES = 3.2
TEXT_INCHES = 1.7
# bounds of a panel's height relative to its width, so that flat and deep boxes stay legible
MIN_PANEL_ASPECT, MAX_PANEL_ASPECT = 0.25, 1.6
OUTLINE_PIXELS = 400  # along the longer side of a view, for the outline of what is hidden
POINT_RADIUS_M = 0.03  # m; the circle about a hidden point
# by so much of a facet the stairs of slanting edges are smoothed, as a standard deviation
CORNER_SMOOTHING = 0.5


def make_comparison_figure(
    volumes: Mapping[str, Volume],
    figures: Mapping[str, Mapping[str, Any]],
    truth: HiddenTruth | None,
) -> Figure:
    """Draw the brightest voxel along z (upper row) and along y (lower row), a column for each
    method. `volumes`: by method, on one grid; each is drawn relative to its own brightest voxel;
    `figures`: what is written below each column: ``seconds``, ``peak_mib``, ``correlation`` and so
    on; `truth`: outlined where it is known.
    """
    grid = next(iter(volumes.values())).grid
    across = np.subtract(*outer_edges(grid.x)[::-1])
    heights = [np.subtract(*outer_edges(axis)[::-1]) / across for axis in (grid.y, grid.z)]
    rows = np.clip(heights, MIN_PANEL_ASPECT, MAX_PANEL_ASPECT) * COLUMN_INCHES
    figure = make_figure(COLUMN_INCHES * len(volumes) + 1, rows.sum() + TEXT_INCHES)
    panels = figure.subplots(
        2, len(volumes), squeeze=False, height_ratios=rows.tolist(), sharex=True
    )
    for column, (name, volume) in enumerate(volumes.items()):
        front, top = panels[:, column]
        drawn = draw_view(front, volume, "xy", truth)
        draw_view(top, volume, "xz", truth)
        down, away = ("y (m), down", "z (m), away from the wall") if column == 0 else ("", "")
        own = figures[name]
        memory = "" if own["peak_mib"] is None else f", {own['peak_mib']:.0f} MiB"
        label_axes(front, f"{name}\n{own['seconds']:.2g} s{memory}", "", down)
        label_axes(top, "", f"x (m)\n\n{_format_merit(own)}", away)
    add_colour_bar(panels[0, -1], drawn, "relative to each method's brightest")
    letter_panels(panels[0])
    return figure


def draw_view(axes: Axes, volume: Volume, plane: str, truth: HiddenTruth | None) -> AxesImage:
    """Draw the brightest voxel along the third axis, and the outline of what is hidden. `plane`:
    names of the axes to the right and downwards, as ``xy``. Returns brightness relative to the
    view's largest, 0 to 1.
    """
    along = "zyx".index(next(name for name in "zyx" if name not in plane))
    picture = volume.magnitude.max(axis=along)
    right, down = (getattr(volume.grid, name) for name in plane)
    (left, last), (upper, lower) = outer_edges(right), outer_edges(down)
    brightest = picture.max() or 1.0
    drawn = draw_image(axes, picture / brightest, (left, last, lower, upper), vmin=0, vmax=1)
    if truth is not None:
        draw_outline(axes, truth, plane)
        axes.set(xlim=(left, last), ylim=(lower, upper))
    return drawn


def draw_outline(axes: Axes, truth: HiddenTruth, plane: str) -> None:
    """Draw the border of everything hidden, seen along the third axis."""
    places = truth.positions[:, ["xyz".index(name) for name in plane]]
    radius = truth.spacing / 2 if truth.spacing else POINT_RADIUS_M
    low, high = places.min(axis=0) - 3 * radius, places.max(axis=0) + 3 * radius
    step = float((high - low).max()) / OUTLINE_PIXELS
    right, down = (np.arange(*ends, step) for ends in zip(low, high + step, strict=True))
    pixels = np.stack(np.meshgrid(right, down), axis=-1)
    # Squares about facets, circles about points. Squares that touch overlap by a hair, or gaps would
    # be drawn between them.
    norm = np.inf if truth.spacing else 2
    distance, _ = cKDTree(places).query(pixels, p=norm, distance_upper_bound=radius * 1.05)
    inside = np.asarray(np.isfinite(distance), np.float64)
    # corners of facets are rounded off, so that the contour is not a staircase
    smooth = gaussian_filter(inside, truth.spacing * CORNER_SMOOTHING / step)
    axes.contour(right, down, smooth, [0.5], colors=LINE_COLOUR, linewidths=1.0)


def _format_merit(figures: Mapping[str, Any]) -> str:
    lines = [f"correlation {figures['correlation']:.3f}", f"sharpness {figures['sharpness']:.1f}"]
    if "energy_near_truth" in figures:
        share, reach = figures["energy_near_truth"], figures["truth_reach_m"]
        lines.append(f"{share:.0%} of the energy within {1000 * reach:.0f} mm of the truth")
        lines.append(f"contrast {figures['contrast_to_truth']:.1f}")
    return "\n".join(lines)


OUTGOING_COLOUR, RETURN_COLOUR, DEVICE_COLOUR = "#d1495b", "#2e6f95", "#8d949b"
WALL_COLOUR, INK_COLOUR = "#c9cdd2", "#20242c"
# x and z, m; the screen stands between the device and everything hidden, and in no way of light
DEVICE_POSITION_M, SCREEN_X_M, SCREEN_Z_M = (1.65, 0.75), 1.16, (0.68, 1.45)
# x of a wall point and x, z of a hidden point, between which a way of light is drawn, m
WALL_POINT_X_M, HIDDEN_POINT_M = -0.8, (0.27, 1.15)
PANEL_ASPECT = 0.63  # of the panels that hold no image, relative to their width: that of an image
# the record is shown from where a row holds this fraction of its brightest bin
LIT_THRESHOLD = 0.02


def make_demo_figure(capture: Capture, truth: HiddenTruth, images: Mapping[str, Volume]) -> Figure:
    """Draw the room from above, one row's streak, and the images by all methods; ``flat`` is that for
    a wall without its depth.
    """
    figure = make_figure(11, 5.6)
    panels = figure.subplots(2, 3)
    _draw_room(panels[0, 0], capture, truth)
    _draw_streak(panels[0, 1], capture)
    hybrid, slow, flat = (images[name] for name in ("hybrid", "backprojection", "flat"))
    wavelength = f"{1e3 * hybrid.provenance['imaging']['wavelength_m']:.0f} mm"
    for axes, image, plane, title in (
        (panels[0, 2], flat, "xy", "hybrid, had the wall been taken for flat"),
        (panels[1, 0], hybrid, "xy", f"hybrid, wavelength {wavelength}"),
        (panels[1, 1], slow, "xy", f"back-projection, wavelength {wavelength}"),
        (panels[1, 2], hybrid, "xz", "hybrid, seen from above"),
    ):
        drawn = draw_view(axes, image, plane, truth)
        down = "y, down (m)" if plane == "xy" else "z, away from the wall (m)"
        label_axes(axes, title, "x (m)", down)
        axes.plot([], [], color=LINE_COLOUR, label="truth")
        look: Any = {"framealpha": 0.3, "labelcolor": "white", "facecolor": INK_COLOUR}
        axes.legend(fontsize=SMALL_FONT_PT, loc="upper right", **look)
    for axes in panels[:, 2]:
        add_colour_bar(axes, drawn, "relative brightness")
    letter_panels(panels.ravel())
    return figure


def _draw_room(axes: Axes, capture: Capture, truth: HiddenTruth) -> None:
    """Top view with the wall at the upper edge: who sees what, and the way of light."""
    middle = capture.wall[capture.wall.shape[0] // 2]
    x, z = middle[:, 0], middle[:, 2]
    behind = z.min() - 0.14
    axes.fill_between(x, z, behind, color=WALL_COLOUR)
    axes.plot(x, z, color=INK_COLOUR, lw=2)
    draw_outline(axes, truth, "xz")
    seen = np.argmin(np.abs(x - WALL_POINT_X_M))
    laser_x, _, laser_z = capture.laser.tolist()
    spot, point = (laser_x, laser_z), (x[seen], z[seen])
    for start, end, colour, style in (
        (DEVICE_POSITION_M, spot, DEVICE_COLOUR, "--"),
        (spot, HIDDEN_POINT_M, OUTGOING_COLOUR, "-"),
        (HIDDEN_POINT_M, point, RETURN_COLOUR, "-"),
        (point, DEVICE_POSITION_M, DEVICE_COLOUR, "--"),
    ):
        arrow = {"arrowstyle": "-|>", "color": colour, "lw": 1.5, "ls": style}
        axes.annotate("", end, start, arrowprops=arrow)
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
    label_axes(axes, "the room from above: a curved wall", "x (m)", "z, away from the wall (m)")


def _draw_streak(axes: Axes, capture: Capture) -> None:
    """What the middle row of the wall shows over the path length."""
    row = capture.signal[:, capture.wall.shape[0] // 2]
    lit = np.flatnonzero(row.max(axis=1) > LIT_THRESHOLD * row.max())
    paths = capture.axis.paths[lit[0] : lit[-1] + 1]
    left, right = outer_edges(capture.wall[0, :, 0])
    first, last = outer_edges(paths)
    shown = row[lit[0] : lit[-1] + 1]
    drawn = draw_image(axes, shown, (left, right, last, first), aspect="auto", vmin=0)
    add_colour_bar(axes, drawn, "photons")
    axes.set_box_aspect(PANEL_ASPECT)
    for place, text in (((-0.78, 1.98), "3"), ((0.72, 2.4), "D")):
        axes.annotate(text, place, color="white", fontsize=SMALL_FONT_PT)
    label_axes(axes, "one row of the wall", "x on the wall (m)", "path spot - hidden - wall (m)")
