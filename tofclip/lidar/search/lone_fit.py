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

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tofclip.compiling import compile_as_part
from tofclip.lidar.detection import CONVERGENCE_STEP_BINS, MAX_FIT_ROUNDS
from tofclip.lidar.pulse import Pulse
from tofclip.lidar.pulse_fit import loop_part
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

vectorised_part = compile_as_part(fastmath=True, _nrt=False, forceinline=True)


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


@loop_part
def stand_alone(estimate, number, even, distance):
    """Whether no two returns of a trace are nearer than `distance`, each around an even bin.

    Parameters
    ----------
    estimate : (most returns, 5) array
        In the last column the bins of the peaks, increasing.
    number : int
        Of returns.
    even : (bins,) bool array
        See `PhaseTable.find_even_bins`.
    distance : int
        Bins.

    Returns
    -------
    bool
    """
    alone = True
    for k in range(number):
        alone &= even[int(estimate[k, 4])]
        alone &= k == 0 or estimate[k, 4] - estimate[k - 1, 4] >= distance
    return alone


@loop_part
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
        Overwritten.
    shapes, slopes, sums
        See `PhaseTable`.
    """
    moving = lone.shape[0]
    for k in range(moving):
        active[k] = k
    for _ in range(MAX_FIT_ROUNDS):
        for a in range(moving):
            k = active[a]
            phase, _ = find_phase(lone[k, OFFSET])
            lone[k, ALONG_PULSE], lone[k, ALONG_SLOPE] = project_on_pulse(
                rests[k], shapes[phase], slopes[phase]
            )
        still = 0
        for a in range(moving):
            k = active[a]
            offset, pr, dr = lone[k, OFFSET], lone[k, ALONG_PULSE], lone[k, ALONG_SLOPE]
            phase, start = find_phase(offset)
            pp, pd, dd = sums[phase, 0], sums[phase, 1], sums[phase, 2]
            across = dd * pr - pd * dr
            lone[k, HEIGHT] = across / (pp * dd - pd * pd)
            if across <= 0:
                continue
            # model: height * p(t - arrival), whose slope is -height * d
            step = start - (pp * dr - pd * pr) / across - offset
            step = min(max(step, -1.0), 1.0)
            lone[k, OFFSET] = offset + step
            if abs(offset + step) > MAX_OFFSET_BINS:
                lone[k, HEIGHT] = np.nan
            elif abs(step) >= CONVERGENCE_STEP_BINS:
                active[still] = k
                still += 1
        moving = still
        if moving == 0:
            break


@loop_part
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
        Goes up by one for each; -1 where a return of the pixel needs the exact fit.
    """
    for k in range(lone.shape[0]):
        height, noise, offset = lone[k, HEIGHT], lone[k, NOISE], lone[k, OFFSET]
        pixel, j = pixels[int(lone[k, TRACE])], int(lone[k, PEAK_BIN])
        number = counts[pixel]
        if np.isnan(height):
            counts[pixel] = -1
            continue
        phase, start = find_phase(offset)
        pp, pd, dd = sums[phase, 0], sums[phase, 1], sums[phase, 2]
        if number < 0 or height <= 0 or height * np.sqrt(pp) <= lone[k, LEAST]:
            continue
        misfit = sum_misfit(rests[k], shapes[phase], slopes[phase], height, offset - start)
        misfit = max(misfit - noise * noise * (sums[phase, 6] - 2), 0.0)
        across_energy, total = dd - pd * pd / pp, height * sums[phase, 3]
        variance = (
            noise * noise * across_energy
            + misfit / max(height * sums[phase, 4], 1e-3 * total) * height * sums[phase, 5]
        )
        width = times[j + 1] - times[j]
        found[pixel, number, 0] = times[j] + offset * width
        found[pixel, number, 1] = total
        found[pixel, number, 2] = np.sqrt(variance) / (across_energy * height) * width
        counts[pixel] = number + 1


@vectorised_part
def find_phase(offset):
    """Number and place of the tabulated phase nearest to an offset.

    Parameters
    ----------
    offset : float
        Bins, at most `MAX_OFFSET_BINS` either way.

    Returns
    -------
    (int, float)
    """
    phase = np.uintp((offset + MAX_OFFSET_BINS) * PHASES_PER_BIN + 0.5)
    return phase, phase / PHASES_PER_BIN - MAX_OFFSET_BINS


@vectorised_part
def copy_rest(trace, first, number, background, rest):
    """Copy some bins of a trace less the background, and fill up with zeros.

    Parameters
    ----------
    trace : (bins,) float32 array
    first, number : int
    background : float
    rest : (number or more,) float32 array
        Overwritten.
    """
    level, there = np.float32(background), trace[first : first + number]
    for w in range(rest.size):
        rest[w] = np.float32(0)
    for w in range(number):
        rest[w] = there[w] - level


@vectorised_part
def project_on_pulse(rest, shape, slope):
    """Products of what is left of a trace with pulse and slope.

    Parameters
    ----------
    rest, shape, slope : (width,) float32 array
        The width is a multiple of `VECTOR_BINS`.

    Returns
    -------
    (float, float)
    """
    pr = dr = np.float32(0)
    for first in range(np.uintp(0), np.uintp(rest.size), np.uintp(VECTOR_BINS)):
        end = first + np.uintp(VECTOR_BINS)
        r, p, d = rest[first:end], shape[first:end], slope[first:end]
        for w in range(VECTOR_BINS):
            pr += r[w] * p[w]
            dr += r[w] * d[w]
    return float(pr), float(dr)


@vectorised_part
def sum_misfit(rest, shape, slope, height, later):
    """Sum of squares of what a return does not explain in the bins that it reaches.

    Parameters
    ----------
    rest, shape, slope : (width,) float32 array
        The width is a multiple of `VECTOR_BINS`.
    height, later : float
        Of the return, and bins by which it arrives after the tabulated phase.

    Returns
    -------
    float
    """
    high, back, total = np.float32(height), np.float32(later), np.float32(0)
    for first in range(np.uintp(0), np.uintp(rest.size), np.uintp(VECTOR_BINS)):
        end = first + np.uintp(VECTOR_BINS)
        r, p, d = rest[first:end], shape[first:end], slope[first:end]
        for w in range(VECTOR_BINS):
            off = r[w] - high * (p[w] - back * d[w])
            total += off * off if p[w] > 0 else np.float32(0)
    return float(total)
