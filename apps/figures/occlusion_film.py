"""Films of seeing through an occluder: a flash as it travels, and a target that walks past behind."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from apps.figures.occlusion import UNSEEN_COLOUR, draw_history
from apps.figures.style import SMALL_FONT_PT, draw_image, make_figure
from tofclip.files import atomic_path
from tofclip.units import MILLIMETRE, PICOSECOND

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from numpy.typing import NDArray

    from apps.occlusion.experiment import Experiment

FRAME_MS, LAST_FRAME_MS = 120, 2500
DARK_THRESHOLD = 0.02  # of a return's brightest instant: the film passes over fainter ones
# of a target that walks: how many, how far to either side (m), and how long each is shown
WALK_STEPS, WALK_REACH_M, WALK_STEP_MS = 14, 18e-3, 180
PANEL_LAYOUT = {"left": 0.02, "right": 0.98, "bottom": 0.16, "top": 0.8}


class FlashFrame(NamedTuple):
    """An instant of the flash."""

    time: float  # ps after the flash
    title: str
    # of the middle view and of the recovery, from 0 to 1
    pictures: tuple[NDArray[Any], NDArray[Any]]


def save_flash_film(experiment: Experiment, path: Path) -> None:
    """Write a GIF: light reaches the occluder, then what stands behind it.

    Each return is shown at its own brightness; the recovered pictures light up as the measurements
    of their gates do.

    `path`: of the GIF.
    """
    figure, frames = _make_canvas(8, 3.2), _make_flash_frames(experiment)
    left, right, time = figure.subplots(1, 3, gridspec_kw=PANEL_LAYOUT)
    images = _lay_out_pictures((left, right), ("what one view sees", "ToF-CLIP"), experiment)
    draw_history(time, experiment)
    time.set_title("sum of all measurements", fontsize=SMALL_FONT_PT + 2)
    time.set_ylabel("")
    time.tick_params(axis="y", labelleft=False)
    cursor = time.axvline(experiment.time_axis.start / PICOSECOND, color=UNSEEN_COLOUR, lw=2)

    def drawn() -> Iterator[Any]:
        for frame in frames:
            cursor.set_xdata([frame.time, frame.time])
            yield _render_image(figure, images, frame.pictures, frame.title)

    _write_gif(path, list(drawn()), [FRAME_MS] * (len(frames) - 1) + [LAST_FRAME_MS])


def save_walk_film(experiment: Experiment, path: Path, advance: Callable[[int], None]) -> None:
    """Write a GIF: the target walks past behind the occluder, each step flashed, measured and
    recovered again.

    Calls ``advance(1)`` after each of `WALK_STEPS`.

    `path`: of the GIF.
    """
    figure = _make_canvas(9.4, 2.9)
    names = ("one view, all its light", "one view, the second return", "ToF-CLIP", "truth")
    images = _lay_out_pictures(
        figure.subplots(1, 4, gridspec_kw={**PANEL_LAYOUT, "bottom": 0.02}), names, experiment
    )
    brightest, drawn = float(experiment.truth.max()), []
    for number, across in enumerate(np.linspace(-WALK_REACH_M, WALK_REACH_M, WALK_STEPS)):
        settings = replace(experiment.settings, seed=experiment.settings.seed + number)
        there = type(experiment)(experiment.scene.move_target(float(across)), settings)
        everything = there.pictures[len(there.pictures) // 2].sum(axis=-1)
        seen = everything * (brightest / everything.max())
        pictures = seen, there.single_view, there.separated.target, there.truth
        title = f"target {across / MILLIMETRE:+.0f} mm from the axis, {there.scene.behind / MILLIMETRE:.0f} mm behind"
        drawn.append(_render_image(figure, images, [one / brightest for one in pictures], title))
        advance(1)
    # there and back again, without showing the ends twice
    _write_gif(path, [*drawn, *drawn[-2:0:-1]], [WALK_STEP_MS] * (2 * WALK_STEPS - 2))


def _make_canvas(width: float, height: float) -> Figure:
    """Make a figure whose drawing can be read back, in inches."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    figure = make_figure(width, height)
    figure.set_layout_engine("none")
    FigureCanvasAgg(figure)
    return figure


def _lay_out_pictures(
    panels: Sequence[Axes], names: Sequence[str], experiment: Experiment
) -> list[Any]:
    """Lay out pictures of a film and return what changes in them."""
    side = experiment.settings.side_px
    images = []
    for axes, name in zip(panels, names, strict=True):
        images.append(draw_image(axes, 0 * experiment.truth, (0, side, side, 0), vmin=0, vmax=1))
        axes.set(xticks=[], yticks=[])
        axes.set_title(name, fontsize=SMALL_FONT_PT + 2)
    return images


def _render_image(
    figure: Figure, images: Sequence[Any], pictures: Sequence[NDArray[Any]], title: str
) -> Any:
    """Put pictures from 0 to 1 into their places and return the figure as an image."""
    from PIL import Image

    for image, picture in zip(images, pictures, strict=True):
        image.set_data(picture)
    figure.suptitle(title, fontsize=SMALL_FONT_PT + 4)
    canvas: Any = figure.canvas
    canvas.draw()
    return Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3])


def _write_gif(path: Path, images: list[Any], durations_ms: list[int]) -> None:
    with atomic_path(path) as temporary:
        images[0].save(
            temporary, save_all=True, append_images=images[1:], duration=durations_ms, loop=0
        )


def _make_flash_frames(experiment: Experiment) -> list[FlashFrame]:
    """Every instant that is not dark; at last the whole of the second return."""
    separated, returns = experiment.separated, experiment.measurements.find_returns()
    parts = [separated.occluder, separated.target][: len(returns)]
    history, middle = (
        experiment.measurements.history,
        experiment.pictures[len(experiment.pictures) // 2],
    )
    times, frames = experiment.time_axis.times / PICOSECOND, []
    for found, recovered in zip(returns, parts, strict=True):
        lit = history / history[found.bins].max()
        scales = [
            max(float(top), 1e-12)
            for top in (middle[..., found.bins].max(), np.quantile(recovered, 0.999))
        ]
        for instant in np.arange(found.bins.start, found.bins.stop)[
            lit[found.bins] > DARK_THRESHOLD
        ]:
            pictures = middle[..., instant] / scales[0], lit[instant] * recovered / scales[1]
            frames.append(
                FlashFrame(
                    float(times[instant]), f"{times[instant]:.0f} ps after the flash", pictures
                )
            )
    brightest = experiment.truth.max()
    behind, last = separated.plain, "nothing comes from behind the occluder"
    if separated.sees_target:
        behind, last = (
            middle[..., returns[1].bins].sum(axis=-1),
            "all of the second return together",
        )
    return [
        *frames,
        FlashFrame(frames[-1].time, last, (behind / brightest, separated.target / brightest)),
    ]
