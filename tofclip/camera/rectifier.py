"""From a raw streak image to the measurements that the forward operator predicts, and how these
fluctuate.

A retroreflector's light falls a part of a column beside where the model has it, as any pixel's
does. Of light ten times the usual that part is as bright as a wall; least squares then put streaks
along its lines and leave out wall pixels to make up for them. Everything but the glint itself is
seen by views in which the glint lies elsewhere. So a frame with a glint is recovered twice: without
the dazzled measurements, and with them for the pixels that no other measurement sees.

Sums of successive rectified rows, in one look at a raw streak image.

Of most shots few rows hold light. To find them, sums over a pulse's length do, for which no
rectified picture has to be written and read again; nor need the dark level be known beforehand,
which takes a look at all rows as well.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofclip.camera.model import Camera
from tofclip.errors import CalibrationError, InputError, ShapeError
from tofclip.operators import LineProjection
from tofclip.storage import Scalar
from tofclip.threads import LANES, count_block_threads, run_blocks, split_blocks

FloatImage = NDArray[np.float32]
Mask = NDArray[np.bool_]

DARK_ROW_FRACTION = 0.05
ROWS_PER_BLOCK = 64
NO_LIGHT_MESSAGE = "nothing rises above the dark level; was there any light?"


@dataclass(frozen=True)
class Measurement:
    """Rectified measurements with the dark level taken off.

    Parameters
    ----------
    values : (columns, frames) float32 array
        Counts on the slit, one column of the array for each instant. May be negative: noise about a
        dark level is.
    valid : (columns, frames) bool array
        False where a sensor pixel was saturated or dead, or where the raw image ends.
    """

    values: FloatImage
    valid: Mask


def measure(
    counts: FloatImage, saturated: Mask | None, camera: Camera, dark: float | None = None
) -> Measurement:
    """Subtract the dark level and rectify the sweep.

    Parameters
    ----------
    counts : (rows, columns) array
        Raw streak image, rows = time.
    saturated : (rows, columns) bool array or None
    camera : Camera
        Its sweep says where each rectified pixel lies; without one the rows are taken as they are.
    dark : float, optional
        Dark level in counts; by default `estimate_dark_level` of the picture.

    Returns
    -------
    Measurement
        Measurements (slit pixels, rows) float32 and their mask.

    Raises
    ------
    CalibrationError
        The picture is not as wide as the camera's slit.
    InputError
        Nothing remains above the dark level, or no measurement can be trusted.
    """
    return Rectifier(camera, counts.shape[0]).measure(counts, saturated, dark)


def require_width(counts: FloatImage, camera: Camera) -> None:
    """Raise `CalibrationError` unless the picture is as wide as the camera's slit.

    Parameters
    ----------
    counts : (rows, columns) float32 array
        Raw streak image.
    camera : Camera

    Raises
    ------
    CalibrationError
        The image is not as wide as the camera's slit.
    """
    if counts.shape[1] != camera.slit_width_px:
        raise CalibrationError(
            f"the streak image has {counts.shape[1]} columns but the camera's slit has {camera.slit_width_px}; "
            "use the camera file that belongs to this instrument"
        )


def estimate_dark_level(counts: FloatImage, row_sums: FloatImage | None = None) -> float:
    """Median of the quietest rows, in counts.

    Taken from whole rows, before or after the light came, so that it stays where the measurements
    scatter about it: the least value of a picture would turn noise into an offset.

    Parameters
    ----------
    counts : (rows, columns) float32 array
    row_sums : (rows,) float32 array, optional
        Sum of each row, where it is known already.

    Returns
    -------
    float
    """
    if row_sums is None:
        # a product, which reads the picture at the rate of memory: NumPy's sum takes thrice as long
        row_sums = counts @ np.ones(counts.shape[1], np.float32)
    # Rows, not pixels: choosing the darkest pixels would choose those whose noise is low.
    quiet = np.argsort(row_sums)[: max(1, round(DARK_ROW_FRACTION * row_sums.size))]
    # the median, which NumPy looks for ten times as long as it sorts
    ordered = np.sort(counts[quiet], axis=None)
    return float((ordered[(ordered.size - 1) // 2] + ordered[ordered.size // 2]) / 2)


class Rectifier:
    """Turns raw streak images of one camera into measurements; holding one saves working out the
    sweep for every shot.

    Parameters
    ----------
    camera : Camera
    rows : int
        Of the raw pictures.

    Notes
    -----
    Memory: as much as a raw picture, twice if the sweep moves light across columns, and at first
    use four times as much for a moment.
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
        self._raw_column = (
            own if self._stays_in_column else np.ascontiguousarray(raw_column, dtype=np.float32)
        )

    def measure(
        self,
        counts: FloatImage,
        saturated: Mask | None = None,
        dark: float | None = None,
        delay: float = 0.0,
    ) -> Measurement:
        """Subtract the dark level and rectify the sweep (bilinear).

        Parameters
        ----------
        counts : (rows, columns) array
        saturated : (rows, columns) bool array, optional
            A measurement is bad if any raw pixel that contributes to it is.
        dark : float, optional
            Counts; by default `estimate_dark_level` of the picture.
        delay : float
            Rows by which this shot's light comes later than the camera's calibration says.

        Returns
        -------
        Measurement
            Measurements (slit pixels, rows) float32 and their mask.

        Raises
        ------
        CalibrationError, InputError
            As for `measure`, or another number of rows.
        """
        self._require_shape(counts)
        valid = self._find_valid(
            np.zeros(counts.shape, bool) if saturated is None else saturated, delay
        )
        if not valid.any():
            raise InputError(
                "no measurement can be trusted: every pixel is saturated, dead or outside the sweep"
            )
        measurements = self.rectify(counts, dark, delay)
        # Light that only saturated pixels show would let a recovery run on nothing.
        if not np.any((measurements > 0) & valid):
            raise InputError(NO_LIGHT_MESSAGE)
        return Measurement(measurements, valid)

    def rectify(
        self,
        counts: FloatImage,
        dark: float | None = None,
        delay: float = 0.0,
    ) -> FloatImage:
        """Return the measurements alone, for methods that cannot leave out single ones.

        Parameters
        ----------
        counts, dark, delay
            As for `measure`.

        Returns
        -------
        (columns, rows) float32 array
            0 beyond the raw image and in dead columns. All columns of a row lie side by side in
            memory, as in the raw picture.

        Raises
        ------
        CalibrationError, InputError
            As for `measure`, but for measurements that cannot be trusted.
        """
        from tofclip.camera.kernels import sample_bilinear, sample_in_time, sample_rows

        self._require_shape(counts)
        level, shift = (
            np.float32(estimate_dark_level(counts) if dark is None else dark),
            np.float32(delay),
        )
        measurements, raw = np.empty(self._raw_row.shape, np.float32), _as_counts(counts)

        def work(piece: slice) -> None:
            rows, target = self._raw_row[piece], measurements[piece]
            if self._stays_in_column and delay == 0:
                numbers = np.arange(piece.start, piece.stop)
                sample_rows(raw, level, self._raw_row, *self._runs, numbers, target)
            elif self._stays_in_column:
                sample_in_time(raw, level, rows, shift, target)
            else:
                sample_bilinear(raw, level, rows, self._raw_column[piece], shift, target)

        run_blocks(work, len(measurements), ROWS_PER_BLOCK)
        # Zero, not their raw value: methods that take no mask must not see a stuck column as light.
        measurements[:, self._dead] = 0
        # Some rows at a time: noise about the dark level is above it in the first ones already.
        pieces = split_blocks(len(measurements), ROWS_PER_BLOCK)
        if not any(measurements[piece].max() > 0 for piece in pieces):
            raise InputError(NO_LIGHT_MESSAGE)
        return measurements.T

    def rectify_rows(
        self, counts: FloatImage, dark: float, numbers: NDArray[np.int64]
    ) -> FloatImage:
        """Return the measurements of some rows.

        Parameters
        ----------
        counts : (rows, columns) array
        dark : float
            Counts.
        numbers : (n,) int array
            Of the rows.

        Returns
        -------
        (columns, n) float32 array
            As those of `rectify`.
        """
        from tofclip.camera.kernels import sample_bilinear, sample_rows

        self._require_shape(counts)
        measurements = np.empty((numbers.size, counts.shape[1]), np.float32)
        raw, level = _as_counts(counts), np.float32(dark)

        def work(piece: slice) -> None:
            some, target = numbers[piece], measurements[piece]
            if self._stays_in_column:
                sample_rows(raw, level, self._raw_row, *self._runs, some, target)
            else:
                row, column = self._raw_row[some], self._raw_column[some]
                sample_bilinear(raw, level, row, column, np.float32(0), target)

        run_blocks(work, numbers.size, ROWS_PER_BLOCK)
        measurements[:, self._dead] = 0
        return measurements.T

    def sum_rows(
        self,
        counts: FloatImage,
        starts: NDArray[np.int64],
        length: int,
        block: int,
        sums: FloatImage,
    ) -> FloatImage:
        """Add up successive rectified rows, from which no dark level is taken.

        Parameters
        ----------
        counts : (rows, columns) array
        starts : (sums,) int array
            First row of each sum.
        length : int
            Rows of a sum.
        block : int
            Sums that each thread takes, whole vectors of them.
        sums : (columns, at least sums) float32 array
            Overwritten as far as there are sums.

        Returns
        -------
        (rows,) float32 array
            Sum of each raw row.
        """
        from tofclip.camera.kernels import sum_boxes, sum_sampled_boxes

        self._require_shape(counts)
        if not self._stays_in_column:
            rectified = self.rectify_rows(counts, 0.0, np.arange(len(counts))).T
            run_blocks(
                lambda piece: sum_boxes(rectified, starts, length, (piece.start, piece.stop), sums),
                starts.size,
                block,
            )
            return np.asarray(counts @ np.ones(counts.shape[1], np.float32))
        raw, row_sums = _as_counts(counts), np.empty(len(counts), np.float32)

        def work(piece: slice) -> None:
            raw_span = (
                len(raw) * piece.start // starts.size,
                len(raw) * piece.stop // starts.size,
            )
            sum_sampled_boxes(
                raw,
                self._raw_row,
                *self._runs,
                starts,
                length,
                (piece.start, piece.stop),
                raw_span,
                sums,
                row_sums,
            )

        run_blocks(work, starts.size, block)
        sums[self._dead, : starts.size] = 0
        return row_sums

    @property
    def inside(self) -> Mask:
        """Where the raw image has what a rectified pixel shows, (rows, columns)."""
        rows, columns = self._raw_row.shape
        inside: Mask = (self._raw_row >= 0) & (self._raw_row <= rows - 1)
        inside &= (self._raw_column >= 0) & (self._raw_column <= columns - 1)
        return inside

    @cached_property
    def _runs(self) -> tuple[NDArray[np.uint64], NDArray[np.int64]]:
        """Neighbours in a row that come from the same two raw rows, and where each row's begin; see
        `sample_row`.
        """
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

    def _find_valid(self, bad: Mask, delay: float) -> Mask:
        from tofclip.camera.kernels import mark_valid

        valid, raw = np.empty(self._raw_row.shape, bool), np.ascontiguousarray(bad)

        def work(piece: slice) -> None:
            # one layout, whether each row has columns of its own or not: the loop is compiled once
            column = np.ascontiguousarray(self._raw_column[piece])
            mark_valid(raw, self._raw_row[piece], column, np.float32(delay), valid[piece])

        run_blocks(work, len(valid), ROWS_PER_BLOCK)
        # Dead columns are invalid at every instant, whatever the sensor shows there.
        valid &= ~self.camera.dead_columns
        return valid.T

    def _require_shape(self, counts: FloatImage) -> None:
        require_width(counts, self.camera)
        if counts.shape != self._raw_row.shape:
            raise ShapeError("a streak image of this camera", self._raw_row.shape, counts.shape)


def _as_counts(counts: FloatImage) -> FloatImage:
    """Return a streak image as compiled loops take it."""
    return np.ascontiguousarray(counts, np.float32)


FLOOR_FIGURE, GAIN_FIGURE = "noise_floor_count", "noise_gain_count"
MISFIT_FIGURE, DAZZLE_FIGURE = "noise_misfit_fraction", "noise_dazzle_count"
DAZZLE_REACH_COLUMNS = 2
"""Columns beside light above `MeasurementNoise.dazzle` that it dazzles: the model's error and the
slit's blur."""

USUAL_QUANTILE, FRAME_DAZZLE_RATIO = 0.75, 5.0
"""Of the lit measurements of a frame; light that dazzles is that many times as bright."""

LIT_DEVIATIONS = 4.0
DAZZLE_MISFIT = 0.3
"""Of such light, that the model has in a neighbouring column."""

DAZZLE_RATIO = 4.0
"""Light that dazzles, relative to the bright measurements' of the shot."""

BRIGHT_QUANTILE = 0.95
"""Of the measurements that are lit."""

MAX_DAZZLED_FRACTION = 0.05
"""Of the lit measurements; where more are that bright, they are the scene."""

MIN_DAZZLED_SHARE = 0.8
"""Of what a pixel's measurements weigh; a pixel that is dazzled more is part of the glint."""


@dataclass(frozen=True)
class MeasurementNoise:
    """Variance of a measurement: ``floor^2 + gain * signal + (misfit * usual)^2``.

    The last is what the model does not explain, which falls beside the light, on measurements that
    should be dark; `usual` is the root mean square of a frame's signal. Beside light that dazzles
    there is `DAZZLE_MISFIT` of that light in addition.
    """

    floor: float  # standard deviation in the dark, counts
    gain: float  # counts of variance for a count of signal
    # of the recovery's residual, what noise does not explain, relative to the signal
    misfit: float = 0.0
    dazzle: float = np.inf  # light above this, counts, dazzles the columns beside it

    @classmethod
    def from_figures(cls, known: Mapping[str, Scalar]) -> MeasurementNoise | None:
        """Return what a recovery wrote down of its measurements; None if it did not."""
        if FLOOR_FIGURE not in known or GAIN_FIGURE not in known:
            return None
        return cls(
            float(known[FLOOR_FIGURE]),
            float(known[GAIN_FIGURE]),
            float(known.get(MISFIT_FIGURE, 0.0)),
            float(known.get(DAZZLE_FIGURE, np.inf)),
        )

    def list_figures(self) -> dict[str, Scalar]:
        """List what frames have to know of their measurements."""
        figures: dict[str, Scalar] = {
            FLOOR_FIGURE: self.floor,
            GAIN_FIGURE: self.gain,
            MISFIT_FIGURE: self.misfit,
        }
        return figures | ({DAZZLE_FIGURE: self.dazzle} if np.isfinite(self.dazzle) else {})

    def compute_variance(self, light: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the variance of each measurement, (columns, frames).

        `light` (columns, frames): what the frames predict, not negative.
        """
        variance = self.floor**2 + self.gain * light
        if light.max(initial=0) <= self.dazzle:
            variance += self.misfit**2 * np.mean(light**2, axis=0)
        else:
            dazzling = self.find_dazzling(light)
            variance += self.misfit**2 * np.mean(np.where(dazzling, 0, light) ** 2, axis=0)
            beside = _take_brightest_around(np.where(dazzling, light, 0))
            variance += (DAZZLE_MISFIT * beside) ** 2
        return np.asarray(variance, dtype=np.float32)

    def find_dazzling(self, light: NDArray[np.float32]) -> NDArray[np.bool_]:
        """Find light that is too bright for what else there is at the same instant.

        Where a bright object is alone, there is nothing that it could dazzle.

        `light` (columns, frames): counts. Returns (columns, frames).
        """
        dazzling = light > self.dazzle
        for frame in np.flatnonzero(dazzling.any(axis=0)):
            lit = light[light[:, frame] > LIT_DEVIATIONS * self.floor, frame]
            usual = float(np.quantile(lit, USUAL_QUANTILE)) if lit.size else 0.0
            dazzling[:, frame] &= light[:, frame] > FRAME_DAZZLE_RATIO * usual
        return np.asarray(dazzling)


def find_dazzle_limit(measurement: Measurement, floor: float) -> float:
    """Return the light that dazzles where there is other light at the same instant, counts.

    `floor`: standard deviation of a dark measurement, counts. Returns infinite where there is none.
    """
    light = measurement.values[measurement.valid]
    lit = light[light > LIT_DEVIATIONS * floor]
    if not lit.size:
        return float("inf")
    limit = DAZZLE_RATIO * float(np.quantile(lit, BRIGHT_QUANTILE))
    number = np.count_nonzero(lit > limit)
    return limit if 0 < number <= MAX_DAZZLED_FRACTION * lit.size else float("inf")


def find_dazzled(measurement: Measurement, noise: MeasurementNoise) -> NDArray[np.bool_]:
    """Find the measurements beside light far brighter than what else there is.

    Returns (columns, frames).
    """
    light = np.where(measurement.valid, measurement.values, 0)
    return _take_brightest_around(noise.find_dazzling(light))


def find_glints(operator: LineProjection, dazzled: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Find the pixels that are seen by dazzled measurements only.

    `dazzled` (columns, frames). Returns (frames, rows, columns).
    """
    transposed = operator.matrix.T
    weight = transposed @ np.ones(dazzled.shape[0], np.float32)
    share = (transposed @ dazzled.astype(np.float32)).T
    glints = share > MIN_DAZZLED_SHARE * np.maximum(weight, np.finfo(np.float32).tiny)
    return np.asarray(glints.reshape(-1, *operator.shape_in))


def _take_brightest_around(light: NDArray[Any]) -> NDArray[Any]:
    """Return the greatest value within `DAZZLE_REACH_COLUMNS`, (columns, frames)."""
    from scipy.ndimage import maximum_filter1d  # reading a shot has to be quick

    size = 2 * DAZZLE_REACH_COLUMNS + 1
    return np.asarray(maximum_filter1d(light, size, axis=0, mode="constant"))


class RowSums:
    """What stays the same from shot to shot in sums of rectified rows.

    `starts` (sums,): first row of each sum; a multiple of `LANES` of them; `length`: rows of a sum.

    Memory: as much as the sums.
    """

    def __init__(self, rectifier: Rectifier, starts: NDArray[np.int64], length: int) -> None:
        self._rectifier, self._starts, self._length = rectifier, starts, length
        inside = np.pad(np.cumsum(rectifier.inside, axis=0, dtype=np.uint16), ((1, 0), (0, 0)))
        # how many rows of each sum lie within the raw image; differences are right beyond 65,535 too
        measured = (inside[starts + length] - inside[starts]).T
        self._measured = np.ascontiguousarray(measured, np.float32)
        self._measured[rectifier.camera.dead_columns] = 0

    def add_up(self, counts: NDArray[np.float32], sums: NDArray[np.float32]) -> float:
        """Add up the rows of a shot; return its dark level.

        `counts` (rows, columns): raw streak image; `sums` (columns, at least sums): overwritten as
        far as there are sums: of measurements, without the dark level; 0 where nothing was
        measured. Returns counts.
        """
        # the compiler takes as long to import as all else
        from tofclip.camera.kernels import subtract_dark_level

        number, threads = self._starts.size, count_block_threads()
        lanes = -(-number // (threads * LANES)) * LANES
        row_sums = self._rectifier.sum_rows(counts, self._starts, self._length, lanes, sums)
        dark = estimate_dark_level(counts, row_sums)
        lit = np.zeros(self._measured.shape[0], bool)
        run_blocks(
            lambda piece: subtract_dark_level(
                self._measured[piece], np.float32(dark), sums[piece], lit[piece]
            ),
            lit.size,
            -(-lit.size // threads),
        )
        if not lit.any():
            raise InputError(NO_LIGHT_MESSAGE)
        return dark
