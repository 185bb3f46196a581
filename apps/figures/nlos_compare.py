"""Images of one hidden scene by several methods, side by side: front and top view, time, memory,
figures of merit.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from scipy.spatial import cKDTree

from apps.figures.style import (
    LINE_COLOUR,
    add_colour_bar,
    draw_image,
    label_axes,
    make_figure,
    outer_edges,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.image import AxesImage

    from nlos import Volume
    from nlos.known_scenes import HiddenTruth

COLUMN_INCHES = 3.2
TEXT_INCHES = 1.7
# bounds of a panel's height relative to its width, so that flat and deep boxes stay legible
MIN_PANEL_ASPECT, MAX_PANEL_ASPECT = 0.25, 1.6
OUTLINE_PIXELS = 400  # along the longer side of a view, for the outline of what is hidden
POINT_RADIUS_M = 0.03  # m; the circle about a hidden point
# by so much of a facet the stairs of slanting edges are smoothed, as a standard deviation
CORNER_SMOOTHING = 0.5
PlaneAxes = tuple[str, str]  # the axes to the right and downwards


def make_comparison_figure(
    volumes: Mapping[str, Volume],
    figures: Mapping[str, Mapping[str, Any]],
    truth: HiddenTruth | None,
) -> Figure:
    """Draw the brightest voxel along z (upper row) and along y (lower row), a column for each
    method.

    `volumes`: by method, on one grid; each is drawn relative to its own brightest voxel; `figures`:
    what is written below each column: ``seconds``, ``peak_mib``, ``correlation`` and so on;
    `truth`: outlined where it is known.
    """
    grid = next(iter(volumes.values())).grid
    across = float(np.subtract(*outer_edges(grid.x)[::-1]))
    heights = [float(np.subtract(*outer_edges(axis)[::-1])) / across for axis in (grid.y, grid.z)]
    rows = np.clip(heights, MIN_PANEL_ASPECT, MAX_PANEL_ASPECT) * COLUMN_INCHES
    figure = make_figure(COLUMN_INCHES * len(volumes) + 1, float(rows.sum()) + TEXT_INCHES)
    panels = figure.subplots(
        2, len(volumes), squeeze=False, height_ratios=rows.tolist(), sharex=True
    )
    for column, (name, volume) in enumerate(volumes.items()):
        front, top = panels[:, column]
        drawn = draw_view(front, volume, ("x", "y"), truth)
        draw_view(top, volume, ("x", "z"), truth)
        label_axes(
            front,
            f"{name}\n{_format_cost(figures[name])}",
            "",
            "y (m), down" if column == 0 else "",
        )
        label_axes(
            top,
            "",
            f"x (m)\n\n{_format_merit(figures[name])}",
            "z (m), away from the wall" if column == 0 else "",
        )
    add_colour_bar(panels[0, -1], drawn, "relative to each method's brightest")
    return figure


def draw_view(axes: Axes, volume: Volume, plane: PlaneAxes, truth: HiddenTruth | None) -> AxesImage:
    """Draw the brightest voxel along the third axis, and the outline of what is hidden.

    `plane`: names of the axes to the right and downwards. Returns brightness relative to the view's
    largest, 0 to 1.
    """
    along = "zyx".index(next(name for name in "zyx" if name not in plane))
    picture = volume.magnitude.max(axis=along)
    right, down = (getattr(volume.grid, name) for name in plane)
    (left, last), (upper, lower) = outer_edges(right), outer_edges(down)
    brightest = float(picture.max()) or 1.0
    drawn = draw_image(axes, picture / brightest, (left, last, lower, upper), vmin=0, vmax=1)
    if truth is not None:
        draw_outline(axes, truth, plane)
        axes.set(xlim=(left, last), ylim=(lower, upper))
    return drawn


def draw_outline(axes: Axes, truth: HiddenTruth, plane: PlaneAxes) -> None:
    """Draw the border of everything hidden, seen along the third axis.

    `truth`: positions, m; `plane`: names of the axes to the right and downwards.
    """
    places = truth.positions[:, ["xyz".index(name) for name in plane]]
    radius = truth.spacing / 2 if truth.spacing else POINT_RADIUS_M
    low, high = places.min(axis=0) - 3 * radius, places.max(axis=0) + 3 * radius
    step = float((high - low).max()) / OUTLINE_PIXELS
    right, down = (
        np.arange(first, last + step, step) for first, last in zip(low, high, strict=True)
    )
    inside = _rasterise_outline(places, right, down, radius, round_ones=not truth.spacing)
    # corners of facets are rounded off, so that the contour is not a staircase
    smooth = gaussian_filter(inside, truth.spacing * CORNER_SMOOTHING / step)
    axes.contour(right, down, smooth, [0.5], colors=LINE_COLOUR, linewidths=1.0)


def _rasterise_outline(
    places: NDArray[np.float64],
    right: NDArray[np.float64],
    down: NDArray[np.float64],
    radius: float,
    round_ones: bool,
) -> NDArray[np.float64]:
    """Return 1 inside the squares about facets, or the circles about points, and 0 outside."""
    pixels = np.stack(np.meshgrid(right, down), axis=-1)
    norm = 2 if round_ones else np.inf
    # Squares that touch overlap by a hair, or gaps would be drawn between them.
    distance, _ = cKDTree(places).query(pixels, p=norm, distance_upper_bound=radius * 1.05)
    return np.asarray(np.isfinite(distance), np.float64)


def _format_cost(figures: Mapping[str, Any]) -> str:
    memory = "" if figures["peak_mib"] is None else f", {figures['peak_mib']:.0f} MiB"
    return f"{figures['seconds']:.2g} s{memory}"


def _format_merit(figures: Mapping[str, Any]) -> str:
    lines = [f"correlation {figures['correlation']:.3f}", f"sharpness {figures['sharpness']:.1f}"]
    if "energy_near_truth" in figures:
        share, reach = figures["energy_near_truth"], figures["truth_reach_m"]
        lines.append(f"{share:.0%} of the energy within {1000 * reach:.0f} mm of the truth")
        lines.append(f"contrast {figures['contrast_to_truth']:.1f}")
    return "\n".join(lines)
