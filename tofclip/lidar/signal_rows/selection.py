"""The rows of a shot in which something may have come back."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tofclip.arrays import empty_aligned
from tofclip.camera import Rectifier
from tofclip.camera.row_sums import RowSums
from tofclip.lidar.signal_rows.bright_frames import BrightFrameFinder
from tofclip.lidar.traces import TraceBins
from tofclip.solvers.traces import GROUP_PIXELS, InverseTraces
from tofclip.threads import LANES, count_block_threads, run_blocks

FloatImage = NDArray[np.float32]
Mask = NDArray[np.bool_]

BOX_LENGTH_WIDTHS = (
    1.7  # a sum over so much of a Gaussian pulse stands out nearly as far as the matched filter's
)
DARK_FRACTION, DARKEST_FRACTION = 0.25, 0.05
MAX_DARK_ENERGY_RATIO, NOISE_ENERGY_RATIO = 1.5, 1.25  # in mean square; noise alone makes a tenth
THRESHOLD_FACTOR = 1.2  # than the limit has an instant to stand out
MIN_DARK_ROWS = 24  # dark rows at least, which know the noise of a dark pixel to a seventh
MAX_ROW_FRACTION = 0.75  # of all rows: what needs more of them is as well searched everywhere
GAP_INSTANTS = LANES + 16
"""Places beyond a column's sums: blocks of twice `LANES` need no end of their own, and columns are an
odd number of cache lines apart, so that neighbours share no place of the cache."""


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
        middles: list[NDArray[np.int64]] = []
        self._owners: list[tuple[BrightFrameFinder, slice]] = []
        """Each operator with its instants, a multiple of `LANES`."""
        finders: dict[InverseTraces, BrightFrameFinder] = {}
        first = 0
        for place in places:
            instants = np.arange(place.rows.start, place.rows.stop, self._step)
            last = first + -(-instants.size // LANES) * LANES
            middles.append(np.pad(instants, (0, last - first - instants.size), constant_values=-1))
            if place.inverse not in finders:
                (measurements,) = place.inverse.inverse.operator.shape_out
                finders[place.inverse] = BrightFrameFinder(
                    place.inverse.tiles, measurements, GROUP_PIXELS
                )
            self._owners.append((finders[place.inverse], slice(first, last)))
            first = last
        self._middles = np.concatenate(middles)
        self._taken = self._middles >= 0
        self._row_sums: RowSums | None = None
        self._starts = np.clip(self._middles - self._length // 2, 0, self.rows - self._length)

    def sum_measurements(self, measurements: FloatImage) -> FloatImage:
        """Add up rectified measurements, (columns, rows), as `bins` needs them."""
        from tofclip.camera.kernels import sum_boxes

        sums = self._allocate_sums(measurements.shape[0])
        by_rows = np.ascontiguousarray(measurements.T)  # as the rectifier leaves them: no copy
        run_blocks(
            lambda piece: sum_boxes(
                by_rows, self._starts, self._length, (piece.start, piece.stop), sums
            ),
            self._starts.size,
            _divide_into_lanes(self._starts.size, count_block_threads()),
        )
        return sums

    def sum_streak(self, counts: FloatImage, rectifier: Rectifier) -> tuple[FloatImage, float]:
        """Add up the measurements of a raw streak image, (rows, columns), and return its dark level,
        counts, as well. The camera is that of the first shot, and so is its `rectifier`.
        """
        if self._row_sums is None:
            self._row_sums = RowSums(rectifier, self._starts, self._length)
        sums = self._allocate_sums(counts.shape[1])
        return sums, self._row_sums.add_up(counts, sums)

    def _allocate_sums(self, columns: int) -> FloatImage:
        """As weights have it: whole cache lines, and a gap between columns, of zeros."""
        instants = self._starts.size
        sums: FloatImage = empty_aligned((columns, instants + GAP_INSTANTS), np.float32)
        sums[:, instants:] = 0
        return sums

    def bins(self, sums: FloatImage) -> TraceBins:
        """Return the rows worth recovering, and a sample of the dark ones that stands for the rest.

        All rows, if a quarter of the shot is not nearly as dark as the darkest twentieth, or if not
        much would be left out.

        `sums` (columns, instants and some): of `sum_measurements` or `sum_streak`; overwritten.

        Memory: as much as the measurements, divided by the rows of a pulse width.
        """
        lit = self._find_signal_bins(sums)
        searched = self._mark_rows_near(lit, self._step // 2 + 1)
        kept = self._mark_rows_near(lit, self._step // 2 + 1 + self._reach)
        number = MIN_DARK_ROWS + -(int(kept.sum()) + MIN_DARK_ROWS) % LANES
        dark = np.flatnonzero(~kept)
        if self.rows - dark.size + number > MAX_ROW_FRACTION * self.rows:
            return TraceBins.all_bins(self.rows)
        bin_weights = kept.astype(np.float32)
        bin_weights[dark[np.linspace(0, dark.size - 1, number).round().astype(np.intp)]] = (
            dark.size / number
        )
        numbers = np.flatnonzero(bin_weights)
        return TraceBins(numbers, searched[numbers], bin_weights[numbers])

    def _find_signal_bins(self, sums: FloatImage) -> Mask:
        from tofclip.lidar.signal_rows.kernels import compute_energies, standardise_columns

        instants, threads = self._starts.size, count_block_threads()
        room = np.empty((2, instants), np.float32)
        compute_energies(sums, room)
        energy = room[0]
        measured = self._taken & (energy > 0)
        if not measured.any():
            return self._taken
        darkest, quiet = np.quantile(energy[measured], [DARKEST_FRACTION, DARK_FRACTION])
        if quiet > MAX_DARK_ENERGY_RATIO * darkest:
            return self._taken
        counted = (measured & (energy <= max(quiet, NOISE_ENERGY_RATIO * darkest))).astype(
            np.float32
        )
        run_blocks(
            lambda piece: standardise_columns(sums, counted, (piece.start, piece.stop)),
            len(sums),
            -(-len(sums) // threads),
        )
        lit = np.concatenate(
            [finder.find(sums, own, self._threshold) for finder, own in self._owners]
        )
        found: Mask = self._taken & lit
        return found

    def _mark_rows_near(self, lit: Mask, distance: int) -> Mask:
        """Rows within `distance` of the middle of a lit instant."""
        middles = self._middles[lit]
        steps = np.zeros(self.rows + 1, np.int64)
        np.add.at(steps, np.maximum(middles - distance, 0), 1)
        np.add.at(steps, np.minimum(middles + distance + 1, self.rows), -1)
        near: Mask = np.cumsum(steps[:-1]) > 0
        return near


def _divide_into_lanes(instants: int, threads: int) -> int:
    """Instants that each thread takes, a multiple of `LANES`."""
    return -(-instants // (threads * LANES)) * LANES
