"""The fit of returns that stand alone on an even time axis, by a table of the pulse.

Nearly all returns of a shot have their pulse to themselves, and a streak camera's rows last equally
long. The pulse and its slope in the bins around such a return depend on one number, by what part of
a bin it arrives after the middle of its bin. They are tabulated for `PHASES_PER_BIN` such phases; a
Gauss-Newton step of `tofclip.lidar.pulse_fit.refine_returns` is two products of the table's rows
with the trace, in single precision, and the sums that hold no trace are in the table as well.

A step from the nearest tabulated phase ends where one from the exact phase would, but for the square
of their distance, at most (1 / 128)^2 of a bin: far below where the steps end
(`CONVERGENCE_STEP_BINS`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from tofclip.lidar.detection import CONVERGENCE_STEP_BINS, MAX_FIT_ROUNDS
from tofclip.lidar.pulse import Pulse
from tofclip.lidar.traces import TraceBins

PHASES_PER_BIN = 64
MAX_OFFSET_BINS = 1.5
"""By how much a return may move away from the bin of its peak; beyond, the exact fit takes over."""

VECTOR_BINS = 16
"""The table's width is a multiple of it: loops over so many bins have no loop left in them."""

OFFSET, HEIGHT, LEAST, NOISE, PEAK_BIN, TRACE, ALONG_PULSE, ALONG_SLOPE = range(8)
LONE_COLUMNS = 8
"""What is known of a return that stands alone: bins by which it arrives after the bin of its peak,
height, response that it must exceed, noise, bin of the peak, its trace's place among those searched
together, and the products of the trace with pulse and slope."""

MAX_UNEVENNESS = 1e-3
"""Of a bin, over the length of a pulse: moves no return by more."""

NOT_ALONE = -1
"""In place of the number of returns of a trace: one of them does not stand alone."""

SUMS_IN_ANY_ORDER = {"reassoc", "contract", "arcp", "nsz"}
"""What sums in vectors need; unlike all of ``fastmath`` it leaves infinities and NaN what they are."""

search_step = njit(nogil=True, cache=True, fastmath=SUMS_IN_ANY_ORDER, error_model="numpy")


@dataclass(frozen=True)
class PhaseTable:
    """A pulse in the bins around the one in which it has its peak, at each phase.

    Parameters
    ----------
    shapes, slopes : (phases, width) float32 array
        Pulse, and its change from bin to bin; zero where the pulse does not matter and in the bins
        that fill up a multiple of `VECTOR_BINS`. Bin w lies ``w - half`` bins after the peak's.
    sums : (phases, 7) float64 array
        Over the bins: of squared pulse, pulse times slope, and squared slope; of the pulse; of the
        pulse as far as the fit leaves it, and of the pulse times the square of the slope across it
        (`tofclip.lidar.pulse_fit.estimate_sum_and_deviation`); number of bins.
    half : int
        Bins on either side. 0: the axis is uneven, and the table empty.
    bin_width : float
        Seconds.
    """

    shapes: NDArray[np.float32]
    slopes: NDArray[np.float32]
    sums: NDArray[np.float64]
    half: int
    bin_width: float

    @classmethod
    def tabulate(cls, pulse: Pulse, times: NDArray[np.float64]) -> PhaseTable:
        """Tabulate a pulse for a time axis.

        Parameters
        ----------
        pulse : Pulse
        times : (bins,) array
            Seconds.

        Returns
        -------
        PhaseTable
        """
        width = float(times[-1] - times[0]) / (times.size - 1)
        first, last = pulse.support
        half = int(np.ceil(max(-first, last) / width + MAX_OFFSET_BINS))
        if np.ptp(np.diff(times)) * half > MAX_UNEVENNESS * width:
            nothing = np.zeros((0, VECTOR_BINS), np.float32)
            return cls(nothing, nothing, np.zeros((0, 7)), 0, width)
        phase = np.arange(round(2 * MAX_OFFSET_BINS * PHASES_PER_BIN) + 1) / PHASES_PER_BIN
        padded = -(-(2 * half + 1) // VECTOR_BINS) * VECTOR_BINS
        after = width * (np.arange(padded) - half - (phase - MAX_OFFSET_BINS)[:, np.newaxis])
        matters = (after >= first) & (after < last)
        shape = np.where(matters, pulse(after), 0)
        slope = np.where(matters, width * pulse.slope_at(after), 0)
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
            shape.astype(np.float32), slope.astype(np.float32), np.stack(columns, 1), half, width
        )

    def find_even_bins(self, bins: TraceBins) -> NDArray[np.bool_]:
        """Say around which bins all those of the table are held.

        Parameters
        ----------
        bins : TraceBins

        Returns
        -------
        (bins,) bool array
        """
        even = np.zeros(bins.numbers.size, bool)
        if self.half > 0:
            span = bins.numbers[2 * self.half :] - bins.numbers[: -2 * self.half]
            even[self.half : self.half + span.size] = span == 2 * self.half
        return even


@search_step
def list_lone_returns(
    traces, pixels, times, moments, least, estimates, even, half, lone, rests, counts
):
    """List the returns of the traces in which all of them stand alone, and return their number.

    Parameters
    ----------
    traces : (n, bins) float32 array
    pixels : (n,) int64 array
        Number of the pixel to which each trace belongs.
    times : (bins,) array
        Seconds, increasing.
    moments : (n, 3) array
        Mean and standard deviation of the bins without a return, and number of estimates.
    least : float
        Standard deviations that a return's response must exceed.
    estimates : (n, returns, 5) array
        First guess of each arrival, seconds, and, in the last column, bin of the peak, increasing.
    even : (bins,) bool array
        See `PhaseTable.find_even_bins`.
    half : int
        See `PhaseTable`.
    lone : (room, LONE_COLUMNS) float64 array
        Overwritten; those of one trace side by side, in the order of time.
    rests : (room, width) float32 array
        Overwritten: trace less background in the bins of the table around each peak; zero in those
        that fill up its width.
    counts : (all pixels,) int64 array, overwritten where `pixels` says
        0, or `NOT_ALONE`.

    Returns
    -------
    int
    """
    listed, held = 0, np.uintp(2 * half + 1)
    for place in range(traces.shape[0]):
        trace, guesses, number = traces[place], estimates[place], int(moments[place, 2])
        level, alone = np.float32(moments[place, 0]), True
        for k in range(number):
            # light that ends before the other's begins, whatever both of them move
            apart = k == 0 or guesses[k, 4] - guesses[k - 1, 4] >= 2 * half + 1
            alone = alone and apart and even[int(guesses[k, 4])]
        counts[pixels[place]] = 0 if alone else NOT_ALONE
        for k in range(number if alone else 0):
            own, rest, j = lone[listed], rests[listed], int(guesses[k, 4])
            own[OFFSET] = (guesses[k, 0] - times[j]) / (times[j + 1] - times[j])
            own[NOISE] = moments[place, 1]
            own[LEAST] = least * moments[place, 1]
            own[PEAK_BIN] = j
            own[TRACE] = place
            first = np.uintp(j - half)
            for w in range(held):
                rest[w] = trace[first + w] - level
            for w in range(held, np.uintp(rest.size)):
                rest[w] = np.float32(0)
            listed += 1
    return listed


@search_step
def fit_lone_returns(lone, rests, active, shapes, slopes, sums):
    """Fit returns that stand alone, of many traces: each round takes one step of every return that
    still moves.

    A step waits for the one before it. Steps of different returns do not, so that the processor
    works on several at a time.

    Parameters
    ----------
    lone : (returns, LONE_COLUMNS) float64 array
        Column `OFFSET`, by how many bins the return arrives after the bin of its peak, is improved;
        `HEIGHT` is overwritten: not above zero where there is no pulse, NaN where the return moved
        further than `MAX_OFFSET_BINS` and needs the exact fit.
    rests : (returns, width) float32 array
        Trace less background in the bins of the table around each peak; zero in those that fill up
        its width.
    active : (returns,) int64 array
        Numbers of the returns; overwritten.
    shapes, slopes, sums
        See `PhaseTable`.
    """
    moving = lone.shape[0]
    for _ in range(MAX_FIT_ROUNDS):
        for a in range(moving):
            own, rest = lone[active[a]], rests[active[a]]
            phase = np.uintp((own[OFFSET] + MAX_OFFSET_BINS) * PHASES_PER_BIN + 0.5)
            shape, slope = shapes[phase], slopes[phase]
            pr = dr = np.float32(0)
            for first in range(np.uintp(0), np.uintp(rest.size), np.uintp(VECTOR_BINS)):
                for w in range(VECTOR_BINS):
                    here = first + np.uintp(w)
                    pr += rest[here] * shape[here]
                    dr += rest[here] * slope[here]
            own[ALONG_PULSE] = pr
            own[ALONG_SLOPE] = dr
        still = 0
        for a in range(moving):
            k = active[a]
            own = lone[k]
            pr, dr = own[ALONG_PULSE], own[ALONG_SLOPE]
            phase = np.uintp((own[OFFSET] + MAX_OFFSET_BINS) * PHASES_PER_BIN + 0.5)
            pp, pd, dd = sums[phase, 0], sums[phase, 1], sums[phase, 2]
            across = dd * pr - pd * dr
            own[HEIGHT] = across / (pp * dd - pd * pd)
            if across <= 0:
                continue
            # model: height * p(t - arrival), whose slope is -height * d
            step = phase / PHASES_PER_BIN - MAX_OFFSET_BINS - own[OFFSET]
            step -= (pp * dr - pd * pr) / across
            step = 1.0 if step > 1.0 else (-1.0 if step < -1.0 else step)
            own[OFFSET] += step
            if math.fabs(own[OFFSET]) > MAX_OFFSET_BINS:
                own[HEIGHT] = np.nan
            elif math.fabs(step) >= CONVERGENCE_STEP_BINS:
                active[still] = k
                still += 1
        moving = still
        if moving == 0:
            break


@search_step
def measure_lone_returns(lone, rests, pixels, times, shapes, slopes, sums, found, counts):
    """Write instant, sum and standard deviation of the returns that prove themselves.

    Parameters
    ----------
    lone : (returns, LONE_COLUMNS) float64 array
        Of `fit_lone_returns`; those of one trace side by side, in the order of time.
    rests : (returns, width) float32 array
    pixels : (traces,) int64 array
        Number of the pixel to which each trace belongs.
    times : (bins,) array
        Seconds.
    shapes, slopes, sums
        See `PhaseTable`.
    found : (all pixels, most returns, 3) float64 array
        Overwritten: seconds, sum over the bins, standard deviation in seconds.
    counts : (all pixels,) int64 array
        Goes up by one for each; `NOT_ALONE` where a return of the pixel needs the exact fit.
    """
    for k in range(lone.shape[0]):
        own, rest = lone[k], rests[k]
        height, noise, offset = own[HEIGHT], own[NOISE], own[OFFSET]
        pixel, j = pixels[int(own[TRACE])], int(own[PEAK_BIN])
        number = counts[pixel]
        if math.isnan(height):
            counts[pixel] = NOT_ALONE
            continue
        phase = np.uintp((offset + MAX_OFFSET_BINS) * PHASES_PER_BIN + 0.5)
        shape, slope, known = shapes[phase], slopes[phase], sums[phase]
        if number < 0 or height <= 0 or height * math.sqrt(known[0]) <= own[LEAST]:
            continue
        high, misfit = np.float32(height), np.float32(0)
        later = np.float32(offset - (phase / PHASES_PER_BIN - MAX_OFFSET_BINS))
        for first in range(np.uintp(0), np.uintp(rest.size), np.uintp(VECTOR_BINS)):
            for w in range(VECTOR_BINS):
                here = first + np.uintp(w)
                off = rest[here] - high * (shape[here] - later * slope[here])
                misfit += off * off if shape[here] > 0 else np.float32(0)
        excess = misfit - noise * noise * (known[6] - 2)
        excess = excess if excess > 0 else 0.0
        across_energy, total = known[2] - known[1] * known[1] / known[0], height * known[3]
        unfitted = height * known[4] if height * known[4] > 1e-3 * total else 1e-3 * total
        variance = noise * noise * across_energy + excess / unfitted * height * known[5]
        width, result = times[j + 1] - times[j], found[pixel, number]
        result[0] = times[j] + offset * width
        result[1] = total
        result[2] = math.sqrt(variance) / (across_energy * height) * width
        counts[pixel] = number + 1
