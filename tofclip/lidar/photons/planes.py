"""The instant of a surface below a bin: planes through the neighbours on it, fitted to the likelihood
of their photons by Fisher scoring, and what planes miss where it bends.
"""

from __future__ import annotations

import numpy as np
import scipy

from tofclip.lidar.photons.image import FloatArray, PhotonImage
from tofclip.lidar.photons.matching import PIXELS_PER_BLOCK
from tofclip.lidar.photons.response import MIN_SIGNAL_PHOTONS, Scene
from tofclip.threads import run_blocks

PLANE_ROUNDS = 5

TRIAL_ROUNDS = 3
"""Of a reach that is tried, from the fit of the reach before."""

NESTED_BIAS_RATIO = 4 / 3
"""A curved surface pulls a plane by the square of its reach: what a plane of half the reach differs
by is three quarters of what both miss."""

GATE_WIDTHS = 1.0
"""A neighbour whose surface is further off than this many widths of the response is another's."""

ROWS_PER_BLOCK = 16


def fit_surface(
    photons: PhotonImage,
    scene: Scene,
    surface: FloatArray,
    reach: int,
    rounds: int = PLANE_ROUNDS,
) -> FloatArray:
    """Move a surface to the likelihood's maximum, plane by plane.

    `surface` (rows, columns): instants to start from, in bins; `reach`: pixels up to this far away
    share a plane; `rounds`: steps of Fisher scoring. Returns (rows, columns, 3): see
    `surface_kernels.fit_planes`.
    """
    now = np.array(surface, dtype=np.float64)
    brightness = np.full(now.size, scene.count_signal(photons))
    slopes, gate = np.zeros((*now.shape, 2)), GATE_WIDTHS * scene.response.width
    fitted = np.empty((*now.shape, 3))
    for _ in range(rounds):
        sums = _measure_photons(photons, scene, now.ravel(), brightness).reshape(*now.shape, 3)
        _fit_planes(now, sums, reach, gate, slopes, fitted)
        now = fitted[..., 0].copy()
        brightness = np.maximum(fitted[..., 2].ravel(), MIN_SIGNAL_PHOTONS)
    return fitted


def _measure_photons(
    photons: PhotonImage, scene: Scene, surface: FloatArray, brightness: FloatArray
) -> FloatArray:
    """Slope and information of each pixel's likelihood, and its signal; see `measure_events`."""
    from tofclip.lidar.photons import surface_kernels as kernels

    response, sums = scene.response, np.empty((surface.size, 3))
    table = np.stack([response.log_slope, response.density / scene.background], axis=1)

    def work(piece: slice) -> None:
        kernels.measure_events(
            photons.offsets[piece.start : piece.stop + 1],
            photons.bin,
            photons.count,
            surface[piece],
            table,
            response.start,
            response.step,
            brightness[piece],
            sums[piece],
        )

    run_blocks(work, surface.size, PIXELS_PER_BLOCK)
    return sums


def _fit_planes(
    surface: FloatArray,
    sums: FloatArray,
    reach: int,
    gate: float,
    slopes: FloatArray,
    fitted: FloatArray,
) -> None:
    """Fit a plane around every pixel, `fitted` and `slopes` are overwritten; see `fit_planes`."""
    from tofclip.lidar.photons import surface_kernels as kernels

    def work(piece: slice) -> None:
        kernels.fit_planes(surface, sums, reach, gate, slopes, (piece.start, piece.stop), fitted)

    run_blocks(work, surface.shape[0], ROWS_PER_BLOCK)


def estimate_bias(fitted: FloatArray, nested: FloatArray, reach: int, width: float) -> FloatArray:
    """Mean square, in bins, of what planes miss where a surface bends, (rows, columns).

    Two estimates of which one uses a part of the other's photons differ by the difference of their
    variances if neither is biased; what they differ by beyond that is bias.

    `fitted, nested` (rows, columns, 3): fits of `reach` and of half of it; see `fit_surface`;
    `reach`: in pixels; `width`: full width of the response, bins. Where a fit is less sure than
    that, nothing is known. Returns (rows, columns): bins squared.
    """
    apart = (fitted[..., 0] - nested[..., 0]) ** 2
    wide, narrow = fitted[..., 1] ** 2, nested[..., 1] ** 2
    # A border that moved is not a bend.
    known = (np.maximum(wide, narrow) < width**2) & (apart < 25 * narrow)
    excess = np.zeros(apart.shape)
    excess[known] = (apart - narrow)[known] + wide[known]
    number = scipy.ndimage.uniform_filter(known.astype(float), 2 * reach + 1, mode="nearest")
    mean = scipy.ndimage.uniform_filter(excess, 2 * reach + 1, mode="nearest") / np.maximum(
        number, 1e-9
    )
    bias: FloatArray = NESTED_BIAS_RATIO**2 * np.maximum(mean, 0)
    return bias
