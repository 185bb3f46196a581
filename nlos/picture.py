"""The picture of a volume, three views and a depth map, and the film of a transient video, its front
view at every instant, both with axes in metres.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from nlos.video import TransientVideo
from nlos.volume import Volume
from tofclip.arrays import AnyArray, FloatArray
from tofclip.files import PICTURE_SUFFIXES, atomic_path, require_suffix
from tofclip.notebook import letter_panels, save_figure
from tofclip.units import MILLIMETRE, NANOSECOND

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.image import AxesImage


# The depth map shows columns whose brightest voxel has at least this fraction of the brightest about
# its depth, by so many voxels, and that of the volume's: a thing behind a brighter one is shown too.
DEPTH_THRESHOLD, NEIGHBOUR_VOXELS, MIN_DEPTH_BRIGHTNESS = 0.4, 8, 0.25
COLOUR_MAP = "inferno"
DEPTH_COLOUR_MAP = "viridis"
# Of the colours' scale: a flat thing whose depths are one voxel apart would look like steps.
MIN_DEPTH_SPAN_VOXELS = 8
WIDTH_INCHES, HEADER_INCHES, FONT_PT = 11.0, 1.0, 8
DOTS_PER_INCH = 110
# Bounds of a panel's side relative to the scene's width, so that flat and deep boxes stay legible.
MIN_PANEL_RATIO, MAX_PANEL_RATIO = 0.3, 2.0


def save_picture(volume: Volume, path: str | Path) -> None:
    """Draw front, side and top view and a depth map into a file; the front looks along +z, y down,
    the side view has the wall at its left edge, the top view at its upper edge.
    """
    require_suffix(path, *PICTURE_SUFFIXES)  # before the drawing
    save_figure(_draw_figure(volume), path)


def _draw_figure(volume: Volume) -> Figure:
    # A bare figure draws with Agg and leaves the caller's pyplot alone.
    from matplotlib import rc_context
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

    edges = [_find_edges(axis) for axis in (volume.grid.x, volume.grid.y, volume.grid.z)]
    lengths = np.array([last - first for first, last in edges])
    width, height, depth = np.clip(lengths / lengths[0], MIN_PANEL_RATIO, MAX_PANEL_RATIO)
    # Of a flat box all views stand in a row; of a deep one the top view stands below the front.
    columns = [width, depth, width, width] if depth < width else [width, depth]
    rows = [height] if depth < width else [height, depth]
    size = (WIDTH_INCHES, WIDTH_INCHES * sum(rows) / sum(columns) + HEADER_INCHES)
    with rc_context({"font.size": FONT_PT}):
        figure = Figure(figsize=size, dpi=DOTS_PER_INCH, layout="constrained")
        panels = figure.subplots(
            len(rows), len(columns), squeeze=False, width_ratios=columns, height_ratios=rows
        )
        front, side, top, depth_map = panels.ravel()
        bar: dict[str, Any] = {"location": "bottom", "shrink": 0.8}
        views = [front, side, top] if len(rows) == 1 else [front, top]
        x, y, z = volume.grid.x, volume.grid.y, volume.grid.z
        seen, down = volume.magnitude, "y (m), down"
        seen = seen / (seen.max() or 1.0)
        _draw_picture(side, "side: wall left", seen.max(axis=2).T, (z, y), ("z (m)", down))
        _draw_picture(top, "top: wall above", seen.max(axis=1), (x, z), ("x (m)", "z (m)"))
        title, labels = "front: from the wall", ("x (m)", down)
        drawn = _draw_picture(front, title, seen.max(axis=0), (x, y), labels)
        figure.colorbar(drawn, ax=views, label="relative brightness", aspect=30, **bar)
        title = f"depth above {DEPTH_THRESHOLD:.0%} of its layers' peak"
        drawn = _draw_picture(depth_map, title, map_depths(volume), (x, y), labels, None)
        drawn.set_cmap(DEPTH_COLOUR_MAP)
        nearest, furthest = drawn.get_clim()
        if nearest is not None and furthest is not None:
            middle, voxel = (nearest + furthest) / 2, float(z[-1] - z[0]) / max(z.size - 1, 1)
            reach = max(furthest - nearest, MIN_DEPTH_SPAN_VOXELS * voxel) / 2
            drawn.set_clim(middle - reach, middle + reach)
        others = [depth_map] if len(rows) == 1 else [side, depth_map]
        figure.colorbar(drawn, ax=others, label="z (m)", ticks=MaxNLocator(4), **bar)
        figure.suptitle(_describe_imaging(volume))
        letter_panels((front, side, top, depth_map))
    return figure


def _describe_imaging(volume: Volume) -> str:
    """Method, wavelength and size of the voxels, as far as they are known."""
    past = volume.provenance
    while "imaging" not in past and isinstance(past.get("earlier"), Mapping):
        past = past["earlier"]
    past = past.get("imaging", {})
    said = [str(past["method"])] if "method" in past else []
    if past.get("wavelength_m"):
        said.append(f"wavelength {1e3 * past['wavelength_m']:.3g} mm")
    if volume.grid.x.size > 1:
        said.append(f"voxels of {1e3 * np.diff(volume.grid.x).mean():.3g} mm")
    if widths := past.get("resolution_m"):
        size = " x ".join(f"{widths[axis] / MILLIMETRE:.0f}" for axis in "xyz")
        said.append(f"a point appears {size} mm wide (x, y, z)")
    return ", ".join(said)


def map_depths(volume: Volume) -> FloatArray:
    """Depth of every column's brightest voxel (y, x), m; NaN where that is weak at its depth."""
    from scipy.ndimage import maximum_filter1d

    projection, layers = volume.maximum_projection(), volume.magnitude.max(axis=(1, 2))
    about = maximum_filter1d(layers, 2 * NEIGHBOUR_VOXELS + 1)
    least = np.maximum(DEPTH_THRESHOLD * about, MIN_DEPTH_BRIGHTNESS * layers.max())
    own = least[np.searchsorted(volume.grid.z, projection.depth)]
    return np.where(projection.brightness < own, np.nan, projection.depth)


def _draw_picture(
    axes: Axes,
    title: str,
    picture: AnyArray,
    coordinates: tuple[FloatArray, FloatArray],
    labels: tuple[str, str],
    brightest: float | None = 1.0,
) -> AxesImage:
    """Draw a picture (rows, columns), its first coordinate to the right, the second downwards."""
    lowest, edges = None if brightest is None else 0.0, compute_extent(*coordinates)
    drawn = axes.imshow(
        picture, COLOUR_MAP, vmin=lowest, vmax=brightest, extent=edges, interpolation="nearest"
    )
    axes.set(title=title, xlabel=labels[0], ylabel=labels[1])
    return drawn


def compute_extent(right: FloatArray, down: FloatArray) -> tuple[float, float, float, float]:
    """Left, right, lower and upper edge of a picture with axes right and down, m."""
    return (*_find_edges(right), *_find_edges(down)[::-1])


def _find_edges(axis: FloatArray) -> tuple[float, float]:
    """Outer edges of the first and the last voxel, m; a single voxel gets 1 mm."""
    half = (axis[-1] - axis[0]) / (2 * (axis.size - 1)) if axis.size > 1 else 0.5e-3
    return float(axis[0] - half), float(axis[-1] + half)


FIGURE_SIZE_INCHES = (5.6, 5.0)
FILM_DOTS_PER_INCH = 80
FRAME_DURATION_MS, LAST_FRAME_DURATION_MS = 80, 1000


def save_film(video: TransientVideo, path: str | Path) -> None:
    """Write a GIF that looks along +z from the wall, y down, of one scale; 0.2 MB of memory each."""
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
    figure = Figure(figsize=FIGURE_SIZE_INCHES, dpi=FILM_DOTS_PER_INCH, layout="constrained")
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
