"""The surface that photons of a picture show, in two steps.

1. On a coarse time axis: the most likely piecewise smooth one, by semi-global matching over eight
   directions (H. Hirschmueller, IEEE Trans. Pattern Anal. 30, 328, 2008), with log-matched filter
   responses as scores.
2. Below a bin: planes through the neighbours on the same surface, fitted to the likelihood of their
   photons by Fisher scoring, and what planes miss where it bends.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import scipy

from tofclip.arrays import BoolArray, Float32Array, FloatArray, IntArray
from tofclip.lidar.photons.image import PhotonImage
from tofclip.lidar.photons.scene import MIN_SIGNAL_PHOTONS, Scene, group_shades
from tofclip.threads import run_blocks

LABELS_PER_WIDTH = 2  # coarse bins in the full width of the response
# Memory of the two volumes (pixels, labels) of float32, and of the tables of tiles before them; a longer
# axis gets coarser labels.
MAX_VOLUME_BYTES = 1 << 31
TILE_PX = 16
TILE_TABLES = 3  # of (tiles, coarse bins) float64 at once: counts, pooled sums, and a sorted copy
MIN_TILE_SIGNIFICANCE = 5.0  # above the background, where a tile says that some surface lies there
PIXELS_PER_BLOCK, ROWS_PER_BLOCK = 1 << 14, 16
JUMP_COST_RATIO = 9.0  # a change by several labels costs this many times as much as one by one

PLANE_ROUNDS = 5
TRIAL_ROUNDS = 3  # of a reach that is tried, from the fit of the reach before
# A curved surface pulls a plane by the square of its reach: what a plane of half the reach differs by is
# three quarters of what both miss.
NESTED_BIAS_RATIO = 4 / 3
# Of a variance, between what a square of chance alone has as median (.455) and as mean (1), as the bias of a
# neighbourhood is neither everywhere nor nowhere.
CHANCE_SHARE = 0.7
GATE_WIDTHS = 1.0  # of the response: a neighbour whose surface is further off is another's


@dataclass(frozen=True)
class LabelAxis:
    """The instants on which a surface is looked for."""

    coarse: int  # bins of a coarse one
    numbers: IntArray  # (labels,), coarse bins that are labels
    coarse_bins: int  # coarse bins of the whole axis

    def number_events(self, photons: PhotonImage) -> IntArray:
        """Return the coarse bin of each event."""
        return ((photons.bin + 0.5) / self.coarse).astype(np.int64)


def choose_label_axis(photons: PhotonImage, scene: Scene) -> LabelAxis:
    """Cut the time axis into labels and leave out those at which nothing comes back anywhere."""
    tiles = math.prod(-(-length // TILE_PX) for length in photons.image_shape)
    coarse = max(1, round(scene.response.width / LABELS_PER_WIDTH))
    while True:
        total = int(np.ceil((photons.bins + 1) / coarse))
        if TILE_TABLES * 8 * tiles * total <= MAX_VOLUME_BYTES:
            axis = LabelAxis(coarse, np.arange(total), total)
            numbers = np.flatnonzero(_find_occupied_bins(photons, scene, axis, tiles))
            axis = LabelAxis(coarse, numbers, total) if numbers.size else axis
            # two float32 volumes, the scores and their sums, have to fit
            if 2 * 4 * photons.pixels * axis.numbers.size <= MAX_VOLUME_BYTES:
                return axis
        coarse *= 2


def _find_occupied_bins(
    photons: PhotonImage, scene: Scene, axis: LabelAxis, tiles: int
) -> BoolArray:
    """Coarse bins, and those around, at which some tile of the picture is above the background."""
    y, x = np.divmod(photons.pixel, photons.image_shape[1])
    tile = (y // TILE_PX) * -(-photons.image_shape[1] // TILE_PX) + x // TILE_PX
    number = tile * axis.coarse_bins + axis.number_events(photons)
    light = photons.count / photons.relative
    counts = np.bincount(number, light, tiles * axis.coarse_bins).reshape(tiles, -1)
    length = max(1, round(scene.response.width / axis.coarse))
    pooled = scipy.ndimage.uniform_filter1d(counts, length, axis=1, mode="constant") * length
    # A tile may be brighter or darker than the others throughout.
    level = np.minimum(np.quantile(counts, 0.5, axis=1), counts.mean(axis=1))
    dark = scene.background * TILE_PX**2 * axis.coarse
    expected = length * np.where(level > 0, level, dark)
    limit = expected + MIN_TILE_SIGNIFICANCE * np.sqrt(expected) + 2
    occupied = np.any(pooled > limit[:, np.newaxis], axis=0)
    return scipy.ndimage.binary_dilation(occupied, iterations=2 * LABELS_PER_WIDTH)


def compute_scores(photons: PhotonImage, scene: Scene, axis: LabelAxis) -> Float32Array:
    """Log-likelihood ratio of a surface at each label against none, (pixels, labels)."""
    from tofclip.lidar.photons import kernels

    shares, first = scene.response.coarse_shares(axis.coarse)
    odds = scene.count_signal(photons) * shares / (scene.background * axis.coarse)
    level, shade = group_shades(photons.relative)
    weights = np.log1p(odds / level[:, np.newaxis]).astype(np.float32)
    score = np.empty((photons.pixels, axis.numbers.size), np.float32)
    number, label = axis.number_events(photons), np.full(axis.coarse_bins, -1)
    label[axis.numbers] = np.arange(axis.numbers.size)

    def work(piece: slice) -> None:
        offsets = photons.offsets[piece.start : piece.stop + 1]
        kernels.score_labels(
            offsets, number, photons.count, label, weights, shade, first, score[piece]
        )

    run_blocks(work, score.shape[0], PIXELS_PER_BLOCK)
    return score


def match_labels(
    score: Float32Array, axis: LabelAxis, image_shape: tuple[int, int], slope_cost: float
) -> tuple[FloatArray, Float32Array]:
    """Find the most likely piecewise smooth surface, instants (rows, columns) in bins, and by how much
    the label of each beats the next best that is not beside it. The cost is of a change by one label.
    """
    from tofclip.lidar.photons import kernels

    cube = score.reshape(*image_shape, -1)
    total = np.zeros_like(cube)
    costs = np.float32(slope_cost), np.float32(slope_cost * JUMP_COST_RATIO)
    kernels.add_path_scores(cube, *costs, total)
    kernels.add_path_scores(cube[::-1, ::-1], *costs, total[::-1, ::-1])
    label, margin = np.empty(score.shape[0], np.int64), np.empty(score.shape[0], np.float32)
    summed, apart = total.reshape(score.shape), 2 * LABELS_PER_WIDTH

    def work(piece: slice) -> None:
        own = score[piece], summed[piece], np.float32(7), apart
        kernels.find_best_labels(*own, label[piece], margin[piece])

    run_blocks(work, score.shape[0], PIXELS_PER_BLOCK)
    # in the middle of labels
    surface = (axis.numbers[label] + 0.5) * axis.coarse - 0.5
    return surface.reshape(image_shape).astype(np.float64), margin.reshape(image_shape)


def match_photons(
    photons: PhotonImage, scene: Scene, axis: LabelAxis, slope_cost: float
) -> tuple[FloatArray, Float32Array]:
    """As `match_labels`, of the scores that photons give."""
    score = compute_scores(photons, scene, axis)
    return match_labels(score, axis, photons.image_shape, slope_cost)


def fit_surface(
    photons: PhotonImage, scene: Scene, surface: FloatArray, reach: int, rounds: int = PLANE_ROUNDS
) -> FloatArray:
    """Move a surface, (rows, columns) in bins, to the likelihood's maximum, plane by plane. Pixels
    up to `reach` away share a plane. Returns (rows, columns, 3): instant, deviation, and mean
    photons of these pixels, or the pixel's own where cycles end with their first photon.
    """
    from tofclip.lidar.photons import kernels

    response, now = scene.response, np.array(surface, dtype=np.float64)
    all_counted = np.isinf(photons.cycles)
    table = np.stack([response.log_slope, response.density / scene.background], axis=1)
    brightness = around = np.full(now.size, scene.count_signal(photons))
    slopes, gate = np.zeros((*now.shape, 2)), GATE_WIDTHS * response.width
    sums, fitted = np.empty((now.size, 4)), np.empty((*now.shape, 3))

    def measure(piece: slice) -> None:
        offsets, flat = photons.offsets[piece.start : piece.stop + 1], now.reshape(-1)[piece]
        sampled = table, response.start, response.step, brightness[piece]
        seen = offsets, photons.bin, photons.count, flat, *sampled
        if all_counted:
            kernels.measure_events(*seen, photons.relative, sums[piece])
        else:
            dead = around[piece], scene.background / photons.cycles, photons.cycles
            kernels.measure_first_photons(*seen, *dead, sums[piece])

    def fit(piece: slice) -> None:
        around = sums.reshape(*now.shape, -1)
        kernels.fit_planes(now, around, reach, gate, slopes, (piece.start, piece.stop), fitted)

    # signal and instant say something of each other where cycles end with the first photon
    for _ in range(rounds if all_counted else 4 * rounds):
        run_blocks(measure, now.size, PIXELS_PER_BLOCK)
        run_blocks(fit, now.shape[0], ROWS_PER_BLOCK)
        now = fitted[..., 0].copy()
        brightness = around = np.maximum(fitted[..., 2].ravel(), MIN_SIGNAL_PHOTONS)
        if not all_counted:
            weight = kernels.NEIGHBOURS_PHOTONS / around
            brightness = (sums[:, 2] + weight * around) / (sums[:, 3] + weight)
    if not all_counted:
        fitted[..., 2] = brightness.reshape(now.shape)
    return fitted


def estimate_bias(fitted: FloatArray, nested: FloatArray, reach: int, width: float) -> FloatArray:
    """Mean square, in bins, of what planes miss where a surface bends, (rows, columns).

    Two estimates, here with a reach and with half of it, of which one uses a part of the other's
    photons differ by the difference of their variances if neither is biased; what they differ by
    beyond that is bias. Of a neighbourhood the median counts: a mean is ruled by its borders.
    """
    apart = (fitted[..., 0] - nested[..., 0]) ** 2
    wide, narrow = fitted[..., 1] ** 2, nested[..., 1] ** 2
    # Where a fit is less sure than the response's width nothing is known.
    known = np.maximum(wide, narrow) < width**2
    excess = np.zeros(apart.shape)
    excess[known] = apart[known] - CHANCE_SHARE * (narrow[known] - wide[known])
    usual = scipy.ndimage.median_filter(excess, 2 * reach + 1, mode="nearest")
    return NESTED_BIAS_RATIO**2 * np.maximum(usual, 0)
