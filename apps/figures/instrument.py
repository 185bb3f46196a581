"""Fitted lines and slit centres over the focus-mode pictures that they were fitted to; what a target at
known distances said: range walk, offsets and response of the pixels; and an instrument that is to be
built: what its views see, what they leave undetermined, and how well it will measure.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from apps.figures.occlusion import draw_region
from apps.figures.style import (
    LINE_COLOUR,
    SMALL_FONT_PT,
    add_panels,
    draw_camera_picture,
    draw_image,
    draw_spread_picture,
    label_axes,
    make_figure,
)
from tofclip.arrays import AnyArray
from tofclip.camera.focus_pictures import FocusCalibration
from tofclip.designs import DesignReport, find_inactive_region, list_footprints
from tofclip.lidar.range_calibration import RangeFit
from tofclip.notebook import letter_panels
from tofclip.units import MILLIMETRE, NANOSECOND, PICOSECOND

ZOOM_HALF_WIDTH_PX = 20
MARGIN_ROWS = 25
CALIBRATION_INCHES, WHOLE_INCHES = (11, 8), 4.8
ZOOM_ROOM_INCHES = (0.5, 0.1, 0.4, 0.3)
WHITE_PERCENTILE = 99.8  # percent: a glint does not darken the rest


def make_calibration_figure(found: FocusCalibration) -> Figure:
    """Draw both pictures whole with the fits, and a zoom into every view's slit centre."""
    views = found.centres_px.size
    figure = make_figure(*CALIBRATION_INCHES)
    upper, lower = add_panels(figure, 2, 1, (0, WHOLE_INCHES))[:, 0]
    lower.sharex(upper)
    _draw_picture(upper, found, found.signal, "slit open: the lines and their fitted angles")
    _draw_picture(lower, found, found.dots, "slit closed: where the lines cross the slit")
    panels = add_panels(figure, 2, views, (WHOLE_INCHES, CALIBRATION_INCHES[1]), ZOOM_ROOM_INCHES)
    for view in range(views):
        _draw_line_zoom(panels[0, view], found, view)
        _draw_dot_profile(panels[1, view], found, view)
    panels[0, 0].set_ylabel("row (px)", fontsize=SMALL_FONT_PT)
    panels[1, 0].set_ylabel("1000 counts", fontsize=SMALL_FONT_PT)
    letter_panels([upper, lower])
    return figure


def _draw_picture(axes: Axes, found: FocusCalibration, picture: AnyArray, title: str) -> None:
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
    picture: AnyArray, row: int, column: int
) -> tuple[AnyArray, tuple[float, float, float, float]]:
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
    noise = np.nanmedian(known.offset_sigma) / MILLIMETRE if known.offset_sigma.size else 0.0
    pictures: list[tuple[AnyArray, str, str, dict[str, Any]]] = [
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
    zero = round(found.camera.time_zero / NANOSECOND, 3) + 0.0  # never "-0.000"
    spread = known.time_zero_sigma / PICOSECOND
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


DESIGN_INCHES = 15.0, 6.6  # of one instrument
PREDICTED_COLOUR, SIMULATED_COLOUR = "#2e6f95", "#e8b04a"


def make_design_figure(reports: Mapping[str, DesignReport]) -> Figure:
    """Draw instruments below each other, by their names."""
    figure = make_figure(DESIGN_INCHES[0], DESIGN_INCHES[1] * len(reports))
    parts = figure.subfigures(len(reports), 1, squeeze=False)
    lettered: list[Axes] = []
    for part, (name, report) in zip(parts[:, 0], reports.items(), strict=True):
        part.suptitle(f"{name}: {_describe(report)}", fontsize=SMALL_FONT_PT + 2)
        panels = part.subplots(2, 4)
        _draw_sensor(panels[0, 0], report)
        sight = report.sight
        values = sight.singular_values / sight.singular_values[0]
        panels[0, 1].semilogy(np.maximum(values, 1e-6), color=PREDICTED_COLOUR)
        kept = sight.least / sight.singular_values[0]
        panels[0, 1].axhline(kept, color="#999999", ls="--", lw=1)
        panels[0, 1].set_ylim(1e-4, 1.5)
        label_axes(panels[0, 1], "singular values (dashed: half kept)", "number", "relative")
        title = f"waves undetermined ({100 * sight.undetermined:.1f} %)"
        edges = (-0.5, 0.5, 0.5, -0.5)
        drawn = draw_image(panels[0, 2], sight.by_frequency, edges, vmin=0, vmax=1, cmap="magma")
        part.colorbar(drawn, ax=panels[0, 2])
        label_axes(panels[0, 2], title, "across (cycles/px)", "down (cycles/px)")
        # the points' own peaks would leave their rays in the dark
        most = 0.4 * sight.points.max()
        look: Any = {"vmin": -most, "vmax": most, "cmap": "RdBu_r"}
        draw_camera_picture(panels[0, 3], sight.points, "four points, recovered", **look)
        _draw_field(panels[1, 0], report)
        _draw_ranges(part, panels[1, 1:3], report)
        _draw_accuracy(panels[1, 3], report)
        lettered += panels.flat
    letter_panels(lettered)
    return figure


def _describe(report: DesignReport) -> str:
    known, figures = report.design, report.figures
    down, across = figures["field_of_view_deg"]
    seconds = [one.seconds for one in report.simulated.values()]
    return (
        f"{known.sensor}, {known.views} views, {figures['readings']} readings "
        f"of {known.rows_px} x {known.columns_px} px, "
        f"field {across:.1f} x {down:.1f}\N{DEGREE SIGN}, {known.photons:g} photons, "
        f"refocus from {figures.get('refocus_nearest_m', 0):.2g} m, {figures['refocus_planes']:.1f} planes told apart, "
        f"{figures['bytes_per_second'] / 1e6:.3g} MB/s"
        + (f", {np.median(seconds):.2g} s a shot here" if seconds else "")
    )


def _draw_sensor(axes: Axes, report: DesignReport) -> None:
    """What each view puts on the slit; of codes the first."""
    known = report.design
    if known.encoder is not None:
        code = known.matrix(0.0)[0].reshape(known.camera.image_shape)
        draw_camera_picture(axes, code, "what one reading sees")
        return
    angles = np.degrees(known.camera.angles)
    for light, angle, centre in zip(
        list_footprints(known), angles, known.camera.centres_px, strict=True
    ):
        axes.fill_between(np.arange(light.size), light, alpha=0.45, lw=0)
        axes.annotate(f"{angle:.0f}\N{DEGREE SIGN}", (centre, 0), fontsize=7, ha="center")
    axes.set_xlim(0, known.camera.slit_width_px)
    shared = 100 * report.figures["sensor_overlap"]
    label_axes(axes, f"views on the sensor, {shared:.0f} % shared", "column (px)", "picture px")


def _draw_field(axes: Axes, report: DesignReport) -> None:
    """The inactive region, or what all views have in common at each distance."""
    known = report.design
    if "inactive_m" in report.figures:
        draw_region(axes, find_inactive_region(known))
        axes.set_title(axes.get_title(), fontsize=SMALL_FONT_PT - 1)
        return
    distance = np.geomspace(known.near_m / 4, 2 * known.far_m, 200)
    camera = known.camera
    moved = np.abs(camera.shear_at(distance)) * np.ptp(camera.view_positions)
    axes.plot(distance, np.maximum(0, 1 - moved / known.columns_px), color=PREDICTED_COLOUR)
    axes.axvspan(known.near_m, known.far_m, color=LINE_COLOUR, alpha=0.2, lw=0)
    axes.set(xlim=distance[[0, -1]], ylim=(0, 1.02))
    title = "field common to all views"
    label_axes(axes, title, "distance (m)", "share of the width")


def _draw_ranges(figure: Any, panels: Any, report: DesignReport) -> None:
    name = next(iter(report.predicted))
    kinds = {"predicted": report.predicted[name]}
    if report.simulated:
        kinds["simulated"] = report.simulated[name]
    maps = {f"range deviation, {kind}": one.range_deviation for kind, one in kinds.items()}
    maps |= {} if report.simulated else {"range offset, predicted": kinds["predicted"].range_offset}
    top = np.nanpercentile(kinds["predicted"].range_deviation, 95) / MILLIMETRE
    for axes, (title, values) in zip(panels, maps.items(), strict=True):
        limits: Any = {"vmin": 0, "vmax": top, "cmap": "viridis"} if "offset" not in title else {}
        rows, columns = np.nonzero(np.isfinite(values))
        light = values[rows, columns] / MILLIMETRE
        drawn = axes.scatter(columns, rows, c=light, s=6, marker="s", linewidths=0, **limits)
        figure.colorbar(drawn, ax=axes, label="mm")
        shape = report.design.camera.image_shape
        axes.set(xlim=(0, shape[1]), ylim=(shape[0], 0), aspect="equal")
        label_axes(axes, f"{title}, {name}", "x (px)", "y (px), down")


def _draw_accuracy(axes: Axes, report: DesignReport) -> None:
    """Errors of pictures, bias below and noise pale on top, with range deviations above the bars."""
    for shift, kinds, colour, kind in (
        (-0.2, report.predicted, PREDICTED_COLOUR, "predicted"),
        (0.2, report.simulated, SIMULATED_COLOUR, "simulated"),
    ):
        for place, one in enumerate(kinds.values()):
            left = place + shift
            axes.bar(left, one.picture_bias, 0.38, color=colour)
            axes.bar(left, one.picture_noise, 0.38, one.picture_bias, color=colour, alpha=0.4)
            said = f"{one.median_deviation / MILLIMETRE:.2g}"
            above: Any = {"fontsize": 7, "ha": "center", "va": "bottom"}
            axes.annotate(said, (left, one.picture_error), **above)
        if kinds:
            axes.bar(0, 0, color=colour, label=kind)
    axes.set_xticks(range(len(report.predicted)), list(report.predicted))
    axes.set_ylim(0, 1.25 * axes.get_ylim()[1])
    axes.legend(fontsize=SMALL_FONT_PT, ncols=2, frameon=False)
    label_axes(axes, "picture error; range deviation (mm)", "", "NMSE")
