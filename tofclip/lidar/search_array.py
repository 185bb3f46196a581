"""Peaks of traces with the array API standard; what `tofclip.lidar.peak_kernels` does, for all
pixels of a piece at once.

The fit of returns with the array API standard; what `tofclip.lidar.fit_kernels` does, for all pixels
of a piece at once.

The search for returns with the array API standard: all pixels of a piece at once, in arrays of any
library and on any device.

The steps are those of `tofclip.lidar.search`. Functions that do the same have the same names in
`tofclip.lidar.peak_kernels` and `tofclip.lidar.fit_kernels`, where they take one pixel after the
other. Here a loop runs over the returns of a pixel, at most `Detection.max_returns`, and arrays hold
one entry for each pixel.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from tofclip.arrays import (
    Array,
    ComputeDevice,
    PerDevice,
    as_type,
    build_index_window,
    gather_entries,
    gather_rows,
    namespace,
    native_device,
    to_numpy,
    zeros,
)
from tofclip.lidar.detection import (
    CONVERGENCE_STEP_BINS,
    MAX_FIT_ROUNDS,
    PREFIT_THRESHOLD_FACTOR,
    Detection,
)
from tofclip.lidar.pulse import Pulse
from tofclip.lidar.pulse_tables import list_windows
from tofclip.operators.sparse import Product, make_portable_product
from tofclip.shots import Frames
from tofclip.threads import split_blocks

FloatArray = NDArray[np.float64]
Filters = tuple[NDArray[np.float32], NDArray[np.float32]]


@dataclass(frozen=True)
class Peaks:
    """Peaks that might count, in the order of time."""

    arrival: Array  # (most returns, pixels), instants, to a fraction of a bin, s
    height: Array  # (most returns, pixels), of the trace at the bin, above the background
    valid: Array  # (most returns, pixels), which of them there are
    background: Array  # (pixels,), mean and standard deviation of the bins that no peak claims
    noise: Array  # (pixels,), mean and standard deviation of the bins that no peak claims

    def select(self, pixels: Array) -> Peaks:
        """Return the peaks of some pixels, by their numbers."""
        xp = namespace(self.valid)
        some = (xp.take(part, pixels, axis=1) for part in (self.arrival, self.height, self.valid))
        return Peaks(
            *some, *(xp.take(part, pixels, axis=0) for part in (self.background, self.noise))
        )


@dataclass
class BackgroundLevel:
    """Sums over the bins that no peak claims, each value less `offset` so that little noise shows
    on much light.
    """

    offset: Array
    total: Array
    square: Array
    bin_count: Array

    @property
    def background(self) -> Array:
        """Mean, (pixels,)."""
        return self.offset + self.total / self.bin_count

    @property
    def noise(self) -> Array:
        """Standard deviation, (pixels,)."""
        xp, mean = namespace(self.total), self.total / self.bin_count
        return xp.sqrt(xp.clip(self.square / self.bin_count - mean * mean, min=0.0))

    def exclude(self, values: Array, free: Array, chosen: Array) -> BackgroundLevel:
        """Return the level of the `chosen` pixels less those of some values that were `free`,
        (bins, pixels) both.

        `values` (bins, pixels): less the offset; `free` (bins, pixels); `chosen` (pixels,).
        """
        xp = namespace(values)
        values, counted = values * xp.astype(free, values.dtype), xp.astype(free, xp.float64)
        return BackgroundLevel(
            self.offset,
            xp.where(chosen, self.total - xp.sum(values, axis=0, dtype=xp.float64), self.total),
            xp.where(
                chosen, self.square - xp.sum(values * values, axis=0, dtype=xp.float64), self.square
            ),
            xp.where(chosen, self.bin_count - xp.sum(counted, axis=0), self.bin_count),
        )


class PeakSearch:
    """Filters and distances that stay the same from shot to shot.

    `times` (bins,): s, increasing; `filters`: the sharp filter that shows candidates and the
    matched one that judges them, of unit energy, nowhere negative: row w holds the weight of bin
    ``j + w - width // 2`` for a return at bin j.
    """

    def __init__(
        self, times: FloatArray, filters: Filters, pulse: Pulse, detection: Detection
    ) -> None:
        (_, scale), self._detection = pulse.kernel_table(), detection
        windows = list_windows(times, scale, pulse.fwhm)
        self._max_window_bins = max(1, int((windows[:, 1] - windows[:, 0]).max()))
        self._bins, self._last_time = times.size, float(times[-1])
        self._gains = [float(one.sum(axis=0).max()) for one in filters]
        self._sharp, self._matched = (
            PerDevice(partial(_build_banded_product, one)) for one in filters
        )
        tables = [
            times,
            filters[1].sum(axis=0, dtype=np.float64),
            *windows.T,
        ]
        self._tables = PerDevice(lambda device: [device.put(table) for table in tables])

    def take_strongest_peaks(self, traces: Array) -> Peaks:
        """Return the peaks of (bins, pixels) float32 traces."""
        xp = namespace(traces)
        times, _, claimed_from, claimed_to, *_ = self._tables.get(traces)
        offset = xp.mean(traces, axis=0)
        centred = traces - offset
        response = self._matched.get(traces)(centred)
        level = _sum_moments(centred, offset)
        needed, claiming = 0 * level.total, level.bin_count > 0
        claims: list[tuple[Array, Array, Array]] = []
        found: list[tuple[Array, Array]] = []
        for best, height in self._iterate_maxima(traces):
            bright = self._gains[1] * (height / self._gains[0] - level.background)
            active = (height > 0) & (bright > self._detection.signal_to_noise * level.noise)
            active = (
                active & (bright * self._last_time**2 >= needed) & (found[-1][1] if found else True)
            )
            if not xp.any(active):
                break
            first, last = gather_entries(claimed_from, best), gather_entries(claimed_to, best)
            claiming = (
                claiming
                & active
                & (2 * (level.bin_count - xp.astype(last - first, xp.float64)) >= self._bins)
            )
            bins, free = build_index_window(first, self._max_window_bins, last, self._bins)
            for earlier_first, earlier_last, counted in claims:
                free = free & ~((bins >= earlier_first) & (bins < earlier_last) & counted)
            level = level.exclude(gather_rows(centred, bins), free, claiming)
            claims.append((first, last, claiming))
            strength = (
                self._compute_response(response, best, level) * gather_entries(times, best) ** 2
            )
            needed = xp.where(active, xp.maximum(needed, self._min_fraction * strength), needed)
            found.append((best, active))
        return self._confirm_peaks(centred, response, level, found)

    @property
    def _min_fraction(self) -> float:
        """Of the strongest return, below which a candidate is dropped before the fit."""
        return PREFIT_THRESHOLD_FACTOR * self._detection.min_pixel_fraction

    def _iterate_maxima(self, traces: Array) -> Iterator[tuple[Array, Array]]:
        """Yield bin and score of each trace's highest maximum, then of the highest that keeps its
        distance, and so on.

        The first and the last bin are not maxima, for whatever rises towards them has its maximum
        outside.
        """
        xp = namespace(traces)
        *_, near_from, near_to = self._tables.get(traces)
        score = self._sharp.get(traces)(traces)
        inner = score[1:-1, :]
        maximal = (inner >= score[:-2, :]) & (inner > score[2:, :]) & (inner > 0)
        inner = xp.where(maximal, inner, 0)
        bins = xp.arange(1, self._bins - 1, dtype=near_from.dtype, device=native_device(traces))[
            :, None
        ]
        for _ in range(self._detection.max_returns):
            best = xp.astype(xp.argmax(inner, axis=0), near_from.dtype) + 1
            yield best, gather_rows(inner, best - 1)
            near = (bins >= gather_entries(near_from, best)) & (
                bins < gather_entries(near_to, best)
            )
            inner = xp.where(near, 0, inner)

    def _compute_response(self, response: Array, best: Array, level: BackgroundLevel) -> Array:
        """Response of the matched filter at the bins `best` to what exceeds the background; never
        below zero.
        """
        weights = gather_entries(self._tables.get(response)[1], best)
        exceeding = gather_rows(response, best) - (level.background - level.offset) * weights
        return namespace(response).clip(exceeding, min=0.0)

    def _confirm_peaks(
        self,
        centred: Array,
        response: Array,
        level: BackgroundLevel,
        found: list[tuple[Array, Array]],
    ) -> Peaks:
        """Keep what the matched filter confirms, now that background and noise are known; sort by
        time.
        """
        xp = namespace(centred)
        if not found:
            nothing = zeros((1, centred.shape[1]), level.total)
            return Peaks(nothing, nothing, nothing > 0, level.background, level.noise)
        order = xp.argsort(
            xp.stack([xp.where(active, best, self._bins) for best, active in found]), axis=0
        )
        bins, active = (
            xp.take_along_axis(xp.stack(list(part)), order, axis=0)
            for part in zip(*found, strict=True)
        )
        times = self._tables.get(centred)[0]
        rows = range(bins.shape[0])
        strength = xp.stack([self._compute_response(response, bins[k, :], level) for k in rows])
        weighed = strength * gather_entries(times, bins) ** 2
        needed = xp.max(xp.where(active, self._min_fraction * weighed, 0), axis=0)
        kept = (
            active
            & (strength > self._detection.signal_to_noise * level.noise)
            & (weighed >= needed)
        )
        arrival = xp.stack(
            [self._interpolate_peak_time(response, bins[k, :], strength[k, :], level) for k in rows]
        )
        height = xp.clip(gather_rows(centred, bins) - (level.background - level.offset), min=0.0)
        return Peaks(arrival, xp.where(kept, height, 0), kept, level.background, level.noise)

    def _interpolate_peak_time(
        self, response: Array, best: Array, here: Array, level: BackgroundLevel
    ) -> Array:
        """Instant near a bin at which the response is highest: by a parabola in its logarithm."""
        xp = namespace(response)
        times = self._tables.get(response)[0]
        before, after = (self._compute_response(response, best + side, level) for side in (-1, 1))
        known = (before > 0) & (after > 0) & (here >= before) & (here >= after)
        here, before, after = (xp.where(known, strength, 1) for strength in (here, before, after))
        rise, fall = xp.log(here / before), xp.log(here / after)
        bent = rise + fall > 0
        share = xp.where(bent, (rise - fall) / xp.where(bent, 2 * (rise + fall), 1), 0)
        step = (gather_entries(times, best + 1) - gather_entries(times, best - 1)) / 2
        return gather_entries(times, best) + xp.where(known, share, 0) * step


def _sum_moments(centred: Array, offset: Array) -> BackgroundLevel:
    xp = namespace(centred)
    total = xp.sum(centred, axis=0, dtype=xp.float64)
    square = xp.sum(centred * centred, axis=0, dtype=xp.float64)
    return BackgroundLevel(offset, total, square, 0 * total + centred.shape[0])


def _build_banded_product(filters: NDArray[np.float32], device: ComputeDevice) -> Product:
    """Set up the product that filters (bins, pixels) traces: a matrix with the filters' weights
    beside its diagonal.
    """
    import scipy.sparse

    entry, there = np.nonzero(filters)
    seen = there + entry - filters.shape[0] // 2
    shape = (filters.shape[1], filters.shape[1])
    return make_portable_product(
        scipy.sparse.csr_array((filters[entry, there], (there, seen)), shape=shape), device
    )


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
    """See `tofclip.lidar.fit_kernels.estimate_sum_and_deviation`; `profile` is pulse, slope across
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


Candidates = tuple[NDArray[np.int64], FloatArray, FloatArray, FloatArray]

WORKING_BYTES = 1 << 30
"""What a search may take for the pixels that it looks at at once."""

# arrays of the traces' size at once: they, centred, two filters' responses, maxima, temporaries
WORKING_ARRAYS = 8


class ArrayTraces:
    """Traces of a transient cube in an array of any library."""

    def __init__(self, frames: Frames) -> None:
        self.values = namespace(frames.values).reshape(
            as_type(frames.values, np.float32), (frames.times.size, -1)
        )


class ArraySearch:
    """What `tofclip.lidar.trace_search.TraceSearch` does, for many pixels at once.

    Peaks and fits are found step for step as there; only what was found, a few numbers for each
    return, is fetched. Memory on the device: 1 GiB beside the frames.

    `times` (bins,): s, increasing; `filters`: see `PeakSearch`.
    """

    def __init__(
        self, times: FloatArray, filters: Filters, pulse: Pulse, detection: Detection
    ) -> None:
        self._peaks, self._fit = (
            PeakSearch(times, filters, pulse, detection),
            PulseFitter(times, pulse),
        )
        self._min_signal_to_noise = detection.signal_to_noise

    def find_candidates(self, traces: Array) -> Candidates:
        """Return pixel number, instant, counts and deviation of every candidate, in raster and time
        order.

        `traces` (bins, pixels).
        """
        bins, pixels = traces.shape
        at_once = max(1, WORKING_BYTES // (WORKING_ARRAYS * bins * np.dtype(np.float32).itemsize))
        found = [
            self._search_pixels(traces[:, piece], piece.start)
            for piece in split_blocks(pixels, at_once)
        ]
        pixel, time, signal, deviation = (np.concatenate(part) for part in zip(*found, strict=True))
        return pixel, time, signal, deviation

    def _search_pixels(self, traces: Array, number: int) -> Candidates:
        """Search some pixels, the first of which has the given number."""
        xp = namespace(traces)
        peaks = self._peaks.take_strongest_peaks(traces)
        (pixels,) = xp.nonzero(xp.any(peaks.valid, axis=0))
        chosen = peaks.select(pixels)
        fit = self._fit.refine_returns(xp.take(traces, pixels, axis=1), chosen)
        described = self._fit.measure_returns(
            fit, chosen.noise, self._min_signal_to_noise * chosen.noise
        )
        proven, signal, deviation = (
            to_numpy(xp.stack(list(part))) for part in zip(*described, strict=True)
        )
        time, numbers = to_numpy(xp.stack(fit.arrival)), number + to_numpy(pixels).astype(np.int64)
        pixel = np.broadcast_to(numbers, proven.shape)[proven]
        order = np.lexsort((time[proven], pixel))
        return pixel[order], time[proven][order], signal[proven][order], deviation[proven][order]
