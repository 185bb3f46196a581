"""Images of one hidden scene by several methods, side by side: front and top view, time, memory, figures of merit."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from apps.figures.style import LINE, colour_bar, draw, label, outer_edges, page

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.image import AxesImage

    from apps.nlos.truth import HiddenTruth
    from nlos import Volume

COLUMN_INCHES = 3.2
TEXT_INCHES = 1.7
FLATTEST, DEEPEST = 0.25, 1.6
"""Bounds of a panel's height relative to its width, so that flat and deep boxes stay legible."""

OUTLINE_PIXELS = 400
"""Along the longer side of a view, for the outline of what is hidden."""

POINT_RADIUS = 0.03
"""m; the circle about a hidden point."""

CORNER = 0.5
"""By so much of a facet the stairs of slanting edges are smoothed, as a standard deviation."""

Plane = tuple[str, str]
"""The axes to the right and downwards."""


def compare_figure(
    volumes: Mapping[str, Volume], figures: Mapping[str, Mapping[str, Any]], truth: HiddenTruth | None
) -> Figure:
    """Draw the brightest voxel along z (upper row) and along y (lower row), a column for each method.

    Parameters
    ----------
    volumes : mapping
        By method, on one grid; each is drawn relative to its own brightest voxel.
    figures : mapping
        What is written below each column: ``seconds``, ``peak_mib``, ``correlation`` and so on.
    truth : HiddenTruth or None
        Outlined where it is known.
    """
    grid = next(iter(volumes.values())).grid
    across = float(np.subtract(*outer_edges(grid.x)[::-1]))
    heights = [float(np.subtract(*outer_edges(axis)[::-1])) / across for axis in (grid.y, grid.z)]
    rows = np.clip(heights, FLATTEST, DEEPEST) * COLUMN_INCHES
    figure = page(COLUMN_INCHES * len(volumes) + 1, float(rows.sum()) + TEXT_INCHES)
    panels = figure.subplots(2, len(volumes), squeeze=False, height_ratios=rows.tolist(), sharex=True)
    for column, (name, volume) in enumerate(volumes.items()):
        front, top = panels[:, column]
        drawn = draw_view(front, volume, ("x", "y"), truth)
        draw_view(top, volume, ("x", "z"), truth)
        label(front, f"{name}\n{_cost(figures[name])}", "", "y (m), down" if column == 0 else "")
        label(top, "", f"x (m)\n\n{_merit(figures[name])}", "z (m), away from the wall" if column == 0 else "")
    colour_bar(panels[0, -1], drawn, "relative to each method's brightest")
    return figure


def draw_view(axes: Axes, volume: Volume, plane: Plane, truth: HiddenTruth | None) -> AxesImage:
    """Draw the brightest voxel along the third axis, and the outline of what is hidden."""
    along = "zyx".index(next(name for name in "zyx" if name not in plane))
    picture = volume.magnitude.max(axis=along)
    right, down = (getattr(volume.grid, name) for name in plane)
    (left, last), (upper, lower) = outer_edges(right), outer_edges(down)
    brightest = float(picture.max()) or 1.0
    drawn = draw(axes, picture / brightest, (left, last, lower, upper), vmin=0, vmax=1)
    if truth is not None:
        draw_outline(axes, truth, plane)
        axes.set(xlim=(left, last), ylim=(lower, upper))
    return drawn


def draw_outline(axes: Axes, truth: HiddenTruth, plane: Plane) -> None:
    """Draw the border of everything hidden, seen along the third axis."""
    from scipy.ndimage import gaussian_filter

    places = truth.positions[:, ["xyz".index(name) for name in plane]]
    radius = truth.spacing / 2 if truth.spacing else POINT_RADIUS
    low, high = places.min(axis=0) - 3 * radius, places.max(axis=0) + 3 * radius
    step = float((high - low).max()) / OUTLINE_PIXELS
    right, down = (np.arange(first, last + step, step) for first, last in zip(low, high, strict=True))
    inside = _inside(places, right, down, radius, round_ones=not truth.spacing)
    smooth = gaussian_filter(inside, truth.spacing * CORNER / step)
    axes.contour(right, down, smooth, [0.5], colors=LINE, linewidths=1.0)


def _inside(
    places: NDArray[np.float64],
    right: NDArray[np.float64],
    down: NDArray[np.float64],
    radius: float,
    round_ones: bool,
) -> NDArray[np.float64]:
    """Return 1 inside the squares about facets, or the circles about points, and 0 outside."""
    from scipy.spatial import cKDTree

    pixels = np.stack(np.meshgrid(right, down), axis=-1)
    norm = 2 if round_ones else np.inf
    # Squares that touch overlap by a hair, or gaps would be drawn between them.
    distance, _ = cKDTree(places).query(pixels, p=norm, distance_upper_bound=radius * 1.05)
    return np.asarray(np.isfinite(distance), np.float64)


def _cost(figures: Mapping[str, Any]) -> str:
    memory = "" if figures["peak_mib"] is None else f", {figures['peak_mib']:.0f} MiB"
    return f"{figures['seconds']:.2g} s{memory}"


def _merit(figures: Mapping[str, Any]) -> str:
    lines = [f"correlation {figures['correlation']:.3f}", f"sharpness {figures['sharpness']:.1f}"]
    if "energy_near_truth" in figures:
        share, reach = figures["energy_near_truth"], figures["truth_reach_m"]
        lines.append(f"{share:.0%} of the energy within {1000 * reach:.0f} mm of the truth")
        lines.append(f"contrast {figures['contrast_to_truth']:.1f}")
    return "\n".join(lines)
