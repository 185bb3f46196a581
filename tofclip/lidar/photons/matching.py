"""The instant of each pixel's surface on a coarse time axis: the most likely piecewise smooth one, by
semi-global matching (H. Hirschmueller, IEEE Trans. Pattern Anal. 30, 328, 2008), with log-matched
filter responses as scores.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from tofclip.lidar.photons.image import FloatArray, PhotonImage
from tofclip.lidar.photons.response import Scene
from tofclip.threads import run_blocks

LABELS_PER_WIDTH = 2
"""Coarse bins in the full width of the response."""

MAX_VOLUME_BYTES = 1 << 31
"""Memory of the two volumes (pixels, labels) of float32, and of the tables of tiles before them; a
longer axis gets coarser labels."""

JUMP_COST_RATIO = 7.0
"""Any larger change costs this many times as much."""

TILE_PX = 16

TILE_TABLES = 3
"""Of (tiles, coarse bins) float64 at once: counts, their pooled sums, and a copy that is sorted."""

MIN_TILE_SIGNIFICANCE = 5.0
"""Standard deviations above the background at which a tile of the picture says that some surface
lies at an instant."""

PIXELS_PER_BLOCK = 1 << 14


@dataclass(frozen=True)
class LabelAxis:
    """The instants on which a surface is looked for."""

    coarse: int  # bins of a coarse one
    numbers: NDArray[np.int64]  # (labels,), coarse bins that are labels
    coarse_bins: int  # coarse bins of the whole axis

    def number_events(self, photons: PhotonImage) -> NDArray[np.int64]:
        """Return the coarse bin of each event."""
        return ((photons.bin + 0.5) / self.coarse).astype(np.int64)

    @property
    def places(self) -> NDArray[np.int64]:
        """Label of each coarse bin, or -1."""
        places = np.full(self.coarse_bins, -1)
        places[self.numbers] = np.arange(self.numbers.size)
        return places

    def to_bins(self, label: NDArray[np.int64]) -> FloatArray:
        """Return the instants in the middle of labels, in bins."""
        return np.asarray((self.numbers[label] + 0.5) * self.coarse - 0.5, dtype=np.float64)


def choose_label_axis(photons: PhotonImage, scene: Scene) -> LabelAxis:
    """Cut the time axis into labels and leave out those at which nothing comes back anywhere."""
    pixels = photons.offsets.size - 1
    coarse = max(1, round(scene.response.width / LABELS_PER_WIDTH))
    while True:
        total = int(np.ceil((photons.bins + 1) / coarse))
        if TILE_TABLES * 8 * count_tiles(photons.image_shape) * total > MAX_VOLUME_BYTES:
            coarse *= 2
            continue
        axis = LabelAxis(coarse, np.arange(total), total)
        numbers = np.flatnonzero(find_occupied_bins(photons, scene, axis))
        if numbers.size == 0:
            numbers = np.arange(total)
        if 2 * 4 * pixels * numbers.size <= MAX_VOLUME_BYTES:
            return LabelAxis(coarse, numbers, total)
        # two float32 volumes, the scores and their sums, have to fit
        coarse *= 2


def count_tiles(image_shape: tuple[int, int]) -> int:
    """Number of tiles that cover a picture."""
    return math.prod(-(-length // TILE_PX) for length in image_shape)


def find_occupied_bins(photons: PhotonImage, scene: Scene, axis: LabelAxis) -> NDArray[np.bool_]:
    """Coarse bins at which some tile of the picture is brighter than the background, and those
    around.

    `scene`: response and background, photons per pixel and bin; `axis`: the coarse time axis.
    Returns (coarse_bins,).
    """
    columns = photons.image_shape[1]
    y, x = np.divmod(photons.pixel, columns)
    across = -(-columns // TILE_PX)
    tiles = count_tiles(photons.image_shape)
    tile = (y // TILE_PX) * across + x // TILE_PX
    number = tile * axis.coarse_bins + axis.number_events(photons)
    counts = np.bincount(number, photons.count, tiles * axis.coarse_bins)
    counts = counts.reshape(tiles, axis.coarse_bins)
    length = max(1, round(scene.response.width / axis.coarse))
    pooled = scipy.ndimage.uniform_filter1d(counts, length, axis=1, mode="constant") * length
    # A tile may be brighter or darker than the others throughout.
    level = np.minimum(np.quantile(counts, 0.5, axis=1), counts.mean(axis=1))
    expected = length * np.maximum(
        level, scene.background * TILE_PX**2 * axis.coarse * (level == 0)
    )
    limit = expected + MIN_TILE_SIGNIFICANCE * np.sqrt(expected) + 2
    occupied = np.any(pooled > limit[:, np.newaxis], axis=0)
    return np.asarray(scipy.ndimage.binary_dilation(occupied, iterations=2 * LABELS_PER_WIDTH))


def compute_scores(photons: PhotonImage, scene: Scene, axis: LabelAxis) -> NDArray[np.float32]:
    """Log-likelihood ratio of a surface at each label against none, (pixels, labels).

    Returns (pixels, labels).
    """
    from tofclip.lidar.photons import surface_kernels as kernels

    shares, first = scene.response.coarse_shares(axis.coarse)
    odds = scene.count_signal(photons) * shares / (scene.background * axis.coarse)
    weights = np.log1p(odds).astype(np.float32)
    score = np.empty((photons.offsets.size - 1, axis.numbers.size), np.float32)
    number, places = axis.number_events(photons), axis.places

    def work(piece: slice) -> None:
        kernels.score_labels(
            photons.offsets[piece.start : piece.stop + 1],
            number,
            photons.count,
            places,
            weights,
            first,
            score[piece],
        )

    run_blocks(work, score.shape[0], PIXELS_PER_BLOCK)
    return score


def match_labels(
    score: NDArray[np.float32], image_shape: tuple[int, int], slope_cost: float
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Find the labels of the most likely piecewise smooth surface.

    `score` (pixels, labels); `slope_cost`: for a change by one label; others cost `JUMP_COST_RATIO`
    times as much. Returns (rows, columns): labels, and by how much each beats the next best that is
    not beside it.
    """
    from tofclip.lidar.photons import surface_kernels as kernels

    cube = score.reshape(*image_shape, -1)
    total = np.zeros_like(cube)
    costs = np.float32(slope_cost), np.float32(slope_cost * JUMP_COST_RATIO)
    kernels.add_path_scores(cube, *costs, total)
    kernels.add_path_scores(cube[::-1, ::-1], *costs, total[::-1, ::-1])
    label, margin = np.empty(score.shape[0], np.int64), np.empty(score.shape[0], np.float32)
    summed = total.reshape(score.shape)
    apart = 2 * LABELS_PER_WIDTH

    def work(piece: slice) -> None:
        kernels.find_best_labels(
            score[piece], summed[piece], np.float32(7), apart, label[piece], margin[piece]
        )

    run_blocks(work, score.shape[0], PIXELS_PER_BLOCK)
    return label.reshape(image_shape), margin.reshape(image_shape)
