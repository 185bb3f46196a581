"""The search for returns in NumPy's traces, some pixels at once: the compiled steps in their order."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tofclip.lidar.detection import Detection
from tofclip.lidar.pulse import Pulse
from tofclip.lidar.search.compiled import (
    confirm_peaks,
    find_maxima,
    find_strongest_peaks,
    fit_crowded_returns,
)
from tofclip.lidar.search.lone_fit import (
    LONE_COLUMNS,
    NOT_ALONE,
    PhaseTable,
    fit_lone_returns,
    list_lone_returns,
    measure_lone_returns,
)
from tofclip.lidar.search.windows import list_windows
from tofclip.lidar.traces import TraceBins

FloatArray = NDArray[np.float64]
Filters = tuple[NDArray[np.float32], NDArray[np.float32], tuple[float, float]]

NEIGHBOUR_FRACTION = 0.5  # of what is of interest: weaker peaks do not move a return beside them


@dataclass(frozen=True)
class SearchMemory:
    """What a thread's search overwrites, for some pixels.

    Parameters
    ----------
    traces, maxima : (pixels, bins) float32 array
    moments : (pixels, 3) array
    estimates : (pixels, returns, 5) array
    score, free : (bins,) float32 array
    peaks : (pixels, returns, 4) array
    profile : (bins, 3) array
    lone : (pixels * returns, LONE_COLUMNS) array
    rests : (pixels * returns, width) float32 array
    """

    traces: NDArray[np.float32]
    maxima: NDArray[np.float32]
    moments: FloatArray
    estimates: FloatArray
    score: NDArray[np.float32]
    free: NDArray[np.float32]
    peaks: FloatArray
    profile: FloatArray
    lone: FloatArray
    rests: NDArray[np.float32]


class TraceSearch:
    """What the compiled steps take for traces that hold the same bins.

    Parameters
    ----------
    times : (bins,) array
        Instants of the bins, s, increasing.
    bins : TraceBins
    filters : (sharp, matched, gains)
        Of the whole axis: (width, axis) and (axis, width + 1) arrays, and their largest sums; see
        `tofclip.lidar.search.compiled`.
    pulse : Pulse
    table : PhaseTable
    detection : Detection
    """

    def __init__(
        self,
        times: FloatArray,
        bins: TraceBins,
        filters: Filters,
        pulse: Pulse,
        table: PhaseTable,
        detection: Detection,
    ) -> None:
        sharp, matched, self._gains = filters
        self._times, self._bins, self._table = times, bins, table
        # Beyond the bins that are searched the filters reach into what lies elsewhere on the axis.
        self._sharp = np.take(sharp, bins.numbers, axis=1) * bins.search_mask
        self._matched = matched[bins.numbers]
        self._pulse = pulse.kernel_table()
        _, scale = self._pulse
        self._windows = list_windows(times, scale, pulse.fwhm)
        self._even = table.find_even_bins(bins)
        self._signal_to_noise = float(detection.signal_to_noise)
        self._limits = (
            2 * (scale[3] - scale[2]),
            self._signal_to_noise,
            float(detection.min_pixel_fraction),
            float(times[bins.search_mask].max(initial=0.0)),
        )
        self._most = detection.max_returns
        self._weights = bins.bin_weights.astype(np.float64)

    def allocate_memory(self, pixels: int) -> SearchMemory:
        """Return memory for a number of pixels at once."""
        bins, most = self._times.size, self._most
        return SearchMemory(
            traces=np.empty((pixels, bins), np.float32),
            maxima=np.empty((pixels, bins), np.float32),
            moments=np.empty((pixels, 3)),
            estimates=np.empty((pixels, most, 5)),
            score=np.empty(bins, np.float32),
            free=self._bins.bin_weights.copy(),
            peaks=np.empty((pixels, most, 4)),
            profile=np.empty((bins, 3)),
            lone=np.empty((pixels * most, LONE_COLUMNS)),
            rests=np.empty((pixels * most, self._table.shapes.shape[1]), np.float32),
        )

    def find_returns(
        self,
        pixels: NDArray[np.int64],
        memory: SearchMemory,
        least: NDArray[np.float32],
        found: FloatArray,
        counts: NDArray[np.int64],
    ) -> None:
        """Find the returns of the first traces of a memory.

        Parameters
        ----------
        pixels : (n,) int64 array
            Number of the pixel of each trace.
        memory : SearchMemory
        least : (bins,) float32 array
            Response that a return at each bin must exceed to be of interest; 0 where nothing is
            known.
        found : (all pixels, most returns, 3) array, overwritten where `pixels` says
            Instant, s, sum of the fitted pulse over the bins, standard deviation of the instant, s;
            nearest first.
        counts : (all pixels,) int64 array, overwritten where `pixels` says
            Number of returns of each pixel.
        """
        held, lowest = slice(pixels.size), float(least.min())
        traces, maxima = memory.traces[held], memory.maxima[held]
        moments, peaks, estimates = (
            part[held] for part in (memory.moments, memory.peaks, memory.estimates)
        )
        limits = (*self._limits, lowest)
        weights, table = self._bins.bin_weights, self._table
        sharp_gain, matched_gain = self._gains
        of_interest = np.float32(sharp_gain / matched_gain * NEIGHBOUR_FRACTION) * least
        # the sharp filter's response to the background, below which nothing of interest can lie
        gain = sharp_gain if lowest > 0 else 0.0
        find_maxima(
            traces, self._weights, self._sharp, of_interest, gain, memory.score, moments, maxima
        )
        find_strongest_peaks(
            traces,
            self._times,
            weights,
            self._matched,
            self._gains,
            self._windows,
            limits,
            maxima,
            maxima.view(np.int32),
            moments,
            memory.free,
            peaks,
        )
        confirm_peaks(traces, self._times, self._matched, limits, least, moments, peaks, estimates)
        fixed = traces, pixels, self._times, moments, self._signal_to_noise, estimates
        listed = list_lone_returns(
            *fixed, self._even, table.half, memory.lone, memory.rests, counts
        )
        lone, tables = memory.lone[:listed], (table.shapes, table.slopes, table.sums)
        fit_lone_returns(lone, memory.rests, np.arange(listed), *tables)
        measure_lone_returns(lone, memory.rests, pixels, self._times, *tables, found, counts)
        if (counts[pixels] == NOT_ALONE).any():
            fit_crowded_returns(*fixed, self._pulse, memory.profile, found, counts)
