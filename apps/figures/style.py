"""What all pictures and films have in common: sizes, colours, labelled axes, and writing that is all or
nothing.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import PowerNorm
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from numpy.typing import NDArray
from PIL import Image

from tofclip.arrays import AnyArray, FloatArray
from tofclip.errors import MissingDependencyError, StorageError
from tofclip.files import DISK_IS_FULL, atomic_path
from tofclip.units import NANOSECOND

BRIGHTNESS_COLOURMAP = "inferno"
DEPTH_COLOURMAP = "viridis"
EMPTY_COLOUR = "#20242c"  # where a picture has no value
LINE_COLOUR = "#3dd6c8"  # drawn over a brightness map
SMALL_FONT_PT = 8
WHITE_PERCENTILE = 99.5  # percent: a glint does not darken the rest
SHOWN_PERCENTILES = (1.0, 99.0)  # percent of the pixels that span the colours
DOTS_PER_INCH = 100  # on a screen
PAGE_WIDTH_PX = 1300
# Colours of pictures with more bytes; 0: all, without transparency. 256 make a quarter of the
# bytes, off by less than 16 of 255 anywhere; 64 are enough for the greys of many small pictures.
FEWER_COLOURS = {150_000: 0, 290_000: 256, 600_000: 64}


# what ticks and labels take at the left, right, bottom and top of a panel
LABEL_ROOM_INCHES = (0.6, 0.12, 0.45, 0.3)


def make_figure(width: float, height: float) -> Figure:
    """Make an empty figure, in inches; it draws with Agg, without a display or pyplot."""
    return Figure(figsize=(width, height), dpi=DOTS_PER_INCH, layout="constrained")


def add_panels(
    figure: Figure,
    rows: int,
    columns: int,
    band: tuple[float, float],
    room: tuple[float, float, float, float] = LABEL_ROOM_INCHES,
) -> AnyArray:
    """Put a grid of panels, (rows, columns), across a figure, at places known beforehand.

    To search for places that fit around the labels takes longer than to draw a figure of many
    panels; with this the figure's own search is off.

    `band`: where the grid begins and ends, inches from the top of the figure; `room` (left, right,
    bottom, top): inches that ticks and labels take around each panel.
    """
    figure.set_layout_engine(None)
    width, height = figure.get_size_inches()
    left, right, bottom, top = room
    place = {
        "left": left / width,
        "right": 1 - right / width,
        "bottom": 1 - (band[1] - bottom) / height,
        "top": 1 - (band[0] + top) / height,
        "wspace": (left + right) / (width / columns - left - right),
        "hspace": (bottom + top) / ((band[1] - band[0]) / rows - bottom - top),
    }
    return figure.subplots(rows, columns, squeeze=False, gridspec_kw=place)


def store_picture(picture: Path, place: Path) -> None:
    """Store a picture for a page, of a page's width and in `FEWER_COLOURS`."""
    drawn = picture.read_bytes()

    def compress(image: Image.Image) -> bytes:
        file = io.BytesIO()
        image.save(file, format="PNG", optimize=True)
        return file.getvalue()

    if picture.suffix.lower() == ".png":
        with Image.open(io.BytesIO(drawn)) as opened:
            whole = opened.convert("RGB")
        if whole.width > PAGE_WIDTH_PX:
            whole.thumbnail((PAGE_WIDTH_PX, PAGE_WIDTH_PX**2), Image.Resampling.LANCZOS)
            drawn = compress(whole)
        for most, colours in FEWER_COLOURS.items():
            if len(drawn) > most:
                look: Any = {"method": Image.Quantize.MAXCOVERAGE, "dither": Image.Dither.NONE}
                drawn = compress(whole.quantize(colours, **look) if colours else whole)
    with atomic_path(place) as temporary:
        temporary.write_bytes(drawn)


def draw_image(
    axes: Axes,
    picture: AnyArray,
    extent: tuple[float, float, float, float] | None = None,
    **look: Any,
) -> AxesImage:
    """Draw a picture, its pixels as squares; `extent`: left, right, bottom, top."""
    axes.set_facecolor(EMPTY_COLOUR)
    return axes.imshow(
        picture, extent=extent, **{"cmap": BRIGHTNESS_COLOURMAP, "interpolation": "nearest", **look}
    )


def label_axes(axes: Axes, title: str, x: str, y: str) -> None:
    """Set the title of a picture and the labels of its axes, with units."""
    # A place of its own, or matplotlib looks for free space above the ticks at every drawing.
    axes.set_title(title, fontsize=SMALL_FONT_PT + 2, y=1.0)
    axes.set_xlabel(x, fontsize=SMALL_FONT_PT)
    axes.set_ylabel(y, fontsize=SMALL_FONT_PT)
    axes.tick_params(labelsize=SMALL_FONT_PT)


def add_colour_bar(axes: Axes, mapped: Any, meaning: str) -> None:
    """Put a colour scale beside a picture, as high as it, labelled with its meaning and unit."""
    place = axes.inset_axes((1.03, 0.0, 0.04, 1.0))
    bar = axes.figure.colorbar(mapped, cax=place)
    bar.set_label(meaning, fontsize=SMALL_FONT_PT)
    bar.ax.tick_params(labelsize=SMALL_FONT_PT)


def outer_edges(axis: FloatArray) -> tuple[float, float]:
    """Outer edges of the first and last pixel of an even axis; a single one is a unit wide."""
    half = (axis[-1] - axis[0]) / (2 * (axis.size - 1)) if axis.size > 1 else 0.5
    return axis[0] - half, axis[-1] + half


def draw_camera_picture(
    axes: Axes, picture: AnyArray, title: str, meaning: str = "", **look: Any
) -> None:
    """Draw what a camera sees, with a colour scale beside it where its meaning is named."""
    drawn = draw_image(axes, picture, **look)
    label_axes(axes, title, "x (px)", "y (px), down")
    if meaning:
        add_colour_bar(axes, drawn, meaning)


def draw_spread_picture(
    axes: Axes,
    picture: AnyArray,
    title: str,
    meaning: str,
    least_span: float = 0.0,
    **look: Any,
) -> None:
    """Draw a pixel's own numbers; all but the outermost of them span the colours, from `vmin` where it
    is given, and at least `least_span`, or noise would look like a scene.
    """
    finite = picture[np.isfinite(picture)]
    if finite.size:
        low, high = np.percentile(finite, SHOWN_PERCENTILES)
        widen = max(0.0, least_span - (high - low)) / 2
        look = {"vmin": low - widen, "vmax": high + widen, **look}
    add_colour_bar(axes, draw_image(axes, picture, **look), meaning)
    label_axes(axes, title, "x (px)", "y (px), down")


def draw_streak(
    axes: Axes,
    picture: AnyArray,
    times: FloatArray,
    title: str,
    meaning: str,
    **look: Any,
) -> None:
    """Draw a streak image over the slit's columns and its time axis."""
    first, last = outer_edges(times / NANOSECOND)
    extent = (-0.5, picture.shape[1] - 0.5, last, first)
    drawn = draw_image(axes, picture, extent, aspect="auto", **look)
    label_axes(axes, title, "slit column (px)", "time axis (ns)")
    add_colour_bar(axes, drawn, meaning)


def scale_brightness(picture: AnyArray, gamma: float = 1.0) -> dict[str, Any]:
    """How a picture is shown whose few brightest pixels do not darken the rest; with a `gamma` below
    1 far things stay visible beside near ones, and the colour scale says so.
    """
    top = np.percentile(picture, WHITE_PERCENTILE) if picture.size else 0.0
    return {"norm": PowerNorm(gamma, 0, top if top > 0 else picture.max(initial=0) or 1.0)}


def scatter_points(
    axes: Axes, right: AnyArray, up: AnyArray, light: AnyArray, size: float = 1.5
) -> None:
    """Draw a cloud from one side, as bright as its points are, 0 to 1."""
    axes.set_facecolor(EMPTY_COLOUR)
    look: Any = {"cmap": BRIGHTNESS_COLOURMAP, "vmin": 0, "vmax": 1, "linewidths": 0}
    axes.scatter(right, up, c=light, s=size, **look)


def tone_map(picture: AnyArray, gamma: float = 1.0) -> AnyArray:
    """Scale brightness to 0..1 for the eye; a glint does not darken the rest."""
    top = (np.percentile(picture, WHITE_PERCENTILE) or picture.max() or 1.0) if picture.size else 1
    return np.clip(picture / top, 0, 1) ** gamma


CODEC = "vp09"  # free of licences, and every browser plays it


def import_opencv() -> Any:
    """Import OpenCV, or say where it is to be had."""
    try:
        import cv2
    except ImportError as fault:
        raise MissingDependencyError("films need OpenCV: pip install 'tofclip[film]'") from fault
    return cv2


@contextmanager
def open_film(out: Path, rate: float) -> Iterator[Callable[[NDArray[np.uint8]], None]]:
    """Yield what appends a picture (rows, columns, 3), red first, to a film of `rate` a second; all are
    of one size, and the file appears whole or not at all.
    """
    cv2, pictures, writer = import_opencv(), 0, None
    with atomic_path(out) as temporary:

        def add(pixels: NDArray[np.uint8]) -> None:
            nonlocal pictures, writer
            if writer is None:
                size, code = (pixels.shape[1], pixels.shape[0]), cv2.VideoWriter_fourcc(*CODEC)
                writer = cv2.VideoWriter(str(temporary), code, rate, size)
            if not writer.isOpened():
                raise StorageError(
                    f"no film can be begun: the disk is full, or this machine's OpenCV has no {CODEC}: write pictures"
                )
            writer.write(pixels[..., ::-1])
            pictures += 1

        try:
            yield add
        finally:
            if writer is not None:
                writer.release()
        # OpenCV says nothing of what it could not write: the last picture has to be there.
        film = cv2.VideoCapture(str(temporary))
        film.set(cv2.CAP_PROP_POS_FRAMES, pictures - 1)
        if not film.read()[0]:
            raise StorageError(f"{out}: cannot be written: {DISK_IS_FULL}")
