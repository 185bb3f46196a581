"""Ranges of pixels that caught too few photons to stand alone: neighbours lend theirs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tofclip.errors import InputError, ShapeError
from tofclip.lidar.photons.detector import Arrivals, FloatArray, PhotonDetector


@dataclass(frozen=True)
class Smoothness:
    """How much neighbouring pixels have to agree.

    Parameters
    ----------
    slope_cost : float
        Log-likelihood that a change by one bin from pixel to pixel has to bring.
    jump_cost : float
        Log-likelihood that any larger change has to bring: borders of objects stay sharp.
    reach_px : int
        Photons of neighbours up to so far away are pooled, if they lie on the same surface.

    Raises
    ------
    InputError
        Costs that are negative or a jump that is cheaper than a slope; a negative reach.
    """

    slope_cost: float = 1.0
    jump_cost: float = 6.0
    reach_px: int = 1

    def __post_init__(self) -> None:
        if not 0 <= self.slope_cost <= self.jump_cost < np.inf or self.reach_px < 0:
            raise InputError(
                "slope and jump cost must not be negative, the jump not cheaper, the reach not negative"
            )


def locate_with_smoothness(
    detector: PhotonDetector, counts: ArrayLike, smoothness: Smoothness | None = None
) -> Arrivals:
    """Find one return for every pixel of a picture, with the help of its neighbours.

    The bins are those of the most likely piecewise smooth surface (semi-global matching over four
    directions, with log-matched filter responses as scores); then the photons of neighbours on the
    same surface are summed, moved to the pixel's bin, and the Poisson likelihood of the sum is
    maximised. Every pixel gets a return: `confidence`, the Cramer-Rao bound of the pooled photons,
    says what it is worth. Neighbours share photons, so their errors are alike.

    Parameters
    ----------
    detector : PhotonDetector
    counts : (rows, columns, bins) array
        Photons counted.
    smoothness : Smoothness, optional

    Returns
    -------
    Arrivals
        Arrays of (rows * columns, 1), in raster order; photons are those of an average contributor.

    Raises
    ------
    ShapeError, InputError
        No cube, or counts that are negative or not finite.

    Notes
    -----
    H. Hirschmueller, "Stereo processing by semiglobal matching and mutual information", IEEE Trans.
    Pattern Anal. 30, 328 (2008). Memory: four float64 copies of `counts`.
    """
    from tofclip.lidar.photons.kernels import pool_neighbours

    smoothness = Smoothness() if smoothness is None else smoothness
    cube = np.asarray(counts, dtype=np.float64)
    if cube.ndim != 3 or cube.shape[2] != detector.bins:
        raise ShapeError("counts", f"(rows, columns, {detector.bins})", cube.shape)
    cube = detector.validate_histograms(cube.reshape(-1, detector.bins)).reshape(cube.shape)
    label = find_surface(detector, cube, smoothness)
    pooled, contributors = np.empty_like(cube), np.empty(label.shape, np.int64)
    pool_neighbours(cube, label, smoothness.reach_px, 1, pooled, contributors)
    one = np.ones(label.size, np.int64)
    found = detector.refine(pooled.reshape(-1, detector.bins), label.reshape(-1, 1), one)
    return Arrivals(found.range, found.photons / contributors.reshape(-1, 1), found.confidence)


def find_surface(
    detector: PhotonDetector, cube: FloatArray, smoothness: Smoothness
) -> NDArray[np.int64]:
    """Bin of each pixel's return on the most likely piecewise smooth surface, (rows, columns).

    Semi-global matching along the four directions of rows and columns (H. Hirschmueller, IEEE TPAMI
    30, 328, 2008).

    `detector`: gives the filter's weights; `cube` (rows, columns, bins): photons; `smoothness`:
    costs of a slope and of a jump. Returns (rows, columns).
    """
    from tofclip.lidar.photons.kernels import add_path_scores, compute_scores

    filtering = detector.weights(max(float(cube.mean()), 1 / cube.size)), detector.first_offset
    score, total = np.empty_like(cube), np.zeros_like(cube)
    compute_scores(cube.reshape(-1, detector.bins), *filtering, score.reshape(-1, detector.bins))
    for turned, sum_turned in ((score, total), (score.swapaxes(0, 1), total.swapaxes(0, 1))):
        for way in (slice(None), slice(None, None, -1)):
            add_path_scores(
                turned[way], smoothness.slope_cost, smoothness.jump_cost, sum_turned[way]
            )
    label: NDArray[np.int64] = (
        (total - 3 * score).argmax(axis=2).astype(np.int64)
    )  # each path counted the pixel itself
    return label
