"""Hot pixels of a photon-counting detector: one bin far beyond all that the other pixels count.

Pairs of photons grow with the square of their number: one such pixel would say more about the
pulse than all others together. It is found before anything is learnt.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from tofclip.errors import InputError
from tofclip.lidar.photons.photon_image import FloatArray, PhotonImage

PEAK_RATIO = 20.0
"""Photons of a hot pixel's fullest bin over those of the usual pixel's fullest bin, over those of
the bins beside it, and over those of each neighbour at that time: light of a pulse is in several
bins, or a surface goes on in the next pixel."""

TOTAL_RATIO = 2.0
"""Photons of a hot pixel over those of a usual one; saves looking at the bins of all others."""

USUAL_QUANTILE = 0.9
"""Of the pixels: up to a tenth of them may be hot."""

SAMPLED_PIXELS = 4096
NEIGHBOUR_BINS = 2
"""By how many bins the same surface may lie earlier or later in the next pixel."""


@dataclass(frozen=True)
class BinTable:
    """Photons in the bins that are not empty."""

    place: NDArray[np.int64]  # (n,), pixel times the number of bins, plus the bin; ascending
    count: FloatArray  # (n,)
    bins: int  # bins of the time axis

    @classmethod
    def from_pixels(cls, photons: PhotonImage, chosen: NDArray[np.bool_]) -> BinTable:
        """Count the photons of some pixels.

        `chosen` (pixels,).
        """
        some = chosen[photons.pixel]
        whole = np.clip(np.rint(photons.bin[some]).astype(np.int64), 0, photons.bins - 1)
        place, event = np.unique(photons.pixel[some] * photons.bins + whole, return_inverse=True)
        count = np.bincount(event.ravel(), photons.count[some], place.size)
        return cls(place, count.astype(np.float64), photons.bins)

    def find_fullest(self, pixels: NDArray[np.int64]) -> tuple[NDArray[np.int64], FloatArray]:
        """Return the fullest bin of each of these pixels, and its photons."""
        pixel = self.place // self.bins
        order = np.lexsort((self.count, pixel))
        last = np.searchsorted(pixel, pixels, side="right") - 1
        held = np.maximum(last, 0)
        seen = (last >= 0) & (pixel[held] == pixels)
        fullest = order[held]
        return np.where(seen, self.place[fullest] % self.bins, 0), np.where(
            seen, self.count[fullest], 0.0
        )

    def count_at(self, pixels: NDArray[np.int64], number: NDArray[np.int64]) -> FloatArray:
        """Return the photons of these pixels in these bins."""
        sought = pixels * self.bins + number
        nearest = np.minimum(np.searchsorted(self.place, sought), self.place.size - 1)
        there = (self.place[nearest] == sought) & (number >= 0) & (number < self.bins)
        return np.where(there, self.count[nearest], 0.0)


def find_hot_pixels(photons: PhotonImage) -> NDArray[np.bool_]:
    """Say which pixels have one bin far beyond what the others count.

    Returns (rows, columns).
    """
    hot = np.zeros(photons.image_shape, np.bool_)
    total = photons.photons_per_pixel.ravel()
    usual_total = max(float(np.quantile(total, USUAL_QUANTILE)), 1.0)
    bright = np.flatnonzero(total > np.maximum(TOTAL_RATIO * usual_total, PEAK_RATIO))
    if not bright.size:
        return hot
    sampled = np.arange(0, total.size, -(-total.size // SAMPLED_PIXELS))
    chosen = np.zeros(total.size, np.bool_)
    chosen[sampled] = chosen[bright] = True
    table = BinTable.from_pixels(photons, chosen)
    usual = max(float(np.quantile(table.find_fullest(sampled)[1], USUAL_QUANTILE)), 1.0)
    number, peak = table.find_fullest(bright)
    kept = peak > PEAK_RATIO * usual
    bright, number, peak = bright[kept], number[kept], peak[kept]
    hot.ravel()[bright] = True
    table = BinTable.from_pixels(
        photons, scipy.ndimage.binary_dilation(hot, np.ones((3, 3))).ravel()
    )
    # A surface goes on in the next pixel or the next bin; what stands alone in both is the
    # sensor's.
    alone = np.ones(bright.size, np.bool_)
    rows, columns = photons.image_shape
    for step_y, step_x in np.ndindex(3, 3):
        y, x = bright // columns + step_y - 1, bright % columns + step_x - 1
        inside = (y >= 0) & (y < rows) & (x >= 0) & (x < columns)
        own = (step_y, step_x) == (1, 1)
        for later in range(-NEIGHBOUR_BINS, NEIGHBOUR_BINS + 1):
            if not (own and later == 0):
                light = table.count_at(np.where(inside, y * columns + x, 0), number + later)
                alone &= ~inside | (light * PEAK_RATIO < peak)
    hot.ravel()[bright] = alone
    return hot


def leave_out_pixels(photons: PhotonImage, pixels: NDArray[np.bool_]) -> PhotonImage:
    """Return the photons of the other pixels.

    `pixels` (rows, columns).
    """
    if not pixels.any():
        return photons
    count = np.where(pixels.ravel()[photons.pixel], np.float32(0), photons.count)
    if not count.any():
        raise InputError(f"only hot pixels counted photons ({int(pixels.sum())} of {pixels.size})")
    return photons.select(count)
