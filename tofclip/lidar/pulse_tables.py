"""What the search for returns needs to know of traces and of the pulse on one time axis: which bins
there are, windows, filters, and a table of the pulse.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from tofclip.arrays import BoolArray, Float32Array, FloatArray, IntArray
from tofclip.lidar.pulse import Pulse, Table


@dataclass(frozen=True)
class TraceBins:
    """Which bins of a time axis traces hold."""

    numbers: IntArray  # (n,), increasing
    # (n,), whether a return may lie there. Wherever one may, all bins that its search and its fit
    # look at are held
    search_mask: BoolArray
    # (n,), for how many bins of the axis each one stands where background and noise are concerned
    bin_weights: Float32Array

    @classmethod
    def all_bins(cls, bins: int) -> TraceBins:
        """Return all bins of an axis, every one for itself."""
        return cls(np.arange(bins), np.ones(bins, bool), np.ones(bins, np.float32))


class Traces(Protocol):
    """Anything that hands out pixels' traces."""

    pixels: IntArray
    """Numbers of the pixels, counted in raster order, in the order in which their traces are
    cheapest to have.
    """

    bins: TraceBins
    """The bins that they hold."""

    def fill(self, piece: slice, traces: Float32Array) -> None:
        """Write the traces of ``pixels[piece]`` into (n, bins) contiguous memory."""
        ...


class PictureTraces:
    """Traces of pictures, (bins, rows, columns), that are there already."""

    def __init__(self, pictures: Float32Array, bins: TraceBins) -> None:
        self.pictures = pictures.reshape(len(pictures), -1).astype(np.float32, copy=False)
        self.pixels, self.bins = np.arange(self.pictures.shape[1]), bins

    def fill(self, piece: slice, traces: Float32Array) -> None:
        """Write traces of neighbours in raster order."""
        from tofclip.solvers.kernels import copy_lanes_to_frames

        # contiguous: the loop is compiled for solvers' blocks, and copying short runs costs little
        copy_lanes_to_frames(np.ascontiguousarray(self.pictures[:, piece]), 0, traces)


def list_windows(
    times: FloatArray, scale: tuple[float, float, float, float], distance: float
) -> IntArray:
    """List the bins that a return at each bin reaches, and those too near for another return:
    (bins, 4) first bin reached and the one after the last; first bin nearer than `distance`, s, and
    the one after the last. `scale`: of the pulse, `tofclip.lidar.Pulse.kernel_table`. Bins are
    often just `distance` apart; what then is nearer is for the rounding of their difference to say,
    and not for that of a sum with the distance.
    """
    first = np.searchsorted(times, times - distance)
    last = np.searchsorted(times, times + distance, side="right")
    first += times - times[first] >= distance
    last -= times[last - 1] - times >= distance
    claimed = [np.searchsorted(times, times + reach) for reach in scale[2:]]
    return np.stack([*claimed, first, last], axis=1).astype(np.int64)


PHASES_PER_BIN = 64
MAX_OFFSET_BINS = 1.5  # of a return from the bin of its peak; beyond, that bin follows it
VECTOR_BINS = 16  # the table's width is a multiple of a vector's length (`tofclip.vectors`)
MAX_UNEVENNESS = 1e-3  # of a bin, over the length of a pulse: moves no return by more


class PhaseTable(NamedTuple):
    """A pulse in the bins around the one in which it has its peak, at each phase. A streak camera's
    rows last equally long, so that the pulse and its slope in the bins around a return depend on
    one number, by what part of a bin it arrives after the middle of its bin.
    """

    # (phases, width), pulse, and its change from bin to bin; zero where the pulse does not matter and
    # in the bins that fill up a whole vector. Bin w lies ``w - half`` bins after the peak's
    shapes: Float32Array
    slopes: Float32Array
    # (phases, 4 * half + width), pulse, wherever it ends. Bin w lies ``w - 3 * half`` bins after it
    tails: Float32Array
    # (phases, 7), over the bins: of squared pulse, pulse times slope, and squared slope; of the
    # pulse; of the pulse as far as the fit leaves it, and of the pulse times the square of the
    # slope across it (`tofclip.lidar.fit_kernels.estimate_deviation`); number of bins
    sums: FloatArray
    half: int  # bins on either side. 0: the axis is uneven, and the table empty
    bin_width: float  # s

    @classmethod
    def tabulate(cls, pulse: Pulse, times: FloatArray) -> PhaseTable:
        """Tabulate a pulse for a time axis of instants `times`, s."""
        width = float(times[-1] - times[0]) / (times.size - 1)
        first, last = pulse.support
        half = int(np.ceil(max(-first, last) / width + MAX_OFFSET_BINS))
        if np.ptp(np.diff(times)) * half > MAX_UNEVENNESS * width:
            nothing = np.zeros((0, VECTOR_BINS), np.float32)
            return cls(nothing, nothing, nothing, np.zeros((0, 7)), 0, width)
        phases = np.arange(round(2 * MAX_OFFSET_BINS * PHASES_PER_BIN) + 1) / PHASES_PER_BIN
        arrival = (phases - MAX_OFFSET_BINS)[:, np.newaxis]
        padded = -(-(2 * half + 1) // VECTOR_BINS) * VECTOR_BINS
        after = width * (np.arange(padded) - half - arrival)
        matters = (after >= first) & (after < last)
        shape = np.where(matters, pulse(after), 0)
        slope = np.where(matters, width * pulse.slope_at(after), 0)
        tails = pulse(width * (np.arange(4 * half + padded) - 3 * half - arrival))
        squares, mixed = np.sum(shape**2, axis=1), np.sum(shape * slope, axis=1)
        steepness = np.sum(slope**2, axis=1)
        # what a change of height cannot mimic
        across = slope - shape * (mixed / squares)[:, np.newaxis]
        across_energy = steepness - mixed**2 / squares
        # the fit's leverages
        fitted = shape**2 / squares[:, np.newaxis] + across**2 / across_energy[:, np.newaxis]
        unfitted, weighted = shape * (1 - fitted), across**2 * shape
        further = (np.sum(one, axis=1) for one in (shape, unfitted, weighted, matters))
        sums = np.stack([squares, mixed, steepness, *further], 1)
        single = (one.astype(np.float32) for one in (shape, slope, tails))
        return cls._make([*single, sums, half, width])

    def find_even_bins(self, bins: TraceBins) -> BoolArray:
        """Say around which of the bins, (n,), all those of the table are held."""
        even = np.zeros(bins.numbers.size, bool)
        if self.half > 0:
            span = bins.numbers[2 * self.half :] - bins.numbers[: -2 * self.half]
            even[self.half : self.half + span.size] = span == 2 * self.half
        return even


# of the filter that looks for candidates; it costs a tenth of the matched filter's sensitivity
SHARPENING_FACTOR = 2.0


@dataclass(frozen=True)
class PulseFilters:
    """A pulse as the search for returns on a time axis needs it."""

    # (width, bins), filter that shows candidates, and the one that judges them. Entry w is the weight
    # of bin ``j + w - width // 2`` for a return at bin j
    sharp: Float32Array
    matched: Float32Array
    sums: FloatArray  # (bins,), of the matched filters
    gains: tuple[float, float]  # (2,), largest sums of either
    table: PhaseTable
    kernel: Table  # (curve, scale), `tofclip.lidar.Pulse.kernel_table`
    fwhm: float  # of the pulse, s

    @classmethod
    def build(cls, pulse: Pulse, times: FloatArray) -> PulseFilters:
        """Work them out for instants `times`, s."""
        sharp = _build_filter(pulse.compress(SHARPENING_FACTOR), times)
        matched = _build_filter(pulse, times)
        sums = matched.sum(axis=0)
        return cls(
            sharp,
            matched,
            sums.astype(np.float64),
            (float(sharp.sum(axis=0).max()), float(sums.max())),
            PhaseTable.tabulate(pulse, times),
            pulse.kernel_table(),
            pulse.fwhm,
        )


def _build_filter(pulse: Pulse, times: FloatArray) -> Float32Array:
    """Unit-energy filter for a return at each bin, (width, bins); the time axis may be uneven. What
    a measured pulse has below zero is noise and left out. Where the axis cuts off most of the pulse
    the energy stays below one: little would be known of such a return.
    """
    before, after = pulse.support
    # what lies between two bins is reached by neither: without it rows of zeros would be applied
    half = int(np.floor(max(-before, after) / np.diff(times).min())) + 1
    filters = np.zeros((2 * half, times.size))
    for row, shift in enumerate(range(-half, half)):
        here = np.arange(max(0, -shift), min(times.size, times.size - shift))
        filters[row, here] = np.maximum(pulse(times[here + shift] - times[here]), 0)
    energy = np.sum(filters**2, axis=0)
    filters /= np.sqrt(np.maximum(energy, np.median(energy) / 2))
    return filters.astype(np.float32)
