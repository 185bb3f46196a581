"""The search for returns in NumPy's traces, some pixels at once: the compiled steps in their order."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from tofclip.arrays import AnyArray, BoolArray, Float32Array, FloatArray, IntArray
from tofclip.lidar.fit_kernels import list_returns, search_traces
from tofclip.lidar.peak_kernels import (
    CANDIDATE_COLUMNS,
    WORD_BINS,
    Axis,
    Limits,
    Room,
)
from tofclip.lidar.pulse import PulseFilters, Traces, list_windows
from tofclip.lidar.significance import Detection
from tofclip.vectors import LENGTH

NEIGHBOUR_FRACTION = 0.5  # of what is of interest: weaker peaks do not move a return beside them


class TraceSearch:
    """The search in some traces, at most `pixels` of them together, and what it has found so far.

    Compiled loops take a vector of bins at a time. Behind the last bin the axis, of instants `times`,
    is filled up with bins that weigh nothing and are not searched, to a whole number of vectors that
    holds the filters.
    """

    def __init__(
        self,
        times: FloatArray,
        source: Traces,
        filters: PulseFilters,
        detection: Detection,
        pixels: int,
    ) -> None:
        bins, self._most = source.bins, detection.max_returns
        self._source, self._pixels = source, pixels
        self._spare: list[tuple[Float32Array, Float32Array, Room]] = []
        self._found = np.empty((source.pixels.size, self._most, 3))
        self._counts = np.zeros(source.pixels.size, np.int64)
        self._pulse, self._table = filters.kernel, filters.table
        scale = self._pulse[1]
        self._number = number = bins.numbers.size
        sharp, matched = (
            np.take(one, bins.numbers, axis=1) for one in (filters.sharp, filters.matched)
        )
        widths = len(sharp) + LENGTH, _fill_up(len(matched), LENGTH)
        self._length = length = _fill_up(max(number, *widths), 2 * LENGTH)
        self._searched = _pad(bins.search_mask, length)
        self._searched[[0, number - 1]] = False  # a maximum has neighbours
        # Beyond the bins that are searched the filters reach into what lies elsewhere on the axis.
        sharp = _pad(sharp * bins.search_mask, length)
        runs, edges, words = _place_vectors(sharp, self._searched)
        aligned, starts = _align(matched, length, widths[1])
        self._axis = Axis(
            times=np.ascontiguousarray(times),
            bin_weights=_pad(bins.bin_weights, length),
            sharp=sharp,
            runs=runs,
            edges=edges,
            words=words,
            matched=aligned,
            starts=starts,
            sums=filters.sums[bins.numbers],
            windows=list_windows(times, scale, filters.fwhm).astype(np.int32),
            even=self._table.find_even_bins(bins),
        )
        self._limits = Limits(
            reach=2 * (scale[3] - scale[2]),
            signal_to_noise=float(detection.signal_to_noise),
            pixel_fraction=float(detection.min_pixel_fraction),
            last_instant=float(times[bins.search_mask].max(initial=0.0)),
            sharp_gain=filters.gains[0],
            matched_gain=filters.gains[1],
            background_gain=0.0,
            lowest_response=0.0,
            of_interest=np.empty(0, np.float32),
            least=np.empty(0, np.float32),
        )
        self.set_least(np.zeros(number, np.float32))

    def set_least(self, least: Float32Array) -> None:
        """Say which response, (bins,), a return must exceed to be of interest; 0: none is known."""
        lowest, gain = float(least.min()), self._limits.sharp_gain
        # None exceeds it where nothing is searched.
        of_interest = np.full(self._length + WORD_BINS, np.inf, np.float32)
        searched = np.flatnonzero(self._searched)
        share = np.float32(gain / self._limits.matched_gain * NEIGHBOUR_FRACTION)
        of_interest[searched] = share * least[searched]
        self._limits = self._limits._replace(
            # the sharp filter's response to the background, below which nothing of interest can lie
            background_gain=gain if lowest > 0 else 0.0,
            lowest_response=lowest,
            of_interest=of_interest,
            least=least,
        )

    def find_returns(self, pieces: Iterable[slice]) -> None:
        """Find the returns of some of the source's pixels, those of each piece together."""
        memory = self._spare.pop() if self._spare else self._allocate_memory()
        everywhere = self._axis, self._limits, self._table, self._pulse
        for piece in pieces:
            pixels = self._source.pixels[piece]
            handed, traces = (one[: pixels.size] for one in memory[:2])
            self._source.fill(piece, handed)
            if traces.shape != handed.shape:
                traces[:, : self._number] = handed
            search_traces(traces, pixels, *everywhere, memory[2], self._found, self._counts)
        self._spare.append(memory)

    def list_found(self) -> tuple[IntArray, FloatArray]:
        """List all that was found so far, in raster and time order: numbers of the pixels, and (3, n)
        instants, s, sums of the fitted pulses over the bins, standard deviations of the instants, s.
        """
        pixel = np.empty(int(self._counts.sum()), np.int64)
        values = np.empty((3, pixel.size))
        list_returns(self._found, self._counts, pixel, values)
        return pixel, values

    def _allocate_memory(self) -> tuple[Float32Array, Float32Array, Room]:
        """What a thread's search overwrites: (pixels, bins) traces as they are handed out, the same in
        whole vectors of bins, which is the same memory where those are whole, and all else.
        """
        length, most, pixels = self._length, self._most, self._pixels
        listed, width = pixels * most, self._table.shapes.shape[1]
        # Vectors that begin in the last trace may end behind it.
        traces = np.zeros((pixels + -(-width // length), length), np.float32)[:pixels]
        whole = self._number == length
        room = Room(
            score=np.zeros(length + WORD_BINS + 2, np.float32),
            places=np.zeros((4, length), np.int32),
            responses=np.empty(length, np.float32),
            free=self._axis.bin_weights.copy(),
            peaks=np.empty((most, 2)),
            moments=np.empty((pixels, 2)),
            candidates=np.empty((listed, CANDIDATE_COLUMNS)),
            rests=np.empty((listed, width), np.float32),
            fitted=np.empty(listed, np.int64),
            estimates=np.empty((most, 5)),
            level=np.empty(self._number),
        )
        handed = traces if whole else np.empty((pixels, self._number), np.float32)
        return handed, traces, room


def _place_vectors(sharp: Float32Array, searched: BoolArray) -> tuple[IntArray, IntArray, IntArray]:
    """Where the sharp filter is applied, in vectors, an even number of them, and in single bins at the
    ends, and where maxima are sought.
    """
    width, length = sharp.shape
    first, last = width // 2, length - LENGTH - width + width // 2
    runs = np.append(np.arange(first, last, LENGTH), last)
    words = np.arange(0, length, WORD_BINS)
    # the neighbours of what is searched are compared with it
    near = np.any(sharp != 0, axis=0)
    at_ends = near.copy()
    at_ends[first : last + LENGTH] = False

    def is_marked(marked: BoolArray, starts: IntArray, step: int) -> Any:
        before = np.concatenate([[0], np.cumsum(marked)])
        return before[np.minimum(starts + step, marked.size)] > before[starts]

    runs = runs[is_marked(near, runs, LENGTH)]
    words = words[is_marked(searched, words, WORD_BINS)]
    return np.append(runs, runs[-1:]) if runs.size % 2 else runs, np.flatnonzero(at_ends), words


def _align(matched: Float32Array, length: int, width: int) -> tuple[Float32Array, IntArray]:
    """The matched filters, (bins, width), each from a bin that leaves room, and these bins."""
    number = matched.shape[1]
    first = np.arange(number) - len(matched) // 2
    starts = np.clip(first, 0, length - width)
    aligned = np.zeros((number, width), np.float32)
    aligned[:, : len(matched)] = matched.T
    for j in np.flatnonzero(starts != first):
        weights, away = np.zeros(3 * width, np.float32), width + first[j] - starts[j]
        weights[away : away + len(matched)] = matched[:, j]
        aligned[j] = weights[width : 2 * width]
    return aligned, starts


def _fill_up(number: int, step: int) -> int:
    """The least multiple of `step` that is not smaller."""
    return -(-number // step) * step


def _pad(values: AnyArray, length: int) -> AnyArray:
    """Fill the last axis up with zeros."""
    padded = np.zeros((*values.shape[:-1], length), values.dtype)
    padded[..., : values.shape[-1]] = values
    return padded
