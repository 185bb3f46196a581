"""The inactive region behind an occluder, drawn to scale: how many views see each place."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from apps.figures.style import (
    EMPTY_COLOUR,
    LINE_COLOUR,
    add_colour_bar,
    draw_image,
    label_axes,
    make_figure,
)
from tofclip.units import MILLIMETRE

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from tofclip.occlusion import InactiveRegion

VIEW_COUNT = 7
DRAWN_LENGTH_FACTOR = 2.2  # of the region, behind the occluder
ENDLESS_DEPTH_FACTOR = 3.0  # drawn behind an occluder whose region has no end
GRID_SHAPE = (240, 480)
OCCLUDER_COLOUR = "#e8b04a"
TEXT_BOX = {"facecolor": EMPTY_COLOUR, "edgecolor": "none", "pad": 1.5}


def make_region_figure(region: InactiveRegion) -> Figure:
    """Draw views, occluder and the region from above, in millimetres."""
    figure = make_figure(9.6, 4.2)
    draw_region(figure.subplots(), region)
    return figure


def draw_region(axes: Axes, region: InactiveRegion, least_reach: float = 0.0) -> None:
    """Draw the region from above with seven views; z to the right, x upwards.

    `least_reach`: draw at least so far behind the occluder, m.
    """
    places = np.linspace(-0.5, 0.5, VIEW_COUNT) * region.baseline
    usual = (
        DRAWN_LENGTH_FACTOR * region.length
        if region.is_bounded
        else ENDLESS_DEPTH_FACTOR * region.distance
    )
    reach = max(usual, least_reach)
    half = 0.62 * max(region.baseline, region.width)
    x = np.linspace(-half, half, GRID_SHAPE[0])[:, np.newaxis, np.newaxis]
    behind = np.linspace(0, reach, GRID_SHAPE[1])[:, np.newaxis]
    share = region.sees(places, x, behind).mean(axis=-1)
    edges = np.array([region.distance, region.distance + reach, -half, half]) / MILLIMETRE
    left, right, low, high = edges.tolist()
    mapped = draw_image(
        axes, share[::-1], (left, right, low, high), cmap="bone", vmin=0, vmax=1, aspect="auto"
    )
    add_colour_bar(axes, mapped, "share of the views that see the place")
    _draw_lines(axes, region, reach)
    axes.plot(
        np.zeros(len(places)), places / MILLIMETRE, "s", color=LINE_COLOUR, ms=7, clip_on=False
    )
    axes.plot(
        [left, left], np.array([-0.5, 0.5]) * region.width / MILLIMETRE, color=OCCLUDER_COLOUR, lw=6
    )
    axes.set_xlim(-0.03 * right, right)
    axes.set_facecolor(EMPTY_COLOUR)
    label_axes(
        axes, _format_title(region), "z, away from the views (mm)", "x, along the baseline (mm)"
    )


def _draw_lines(axes: Axes, region: InactiveRegion, reach: float) -> None:
    """Lines of sight from both ends past the occluder's nearer edge, and the region's length."""
    far = region.distance + reach
    for side in (-1, 1):
        slope = side * (region.width - region.baseline) / 2 / region.distance
        z = np.array([0, far])
        x = side * region.baseline / 2 + slope * z
        axes.plot(z / MILLIMETRE, x / MILLIMETRE, color=LINE_COLOUR, lw=1, ls="--")
    if region.is_bounded:
        start, stop = region.distance / MILLIMETRE, (region.distance + region.length) / MILLIMETRE
        axes.annotate(
            "", (stop, 0), (start, 0), arrowprops={"arrowstyle": "<->", "color": OCCLUDER_COLOUR}
        )
        said = f"l = {region.length / MILLIMETRE:.1f} mm, hidden"
        axes.annotate(
            said,
            (start, 0),
            (8, 7),
            textcoords="offset points",
            color=OCCLUDER_COLOUR,
            bbox=TEXT_BOX,
        )


def _format_title(region: InactiveRegion) -> str:
    sizes = f"L = {region.baseline / MILLIMETRE:g} mm, D = {region.width / MILLIMETRE:.3g} mm, "
    sizes += f"d = {region.distance / MILLIMETRE:g} mm"
    if not region.is_bounded:
        return f"{sizes}: D \N{GREATER-THAN OR EQUAL TO} L, nothing behind the occluder is promised to be seen"
    return f"{sizes}: l = d D / (L \N{MINUS SIGN} D) = {region.length / MILLIMETRE:.1f} mm"
