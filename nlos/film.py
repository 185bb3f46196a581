"""The film of a transient video: its front view at every instant, with axes in metres."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nlos.picture import COLOUR_MAP, compute_extent
from nlos.video import TransientVideo
from tofclip.files import atomic_path, require_suffix

FIGURE_SIZE_INCHES = (5.6, 5.0)
DOTS_PER_INCH = 80
FRAME_DURATION_MS, LAST_FRAME_DURATION_MS = 80, 1000
NANOSECOND = 1e-9


def save_film(video: TransientVideo, path: str | Path) -> None:
    """Write a GIF that looks along +z from the wall, x to the right and y down; all instants share
    one scale.

    Memory for all pictures of the film, 0.2 MB each.

    `video`: with depth or without; `path`: ends in .gif.
    """
    from PIL import Image

    target = Path(path)
    require_suffix(target, ".gif")
    first, *others = (
        Image.fromarray(picture).quantize(dither=Image.Dither.NONE)
        for picture in render_frames(video)
    )
    durations = [FRAME_DURATION_MS] * len(others) + [LAST_FRAME_DURATION_MS]
    with atomic_path(target) as temporary:
        first.save(
            temporary, format="GIF", save_all=True, append_images=others, duration=durations, loop=0
        )


def render_frames(video: TransientVideo) -> Iterator[NDArray[np.uint8]]:
    """Draw every instant, (rows, columns, 3), red first; all of one size and scale."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    front = video.values if video.values.ndim == 3 else video.values.max(axis=1)
    figure = Figure(figsize=FIGURE_SIZE_INCHES, dpi=DOTS_PER_INCH, layout="constrained")
    canvas, axes = FigureCanvasAgg(figure), figure.add_subplot()
    edges = compute_extent(video.grid.x, video.grid.y)
    drawn = axes.imshow(front[0], COLOUR_MAP, vmin=0, vmax=float(front.max()) or 1.0, extent=edges)
    drawn.set_interpolation("nearest")
    axes.set(xlabel="x (m)", ylabel="y (m), down", title=_format_title(video.times[-1]))
    figure.colorbar(drawn, ax=axes, label="brightness")
    # The layout settles at the first drawing and then stays, so that nothing jumps.
    canvas.draw()
    figure.set_layout_engine("none")
    for picture, time in zip(front, video.times, strict=True):
        drawn.set_data(picture)
        axes.set_title(_format_title(time))
        canvas.draw()
        yield np.asarray(canvas.buffer_rgba())[..., :3].copy()


def _format_title(time: float) -> str:
    return f"{time / NANOSECOND:.2f} ns after the flash left the wall"
