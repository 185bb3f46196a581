"""An instrument that is to be built, on one page: what its views see, what they leave undetermined, and how
well it will measure, predicted and simulated side by side.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from apps.figures.occlusion import draw_region
from apps.figures.style import (
    LINE_COLOUR,
    SMALL_FONT_PT,
    draw_camera_picture,
    draw_image,
    label_axes,
    make_figure,
)
from tofclip.designs import find_inactive_region, list_footprints
from tofclip.notebook import letter_panels
from tofclip.units import MILLIMETRE

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from tofclip.designs import Accuracy, DesignReport

WIDTH_INCHES, HEIGHT_INCHES = 15.0, 6.6  # of one instrument
PREDICTED_COLOUR, SIMULATED_COLOUR = "#2e6f95", "#e8b04a"


def make_design_figure(reports: Mapping[str, DesignReport]) -> Figure:
    """Draw instruments below each other, by their names."""
    figure = make_figure(WIDTH_INCHES, HEIGHT_INCHES * len(reports))
    parts: Any = figure.subfigures(len(reports), 1, squeeze=False)
    lettered: list[Axes] = []
    for part, (name, report) in zip(parts[:, 0], reports.items(), strict=True):
        part.suptitle(f"{name}: {_describe(report)}", fontsize=SMALL_FONT_PT + 2)
        panels = part.subplots(2, 4)
        _draw_sensor(panels[0, 0], report)
        _draw_singular_values(panels[0, 1], report)
        sight = report.sight
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


def _draw_singular_values(axes: Axes, report: DesignReport) -> None:
    values = report.sight.singular_values
    axes.semilogy(np.maximum(values / values[0], 1e-6), color=PREDICTED_COLOUR)
    axes.axhline(report.sight.least / values[0], color="#999999", ls="--", lw=1)
    axes.set_ylim(1e-4, 1.5)
    label_axes(axes, "singular values (dashed: half kept)", "number", "relative")


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
            _draw_bar(axes, place + shift, one, colour)
        if kinds:
            axes.bar(0, 0, color=colour, label=kind)
    axes.set_xticks(range(len(report.predicted)), list(report.predicted))
    axes.set_ylim(0, 1.25 * axes.get_ylim()[1])
    axes.legend(fontsize=SMALL_FONT_PT, ncols=2, frameon=False)
    label_axes(axes, "picture error; range deviation (mm)", "", "NMSE")


def _draw_bar(axes: Axes, place: float, one: Accuracy, colour: str) -> None:
    axes.bar(place, one.picture_bias, 0.38, color=colour)
    axes.bar(place, one.picture_noise, 0.38, one.picture_bias, color=colour, alpha=0.4)
    said = f"{one.median_deviation / MILLIMETRE:.2g}"
    axes.annotate(said, (place, one.picture_error), fontsize=7, ha="center", va="bottom")
