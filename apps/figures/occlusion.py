"""The demonstration of seeing through an occluder, in one picture."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from apps.figures.occlusion_region import OCCLUDER_COLOUR, TEXT_BOX, draw_region
from apps.figures.style import (
    EMPTY_COLOUR,
    LINE_COLOUR,
    SMALL_FONT_PT,
    draw_image,
    label_axes,
    make_figure,
)
from tofclip.metrics import correlation_coefficient
from tofclip.units import MILLIMETRE, PICOSECOND

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from numpy.typing import NDArray

    from apps.occlusion.experiment import Experiment
    from apps.occlusion.probe import ProbeResult

SEEN_COLOUR, UNSEEN_COLOUR = "#57c84d", "#ff5a5f"
DRAWN_DEPTH_FACTOR = 1.15  # of the target's distance behind the occluder is drawn
MIN_RELATIVE_LIGHT, CAPTION_LEVEL = (
    1e-4,
    12.0,
)  # of the strongest instant: where the drawing begins, and where its captions stand


def make_occlusion_figure(experiment: Experiment, probes: Sequence[ProbeResult]) -> Figure:
    """Draw the geometry, the returns in time, and what three cameras make of the target, beside the
    truth.

    `probes`: small targets on the axis, drawn with a tick or a cross.
    """
    figure = make_figure(13, 7)
    figure.suptitle(_format_headline(experiment), fontsize=SMALL_FONT_PT + 5)
    halves: Any = figure.subfigures(2, 1, height_ratios=[1.15, 1])
    upper, lower = halves
    plan, time = upper.subplots(1, 2, width_ratios=[1.8, 1])
    _draw_plan(plan, experiment, probes)
    draw_history(time, experiment)
    for axes, (title, picture, truth) in zip(
        lower.subplots(1, 6), _select_pictures(experiment), strict=True
    ):
        brightest = picture.max() if truth is None else truth.max()
        draw_image(axes, picture, vmin=0, vmax=max(float(brightest), 1e-12))
        axes.set(xticks=[], yticks=[])
        axes.set_title(title, fontsize=SMALL_FONT_PT + 1)
        if truth is not None and truth is not picture:
            found = correlation_coefficient(picture, truth)
            axes.set_xlabel(
                f"correlation {found:.2f}",
                fontsize=SMALL_FONT_PT + 2,
                color=SEEN_COLOUR if found >= 0.8 else UNSEEN_COLOUR,
            )
    return figure


def _format_headline(experiment: Experiment) -> str:
    measurements, side = experiment.rig.camera.measurements, experiment.settings.side_px
    views = len(experiment.rig.array.views)
    pixels = " \N{MULTIPLICATION SIGN} ".join(map(str, (views, side, side)))
    title = experiment.scene.title
    return f"{title[0].upper()}{title[1:]}, seen with {measurements} measurements instead of {pixels} pixels"


def _select_pictures(experiment: Experiment) -> list[tuple[str, NDArray[Any], NDArray[Any] | None]]:
    """Title, picture, and the truth it is compared with and scaled to; None: scaled to itself."""
    truth, separated = experiment.truth, experiment.separated
    everything = experiment.pictures[len(experiment.pictures) // 2].sum(axis=-1)
    refocused = experiment.conventional
    # what a light-field camera shows of the target is drawn as bright as the haze allows
    scaled = refocused * (truth.max() / max(float(refocused.max()), 1e-12))
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
    halves = [abs(body.centre[0]) + float(body.shape.half_extent[0]) for body in scene.target]
    z, half = scene.distance / MILLIMETRE, max(halves) / MILLIMETRE
    low, high = axes.get_ylim()
    axes.plot([z, z], [-half, half], color=OCCLUDER_COLOUR, lw=4, alpha=0.9)
    note: dict[str, Any] = {"textcoords": "offset points", "ha": "right", "bbox": TEXT_BOX}
    axes.annotate("target", (z, high), (-6, -6), va="top", color=OCCLUDER_COLOUR, **note)
    for number, one in enumerate(probes):
        colour, mark = (SEEN_COLOUR, "o") if one.is_recovered else (UNSEEN_COLOUR, "X")
        place = one.distance / MILLIMETRE
        axes.plot(place, 0, mark, color=colour, mec="black", ms=10, zorder=5)
        said = f"at {one.factor:g} l: correlation {one.correlation:.2f}"
        line = {"arrowstyle": "-", "color": colour, "lw": 0.8, "shrinkB": 5}
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
    for found, name, colour in zip(
        measurements.find_returns(),
        ("occluder", "target"),
        (OCCLUDER_COLOUR, LINE_COLOUR),
        strict=False,
    ):
        gate = times[found.bins]
        axes.axvspan(float(gate[0]), float(gate[-1]), color=colour, alpha=0.3)
        peak = gate[np.argmax(history[found.bins])]
        said = f"{name}\n{found.distance / MILLIMETRE:.1f} mm"
        axes.text(
            float(peak),
            CAPTION_LEVEL,
            said,
            ha="center",
            va="top",
            fontsize=SMALL_FONT_PT,
            color="white",
        )
    axes.set_ylim(MIN_RELATIVE_LIGHT, 2 * CAPTION_LEVEL)
    label_axes(
        axes,
        "sum of all measurements",
        "time after the flash (ps)",
        "relative to the brightest instant",
    )
