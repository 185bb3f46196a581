"""A pulse in the bins around its return, tabulated for the part of a bin at which it arrives.

A streak camera's rows last equally long, so that the pulse and its slope in the bins around a
return depend on one number, by what part of a bin it arrives after the middle of its bin. They are
tabulated for `PHASES_PER_BIN` such phases; the fit (`tofclip.lidar.search.table_fit`) is then
products of the table's rows with the trace, in single precision, and the sums that hold no trace
are in the table as well.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tofclip.lidar.pulse import Pulse
from tofclip.lidar.traces import TraceBins

PHASES_PER_BIN = 64
MAX_OFFSET_BINS = 1.5
"""By how much a return may lie away from the bin of its peak; beyond, that bin follows it."""

VECTOR_BINS = 16
"""The table's width is a multiple of it: a vector's length (`tofclip.vectors`)."""

MAX_UNEVENNESS = 1e-3
"""Of a bin, over the length of a pulse: moves no return by more."""


@dataclass(frozen=True)
class PhaseTable:
    """A pulse in the bins around the one in which it has its peak, at each phase."""

    # (phases, width), pulse, and its change from bin to bin; zero where the pulse does not matter
    # and in the bins that fill up a multiple of `VECTOR_BINS`. Bin w lies ``w - half`` bins after
    # the peak's
    shapes: NDArray[np.float32]
    # (phases, width), pulse, and its change from bin to bin; zero where the pulse does not matter
    # and in the bins that fill up a multiple of `VECTOR_BINS`. Bin w lies ``w - half`` bins after
    # the peak's
    slopes: NDArray[np.float32]
    # (phases, 4 * half + width), pulse, wherever it ends. Bin w lies ``w - 3 * half`` bins after
    # the peak's
    tails: NDArray[np.float32]
    # (phases, 7), over the bins: of squared pulse, pulse times slope, and squared slope; of the
    # pulse; of the pulse as far as the fit leaves it, and of the pulse times the square of the
    # slope across it (`tofclip.lidar.pulse_fit.estimate_sum_and_deviation`); number of bins
    sums: NDArray[np.float64]
    half: int  # bins on either side. 0: the axis is uneven, and the table empty
    bin_width: float  # seconds

    @classmethod
    def tabulate(cls, pulse: Pulse, times: NDArray[np.float64]) -> PhaseTable:
        """Tabulate a pulse for a time axis.

        `times` (bins,): seconds.
        """
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
        fitted = (
            shape**2 / squares[:, np.newaxis] + across**2 / across_energy[:, np.newaxis]
        )  # the fit's leverages
        columns = (
            squares,
            mixed,
            steepness,
            shape.sum(axis=1),
            np.sum(shape * (1 - fitted), axis=1),
            np.sum(across**2 * shape, axis=1),
            np.count_nonzero(matters, axis=1),
        )
        return cls(
            shape.astype(np.float32),
            slope.astype(np.float32),
            tails.astype(np.float32),
            np.stack(columns, 1),
            half,
            width,
        )

    def find_even_bins(self, bins: TraceBins) -> NDArray[np.bool_]:
        """Say around which bins all those of the table are held.

        Returns (bins,).
        """
        even = np.zeros(bins.numbers.size, bool)
        if self.half > 0:
            span = bins.numbers[2 * self.half :] - bins.numbers[: -2 * self.half]
            even[self.half : self.half + span.size] = span == 2 * self.half
        return even
