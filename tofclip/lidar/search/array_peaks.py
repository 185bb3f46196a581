"""Peaks of traces with the array API standard; what `tofclip.lidar.search.candidates` does, for all
pixels of a piece at once.
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
    build_index_window,
    gather_entries,
    gather_rows,
    namespace,
    native_device,
    zeros,
)
from tofclip.lidar.detection import PREFIT_THRESHOLD_FACTOR, Detection
from tofclip.lidar.pulse import Pulse
from tofclip.lidar.search.windows import list_windows
from tofclip.operators.portable import Product, make_portable_product

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
