"""The rows of a shot in which something may have come back.

The filter that is matched to a lone pixel is a product with the transpose of the operator, as large
as the recovery itself. But only whether any pixel reaches a limit is asked for, and of a few
neighbours in a row it can be said for an eighth of the work that none does: each view's light falls
between two neighbouring measurements, at nearly the same fraction for all of them, so that none gets
more than the highest value that interpolation there has in a short window.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from tofclip.arrays import BoolArray, Float32Array, FloatArray, IntArray, empty_aligned
from tofclip.errors import InputError
from tofclip.lidar.pulse import TraceBins
from tofclip.operators.sparse import Tiles
from tofclip.solvers.direct import GROUP_PIXELS, InverseTraces
from tofclip.threads import LANES, count_block_threads, run_blocks

WINDOW = 4  # measurements under a window: a pair of pairs
FRACTIONS = 4  # parts into which the way from a measurement to the next one is cut
# By which each part reaches into its neighbours, relative to its length: pixels whose fractions are
# alike but for rounding share a window.
FRACTION_SLACK = 0.01
ROUNDING_MARGIN = 1e-4  # by which a bound is raised: sums in float32 may be off by a tenth of it

# a sum over so much of a Gaussian pulse stands out nearly as far as the matched filter's
BOX_LENGTH_WIDTHS = 1.7
DARK_FRACTION, DARKEST_FRACTION = 0.25, 0.05
MAX_DARK_ENERGY_RATIO, NOISE_ENERGY_RATIO = 1.5, 1.25  # in mean square; noise alone makes a tenth
THRESHOLD_FACTOR = 1.2  # than the limit has an instant to stand out
MIN_DARK_ROWS = 24  # dark rows at least, which know the noise of a dark pixel to a seventh
MAX_ROW_FRACTION = 0.75  # of all rows: what needs more of them is as well searched everywhere
GAP_INSTANTS = LANES + 16
"""Places beyond a column's sums: whole vectors need no end of their own, and columns are an odd number
of cache lines apart, so that neighbours share no place of the cache."""


class BrightFrameFinder:
    """Says in which frames the matched filter of any pixel reaches a limit. `tiles`: the operator's
    transpose, a row for each pixel; its entries are not negative; `measurements`: columns of it;
    `group_pixels`: successive rows that are ruled out together: neighbours in a row of the picture.
    """

    def __init__(self, tiles: Tiles, measurements: int, group_pixels: int) -> None:
        if tiles.values.size and tiles.values.min() < 0:
            raise InputError("bright frames are found for operators without negative entries")
        self._tiles, self._group_pixels = tiles, group_pixels
        pixels = tiles.starts.shape[1] - 1
        row = np.repeat(
            np.tile(np.arange(pixels), len(tiles.starts)), np.diff(tiles.starts, axis=1).ravel()
        )
        energy = np.bincount(row, tiles.values.astype(np.float64) ** 2, minlength=pixels)
        scales = np.divide(1, np.sqrt(energy), out=np.zeros(pixels), where=energy > 0)
        self._scales = scales.astype(tiles.values.dtype)
        pixel, column, weight, fraction = _list_pairs(row, tiles)

        # Pairs of a group at nearly the same fraction share a window, as far as it reaches.
        group = pixel // group_pixels
        part = np.clip((FRACTIONS * fraction + FRACTION_SLACK).astype(np.int64), 0, FRACTIONS - 1)
        order = np.lexsort((column, part, group))
        group, part, column = group[order], part[order], column[order]
        begins = (np.diff(group, prepend=-1) != 0) | (np.diff(part, prepend=-1) != 0)
        run = np.flatnonzero(begins | (np.diff(column, prepend=0) > WINDOW))
        lengths = np.diff(run, append=column.size)
        step = (column - np.repeat(column[run], lengths)) // WINDOW
        run_number = np.repeat(np.arange(run.size), lengths)
        begins = (np.diff(run_number, prepend=-1) != 0) | (np.diff(step, prepend=-1) != 0)
        first = np.flatnonzero(begins)
        windows = (part[first] * measurements + column[first]).astype(np.int32)
        starts = np.searchsorted(group[first], np.arange(-(-pixels // group_pixels) + 1))
        # the most that a window of ones adds to any pixel of the group
        window = np.repeat(np.arange(first.size), np.diff(first, append=column.size))
        share = np.bincount(
            window * group_pixels + pixel[order] % group_pixels,
            (weight * scales[pixel])[order],
            minlength=first.size * group_pixels,
        )
        highest = share.reshape(-1, group_pixels).max(axis=1, initial=0)
        self._groups = starts, windows, (highest * (1 + ROUNDING_MARGIN)).astype(np.float32)

    def find(self, readings: Float32Array, span: slice, limit: float) -> BoolArray:
        """Say in which frames of a span a pixel stands out: in which the response ``a'f / |a|``
        reaches the limit, a being its column of the operator. `readings` (measurements, frames) are
        in units of their noise. Whole blocks of `LANES` frames from the first of the span on lie
        within them.
        """
        # the compiler takes as long to import as all else
        from tofclip.lidar.signal_row_kernels import find_bright_frames

        number = span.stop - span.start
        bright = np.full(number, limit <= 0)
        table = self._tiles, self._scales, self._group_pixels, self._groups, readings

        def work(piece: slice) -> None:
            begin = span.start + piece.start
            find_bright_frames(*table, begin, np.float32(limit), bright[piece])

        if limit > 0:
            run_blocks(work, number, _divide_into_lanes(number))
        return bright


def _list_pairs(row: IntArray, tiles: Tiles) -> tuple[IntArray, IntArray, FloatArray, FloatArray]:
    """List each row's entries two by two, as far as they are neighbours: row, first column, sum of
    both, and what the second one has of it. `row`: of each entry.
    """
    order = np.lexsort((tiles.columns, row))
    row, column, value = row[order], tiles.columns[order].astype(np.int64), tiles.values[order]
    # the place of each entry in its run of neighbours: the even ones begin a pair
    begins = np.flatnonzero((np.diff(row, prepend=-1) != 0) | (np.diff(column, prepend=-2) != 1))
    place = np.arange(row.size) - np.repeat(begins, np.diff(begins, append=row.size))
    first = np.flatnonzero(place % 2 == 0)
    alone = np.append(place[1:], 0)[first] != place[first] + 1
    second = np.where(alone, 0.0, np.append(value[1:], 0)[first])
    weight = value[first] + second
    fraction = np.divide(second, weight, out=np.zeros(weight.size), where=weight > 0)
    return row[first], column[first], weight, fraction


@dataclass(frozen=True)
class RowBlock:
    """Successive rows that are recovered alike."""

    rows: slice
    inverse: InverseTraces


class SignalRowFinder:
    """Finds the rows of a shot that hold light, among those where only noise is.

    Measurements are summed over a pulse's length, once per pulse width, and each sum is brought to
    the noise of its column. Back-projection, which is the matched filter of a lone pixel in even
    noise, then says how far the brightest pixel of each instant stands out. Of noise alone the
    brightest of 16 000 pixels stands out by 4.2, and by more than 1.2 times the usual limit of 5 in
    one instant of three hundred: such instants are searched in vain.

    What this leaves out is the faintest of lone pixels. The search judges a return by the inverse,
    in which a pixel stands out less than in the back-projection (in the seed paper's instrument
    0.63 to 0.93 times as far, mostly 0.9), but by the noise of the pixel's own trace, to which
    bright neighbours add at other instants: four times as much as noise alone, in the
    demonstration's scene. So where there are other objects, whatever reaches the limit is seen
    here. In full darkness, a single pixel that stands out of its trace by 5, 6, 7 and 8 is found in
    15, 43, 78 and 98 of 100 cases; a search of all rows finds 50, 75, 98 and 100. The light of
    several pixels adds up.

    `places`: in order and without gaps; `pulse_rows`: full width at half maximum of a return, a
    symmetric one, in rows; `limit`: signal-to-noise from which a response counts as a return;
    `reach`: rows on either side of a return that its search and its fit look at.
    """

    def __init__(
        self, places: Sequence[RowBlock], pulse_rows: float, limit: float, reach: int
    ) -> None:
        self.rows = places[-1].rows.stop
        self._reach, self._threshold = reach, THRESHOLD_FACTOR * limit
        self._step = max(1, round(pulse_rows))
        self._length = min(self.rows, max(1, round(BOX_LENGTH_WIDTHS * pulse_rows)))
        middles: list[IntArray] = []
        # each operator with its instants, a multiple of `LANES`
        self._owners: list[tuple[BrightFrameFinder, slice]] = []
        finders: dict[InverseTraces, BrightFrameFinder] = {}
        last = 0
        for place in places:
            instants, first = np.arange(place.rows.start, place.rows.stop, self._step), last
            last += -(-instants.size // LANES) * LANES
            middles.append(np.pad(instants, (0, last - first - instants.size), constant_values=-1))
            if (inverse := place.inverse) not in finders:
                (measurements,) = inverse.inverse.operator.shape_out
                finders[inverse] = BrightFrameFinder(inverse.tiles, measurements, GROUP_PIXELS)
            self._owners.append((finders[inverse], slice(first, last)))
        self._middles = np.concatenate(middles)
        self._taken = self._middles >= 0
        self._starts = np.clip(self._middles - self._length // 2, 0, self.rows - self._length)

    def bins(self, measurements: Float32Array) -> TraceBins:
        """Return the rows of rectified measurements, (columns, rows), that are worth recovering, and a
        sample of the dark ones that stands for the rest. All rows, if a quarter of the shot is not
        nearly as dark as the darkest twentieth, or if not much would be left out.
        """
        lit = self._find_signal_bins(self._sum_boxes(measurements))
        searched = self._mark_rows_near(lit, self._step // 2 + 1)
        kept = self._mark_rows_near(lit, self._step // 2 + 1 + self._reach)
        number = MIN_DARK_ROWS + -(int(kept.sum()) + MIN_DARK_ROWS) % LANES
        dark = np.flatnonzero(~kept)
        if self.rows - dark.size + number > MAX_ROW_FRACTION * self.rows:
            return TraceBins.all_bins(self.rows)
        bin_weights = kept.astype(np.float32)
        chosen = np.linspace(0, dark.size - 1, number).round().astype(np.intp)
        bin_weights[dark[chosen]] = dark.size / number
        numbers = np.flatnonzero(bin_weights)
        return TraceBins(numbers, searched[numbers], bin_weights[numbers])

    def _sum_boxes(self, measurements: Float32Array) -> Float32Array:
        """Sums over a pulse's length about each instant, (columns, instants), and a gap of zeros."""
        from tofclip.camera.kernels import sum_boxes

        instants = self._starts.size
        sums = empty_aligned((len(measurements), instants + GAP_INSTANTS), np.float32)
        sums[:, instants:] = 0
        by_rows = np.ascontiguousarray(measurements.T)  # as the rectifier leaves them: no copy

        def work(piece: slice) -> None:
            sum_boxes(by_rows, self._starts, self._length, (piece.start, piece.stop), sums)

        run_blocks(work, instants, _divide_into_lanes(instants))
        return sums

    def _find_signal_bins(self, sums: Float32Array) -> BoolArray:
        from tofclip.lidar.signal_row_kernels import compute_energies, standardise_columns

        room = np.empty((2, self._starts.size), np.float32)
        compute_energies(sums, room)
        energy = room[0]
        measured = self._taken & (energy > 0)
        if not measured.any():
            return self._taken
        darkest, quiet = np.quantile(energy[measured], [DARKEST_FRACTION, DARK_FRACTION])
        if quiet > MAX_DARK_ENERGY_RATIO * darkest:
            return self._taken
        counted = measured & (energy <= max(quiet, NOISE_ENERGY_RATIO * darkest))
        weights = counted.astype(np.float32)

        def work(piece: slice) -> None:
            standardise_columns(sums, weights, (piece.start, piece.stop))

        run_blocks(work, len(sums), -(-len(sums) // count_block_threads()))
        lit = [finder.find(sums, own, self._threshold) for finder, own in self._owners]
        return self._taken & np.concatenate(lit)

    def _mark_rows_near(self, lit: BoolArray, distance: int) -> BoolArray:
        """Rows within `distance` of the middle of a lit instant."""
        near = np.zeros(self.rows, bool)
        near[self._middles[lit]] = True
        return scipy.ndimage.maximum_filter1d(near, 2 * distance + 1, mode="constant")


def _divide_into_lanes(instants: int) -> int:
    """Instants that each thread takes, a multiple of `LANES`."""
    return -(-instants // (count_block_threads() * LANES)) * LANES
