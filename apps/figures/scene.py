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
    scatter_points,
    tone_map,
)
from tofclip.units import SPEED_OF_LIGHT

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.figure import Figure

    from tofclip.lidar import PointCloud
    from tofclip.lidar.processing import DetectedObject
    from tofclip.shots import Frames

MIN_BRIGHTNESS = 0.4  # of the colours: dim points stay visible
MAX_RANGE_PANELS = 4
HALF_GATE_BINS = 4


def make_scene_figure(
    frames: Frames, cloud: PointCloud, objects: Sequence[DetectedObject]
) -> Figure:
    """Draw a scene in the manner of the paper's Supplementary Figure 21. `cloud`: of these frames;
    `objects`: numbered in the top view; the four with most points are shown at their ranges.
    """
    figure = make_figure(13, 7.5)
    if frames.time_zero_note:
        figure.suptitle(f"ranges are right{frames.time_zero_note}", fontsize=SMALL_FONT_PT + 2)
    axes = figure.subplots(2, 4)
    for panel in axes[0, 1:3]:
        panel.remove()
    distance = np.maximum(frames.times, 0) * SPEED_OF_LIGHT / 2
    brightness = frames.values * (distance**2).astype(np.float32)[:, np.newaxis, np.newaxis]
    summed = tone_map(brightness.sum(axis=0))
    draw_camera_picture(axes[0, 0], summed, "summed over time, times range squared")
    _draw_cloud(figure, cloud)
    _draw_top_view(axes[0, 3], cloud, objects)
    largest = sorted(objects, key=lambda one: -one.points.size)[:MAX_RANGE_PANELS]
    shown = sorted(largest, key=lambda one: one.range)
    for panel in axes[1, len(shown) :]:
        panel.set_axis_off()
    for panel, one in zip(axes[1], shown, strict=False):
        row = int(np.abs(distance - one.range).argmin())
        gate = slice(max(0, row - HALF_GATE_BINS), row + HALF_GATE_BINS + 1)
        title = f"{one.range:.2f} m, shear {frames.shears[row]:.2f} px"
        draw_camera_picture(panel, tone_map(brightness[gate].sum(axis=0)), title)
    return figure


def _draw_cloud(figure: Figure, cloud: PointCloud) -> None:
    """The cloud from above and aside; the camera looks along the axis that goes back."""
    space: Any = figure.add_subplot(2, 4, (2, 3), projection="3d")
    x, y, z = cloud.xyz.T
    space.scatter(x, z, -y, c=cloud.range, cmap=DEPTH_COLOURMAP, s=1.5, linewidths=0)
    for axis, name in ((space.xaxis, "x (m)"), (space.yaxis, "z (m)"), (space.zaxis, "up (m)")):
        axis.set_label_text(name, fontsize=SMALL_FONT_PT)
    space.view_init(elev=22, azim=-70)
    space.tick_params(labelsize=SMALL_FONT_PT)
    space.set_title("point cloud", fontsize=SMALL_FONT_PT + 2)


def _draw_top_view(axes: Any, cloud: PointCloud, objects: Sequence[DetectedObject]) -> None:
    light = MIN_BRIGHTNESS + (1 - MIN_BRIGHTNESS) * tone_map(cloud.intensity)
    scatter_points(axes, cloud.xyz[:, 0], cloud.xyz[:, 2], light)
    for number, one in enumerate(objects, 1):
        axes.annotate(
            str(number), (one.centre[0], one.centre[2]), color="white", fontsize=SMALL_FONT_PT
        )
    label_axes(axes, "top view", "x (m)", "z, away from the camera (m)")
