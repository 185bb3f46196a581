"""From a raw streak image to the measurements that the forward operator predicts."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from tofclip.arrays import BoolArray, Float32Array, FloatArray, IndexArray, IntArray
from tofclip.camera.model import Camera
from tofclip.errors import CalibrationError, require, require_shape
from tofclip.threads import run_blocks, split_blocks
from tofclip.units import MAD_TO_SIGMA

DARK_ROW_FRACTION = 0.05
# Deviations within which readings of the dark lie, of whole counts half of one at least: what is brighter
# is light that comes in quiet rows as well
DARK_SIGMAS, LEAST_SPREAD_COUNT = 5.0, 0.5
ROWS_PER_BLOCK = 64
NO_LIGHT_MESSAGE = "nothing rises above the dark level; was there any light?"


@dataclass(frozen=True)
class Measurement:
    """Rectified measurements with the dark level taken off: `values` (columns, frames) float32,
    counts on the slit, which may be negative as noise about a dark level is; `valid` (columns,
    frames) is False where a sensor pixel was saturated or dead, or where the raw image ends.
    """

    values: Float32Array
    valid: BoolArray

    def select(self, frames: slice | IndexArray) -> Measurement:
        """Return the measurements of some `frames`, by a slice or by numbers."""
        return Measurement(self.values[:, frames], self.valid[:, frames])


def measure(
    counts: Float32Array, saturated: BoolArray | None, camera: Camera, dark: float | None = None
) -> Measurement:
    """Subtract the dark level from raw `counts` (rows, columns), rows being time, and rectify the sweep of
    `camera`; without one the rows are taken as they are. What is `saturated` (rows, columns) is not
    trusted; `dark` is a level in counts, by default `estimate_dark_level` of the picture.
    `CalibrationError` where the picture is not as wide as the camera's slit, `InputError` where nothing
    remains above the dark level, or no measurement can be trusted.
    """
    return Rectifier(camera, counts.shape[0]).measure(counts, saturated, dark)


def require_width(counts: Float32Array, camera: Camera) -> None:
    """Raise `CalibrationError` unless `counts` are as wide as the slit of `camera`."""
    if counts.shape[1] != camera.slit_width_px:
        turned = ", or turn the picture" if counts.shape[0] == camera.slit_width_px else ""
        raise CalibrationError(
            f"the streak image has {counts.shape[1]} columns but the camera's slit has {camera.slit_width_px}; "
            f"use the camera file that belongs to this instrument{turned}"
        )


def estimate_dark_level(counts: Float32Array) -> float:
    """Mean of the quietest rows of `counts`, (rows, columns), without what is far off, as hot pixels.

    Taken from whole rows, before or after the light came, so that it stays where the
    measurements scatter about it: the least value of a picture would turn noise into an offset, and so
    would the median of few photons, which is a whole number of them. Of every other column in rows where
    the columns between are as dark as in the quietest: rows chosen by their own noise would be too dark.
    """
    halves = (counts[:, ::2], counts[:, 1::2]) if counts.shape[1] > 1 else (counts, counts)
    means = [half.mean(axis=1, dtype=np.float64) for half in halves]
    levels = [_average_dark(half, *means[::way]) for half, way in zip(halves, (1, -1), strict=True)]
    return float(np.mean(levels))


def _average_dark(counts: Float32Array, own: FloatArray, beside: FloatArray) -> float:
    """Mean of rows that are dark by the mean of the columns `beside`, (rows,)."""
    # without noise there is nothing else by which a row is known to be lit
    quiet = np.lexsort((own, beside))[: _count_quiet_rows(counts)]
    level = np.median(counts[quiet])
    if np.all(counts[quiet] == level):  # nothing fluctuates: what other rows have is light
        return float(level)
    spread = max(MAD_TO_SIGMA * np.median(np.abs(counts[quiet] - level)), LEAST_SPREAD_COUNT)

    def average(rows: IndexArray | BoolArray) -> float:
        dark = counts[rows]
        return float(
            np.mean(dark, where=np.abs(dark - level) <= DARK_SIGMAS * spread, dtype=np.float64)
        )

    alike = beside <= average(quiet) + spread / np.sqrt(counts.shape[1])
    alike[quiet] = True
    return average(alike)


def part_quiet_rows(counts: Float32Array) -> tuple[IndexArray, IndexArray]:
    """Return the numbers of the quietest rows of `counts`, (rows, columns), and of all others."""
    # a product, which reads the picture at the rate of memory: NumPy's sum takes thrice as long
    row_sums = counts @ np.ones(counts.shape[1], np.float32)
    # Rows, not pixels: choosing the darkest pixels would choose those whose noise is low.
    order = np.argsort(row_sums)
    number = _count_quiet_rows(counts)
    return order[:number], order[number:]


def _count_quiet_rows(counts: Float32Array) -> int:
    return max(1, round(DARK_ROW_FRACTION * len(counts)))


class Rectifier:
    """Turns raw streak images of one `camera`, so many `rows` high, into measurements; holding one
    saves working out the sweep for every shot. Memory: as much as a raw picture, twice if the
    sweep moves light across columns, and at first use four times as much for a moment.
    """

    def __init__(self, camera: Camera, rows: int) -> None:
        self.camera = camera
        self._dead = np.flatnonzero(camera.dead_columns)
        row, column = np.ogrid[:rows, : camera.slit_width_px]
        position = (row.astype(np.float64), column.astype(np.float64))
        raw = position if camera.sweep is None else camera.sweep.raw_position(*position)
        shape = (rows, camera.slit_width_px)
        # An exact row must not become one that lies beyond the picture by a rounding error of
        # float32.
        self._raw_row = np.ascontiguousarray(np.broadcast_to(raw[0], shape), dtype=np.float32)
        # A sweep that only delays keeps light in its column, and needs half of the look-ups.
        raw_column = np.broadcast_to(raw[1], shape)
        own = np.broadcast_to(column.astype(np.float32), shape)
        self._stays_in_column = bool(np.all(raw_column == own))
        moved = np.ascontiguousarray(raw_column, dtype=np.float32)
        self._raw_column = own if self._stays_in_column else moved

    def measure(
        self,
        counts: Float32Array,
        saturated: BoolArray | None = None,
        dark: float | None = None,
        delay: float = 0.0,
    ) -> Measurement:
        """Subtract the dark level and rectify the sweep (bilinear); `counts`, `saturated` and `dark`
        as for `tofclip.camera.measure`. A measurement is bad if any raw pixel that contributes to
        it is. `delay`: rows by which this shot's light comes later than the camera's calibration
        says.
        """
        self._prepare(counts)
        # where all that contributes is good the sum of its weights is whole
        good = np.ones(counts.shape, np.float32) if saturated is None else ~saturated
        valid = (self._sample(good.astype(np.float32), 0.0, delay) == 1).T
        require(
            valid.any(),
            "no measurement can be trusted: every pixel is saturated, dead or outside the sweep",
        )
        measurements = self.rectify(counts, dark, delay)
        # Light that only saturated pixels show would let a recovery run on nothing.
        require(np.any((measurements > 0) & valid), NO_LIGHT_MESSAGE)
        return Measurement(measurements, valid)

    def rectify(
        self, counts: Float32Array, dark: float | None = None, delay: float = 0.0
    ) -> Float32Array:
        """Return the measurements alone, (columns, rows), arguments as for `measure`, for methods that
        cannot leave out single ones: 0 beyond the raw image and in dead columns. All columns of a
        row lie side by side in memory, as in the raw picture.
        """
        level = estimate_dark_level(counts) if dark is None else dark
        measurements = self._sample(self._prepare(counts), level, delay)
        # Some rows at a time: noise about the dark level is above it in the first ones already.
        pieces = split_blocks(len(measurements), ROWS_PER_BLOCK)
        require(any(measurements[piece].max() > 0 for piece in pieces), NO_LIGHT_MESSAGE)
        return measurements.T

    def _sample(self, raw: Float32Array, dark: float, delay: float) -> Float32Array:
        """The rectified picture of a raw one, (rows, columns); 0 beyond it and in dead columns: methods
        that take no mask must not see a stuck column as light.
        """
        from tofclip.camera.kernels import sample_bilinear, sample_delayed_rows, sample_rows

        level, shift, measurements = np.float32(dark), np.float32(delay), np.empty_like(raw)

        def work(piece: slice) -> None:
            row, found = self._raw_row[piece], measurements[piece]
            if self._stays_in_column and delay == 0:
                runs, starts = self._runs
                sample_rows(raw, level, row, runs, starts[piece.start : piece.stop + 1], found)
            elif self._stays_in_column:
                sample_delayed_rows(raw, level, row, shift, found)
            else:
                column = np.ascontiguousarray(self._raw_column[piece])
                sample_bilinear(raw, level, row, column, shift, found)

        run_blocks(work, len(measurements), ROWS_PER_BLOCK)
        measurements[:, self._dead] = 0
        return measurements

    @cached_property
    def _runs(self) -> tuple[NDArray[np.uint64], IntArray]:
        """Neighbours in a row between the same two raw rows, and where each row's begin."""
        rows, columns = self._raw_row.shape
        top = np.clip(self._raw_row.astype(np.int64), 0, max(rows - 2, 0))
        top[(self._raw_row < 0) | (self._raw_row > rows - 1)] = rows
        starts = np.ones(top.shape, bool)
        np.not_equal(top[:, 1:], top[:, :-1], out=starts[:, 1:])
        row, first = np.nonzero(starts)
        # a run ends where the next one of its row begins
        last = np.where(np.append(row[1:], -1) == row, np.append(first[1:], 0), columns)
        runs = np.stack([first, last, top[row, first]], axis=1).astype(np.uint64)
        return runs, np.searchsorted(row, np.arange(rows + 1))

    def _prepare(self, counts: Float32Array) -> Float32Array:
        """Return a streak image that fits as compiled loops take it."""
        require_width(counts, self.camera)
        require_shape("a streak image of this camera", self._raw_row.shape, counts.shape)
        return np.ascontiguousarray(counts, np.float32)
