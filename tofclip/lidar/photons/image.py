"""Photons counted in every pixel of a picture, as a list of events: what a photon-counting camera
delivers, without the empty bins of a cube.

Hot pixels of a photon-counting detector: one bin far beyond all that the other pixels count.

Pairs of photons grow with the square of their number: one such pixel would say more about the
pulse than all others together. It is found before anything is learnt.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from tofclip.errors import InputError, ShapeError
from tofclip.units import require_credible_bin_width

FloatArray = NDArray[np.float64]

MIN_BIN_WIDTH_S = 1e-13
"""Half of the finest channel that a time-correlated counter offers (0.2 ps)."""


@dataclass(frozen=True)
class PhotonImage:
    """Photon events sorted by pixel.

    Parameters
    ----------
    offsets : (pixels + 1,) int64 array
        The events of pixel p, counted in raster order, are ``offsets[p] : offsets[p + 1]``.
    bin : (events,) float32 array
        Time of each event in bins after the middle of the first bin.
    count : (events,) float32 array
        Photons that the event stands for.
    image_shape : (int, int)
        Rows and columns.
    bins : int
        Bins of the time axis.
    bin_width : float
        Duration of a bin, s.
    axes : str
        Order of the axes of the cube that they were read from and how surely it was recognised;
        empty where it was known.

    Raises
    ------
    ShapeError, InputError
        Arrays that do not belong together, a bin width that is not positive, or no photon at all.
    """

    offsets: NDArray[np.int64]
    bin: NDArray[np.float32]
    count: NDArray[np.float32]
    image_shape: tuple[int, int]
    bins: int
    bin_width: float
    axes: str = ""

    def __post_init__(self) -> None:
        pixels = self.image_shape[0] * self.image_shape[1]
        if self.offsets.shape != (pixels + 1,) or self.offsets[-1] != self.bin.size:
            raise ShapeError("the offsets of photon events", (pixels + 1,), self.offsets.shape)
        if self.count.shape != self.bin.shape:
            raise ShapeError("the counts of photon events", self.bin.shape, self.count.shape)
        if not (np.isfinite(self.bin_width) and self.bin_width > 0):
            raise InputError(f"the width of a bin must be a positive time, got {self.bin_width}")
        require_credible_bin_width(self.bin_width, shortest=MIN_BIN_WIDTH_S)
        if not self.bin.size:
            raise InputError("no pixel counted a photon")

    @classmethod
    def from_cube(cls, counts: ArrayLike, bin_width: float) -> PhotonImage:
        """Turn a histogram for each pixel into events.

        Parameters
        ----------
        counts : (rows, columns, bins) array
            Photons counted in each bin.
        bin_width : float
            Duration of a bin, s.

        Returns
        -------
        PhotonImage

        Raises
        ------
        ShapeError, InputError
            Not a cube, or counts that are negative or not finite.
        """
        cube = np.asarray(counts)
        if cube.ndim != 3:
            raise ShapeError("counts", "(rows, columns, bins)", cube.shape)
        if cube.dtype.kind == "f" and not np.all(np.isfinite(cube)):
            raise InputError("photon counts must be finite")
        if cube.size and cube.min() < 0:
            raise InputError("photon counts must not be negative")
        histograms = np.ascontiguousarray(cube).reshape(-1, cube.shape[2])
        pixel, bin_number = np.nonzero(histograms)
        offsets = np.searchsorted(pixel, np.arange(histograms.shape[0] + 1))
        return cls(
            offsets.astype(np.int64),
            bin_number.astype(np.float32),
            histograms[pixel, bin_number].astype(np.float32),
            (cube.shape[0], cube.shape[1]),
            cube.shape[2],
            float(bin_width),
        )

    @classmethod
    def from_events(
        cls,
        pixel: NDArray[Any],
        bin_number: NDArray[Any],
        image_shape: tuple[int, int],
        bin_width: float,
        bins: int | None = None,
    ) -> PhotonImage:
        """Sort single photons by pixel.

        Parameters
        ----------
        pixel : (photons,) int array
            Raster number of the pixel that counted each photon.
        bin_number : (photons,) array
            Its time in bins, 0 for the middle of the first bin.
        image_shape : (int, int)
            Rows and columns.
        bin_width : float
            Duration of a bin, s.
        bins : int, optional
            Bins of the time axis; by default up to the latest photon.

        Returns
        -------
        PhotonImage

        Raises
        ------
        InputError
            No photon, or a time that is negative or not finite.
        """
        when = np.asarray(bin_number, dtype=np.float32)
        if not when.size:
            raise InputError("no pixel counted a photon")
        if not np.all(np.isfinite(when)) or when.min() < 0:
            raise InputError("photon times must be finite and not negative")
        length = int(when.max()) + 1 if bins is None else bins
        order = np.argsort(pixel, kind="stable")
        offsets = np.searchsorted(pixel[order], np.arange(image_shape[0] * image_shape[1] + 1))
        ones = np.ones(when.size, np.float32)
        return cls(
            offsets.astype(np.int64), when[order], ones, image_shape, length, float(bin_width)
        )

    @cached_property
    def pixel(self) -> NDArray[np.int64]:
        """Raster number of the pixel of each event."""
        return np.repeat(np.arange(self.offsets.size - 1), np.diff(self.offsets))

    @property
    def photons(self) -> float:
        """Photons of the whole picture."""
        return float(self.count.sum(dtype=np.float64))

    @cached_property
    def photons_per_pixel(self) -> FloatArray:
        """Photons of each pixel, (rows, columns)."""
        total = np.bincount(self.pixel, self.count, self.offsets.size - 1)
        return total.reshape(self.image_shape).astype(np.float64)

    @cached_property
    def time_profile(self) -> FloatArray:
        """Photons of all pixels in each bin, (bins,)."""
        whole = np.clip(np.rint(self.bin).astype(np.int64), 0, self.bins - 1)
        return np.bincount(whole, self.count, self.bins).astype(np.float64)

    def select(self, count: NDArray[np.float32]) -> PhotonImage:
        """Return the events with other counts; those with none are left out.

        Parameters
        ----------
        count : (events,) float32 array
        """
        kept = count > 0
        offsets = np.concatenate([[0], np.cumsum(kept)])[self.offsets]
        return PhotonImage(
            offsets, self.bin[kept], count[kept], self.image_shape, self.bins, self.bin_width
        )

    def join_bins(self, number: int) -> PhotonImage:
        """Return the same events, at the same instants, on a time axis of longer bins.

        Parameters
        ----------
        number : int
            Bins that make a new one; the middle of the first stays where it was.
        """
        if number == 1:
            return self
        # A bin's middle is its instant: half of the first new bin lies before the record.
        return PhotonImage(
            self.offsets,
            self.bin / np.float32(number),
            self.count,
            self.image_shape,
            (self.bins - 1 + number // 2) // number + 1,
            self.bin_width * number,
        )

    def split(self, fraction: float, seed: int) -> tuple[PhotonImage, PhotonImage]:
        """Divide the photons at random, so that one part can judge what the other part says.

        Parameters
        ----------
        fraction : float
            Share of the photons in the second part.
        seed : int

        Returns
        -------
        (PhotonImage, PhotonImage)
            Independent of each other if the photons are Poisson distributed.

        Raises
        ------
        InputError
            So few photons that one part has none.
        """
        noise = np.random.default_rng(seed)
        # binomial thinning of Poisson counts gives two independent Poisson counts
        second = noise.binomial(np.rint(self.count).astype(np.int64), fraction).astype(np.float32)
        if not (second.any() and np.any(self.count > second)):
            raise InputError(
                f"{self.photons:g} photons are too few to find a surface and to hold some back "
                "that judge it; each pixel may be judged alone (`single_pixel`)"
            )
        return self.select(self.count - second), self.select(second)

    def histograms(self, pixels: slice) -> FloatArray:
        """Return the histograms of some pixels in raster order, (n, bins)."""
        start, stop, step = pixels.indices(self.offsets.size - 1)
        some = slice(self.offsets[start], self.offsets[stop])
        table = np.zeros((len(range(start, stop, step)), self.bins))
        whole = np.clip(np.rint(self.bin[some]).astype(np.int64), 0, self.bins - 1)
        row, beside = np.divmod(self.pixel[some] - start, step)
        taken = beside == 0
        np.add.at(table, (row[taken], whole[taken]), self.count[some][taken])
        return table


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
