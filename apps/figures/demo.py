"""The demonstration in one picture: what was measured, what came out of it, and how far that is
from the truth.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from apps.figures.style import (
    BRIGHTNESS_COLOURMAP,
    DEPTH_COLOURMAP,
    EMPTY_COLOUR,
    add_colour_bar,
    draw_image,
    label_axes,
    make_figure,
    outer_edges,
)
from tofclip.units import MILLIMETRE, NANOSECOND, SPEED_OF_LIGHT

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from tofclip.lidar import PointCloud, Returns
    from tofclip.shots import Frames, Streak
    from tofclip.simulate import GroundTruth

WHITE_PERCENTILE = 99.5  # percent: a glint does not darken the rest
HISTOGRAM_BINS = 61


def make_demo_figure(
    streak: Streak,
    frames: Frames,
    returns: Returns,
    cloud: PointCloud,
    truth: GroundTruth,
    compared: Frames,
) -> Figure:
    """Draw streak image, brightness and range as seen by the camera; top and side view in metres;
    range errors.

    `truth`: of the simulated scene, for the range errors; `compared`: of the same shot, each frame
    recovered alone.
    """
    figure = make_figure(15.5, 7.6)
    panels = figure.subplots(2, 4)
    _draw_streak(panels[0, 0], streak)
    _draw_brightness(panels[0, 1], frames, "surfaces")
    _draw_brightness(panels[0, 2], compared, "tv")
    _draw_range(panels[0, 3], returns)
    _draw_truth(panels[1, 3], truth)
    limits = _normalise_brightness(cloud.intensity)
    _scatter_points(panels[1, 0], cloud.xyz[:, 0], cloud.xyz[:, 2], limits)
    label_axes(panels[1, 0], "top view of the cloud", "x (m)", "z, away from the camera (m)")
    _scatter_points(panels[1, 1], cloud.xyz[:, 2], cloud.xyz[:, 1], limits)
    # y points down in a cloud, as in a picture.
    panels[1, 1].invert_yaxis()
    label_axes(panels[1, 1], "side view of the cloud", "z, away from the camera (m)", "y, down (m)")
    _draw_errors(panels[1, 2], returns, truth)
    return figure


def _normalise_brightness(values: Any) -> Any:
    """Scale intensities to 0..1 with some light left for the dim ones."""
    top = np.percentile(values, WHITE_PERCENTILE) if values.size else 1.0
    return np.sqrt(np.clip(values / top, 0, 1))


def _draw_streak(axes: Axes, streak: Streak) -> None:
    first, last = outer_edges(streak.times / NANOSECOND)
    extent = (-0.5, streak.counts.shape[1] - 0.5, last, first)
    drawn = draw_image(
        axes,
        streak.counts,
        extent,
        aspect="auto",
        vmin=0,
        vmax=np.percentile(streak.counts, WHITE_PERCENTILE),
    )
    label_axes(axes, "streak image: one shot, seven views", "slit column (px)", "time axis (ns)")
    add_colour_bar(axes, drawn, "photons")


def _draw_brightness(axes: Axes, frames: Frames, name: str) -> None:
    ranges = np.maximum(frames.times, 0) * SPEED_OF_LIGHT / 2
    picture = np.tensordot((ranges**2).astype(np.float32), frames.values, axes=1)
    drawn = draw_image(axes, picture, vmin=0, vmax=np.percentile(picture, WHITE_PERCENTILE))
    label_axes(
        axes,
        f"{name}: brightness \N{MULTIPLICATION SIGN} range\N{SUPERSCRIPT TWO}",
        "x (px)",
        "y (px), down",
    )
    add_colour_bar(axes, drawn, "photons at 1 m")


def _draw_truth(axes: Axes, truth: GroundTruth) -> None:
    drawn = draw_image(axes, truth.reflectance, vmin=0)
    label_axes(axes, "true reflectance", "x (px)", "y (px), down")
    add_colour_bar(axes, drawn, "of the light that falls on it")


def _draw_range(axes: Axes, returns: Returns) -> None:
    drawn = draw_image(axes, returns.image("range"), cmap=DEPTH_COLOURMAP)
    label_axes(axes, "range of the strongest return", "x (px)", "y (px), down")
    add_colour_bar(axes, drawn, "range (m)")


def _scatter_points(axes: Axes, right: Any, up: Any, brightness: Any) -> None:
    axes.set_facecolor(EMPTY_COLOUR)
    axes.scatter(
        right, up, c=brightness, cmap=BRIGHTNESS_COLOURMAP, vmin=0, vmax=1, s=1.2, linewidths=0
    )


def _draw_errors(axes: Axes, returns: Returns, truth: GroundTruth) -> None:
    error = (returns.image("range") - truth.range)[truth.target] / MILLIMETRE
    error = error[np.isfinite(error)]
    bin_mm = SPEED_OF_LIGHT * truth.bin_width / 2 / MILLIMETRE
    edges = np.linspace(-2 * bin_mm, 2 * bin_mm, HISTOGRAM_BINS).tolist()
    axes.hist(np.clip(error, edges[0], edges[-1]), edges, color="#4c72b0")
    for edge in (-bin_mm, bin_mm):
        axes.axvline(edge, color="black", linewidth=0.8, linestyle=":")
    median = float(np.median(np.abs(error)))
    label_axes(
        axes,
        f"range error: median {median:.2f} mm, one bin = {bin_mm:.2f} mm",
        "range error (mm), larger ones at the ends",
        "target pixels",
    )
