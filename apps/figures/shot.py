"""A shot and its recovered frames at a glance; the demonstration in one picture: what was measured, what
came out of it, and how far that is from the truth; the range image that counted photons show; and a scene
with its objects, from two sides and at single ranges.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from scipy.ndimage import gaussian_filter1d
from scipy.signal import find_peaks

from apps.figures.style import (
    DEPTH_COLOURMAP,
    SMALL_FONT_PT,
    add_panels,
    draw_camera_picture,
    draw_image,
    draw_spread_picture,
    draw_streak,
    label_axes,
    make_figure,
    scale_brightness,
    scatter_points,
    tone_map,
)
from tofclip.arrays import AnyArray, BoolArray, Float32Array, FloatArray
from tofclip.camera import estimate_dark_level
from tofclip.lidar import PointCloud, Returns
from tofclip.lidar.cloud import DetectedObject
from tofclip.lidar.photons import SurfaceImage
from tofclip.notebook import letter_panels
from tofclip.shots import Frames, Streak
from tofclip.simulate import GroundTruth
from tofclip.units import MILLIMETRE, NANOSECOND, SPEED_OF_LIGHT

PANEL_COLUMNS = 4
MAX_MOMENTS = 3 * PANEL_COLUMNS
WIDTH_INCHES, OVERVIEW_INCHES, ROW_INCHES = 10.0, 2.9, 2.0
OVERVIEW_ROOM_INCHES = (0.6, 0.95, 0.45, 0.3)  # with a colour scale at the right
STRIP_TITLE_INCHES = 0.25
STRIP_ROOM_INCHES = (0.35, 0.1, 0.2, 0.25)  # ticks, whose last may stand out, and a title
MIN_PEAK_DISTANCE_BINS = 12
MIN_PEAK_PROMINENCE = 0.01  # of the highest
CROP_THRESHOLD = 0.35  # of a frame's brightest pixel: what is dimmer is mostly artefacts
CROP_MARGIN_PX = 8
LIT_THRESHOLD = 0.1  # of the brightest: a pixel's range is shown from there on
GAMMA = 0.6  # far objects stay visible beside near ones
SQUARED_RANGE = " \N{MULTIPLICATION SIGN} range\N{SUPERSCRIPT TWO}"


@dataclass(frozen=True)
class Moment:
    """Frames that are shown as one picture: the first, the last, and the one that names them."""

    frame: int
    first: int
    last: int


def make_preview_figure(streak: Streak, frames: Frames) -> Figure:
    """Draw a recovery; where times are ranges, brightness is multiplied by range squared."""
    moments = choose_moments(frames)
    lines = math.ceil(len(moments) / PANEL_COLUMNS)
    height = OVERVIEW_INCHES + ROW_INCHES * lines
    figure = make_figure(WIDTH_INCHES, height)
    (overview,) = add_panels(figure, 1, 3, (0, OVERVIEW_INCHES), OVERVIEW_ROOM_INCHES)
    left, middle, right = overview
    brightness = frames.values * _compute_compensation(frames)[:, np.newaxis, np.newaxis]
    counts = np.maximum(streak.counts - estimate_dark_level(streak.counts), 0)
    look = scale_brightness(counts, GAMMA)
    draw_streak(left, counts, streak.times, "streak image as measured", "counts", **look)
    unit = f"counts{SQUARED_RANGE} (m\N{SUPERSCRIPT TWO})" if _has_known_range(frames) else "counts"
    summed, method = brightness.sum(axis=0), frames.figures.get("method", "method unknown")
    look = scale_brightness(summed, GAMMA)
    draw_camera_picture(middle, summed, f"sum of all frames, {method}", unit, **look)
    _draw_distance(right, brightness, frames)
    strip = (OVERVIEW_INCHES + STRIP_TITLE_INCHES, height)
    title = f"frames from 0 to their peak, in {unit}; x and y in px"
    place: Any = {"fontsize": SMALL_FONT_PT + 2, "ha": "center", "va": "top"}
    figure.text(0.5, 1 - OVERVIEW_INCHES / height, title, **place)
    panels = add_panels(figure, lines, PANEL_COLUMNS, strip, STRIP_ROOM_INCHES)
    _draw_moments(panels, brightness, moments, frames)
    letter_panels([*overview, *panels.ravel()[: len(moments)]])
    return figure


def choose_moments(frames: Frames) -> list[Moment]:
    """Choose what to show: where most light comes back, in order of time.

    Objects at separate ranges make separate peaks of the summed brightness times range squared;
    each is taken from half its height to half its height. Light that comes without a pause is cut
    into even shares instead.
    """
    energy = frames.values.sum(axis=(1, 2), dtype=np.float64) * _compute_compensation(frames)
    if energy.size <= MAX_MOMENTS:
        return [Moment(frame, frame, frame) for frame in range(energy.size)]
    peaks = _find_peak_moments(energy)
    separate = all(earlier.last < later.first for earlier, later in pairwise(peaks))
    return peaks if separate and len(peaks) >= PANEL_COLUMNS else _split_evenly(energy)


def _find_peak_moments(energy: FloatArray) -> list[Moment]:
    # padded: the first and the last frame can be peaks
    smooth = np.pad(gaussian_filter1d(energy, 1.5), 1)
    prominence = MIN_PEAK_PROMINENCE * smooth.max()
    half_height = {"width": 0, "rel_height": 0.5}
    peaks, found = find_peaks(smooth, None, None, MIN_PEAK_DISTANCE_BINS, prominence, **half_height)
    chosen = np.sort(np.argsort(found["prominences"])[::-1][:MAX_MOMENTS])
    edges = np.rint([found["left_ips"], found["right_ips"]]).astype(int).clip(1, energy.size) - 1
    return [Moment(int(peaks[i]) - 1, int(edges[0, i]), int(edges[1, i])) for i in chosen]


def _split_evenly(energy: FloatArray) -> list[Moment]:
    share = np.cumsum(energy) / (energy.sum() or 1.0)
    cuts = np.searchsorted(share, np.linspace(0.01, 0.99, MAX_MOMENTS + 1)).clip(0, energy.size - 1)
    return [
        Moment((first + last) // 2, first, max(first, last - 1))
        for first, last in pairwise(cuts.tolist())
    ]


def _has_known_range(frames: Frames) -> bool:
    """Whether time is range: it has a zero, and is not of three bounces as from a wall."""
    return frames.camera.time_zero != 0 and "relay_wall" not in frames.attachments


def _compute_compensation(frames: Frames) -> Float32Array:
    """Factor of each frame that undoes the fall-off with range; 1 where it does not apply."""
    if _has_known_range(frames):
        return np.maximum(frames.ranges, 0).astype(np.float32) ** 2
    return np.ones(frames.times.size, np.float32)


def _draw_distance(axes: Axes, brightness: AnyArray, frames: Frames) -> None:
    """When each pixel was brightest; dim ones have no say."""
    scale, meaning = (frames.times / NANOSECOND, "time (ns)")
    if _has_known_range(frames):
        scale, meaning = frames.ranges, "range (m)"
    dim = tone_map(brightness.max(axis=0)) < LIT_THRESHOLD
    distance = np.where(dim, np.nan, scale[brightness.argmax(axis=0)])
    title = f"{meaning.partition(' ')[0]} of each pixel's peak"
    draw_spread_picture(axes, distance, title, meaning, cmap=DEPTH_COLOURMAP)


def _draw_moments(
    panels: AnyArray, brightness: AnyArray, moments: list[Moment], frames: Frames
) -> None:
    """One averaged picture for each moment, scaled to its own brightness."""
    pictures = [brightness[moment.first : moment.last + 1].mean(axis=0) for moment in moments]
    rows, columns = _crop_to_bright(pictures)
    extent = (columns.start - 0.5, columns.stop - 0.5, rows.stop - 0.5, rows.start - 0.5)
    for axes, moment, picture in zip(panels.ravel(), moments, pictures, strict=False):
        draw_image(axes, picture[rows, columns], extent, vmin=0)
        where = f"{frames.times[moment.frame] / NANOSECOND:.2f} ns"
        if _has_known_range(frames):
            where = f"{frames.ranges[moment.frame]:.2f} m"
        which = f"frames {moment.first} to {moment.last}"
        if moment.first == moment.last:
            which = f"frame {moment.frame}"
        label_axes(axes, f"{where}, {which}", "", "")
        peak: Any = {"color": "white", "fontsize": SMALL_FONT_PT, "transform": axes.transAxes}
        axes.text(0.03, 0.04, f"peak {float(f'{picture.max():.3g}'):g}", **peak)
    for axes in panels.ravel()[len(moments) :]:
        axes.set_axis_off()
    # Ticks at the left and below are those of the whole column and row.
    for axes in panels[:, 1:].ravel():
        axes.tick_params(left=False, labelleft=False)
    for axes in panels[:-1].ravel():
        axes.tick_params(bottom=False, labelbottom=False)


def _crop_to_bright(pictures: list[AnyArray]) -> tuple[slice, slice]:
    """Rows and columns that hold everything bright in any picture, with a margin."""
    bright = np.any([picture >= CROP_THRESHOLD * picture.max() for picture in pictures], axis=0)

    def surround(lit: BoolArray) -> slice:
        first, last = np.flatnonzero(lit)[[0, -1]].tolist()
        return slice(max(0, first - CROP_MARGIN_PX), min(lit.size, last + CROP_MARGIN_PX + 1))

    return surround(bright.any(axis=1)), surround(bright.any(axis=0))


HISTOGRAM_BINS = 61
MIN_SPAN_SIGMA = 20  # of the colours of ranges


def make_demo_figure(
    streak: Streak,
    frames: Frames,
    returns: Returns,
    cloud: PointCloud,
    truth: GroundTruth,
    compared: Frames,
) -> Figure:
    """Draw streak, brightness by two methods, range, cloud, and range errors."""
    figure = make_figure(12, 6)
    panels = figure.subplots(2, 4)
    title, look = "one shot, seven views", scale_brightness(streak.counts)
    draw_streak(panels[0, 0], streak.counts, streak.times, title, "photons", **look)
    _draw_brightness(panels[0, 1], frames)
    _draw_brightness(panels[0, 2], compared)
    distance = returns.image("range")
    title = "range of the strongest return"
    draw_camera_picture(panels[0, 3], distance, title, "range (m)", cmap=DEPTH_COLOURMAP)
    meaning = "of the light that falls on it"
    draw_camera_picture(panels[1, 3], truth.reflectance, "true reflectance", meaning, vmin=0)
    light = tone_map(cloud.intensity, gamma=0.5)  # some light is left for the dim points
    scatter_points(panels[1, 0], cloud.xyz[:, 0], cloud.xyz[:, 2], light, 1.2)
    label_axes(panels[1, 0], "top view of the cloud", "x (m)", "z, away from the camera (m)")
    scatter_points(panels[1, 1], cloud.xyz[:, 2], cloud.xyz[:, 1], light, 1.2)
    # y points down in a cloud, as in a picture.
    panels[1, 1].invert_yaxis()
    label_axes(panels[1, 1], "side view of the cloud", "z, away from the camera (m)", "y, down (m)")
    _draw_errors(panels[1, 2], returns, truth)
    letter_panels(panels.ravel())
    return figure


def _draw_brightness(axes: Axes, frames: Frames) -> None:
    picture = np.tensordot(_compute_compensation(frames), frames.values, axes=1)
    title = f"{frames.figures['method']}: brightness{SQUARED_RANGE}"
    draw_camera_picture(axes, picture, title, "photons at 1 m", **scale_brightness(picture))


def _draw_errors(axes: Axes, returns: Returns, truth: GroundTruth) -> None:
    error = (returns.image("range") - truth.range)[truth.target] / MILLIMETRE
    error = error[np.isfinite(error)]
    bin_mm = SPEED_OF_LIGHT * truth.bin_width / 2 / MILLIMETRE
    reach = min(2 * bin_mm, 3 * np.percentile(np.abs(error), 90))
    edges = np.linspace(-reach, reach, HISTOGRAM_BINS).tolist()
    axes.hist(np.clip(error, edges[0], edges[-1]), edges, color="#4c72b0")
    title = f"range error, median {np.median(np.abs(error)):.2f} mm"
    meaning = f"range error (mm); a bin is {bin_mm:.2f} mm"
    label_axes(axes, title, meaning, "target pixels")


def make_range_figure(found: SurfaceImage) -> Figure:
    """Draw a range image with what it is worth."""
    figure = make_figure(10, 7.5)
    axes = figure.subplots(2, 2)
    seen = np.isfinite(found.range)
    sigma, photons = (
        np.median(one[seen]) if seen.any() else np.nan
        for one in (found.range_sigma, found.intensity)
    )
    figure.suptitle(
        f"medians: {photons:.3g} signal photons a pixel, deviation {sigma / MILLIMETRE:.3g} mm",
        fontsize=SMALL_FONT_PT + 2,
    )
    # Ranges that differ by less than noise does are no scene.
    span = MIN_SPAN_SIGMA * sigma if seen.any() else 0.0
    panels: tuple[tuple[Any, str, str, dict[str, Any]], ...] = (
        (found.range, "range", "m", {"cmap": DEPTH_COLOURMAP, "least_span": span}),
        (found.range_sigma / MILLIMETRE, "one standard deviation", "mm", {"vmin": 0}),
        (found.intensity, "signal", "photons", {"vmin": 0}),
        (found.outlier_probability, "outliers", "probability", {"vmin": 0, "vmax": 1}),
    )
    for panel, (picture, title, meaning, look) in zip(axes.flat, panels, strict=True):
        draw_spread_picture(panel, picture, title, meaning, **look)
    letter_panels(axes.flat)
    return figure


MIN_BRIGHTNESS = 0.4  # of the colours: dim points stay visible
MAX_RANGE_PANELS = 4
HALF_GATE_BINS = 4
LABEL_DISTANCE = 0.04  # of the axes: numbers closer to another would cover it
UNIT = "counts \N{MULTIPLICATION SIGN} range\N{SUPERSCRIPT TWO} (m\N{SUPERSCRIPT TWO})"


def make_scene_figure(
    frames: Frames, cloud: PointCloud, objects: Sequence[DetectedObject]
) -> Figure:
    """Draw a scene as the paper's Supplementary Figure 21 does; four objects at their ranges."""
    figure = make_figure(12, 5.6)
    if frames.time_zero_note:
        figure.suptitle(f"ranges are right{frames.time_zero_note}", fontsize=SMALL_FONT_PT + 2)
    halves: Any = figure.subfigures(2, 1, height_ratios=[1.2, 1])
    upper, lower = halves
    front, above = upper.add_subplot(1, 3, 1), upper.add_subplot(1, 3, 3)
    space = upper.add_subplot(1, 3, 2, projection="3d")
    squared = np.maximum(frames.ranges, 0).astype(np.float32) ** 2
    brightness = frames.values * squared[:, np.newaxis, np.newaxis]
    summed = brightness.sum(axis=0)
    title = f"sum of all frames, {frames.figures.get('method', 'method unknown')}"
    draw_camera_picture(front, summed, title, UNIT, **scale_brightness(summed))
    _draw_cloud(space, cloud)
    numbered = sorted(enumerate(objects, 1), key=lambda pair: -pair[1].points.size)
    _draw_top_view(above, cloud, numbered)
    shown = sorted(numbered[:MAX_RANGE_PANELS], key=lambda pair: pair[1].range)
    panels = [front, space, above]
    for column, (number, one) in enumerate(shown, 1):
        row = np.abs(frames.ranges - one.range).argmin()
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
    size, written = np.ptp(cloud.xyz[:, ::2], axis=0), list[Any]()
    for number, one in numbered:
        place, words = np.array([one.centre[0], one.centre[2]]), str(number)
        for other in written:  # what would lie over another number is written behind it
            if np.abs((place - other.xy) / size).max() <= LABEL_DISTANCE:
                other.set_text(f"{other.get_text()}, {words}")
                break
        else:
            look: Any = {"color": "white", "fontsize": SMALL_FONT_PT}
            written.append(axes.annotate(words, place, **look))
    label_axes(axes, "objects from above", "x (m)", "z, away from the camera (m)")
