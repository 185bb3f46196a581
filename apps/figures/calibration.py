"""Fitted lines and slit centres over the focus-mode pictures that they were fitted to; what a target at
known distances said: range walk, offsets and response of the pixels.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from apps.figures.style import (
    LINE_COLOUR,
    SMALL_FONT_PT,
    add_panels,
    draw_image,
    draw_spread_picture,
    label_axes,
    make_figure,
)
from tofclip.notebook import letter_panels
from tofclip.units import MILLIMETRE, NANOSECOND, PICOSECOND

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from tofclip.camera.focus_pictures import FocusCalibration
    from tofclip.lidar.range_calibration import RangeFit


ZOOM_HALF_WIDTH_PX = 20
MARGIN_ROWS = 25
WIDTH_INCHES, HEIGHT_INCHES, WHOLE_INCHES = 11, 8, 4.8
ZOOM_ROOM_INCHES = (0.5, 0.1, 0.4, 0.3)
WHITE_PERCENTILE = 99.8  # percent: a glint does not darken the rest


def make_calibration_figure(found: FocusCalibration) -> Figure:
    """Draw both pictures whole with the fits, and a zoom into every view's slit centre."""
    views = found.centres_px.size
    figure = make_figure(WIDTH_INCHES, HEIGHT_INCHES)
    upper, lower = add_panels(figure, 2, 1, (0, WHOLE_INCHES))[:, 0]
    lower.sharex(upper)
    _draw_picture(upper, found, found.signal, "slit open: the lines and their fitted angles")
    _draw_picture(lower, found, found.dots, "slit closed: where the lines cross the slit")
    panels = add_panels(figure, 2, views, (WHOLE_INCHES, HEIGHT_INCHES), ZOOM_ROOM_INCHES)
    for view in range(views):
        _draw_line_zoom(panels[0, view], found, view)
        _draw_dot_profile(panels[1, view], found, view)
    panels[0, 0].set_ylabel("row (px)", fontsize=SMALL_FONT_PT)
    panels[1, 0].set_ylabel("1000 counts", fontsize=SMALL_FONT_PT)
    letter_panels([upper, lower])
    return figure


def _draw_picture(axes: Axes, found: FocusCalibration, picture: NDArray[Any], title: str) -> None:
    first = max(0, int(found.line_rows_px.min()) - MARGIN_ROWS)
    last = min(picture.shape[0], int(found.line_rows_px.max()) + MARGIN_ROWS + 1)
    # The square root shows faint lines beside bright ones.
    shown = np.sqrt(np.maximum(picture[first:last], 0))
    extent = (-0.5, picture.shape[1] - 0.5, last - 0.5, first - 0.5)
    draw_image(axes, shown, extent, aspect="auto", vmax=np.percentile(shown, WHITE_PERCENTILE))
    for view, angle in enumerate(np.rad2deg(found.angles)):
        _draw_line(axes, found, view)
        row = found.dot_rows_px[view]
        axes.plot(found.centres_px[view], row, "+", color="white", markersize=9, markeredgewidth=1)
        look: Any = {"color": "white", "ha": "center", "va": "top", "fontsize": SMALL_FONT_PT}
        above = (found.centres_px[view], first + 2)
        axes.annotate(f"{angle:.1f}\N{DEGREE SIGN}", above, **look)
    label_axes(axes, title, "slit column (px)", "row (px)")


def _draw_line(axes: Axes, found: FocusCalibration, view: int) -> None:
    rows = found.line_rows_px[view]
    columns = found.line_columns_px[view] + (rows - found.dot_rows_px[view]) * np.tan(
        found.angles[view]
    )
    axes.plot(columns, rows, color=LINE_COLOUR, linewidth=0.8)


def _draw_line_zoom(axes: Axes, found: FocusCalibration, view: int) -> None:
    """The line around the slit, with its fit and the centre found in the dot picture."""
    column, row = round(found.centres_px[view]), round(found.dot_rows_px[view])
    window, extent = _cut_window(found.signal, row, column)
    draw_image(axes, window, extent, aspect="equal")
    _draw_line(axes, found, view)
    cross: Any = {"color": "white", "markersize": 12, "markeredgewidth": 1}
    axes.plot(found.centres_px[view], found.dot_rows_px[view], "+", **cross)
    axes.set_xlim(extent[:2])
    axes.set_ylim(extent[2:])
    label_axes(axes, f"view {view}", "", "")


def _draw_dot_profile(axes: Axes, found: FocusCalibration, view: int) -> None:
    """The dot's profile along the slit, with the fitted centre and its uncertainty."""
    centre, error = found.centres_px[view], found.centre_uncertainty_px[view]
    window, extent = _cut_window(found.dots, round(found.dot_rows_px[view]), round(centre))
    columns = np.arange(window.shape[1]) + extent[0] + 0.5
    thousands = window.sum(axis=0) / 1000
    axes.plot(columns, thousands, color="#444444", linewidth=1, drawstyle="steps-mid")
    axes.axvspan(centre - error, centre + error, color=LINE_COLOUR, alpha=0.4, linewidth=0)
    axes.axvline(centre, color=LINE_COLOUR, linewidth=1)
    label_axes(axes, f"{centre:.2f} \N{PLUS-MINUS SIGN} {error:.2f}", "column (px)", "")


def _cut_window(
    picture: NDArray[Any], row: int, column: int
) -> tuple[NDArray[Any], tuple[float, float, float, float]]:
    """Cut out the surroundings of a pixel, and say where their outer edges lie."""
    top, left = max(0, row - ZOOM_HALF_WIDTH_PX), max(0, column - ZOOM_HALF_WIDTH_PX)
    window = picture[top : row + ZOOM_HALF_WIDTH_PX + 1, left : column + ZOOM_HALF_WIDTH_PX + 1]
    height, width = window.shape
    return window, (left - 0.5, left + width - 0.5, top + height - 0.5, top - 0.5)


MAX_DRAWN_POINTS = 20_000
MIN_SPAN_SIGMA = 6  # of the colours of offsets, or noise would look like a pattern


def make_range_calibration_figure(found: RangeFit, distances: Sequence[float]) -> Figure:
    """Draw the fitted walk over what was measured, and the pictures of the pixels' own numbers."""
    known = found.calibration
    noise = float(np.nanmedian(known.offset_sigma)) / MILLIMETRE if known.offset_sigma.size else 0.0
    pictures: list[tuple[NDArray[Any], str, str, dict[str, Any]]] = [
        (known.offsets / MILLIMETRE, "offset", "mm", {"least_span": MIN_SPAN_SIGMA * noise}),
        (known.offset_sigma / MILLIMETRE, "its standard deviation", "mm", {"vmin": 0}),
        (known.response, "response", "relative to the mean", {"vmin": 0}),
    ]
    drawn = [one for one in pictures if one[0].size]
    figure = make_figure(max(4.4, 3.4 * (1 + len(drawn))), 3.2)
    panels = np.atleast_1d(figure.subplots(1, 1 + len(drawn)))
    walk = panels[0]
    some = slice(None, None, -(-found.signal.size // MAX_DRAWN_POINTS))
    walk.plot(
        found.signal[some], found.excess[some] / MILLIMETRE, ".", color="#999999", markersize=2
    )
    weakest, strongest = known.signal_range
    signal = np.geomspace(weakest, strongest, 100)
    fitted, sigma = (part / MILLIMETRE for part in known.compute_walk(signal))
    walk.fill_between(signal, fitted - sigma, fitted + sigma, color=LINE_COLOUR, alpha=0.3)
    walk.plot(signal, fitted, color=LINE_COLOUR)
    walk.set_xscale("log")
    walk.minorticks_off()
    # There may be no two powers of ten to number.
    ticks = [float(f"{tick:.3g}") for tick in np.geomspace(weakest, strongest, 4)]
    walk.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    zero, spread = found.camera.time_zero / NANOSECOND, known.time_zero_sigma / PICOSECOND
    targets = ", ".join(f"{distance:g}" for distance in distances)
    figure.suptitle(
        f"target at {targets} m: time zero {zero:.3f} ns \N{PLUS-MINUS SIGN} {spread:.2g} ps",
        fontsize=SMALL_FONT_PT + 2,
    )
    title = "residuals" if found.walk_note else "range walk"
    label_axes(walk, title, "counts of a return", "measured too long (mm)")
    for panel, (picture, title, meaning, look) in zip(panels[1:], drawn, strict=True):
        draw_spread_picture(panel, picture, title, meaning, **look)
    letter_panels(panels if drawn else ())
    return figure
