"""The fit of returns with the array API standard; what `tofclip.lidar.pulse_fit` does, for all pixels
of a piece at once.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from tofclip.arrays import (
    Array,
    ComputeDevice,
    PerDevice,
    build_index_window,
    gather_entries,
    gather_rows,
    namespace,
)
from tofclip.lidar.detection import CONVERGENCE_STEP_BINS, MAX_FIT_ROUNDS
from tofclip.lidar.pulse import Pulse
from tofclip.lidar.search.array_peaks import Peaks


@dataclass
class FitState:
    """Returns of some pixels while they are fitted; a list entry for each return, each a (pixels,)
    float64 array.
    """

    traces: Array  # (bins, pixels)
    background: Array  # (pixels,)
    arrival: list[Array]  # s; counts; and by how many bins the return moved last
    height: list[Array]  # s; counts; and by how many bins the return moved last
    step_bins: list[Array]  # s; counts; and by how many bins the return moved last


class PulseFitter:
    """Gauss-Newton steps on one return at a time, for all pixels at once.

    `times` (bins,): s, increasing.
    """

    def __init__(self, times: NDArray[np.float64], pulse: Pulse) -> None:
        curve, scale = pulse.kernel_table()
        self._scale = [float(number) for number in scale]
        self._bins, self._samples = times.size, curve.shape[0]
        self._bin_width = float(times[-1] - times[0]) / (times.size - 1)
        ends = np.searchsorted(times, times + (self._scale[3] - self._scale[2]), side="right")
        self._max_window_bins = int((ends - np.arange(times.size)).max()) + 1
        self._times = PerDevice(partial(ComputeDevice.put, values=times))
        self._pulse, self._slope = (
            PerDevice(partial(ComputeDevice.put, values=part.copy())) for part in curve.T
        )

    def refine_returns(self, traces: Array, peaks: Peaks) -> FitState:
        """Return arrivals and heights that fit (bins, pixels) traces best, from those of the peaks
        on.

        `traces` (bins, pixels); `peaks`: where the fit starts.
        """
        xp = namespace(traces)
        rows = range(peaks.valid.shape[0])
        moved = xp.where(peaks.valid, 0 * peaks.arrival + float("inf"), 0)
        fit = FitState(
            traces,
            peaks.background,
            *([part[k, :] for k in rows] for part in (peaks.arrival, peaks.height, moved)),
        )
        for _ in range(MAX_FIT_ROUNDS):
            for k in rows:
                due = peaks.valid[k, :] & (self._check_overlap(fit, k) >= CONVERGENCE_STEP_BINS)
                self._take_gauss_newton_step(fit, k, due)
            if not xp.any(xp.stack(fit.step_bins) >= CONVERGENCE_STEP_BINS):
                break
        return fit

    def measure_returns(
        self, fit: FitState, noise: Array, least: Array
    ) -> list[tuple[Array, Array, Array]]:
        """Return for each return whether it proves itself, its sum over the bins, and its arrival's
        deviation.

        It has to lie on the time axis and to respond, height times root of the pulse's energy, by
        more than `least`.

        `noise` (pixels,): standard deviation of a bin; `least` (pixels,): response that a return
        must exceed. Returns (pixels,) arrays for each return; seconds.
        """
        xp, times = namespace(noise), self._times.get(noise)
        reported = []
        for k, (arrival, height) in enumerate(zip(fit.arrival, fit.height, strict=True)):
            pulse, slope, rest, inside = self._compute_residual(fit, k)
            energy, mixed, steep = (
                xp.sum(part, axis=0) for part in (pulse * pulse, pulse * slope, slope * slope)
            )
            proven = (height > 0) & (arrival >= times[0]) & (arrival <= times[-1])
            proven = proven & (height * xp.sqrt(energy) > least) & (energy * steep > mixed * mixed)
            height, energy = xp.where(proven, height, 1), xp.where(proven, energy, 1)
            across_energy = xp.where(proven, steep - mixed**2 / energy, 1)
            profile = pulse, slope - pulse * mixed / energy, rest - height * pulse, inside
            reported.append(
                (
                    proven,
                    *_estimate_sum_and_deviation(profile, height, noise, energy, across_energy),
                )
            )
        return reported

    def _check_overlap(self, fit: FitState, k: int) -> Array:
        """Return by how many bins return k, or one that it reaches or that reaches it, moved last."""
        xp, scale = namespace(fit.background), self._scale
        before, after = (
            scale[1] / scale[0] + scale[3],
            (self._samples - 1 - scale[1]) / scale[0] - scale[2],
        )
        moving = fit.step_bins[k]
        for other, arrival in enumerate(fit.arrival):
            later = arrival - fit.arrival[k]
            reaches = (later > -after) & (later < before)
            moving = (
                moving
                if other == k
                else xp.maximum(moving, xp.where(reaches, fit.step_bins[other], 0))
            )
        return moving

    def _take_gauss_newton_step(self, fit: FitState, k: int, due: Array) -> None:
        """Take a Gauss-Newton step with return k, by at most a bin, in the pixels where it is due."""
        xp = namespace(due)
        p, d, rest, _ = self._compute_residual(fit, k)
        pp, pd, dd, pr, dr = (
            xp.sum(part, axis=0) for part in (p * p, p * d, d * d, p * rest, d * rest)
        )
        determinant = pp * dd - pd * pd
        solvable = determinant > 0
        determinant = xp.where(solvable, determinant, 1)
        height = (dd * pr - pd * dr) / determinant
        bright = solvable & (height > 0)
        step = -(pp * dr - pd * pr) / (determinant * xp.where(bright, height, 1))
        step = xp.where(bright, xp.clip(step, min=-self._bin_width, max=self._bin_width), 0)
        fitted = xp.where(bright, height, xp.where(solvable, 0, fit.height[k]))
        fit.arrival[k] = xp.where(due, fit.arrival[k] + step, fit.arrival[k])
        fit.height[k] = xp.where(due, fitted, fit.height[k])
        fit.step_bins[k] = xp.where(due, xp.abs(step) / self._bin_width, fit.step_bins[k])

    def _compute_residual(self, fit: FitState, k: int) -> tuple[Array, Array, Array, Array]:
        """Return pulse, slope, and what the other returns leave, in the bins that return k reaches.

        All are (bins, pixels), zero in bins that it does not reach, which the last array tells.
        """
        xp, times = namespace(fit.background), self._times.get(fit.background)
        first, last = (xp.searchsorted(times, fit.arrival[k] + reach) for reach in self._scale[2:])
        bins, inside = build_index_window(first, self._max_window_bins, last, self._bins)
        instants = gather_entries(times, bins)
        rest = xp.astype(gather_rows(fit.traces, bins), xp.float64) - fit.background
        for other, (arrival, height) in enumerate(zip(fit.arrival, fit.height, strict=True)):
            if other != k:
                rest = rest - height * self._interpolate_pulse(instants - arrival)[0]
        pulse, slope = self._interpolate_pulse(instants - fit.arrival[k])
        return *(xp.where(inside, part, 0) for part in (pulse, slope, rest)), inside

    def _interpolate_pulse(self, time: Array) -> tuple[Array, Array]:
        """Pulse and its slope at `time` after the arrival, by linear interpolation; zero outside
        the samples.
        """
        xp = namespace(time)
        position = time * self._scale[0] + self._scale[1]
        sampled = (position >= 0) & (position < self._samples - 1)
        position = xp.where(sampled, position, 0)
        left = xp.astype(position, xp.int64)
        share = position - xp.astype(left, xp.float64)
        tables = self._pulse.get(time), self._slope.get(time)
        pulse, slope = (
            (1 - share) * gather_entries(one, left) + share * gather_entries(one, left + 1)
            for one in tables
        )
        return xp.where(sampled, pulse, 0), xp.where(sampled, slope, 0)


def _estimate_sum_and_deviation(
    profile: tuple[Array, Array, Array, Array],
    height: Array,
    noise: Array,
    energy: Array,
    across_energy: Array,
) -> tuple[Array, Array]:
    """See `tofclip.lidar.pulse_fit.estimate_sum_and_deviation`; `profile` is pulse, slope across
    it, residual, and where.
    """
    pulse, across, residual, inside = profile
    xp = namespace(pulse)
    bins = xp.sum(xp.astype(inside, xp.float64), axis=0)
    total = xp.sum(height * pulse, axis=0)
    misfit = (
        xp.sum(residual * residual, axis=0) - (bins - 2) * noise**2
    )  # two bins' worth of noise went into the fit
    leverage = pulse * pulse / energy + across * across / across_energy
    unfitted = xp.sum(height * pulse * (1 - leverage), axis=0)
    weighted = xp.sum(across * across * height * pulse, axis=0)
    dispersion = xp.clip(misfit, min=0.0) / xp.maximum(unfitted, 1e-3 * total)
    return total, xp.sqrt(noise**2 * across_energy + dispersion * weighted) / (
        across_energy * height
    )
