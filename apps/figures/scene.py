"""A scene after a flash: the picture summed over time, the cloud from two sides, and pictures at
single ranges.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from apps.figures.style import (
    DEPTH_COLOURMAP,
    SMALL_FONT_PT,
    draw_camera_picture,
    label_axes,
    make_figure,
    scale_brightness,
    scatter_points,
    tone_map,
)
from tofclip.notebook import letter_panels

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.figure import Figure

    from tofclip.lidar import PointCloud
    from tofclip.lidar.processing import DetectedObject
    from tofclip.shots import Frames

MIN_BRIGHTNESS = 0.4  # of the colours: dim points stay visible
MAX_RANGE_PANELS = 4
HALF_GATE_BINS = 4
LABEL_DISTANCE = 0.04  # of the axes: numbers closer to another would cover it
UNIT = "counts \N{MULTIPLICATION SIGN} range\N{SUPERSCRIPT TWO} (m\N{SUPERSCRIPT TWO})"


def make_scene_figure(
    frames: Frames, cloud: PointCloud, objects: Sequence[DetectedObject]
) -> Figure:
    """Draw a scene in the manner of the paper's Supplementary Figure 21. `cloud`: of these frames;
    `objects`: numbered in the top view; the four with most points are shown at their ranges.
    """
    figure = make_figure(12, 5.6)
    if frames.time_zero_note:
        figure.suptitle(f"ranges are right{frames.time_zero_note}", fontsize=SMALL_FONT_PT + 2)
    halves: Any = figure.subfigures(2, 1, height_ratios=[1.2, 1])
    upper, lower = halves
    front, above = upper.add_subplot(1, 3, 1), upper.add_subplot(1, 3, 3)
    space = upper.add_subplot(1, 3, 2, projection="3d")
    distance = np.maximum(frames.ranges, 0)
    brightness = frames.values * (distance**2).astype(np.float32)[:, np.newaxis, np.newaxis]
    summed = brightness.sum(axis=0)
    title = f"sum of all frames, {frames.figures.get('method', 'method unknown')}"
    draw_camera_picture(front, summed, title, UNIT, **scale_brightness(summed))
    _draw_cloud(space, cloud)
    numbered = sorted(enumerate(objects, 1), key=lambda pair: -pair[1].points.size)
    _draw_top_view(above, cloud, numbered)
    shown = sorted(numbered[:MAX_RANGE_PANELS], key=lambda pair: pair[1].range)
    panels = [front, space, above]
    for column, (number, one) in enumerate(shown, 1):
        row = int(np.abs(distance - one.range).argmin())
        gate = slice(max(0, row - HALF_GATE_BINS), row + HALF_GATE_BINS + 1)
        focus = f", shear {frames.shears[row]:.2f} px" if frames.shears.any() else ""
        picture = brightness[gate].sum(axis=0)
        look = scale_brightness(picture)
        title = f"object {number}, {one.range:.2f} m{focus}"
        panels.append(lower.add_subplot(1, MAX_RANGE_PANELS, column))
        draw_camera_picture(panels[-1], picture, title, UNIT, **look)
    letter_panels(panels)
    return figure


def _draw_cloud(space: Any, cloud: PointCloud) -> None:
    """The cloud from above and aside; the camera looks along the axis that goes back."""
    from matplotlib.ticker import MaxNLocator

    x, y, z = cloud.xyz.T
    drawn = space.scatter(x, z, -y, c=cloud.range, cmap=DEPTH_COLOURMAP, s=1.5, linewidths=0)
    bar = space.figure.colorbar(drawn, ax=space, shrink=0.7, pad=0.08)
    bar.set_label("range (m)", fontsize=SMALL_FONT_PT)
    bar.ax.tick_params(labelsize=SMALL_FONT_PT)
    for axis, name in ((space.xaxis, "x (m)"), (space.yaxis, "z (m)"), (space.zaxis, "up (m)")):
        axis.set_label_text(name, fontsize=SMALL_FONT_PT)
        axis.set_major_locator(MaxNLocator(4))
    space.view_init(elev=22, azim=-70)
    space.tick_params(labelsize=SMALL_FONT_PT)
    space.set_title("point cloud", fontsize=SMALL_FONT_PT + 2)


def _draw_top_view(
    axes: Any, cloud: PointCloud, numbered: Sequence[tuple[int, DetectedObject]]
) -> None:
    light = MIN_BRIGHTNESS + (1 - MIN_BRIGHTNESS) * tone_map(cloud.intensity)
    scatter_points(axes, cloud.xyz[:, 0], cloud.xyz[:, 2], light)
    size, taken = np.ptp(cloud.xyz[:, ::2], axis=0), list[Any]()
    for number, one in numbered:
        place = np.array([one.centre[0], one.centre[2]])
        if all(np.abs((place - other) / size).max() > LABEL_DISTANCE for other in taken):
            axes.annotate(str(number), place, color="white", fontsize=SMALL_FONT_PT)
            taken.append(place)
    label_axes(axes, "objects from above", "x (m)", "z, away from the camera (m)")
