"""Seeing through an occluder: the inactive region behind it, to scale; the demonstration in one picture;
films of a flash as it travels and of a target that walks past behind.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.animation import FuncAnimation, PillowWriter
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from apps.figures.style import (
    EMPTY_COLOUR,
    LINE_COLOUR,
    SMALL_FONT_PT,
    add_colour_bar,
    draw_image,
    label_axes,
    make_figure,
)
from apps.occlusion.experiment import Experiment, ProbeResult
from tofclip.arrays import AnyArray
from tofclip.files import atomic_path
from tofclip.metrics import correlation_coefficient
from tofclip.notebook import letter_panels
from tofclip.occlusion import InactiveRegion
from tofclip.units import MILLIMETRE, PICOSECOND

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
    """Draw the region from above, and at least `least_reach`, m, behind the occluder."""
    places = np.linspace(-0.5, 0.5, VIEW_COUNT) * region.baseline
    usual = ENDLESS_DEPTH_FACTOR * region.distance
    if region.is_bounded:
        usual = DRAWN_LENGTH_FACTOR * region.length
    reach = max(usual, least_reach)
    half = 0.62 * max(region.baseline, region.width)
    x = np.linspace(-half, half, GRID_SHAPE[0])[:, np.newaxis, np.newaxis]
    behind = np.linspace(0, reach, GRID_SHAPE[1])[:, np.newaxis]
    share = region.sees(places, x, behind).mean(axis=-1)
    edges = np.array([region.distance, region.distance + reach, -half, half]) / MILLIMETRE
    left, right, low, high = edges.tolist()
    look = {"cmap": "bone", "vmin": 0, "vmax": 1, "aspect": "auto"}
    mapped = draw_image(axes, share[::-1], (left, right, low, high), **look)
    add_colour_bar(axes, mapped, "share of the views that see the place")
    _draw_lines(axes, region, reach)
    axes.plot(0 * places, places / MILLIMETRE, "s", color=LINE_COLOUR, ms=7, clip_on=False)
    ends = np.array([-0.5, 0.5]) * region.width / MILLIMETRE
    axes.plot([left, left], ends, color=OCCLUDER_COLOUR, lw=6)
    axes.set_xlim(-0.03 * right, right)
    axes.set_facecolor(EMPTY_COLOUR)
    x_label, y_label = "z, away from the views (mm)", "x, along the baseline (mm)"
    label_axes(axes, _format_title(region), x_label, y_label)


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
        arrow = {"arrowstyle": "<->", "color": OCCLUDER_COLOUR}
        axes.annotate("", (stop, 0), (start, 0), arrowprops=arrow)
        said = f"l = {region.length / MILLIMETRE:.1f} mm, hidden"
        note: Any = {"textcoords": "offset points", "bbox": TEXT_BOX}
        axes.annotate(said, (start, 0), (8, 7), color=OCCLUDER_COLOUR, **note)


def _format_title(region: InactiveRegion) -> str:
    sizes = f"L = {region.baseline / MILLIMETRE:g} mm, D = {region.width / MILLIMETRE:.3g} mm, "
    sizes += f"d = {region.distance / MILLIMETRE:g} mm"
    if not region.is_bounded:
        return f"{sizes}: D \N{GREATER-THAN OR EQUAL TO} L, nothing behind the occluder is promised to be seen"
    return f"{sizes}: l = d D / (L \N{MINUS SIGN} D) = {region.length / MILLIMETRE:.1f} mm"


SEEN_COLOUR, UNSEEN_COLOUR = "#57c84d", "#ff5a5f"
DRAWN_DEPTH_FACTOR = 1.15  # of the target's distance behind the occluder is drawn
# of the strongest instant: where the drawing begins, and where its captions stand
MIN_RELATIVE_LIGHT, CAPTION_LEVEL = 1e-4, 12.0


def make_occlusion_figure(experiment: Experiment, probes: Sequence[ProbeResult]) -> Figure:
    """Draw geometry, returns in time, and what three cameras see of the target."""
    figure = make_figure(13, 7)
    views, side = len(experiment.rig.array.views), experiment.settings.side_px
    pixels = " \N{MULTIPLICATION SIGN} ".join(map(str, (views, side, side)))
    title, measurements = experiment.scene.title, experiment.rig.camera.measurements
    title = f"{title[0].upper()}{title[1:]}, seen with {measurements} measurements instead of {pixels} pixels"
    figure.suptitle(title, fontsize=SMALL_FONT_PT + 5)
    halves: Any = figure.subfigures(2, 1, height_ratios=[1.15, 1])
    upper, lower = halves
    plan, time = upper.subplots(1, 2, width_ratios=[1.8, 1])
    _draw_plan(plan, experiment, probes)
    draw_history(time, experiment)
    panels = lower.subplots(1, 6)
    for axes, (title, picture, truth) in zip(panels, _select_pictures(experiment), strict=True):
        brightest = picture.max() if truth is None else truth.max()
        draw_image(axes, picture, vmin=0, vmax=max(float(brightest), 1e-12))
        axes.set(xticks=[], yticks=[])
        axes.set_title(title, fontsize=SMALL_FONT_PT + 1)
        if truth is not None and truth is not picture:
            found = correlation_coefficient(picture, truth)
            colour = SEEN_COLOUR if found >= 0.8 else UNSEEN_COLOUR
            axes.set_xlabel(f"correlation {found:.2f}", fontsize=SMALL_FONT_PT + 2, color=colour)
    letter_panels([plan, time, *panels])
    return figure


def _select_pictures(experiment: Experiment) -> list[tuple[str, AnyArray, AnyArray | None]]:
    """Title, picture, and the truth it is compared with and scaled to; None: scaled to itself."""
    truth, separated = experiment.truth, experiment.separated
    everything = experiment.pictures[len(experiment.pictures) // 2].sum(axis=-1)
    refocused = experiment.conventional
    # what a light-field camera shows of the target is drawn as bright as the haze allows
    scaled = refocused * (truth.max() / max(refocused.max(), 1e-12))
    return [
        ("one view,\nall its light", everything, None),
        ("a light-field camera,\nall pixels, refocused behind", scaled, truth),
        (
            "one view with time of flight,\nas many pixels as measurements",
            experiment.single_view,
            experiment.single_view_truth,
        ),
        ("ToF-CLIP: the first return,\nthe occluder", separated.occluder, None),
        ("ToF-CLIP: the second return,\nwhat stands behind", separated.target, truth),
        ("truth:\nthe occluder taken away", truth, truth),
    ]


def _draw_plan(axes: Axes, experiment: Experiment, probes: Sequence[ProbeResult]) -> None:
    """The scene from above: which views see which place, the target, and small targets on the axis."""
    scene = experiment.scene
    draw_region(axes, scene.region, DRAWN_DEPTH_FACTOR * scene.behind)
    halves = [abs(body.centre[0]) + body.shape.half_extent[0] for body in scene.target]
    z, half = scene.distance / MILLIMETRE, max(halves) / MILLIMETRE
    low, high = axes.get_ylim()
    axes.plot([z, z], [-half, half], color=OCCLUDER_COLOUR, lw=4, alpha=0.9)
    note: Any = {"textcoords": "offset points", "ha": "right", "bbox": TEXT_BOX}
    axes.annotate("target", (z, high), (-6, -6), va="top", color=OCCLUDER_COLOUR, **note)
    for number, one in enumerate(probes):
        colour, mark = (SEEN_COLOUR, "o") if one.is_recovered else (UNSEEN_COLOUR, "X")
        place = one.distance / MILLIMETRE
        axes.plot(place, 0, mark, color=colour, mec="black", ms=10, zorder=5)
        said = f"at {one.factor:g} l: correlation {one.correlation:.2f}"
        line = {"arrowstyle": "-", "color": colour, "lw": 0.8, "shrinkB": 5}
        line["relpos"] = (1, 0.5)  # from the end, or the lines cross the labels of nearer ones
        below = (16, -34 - 14 * number)
        axes.annotate(
            said, (place, 0), below, arrowprops=line, fontsize=SMALL_FONT_PT, color=colour, **note
        )
    axes.set_ylim(low, high)


def draw_history(axes: Axes, experiment: Experiment) -> None:
    """Draw all light over time on a logarithmic scale, with the gates of the returns."""
    measurements = experiment.measurements
    times = measurements.time_axis.times / PICOSECOND
    history = np.maximum(measurements.history / measurements.history.max(), MIN_RELATIVE_LIGHT)
    axes.set_facecolor(EMPTY_COLOUR)
    axes.semilogy(times, history, color="white", lw=1.5, drawstyle="steps-mid")
    look: Any = {"ha": "center", "va": "top", "fontsize": SMALL_FONT_PT}
    named = (("occluder", OCCLUDER_COLOUR), ("target", LINE_COLOUR))
    for found, (name, colour) in zip(measurements.find_returns(), named, strict=False):
        gate = times[found.bins]
        axes.axvspan(gate[0], gate[-1], color=colour, alpha=0.3)
        peak = gate[np.argmax(history[found.bins])]
        said = f"{name}\n{found.distance / MILLIMETRE:.1f} mm"
        axes.text(peak, CAPTION_LEVEL, said, color="white", **look)
    axes.set_ylim(MIN_RELATIVE_LIGHT, 2 * CAPTION_LEVEL)
    light = "relative to the brightest instant"
    label_axes(axes, "sum of all measurements", "time after the flash (ps)", light)


FLASH_RATE_HZ, WALK_RATE_HZ, LAST_REPEATS = 8, 6, 20  # the last picture of the flash stays
DARK_THRESHOLD = 0.02  # of a return's brightest instant: the film passes over fainter ones
PANEL_LAYOUT = {"left": 0.02, "right": 0.98, "bottom": 0.16, "top": 0.8}


class FilmFrame(NamedTuple):
    """What a film shows at a time."""

    title: str
    pictures: Sequence[AnyArray]  # from 0 to 1
    time: float = 0.0  # ps after the flash


def _begin_film(width: float, height: float, columns: int, **layout: Any) -> tuple[Figure, Any]:
    figure = make_figure(width, height)
    figure.set_layout_engine("none")
    return figure, figure.subplots(1, columns, gridspec_kw={**PANEL_LAYOUT, **layout})


def _save_film(
    path: Path,
    figure: Figure,
    panels: Mapping[str, Axes],
    frames: Sequence[FilmFrame],
    rate_hz: int,
    move: Callable[[float], object] = lambda _: None,
) -> None:
    """Write a GIF whose pictures are drawn into panels of a figure, by their titles; `move` is called
    with each frame's time.
    """
    drawn = []
    for (name, axes), picture in zip(panels.items(), frames[0].pictures, strict=True):
        drawn.append(draw_image(axes, picture, (0, 1, 1, 0), vmin=0, vmax=1))
        axes.set(xticks=[], yticks=[])
        axes.set_title(name, fontsize=SMALL_FONT_PT + 2)

    def show(frame: FilmFrame) -> None:
        for shown, picture in zip(drawn, frame.pictures, strict=True):
            shown.set_data(picture)
        figure.suptitle(frame.title, fontsize=SMALL_FONT_PT + 4)
        move(frame.time)

    with atomic_path(path) as temporary:
        FuncAnimation(figure, show, frames).save(temporary, PillowWriter(rate_hz))


def save_flash_film(experiment: Experiment, path: Path) -> None:
    """Write a GIF: light reaches the occluder, then what is behind, each at its own brightness."""
    figure, (left, right, time) = _begin_film(8, 3.2, 3)
    draw_history(time, experiment)
    time.set_title("sum of all measurements", fontsize=SMALL_FONT_PT + 2)
    time.set_ylabel("")
    time.tick_params(axis="y", labelleft=False)
    cursor = time.axvline(experiment.time_axis.start / PICOSECOND, color=UNSEEN_COLOUR, lw=2)
    frames = _make_flash_frames(experiment)
    frames += frames[-1:] * LAST_REPEATS
    panels = {"what one view sees": left, "ToF-CLIP": right}
    _save_film(
        path, figure, panels, frames, FLASH_RATE_HZ, lambda now: cursor.set_xdata([now, now])
    )


def save_walk_film(
    experiment: Experiment, places: Sequence[float], path: Path, advance: Callable[[int], None]
) -> None:
    """Write a GIF: the target walks past behind the occluder, from one place, m, to the next, and back."""
    names = ("one view, all its light", "one view, the second return", "ToF-CLIP", "truth")
    brightest, frames = experiment.truth.max(), []
    for number, across in enumerate(places):
        settings = replace(experiment.settings, seed=experiment.settings.seed + number)
        there = type(experiment)(experiment.scene.move_target(across), settings)
        everything = there.pictures[len(there.pictures) // 2].sum(axis=-1)
        seen = everything * (brightest / everything.max())
        pictures = seen, there.single_view, there.separated.target, there.truth
        title = f"target {across / MILLIMETRE:+.0f} mm from the axis, {there.scene.behind / MILLIMETRE:.0f} mm behind"
        frames.append(FilmFrame(title, [one / brightest for one in pictures]))
        advance(1)
    figure, panels = _begin_film(9.4, 2.9, 4, bottom=0.02)
    there_and_back = [*frames, *frames[-2:0:-1]]
    _save_film(path, figure, dict(zip(names, panels, strict=True)), there_and_back, WALK_RATE_HZ)


def _make_flash_frames(experiment: Experiment) -> list[FilmFrame]:
    """Every instant that is not dark; at last the whole of the second return."""
    separated, returns = experiment.separated, experiment.measurements.find_returns()
    parts = [separated.occluder, separated.target][: len(returns)]
    history = experiment.measurements.history
    middle = experiment.pictures[len(experiment.pictures) // 2]
    times, frames = experiment.time_axis.times / PICOSECOND, []
    for found, recovered in zip(returns, parts, strict=True):
        lit = history / history[found.bins].max()
        tops = (middle[..., found.bins].max(), np.quantile(recovered, 0.999))
        seen, made = (max(float(top), 1e-12) for top in tops)
        for instant in found.bins.start + np.flatnonzero(lit[found.bins] > DARK_THRESHOLD):
            pictures = middle[..., instant] / seen, lit[instant] * recovered / made
            title = f"{times[instant]:.0f} ps after the flash"
            frames.append(FilmFrame(title, pictures, times[instant]))
    brightest = experiment.truth.max()
    behind, last = separated.plain, "nothing comes from behind the occluder"
    if separated.sees_target:
        behind = middle[..., returns[1].bins].sum(axis=-1)
        last = "all of the second return together"
    whole = behind / brightest, separated.target / brightest
    return [*frames, FilmFrame(last, whole, frames[-1].time)]
