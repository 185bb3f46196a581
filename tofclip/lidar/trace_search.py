"""The search for returns in NumPy's traces, some pixels at once: the compiled steps in their order."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofclip.arrays import FloatArray
from tofclip.lidar.fit_kernels import (
    fit_crowded_returns,
    fit_lone_returns,
    fit_returns_exactly,
    list_returns,
    measure_returns_by_table,
)
from tofclip.lidar.peak_kernels import (
    CANDIDATE_COLUMNS,
    NEEDS_EXACT_FIT,
    WORD_BINS,
    find_candidates,
)
from tofclip.lidar.pulse_tables import PulseFilters, Traces, list_windows
from tofclip.lidar.significance import Detection
from tofclip.vectors import LENGTH

NEIGHBOUR_FRACTION = 0.5  # of what is of interest: weaker peaks do not move a return beside them


@dataclass(frozen=True)
class SearchMemory:
    """What a thread's search overwrites, for some pixels."""

    held: NDArray[np.float32]  # (pixels, bins), as traces are handed out
    # (pixels, whole vectors of bins), the same memory, where that is a whole number of vectors
    traces: NDArray[np.float32]
    moments: FloatArray  # (pixels, 2)
    peaks: FloatArray  # (returns, 2)
    score: NDArray[np.float32]
    places: NDArray[np.int32]  # (4, bins), see `tofclip.lidar.peak_kernels.find_candidates`
    responses: NDArray[np.float32]
    free: NDArray[np.float32]
    candidates: FloatArray  # (pixels * returns, CANDIDATE_COLUMNS)
    rests: NDArray[np.float32]  # (pixels * returns, width)
    lone: NDArray[np.int64]  # (pixels * returns,)
    crowded: NDArray[np.int64]  # (pixels * returns,)
    estimates: FloatArray  # (returns, 5)
    profile: FloatArray  # (bins, 3)


class TraceSearch:
    """The search in some traces, and what it has found so far.

    Compiled loops take a vector of bins at a time. Behind the last bin the axis is filled up with bins that
    weigh nothing and are not searched, to a whole number of vectors that holds the filters.

    `times` (bins,): instants of the bins, s, increasing; `filters`: of the whole axis; `pixels`:
    that are searched together, at most.
    """

    def __init__(
        self,
        times: FloatArray,
        source: Traces,
        filters: PulseFilters,
        detection: Detection,
        pixels: int,
    ) -> None:
        bins, most = source.bins, detection.max_returns
        self._source, self._pixels, self._spare = source, pixels, list[SearchMemory]()
        self._found = np.empty((source.pixels.size, most, 3))
        self._counts = np.zeros(source.pixels.size, np.int64)
        sharp, matched = (
            np.take(one, bins.numbers, axis=1) for one in (filters.sharp, filters.matched)
        )
        widths = len(sharp) + LENGTH, _fill_up(len(matched), LENGTH)
        self._number = bins.numbers.size
        self._length = _fill_up(max(self._number, *widths), 2 * LENGTH)
        self._times = np.ascontiguousarray(times)
        self._weights = _pad(bins.bin_weights, self._length)
        self._searched = _pad(bins.search_mask, self._length)
        # A maximum has neighbours.
        self._searched[[0, self._number - 1]] = False
        # Beyond the bins that are searched the filters reach into what lies elsewhere on the axis.
        self._sharp = _pad(sharp * bins.search_mask, self._length)
        self._runs, self._edges, self._words = self._place_vectors(len(sharp))
        self._matched, self._starts = self._align(matched, widths[1])
        self._sums = filters.sums[bins.numbers]
        self._gains = *filters.gains, 0.0
        self._pulse, self._table = filters.kernel, filters.table
        scale = self._pulse[1]
        self._windows = list_windows(self._times, scale, filters.fwhm).astype(np.int32)
        self._even = self._table.find_even_bins(bins)
        self._least_ratio, self._most = float(detection.signal_to_noise), most
        self._limits = (
            2 * (scale[3] - scale[2]),
            self._least_ratio,
            float(detection.min_pixel_fraction),
            float(times[bins.search_mask].max(initial=0.0)),
            0.0,
        )
        self.set_least(np.zeros(self._number, np.float32))

    def set_least(self, least: NDArray[np.float32]) -> None:
        """Say what is of interest.

        `least` (bins,): response of the matched filter that a return at each bin must exceed; 0
        where nothing is known.
        """
        lowest = float(least.min())
        sharp_gain, matched_gain = self._gains[:2]
        # the sharp filter's response to the background, below which nothing of interest can lie
        self._gains = sharp_gain, matched_gain, sharp_gain if lowest > 0 else 0.0
        self._limits = (*self._limits[:4], lowest)
        self._least = least
        # None exceeds it where nothing is searched.
        self._of_interest = np.full(self._length + WORD_BINS, np.inf, np.float32)
        searched = np.flatnonzero(self._searched)
        share = np.float32(sharp_gain / matched_gain * NEIGHBOUR_FRACTION)
        self._of_interest[searched] = share * least[searched]

    def _place_vectors(
        self, width: int
    ) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
        """Where the sharp filter is applied, in vectors and in single bins at the ends, and where
        maxima are sought.
        """
        first, last = width // 2, self._length - LENGTH - width + width // 2
        runs = np.append(np.arange(first, last, LENGTH), last)
        words = np.arange(0, self._length, WORD_BINS)
        # the neighbours of what is searched are compared with it
        near = np.any(self._sharp != 0, axis=0)
        at_ends = near.copy()
        at_ends[first : last + LENGTH] = False
        runs = runs[_count(near, runs, LENGTH) > 0]
        return (
            np.append(runs, runs[-1:]) if runs.size % 2 else runs,
            np.flatnonzero(at_ends),
            words[_count(self._searched, words, WORD_BINS) > 0],
        )

    def _align(
        self, matched: NDArray[np.float32], width: int
    ) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
        """The matched filters of all bins, (bins, width), each from a bin on that leaves room for
        its vectors, and these bins.
        """
        first = np.arange(self._number) - len(matched) // 2
        starts = np.clip(first, 0, self._length - width)
        aligned = np.zeros((self._number, width), np.float32)
        aligned[:, : len(matched)] = matched.T
        for j in np.flatnonzero(starts != first):
            weights, away = np.zeros(3 * width, np.float32), width + first[j] - starts[j]
            weights[away : away + len(matched)] = matched[:, j]
            aligned[j] = weights[width : 2 * width]
        return aligned, starts

    def _allocate_memory(self) -> SearchMemory:
        pixels = self._pixels
        most, width, length = self._most, self._table.shapes.shape[1], self._length
        # Vectors that begin in the last trace may end behind it.
        traces = np.zeros((pixels + -(-width // length), length), np.float32)[:pixels]
        whole = self._number == length
        return SearchMemory(
            held=traces if whole else np.empty((pixels, self._number), np.float32),
            traces=traces,
            moments=np.empty((pixels, 2)),
            peaks=np.empty((most, 2)),
            score=np.zeros(length + WORD_BINS + 2, np.float32),
            places=np.zeros((4, length), np.int32),
            responses=np.empty(length, np.float32),
            free=self._weights.copy(),
            candidates=np.empty((pixels * most, CANDIDATE_COLUMNS)),
            rests=np.empty((pixels * most, width), np.float32),
            lone=np.empty(pixels * most, np.int64),
            crowded=np.empty(pixels * most, np.int64),
            estimates=np.empty((most, 5)),
            profile=np.empty((self._number, 3)),
        )

    def find_returns(self, pieces: Iterable[slice]) -> None:
        """Find the returns of some pixels.

        `pieces`: of the source's pixels, which are searched together; at most as many as there is
        memory for.
        """
        memory = self._spare.pop() if self._spare else self._allocate_memory()
        for piece in pieces:
            self._search_piece(piece, memory)
        self._spare.append(memory)

    def list_found(self) -> tuple[NDArray[np.int64], FloatArray]:
        """List all that was found so far, in raster and time order.

        Returns `pixel` (n,): number of the pixel; `values` (3, n): instant, s, sum of the fitted
        pulse over the bins, standard deviation of the instant, s.
        """
        pixel = np.empty(int(self._counts.sum()), np.int64)
        values = np.empty((3, pixel.size))
        list_returns(self._found, self._counts, pixel, values)
        return pixel, values

    def _search_piece(self, piece: slice, memory: SearchMemory) -> None:
        source, found, counts = self._source, self._found, self._counts
        pixels = source.pixels[piece]
        part = slice(pixels.size)
        held, traces = memory.held[part], memory.traces[part]
        source.fill(piece, held)
        if traces.shape != held.shape:
            traces[:, : self._number] = held
        moments, candidates, rests = memory.moments[part], memory.candidates, memory.rests
        table, half = self._table, self._table.half
        listed, alone, crowded = find_candidates(
            traces,
            pixels,
            self._times,
            self._weights,
            self._sharp,
            self._runs,
            self._edges,
            self._words,
            self._of_interest,
            self._least,
            self._matched,
            self._starts,
            self._sums,
            self._gains,
            self._windows,
            self._limits,
            self._even,
            half,
            memory.score,
            memory.places,
            memory.responses,
            memory.free,
            memory.peaks,
            moments,
            candidates,
            rests,
            counts,
            memory.lone,
            memory.crowded,
        )
        shapes, slopes, sums = table.shapes, table.slopes, table.sums
        around = traces, moments, self._even, half, candidates, rests
        fit_lone_returns(*around, memory.lone, alone, shapes, slopes, sums)
        fit_crowded_returns(*around, memory.crowded, crowded, shapes, slopes, table.tails, sums)
        measure_returns_by_table(
            candidates,
            listed,
            rests,
            self._least_ratio,
            pixels,
            self._times,
            shapes,
            slopes,
            sums,
            found,
            counts,
        )
        if (counts[pixels] == NEEDS_EXACT_FIT).any():
            fit_returns_exactly(
                held,
                pixels,
                self._times,
                moments,
                self._least_ratio,
                self._windows,
                candidates,
                listed,
                self._pulse,
                memory.estimates,
                memory.profile,
                found,
                counts,
            )


def _fill_up(number: int, step: int) -> int:
    """The least multiple of `step` that is not smaller."""
    return -(-number // step) * step


def _pad(values: NDArray[Any], length: int) -> NDArray[Any]:
    """Fill the last axis up with zeros."""
    padded = np.zeros((*values.shape[:-1], length), values.dtype)
    padded[..., : values.shape[-1]] = values
    return padded


def _count(marked: NDArray[np.bool_], starts: NDArray[np.int64], width: int) -> NDArray[np.int64]:
    """How many bins are marked in windows that begin at `starts`."""
    before = np.concatenate([[0], np.cumsum(marked)])
    ends = np.minimum(starts + width, marked.size)
    counts: NDArray[np.int64] = before[ends] - before[starts]
    return counts
