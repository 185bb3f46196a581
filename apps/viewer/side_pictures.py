"""Flat pictures beside the scene: streak image, intensity, depth."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from apps.viewer.colouring import PALETTE_SIZE, Scale, load_palette
from tofclip.lidar import PointCloud

WHITE_PERCENTILE = 99.7  # percent: a glint does not darken the rest
GAMMA = 0.6  # far objects stay visible beside near ones
EMPTY_COLOUR = (32, 36, 44)
FRONT_SIDE_PX = 128
MAX_SIDE_PX = 420
MIN_SIDE_PX = 200

Picture = NDArray[np.float32]
Image = NDArray[np.uint8]


def render_pictures(pictures: Mapping[str, Picture], scale: Scale) -> dict[str, Image]:
    """Turn pictures into images of a handy size.

    `pictures`: ``"depth"`` is in m, NaN where there is nothing; all others are brightness; `scale`:
    the scene's colours.
    """
    return {
        name: resize_image(
            colour_depth(picture, scale)
            if name == "depth"
            else colour_brightness(
                picture, scale.palette if scale.quantity == "intensity" else "grey"
            )
        )
        for name, picture in pictures.items()
    }


def project_front(cloud: PointCloud) -> dict[str, Picture]:
    """Return intensity and depth as seen from the origin along z, 128 x 128, of a cloud that has no
    camera.
    """
    if len(cloud) == 0:
        empty = np.full((FRONT_SIDE_PX, FRONT_SIDE_PX), np.nan, np.float32)
        return {"intensity": np.zeros_like(empty), "depth": empty}
    low, high = np.percentile(cloud.xyz[:, :2], (0.5, 99.5), axis=0)
    middle, width = (low + high) / 2, max(float((high - low).max()), 1e-6)
    place = np.rint(((cloud.xyz[:, :2] - middle) / width + 0.5) * (FRONT_SIDE_PX - 1)).astype(
        np.intp
    )
    inside = np.flatnonzero(np.all((place >= 0) & (place < FRONT_SIDE_PX), axis=1))
    order = inside[np.argsort(-cloud.xyz[inside, 2], kind="stable")]  # the nearest is written last
    depth = np.full((FRONT_SIDE_PX, FRONT_SIDE_PX), np.nan, np.float32)
    light = np.zeros_like(depth)
    column, row = place[order].T
    depth[row, column], light[row, column] = cloud.xyz[order, 2], cloud.intensity[order]
    _close_seams(depth, light)
    return {"intensity": light, "depth": depth}


def _close_seams(depth: Picture, light: Picture) -> None:
    """Fill, in place, empty pixels between two seen ones of a row or a column: a camera with fewer
    pixels than the picture leaves such seams.
    """
    for deep, bright in ((depth, light), (depth.T, light.T)):
        before, here, after = deep[:-2], deep[1:-1], deep[2:]
        seam = np.isnan(here) & np.isfinite(before) & np.isfinite(after)
        nearer = before <= after
        here[seam] = np.where(nearer, before, after)[seam]
        bright[1:-1][seam] = np.where(nearer, bright[:-2], bright[2:])[seam]


def colour_brightness(picture: Picture, palette: str) -> Image:
    """Colour a picture by its brightness, negative values as dark.

    `picture` (rows, columns). Returns (rows, columns, 3).
    """
    light = np.maximum(np.nan_to_num(picture), 0)
    top = float(np.percentile(light, WHITE_PERCENTILE)) or float(light.max()) or 1.0
    toned = np.clip(light / np.float32(top), 0, 1) ** np.float32(GAMMA)
    return load_palette(palette)[(255 * toned).astype(np.intp)]


def colour_depth(picture: Picture, scale: Scale) -> Image:
    """Colour a picture of distances; NaN becomes a dark grey.

    `picture` (rows, columns): metres; `scale`: taken where it is one of ranges; else the colours
    run from the 1st to the 99th percentile. Returns (rows, columns, 3).
    """
    image = np.empty((*picture.shape, 3), np.uint8)
    image[:] = EMPTY_COLOUR
    there = np.isfinite(picture)
    if there.any():
        if scale.quantity != "range":
            low, high = np.percentile(picture[there], (1, 99))
            scale = Scale(
                "range", "m", scale.palette, np.linspace(low, max(high, low + 1e-9), PALETTE_SIZE)
            )
        image[there] = scale.colours(picture[there])
    return image


def resize_image(image: Image) -> Image:
    """Shrink a large image by taking every n-th pixel, enlarge a small one by repeating its pixels."""
    steps = [max(1, -(-side // MAX_SIDE_PX)) for side in image.shape[:2]]
    thinned = image[:: steps[0], :: steps[1]]
    times = max(1, MIN_SIDE_PX // max(thinned.shape[:2]))
    return np.ascontiguousarray(thinned.repeat(times, axis=0).repeat(times, axis=1))
