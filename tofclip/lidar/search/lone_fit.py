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

VECTOR_BINS = 32
"""The table's width is a multiple of it: the compiler's loops over vectors take as many at a time."""

MAX_UNEVENNESS = 1e-3
"""Of a bin, over the length of a pulse: moves no return by more."""

vectorised_part = compile_as_part(fastmath=True, _nrt=False)


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
def fit_lone_returns(
    trace,
    times,
    background,
    noise,
    least,
    estimate,
    distance,
    even,
    shapes,
    slopes,
    sums,
    half,
    rest,
    found,
):
    """Fit returns that stand alone and measure those that prove themselves.

    Parameters
    ----------
    trace, times : (bins,) array
        Brightness, and seconds.
    background, noise : float
        Mean and standard deviation of the bins without a return.
    least : float
        Response that a return must exceed.
    estimate : (returns, 5) array
        First guess of each arrival, seconds, and, in the last column, bin of the peak, increasing.
    distance : float
        Bins within which two returns do not stand alone.
    even : (bins,) bool array
        See `PhaseTable.find_even_bins`.
    shapes, slopes, sums, half
        See `PhaseTable`.
    rest : (width,) float32 array
        Zero, and zero again afterwards from bin ``2 * half + 1`` on.
    found : (returns, 3) array
        Overwritten: seconds, sum over the bins, standard deviation in seconds.

    Returns
    -------
    int
        Number of returns; -1 if one of them does not stand alone, and the exact fit is needed.
    """
    number = 0
    for k in range(estimate.shape[0]):
        j = int(estimate[k, 4])
        if not even[j] or (k > 0 and j - estimate[k - 1, 4] < distance):
            return -1
    for k in range(estimate.shape[0]):
        j = int(estimate[k, 4])
        width = times[j + 1] - times[j]
        copy_rest(trace, np.uintp(j - half), np.uintp(2 * half + 1), background, rest)
        offset, height = (estimate[k, 0] - times[j]) / width, 0.0
        for _ in range(MAX_FIT_ROUNDS):
            phase, start = find_phase(offset)
            pr, dr = project_on_pulse(rest, shapes[phase], slopes[phase])
            pp, pd, dd = sums[phase, 0], sums[phase, 1], sums[phase, 2]
            determinant = pp * dd - pd * pd
            height = (dd * pr - pd * dr) / determinant
            if height <= 0:
                break
            # model: height * p(t - arrival), whose slope is -height * d
            step = start - (pp * dr - pd * pr) / (determinant * height) - offset
            step = min(max(step, -1.0), 1.0)
            offset += step
            if abs(offset) > MAX_OFFSET_BINS:
                return -1
            if abs(step) < CONVERGENCE_STEP_BINS:
                break
        phase, start = find_phase(offset)
        pp, pd, dd = sums[phase, 0], sums[phase, 1], sums[phase, 2]
        if height <= 0 or height * np.sqrt(pp) <= least:
            continue
        misfit = sum_misfit(rest, shapes[phase], slopes[phase], height, offset - start)
        misfit = max(misfit - noise * noise * (sums[phase, 6] - 2), 0.0)
        across_energy, total = dd - pd * pd / pp, height * sums[phase, 3]
        variance = (
            noise * noise * across_energy
            + misfit / max(height * sums[phase, 4], 1e-3 * total) * height * sums[phase, 5]
        )
        found[number, 0] = times[j] + offset * width
        found[number, 1] = total
        found[number, 2] = np.sqrt(variance) / (across_energy * height) * width
        number += 1
    return number


@loop_part
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
    """Copy some bins of a trace less the background.

    Parameters
    ----------
    trace : (bins,) float32 array
    first, number : int
    background : float
    rest : (number or more,) float32 array
        Overwritten in the first `number` bins.
    """
    level, there = np.float32(background), trace[first : first + number]
    for w in range(number):
        rest[w] = there[w] - level


@vectorised_part
def project_on_pulse(rest, shape, slope):
    """Products of what is left of a trace with pulse and slope.

    Parameters
    ----------
    rest, shape, slope : (width,) float32 array

    Returns
    -------
    (float, float)
    """
    pr = dr = np.float32(0)
    for w in range(rest.size):
        pr += rest[w] * shape[w]
        dr += rest[w] * slope[w]
    return float(pr), float(dr)


@vectorised_part
def sum_misfit(rest, shape, slope, height, later):
    """Sum of squares of what a return does not explain in the bins that it reaches.

    Parameters
    ----------
    rest, shape, slope : (width,) float32 array
    height, later : float
        Of the return, and bins by which it arrives after the tabulated phase.

    Returns
    -------
    float
    """
    high, back, total = np.float32(height), np.float32(later), np.float32(0)
    for w in range(rest.size):
        off = rest[w] - high * (shape[w] - back * slope[w])
        total += off * off if shape[w] > 0 else np.float32(0)
    return float(total)
