"""Photons counted in every pixel of a picture, as a list of events: what a photon-counting camera
delivers, without the empty bins of a cube.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
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
