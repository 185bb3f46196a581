"""How the streak tube's sweep distorts the picture, as maps from rectified pixels to raw ones.

A *rectified* streak image has one row per instant, the same for all columns; its columns are the
slit's. A sweep says where in the *raw* image each rectified pixel lies, so that the raw image is
sampled there. Pixel coordinates are 0-based, pixel centres are whole numbers, row = time, column =
slit.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from tofclip.errors import CalibrationError, FileFormatError, ShapeError
from tofclip.storage import Field, Record

FloatArray = NDArray[np.float64]


class Sweep(Protocol):
    """Anything that says where a rectified pixel lies in the raw streak image."""

    def raw_position(self, row: FloatArray, column: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the raw (row, column) of rectified positions; arguments broadcast against each
        other.
        """
        ...

    def to_record(self) -> Record:
        """Return the map's numbers for storage."""
        ...


@dataclass(frozen=True)
class SkewSweep:
    """A time skew per view: ``raw row = offset_k + (1 + stretch_k) * row`` at each view's centre.

    Between two centres offset and stretch are interpolated linearly, beyond the outer ones they go
    on linearly: the sweep's distortion is a smooth function of the slit column.

    Parameters
    ----------
    centres_px : (views,) array
        Slit columns where the skew is known, increasing.
    offsets_bin : (views,) array
        Rows by which a view is late.
    stretches : (views,) array
        Relative excess of rows per instant.
    """

    centres_px: FloatArray
    offsets_bin: FloatArray
    stretches: FloatArray

    def __post_init__(self) -> None:
        for name in ("centres_px", "offsets_bin", "stretches"):
            object.__setattr__(self, name, np.asarray(getattr(self, name), dtype=np.float64))
        if self.centres_px.size == 0 or self.centres_px.ndim != 1:
            raise ShapeError("sweep centres", "(views,)", self.centres_px.shape)
        if not self.centres_px.shape == self.offsets_bin.shape == self.stretches.shape:
            raise ShapeError("sweep skew", "(views,) in all three arrays", self.offsets_bin.shape)
        if not np.all(np.diff(self.centres_px) > 0):
            raise CalibrationError(f"sweep centres must increase, got {self.centres_px}")

    def raw_position(self, row: FloatArray, column: FloatArray) -> tuple[FloatArray, FloatArray]:
        offset = _interpolate_linearly(column, self.centres_px, self.offsets_bin)
        stretch = _interpolate_linearly(column, self.centres_px, self.stretches)
        raw_row, raw_column = np.broadcast_arrays(offset + (1.0 + stretch) * row, column)
        return raw_row, raw_column

    def to_record(self) -> Record:
        return Record(
            "skew_sweep",
            {
                "centres": Field(self.centres_px, "px", ("view",)),
                "offsets": Field(self.offsets_bin, "bin", ("view",)),
                "stretches": Field(self.stretches, "", ("view",)),
            },
        )

    @classmethod
    def from_record(cls, record: Record) -> SkewSweep:
        return cls(
            record.array("centres", np.float64, 1, "px"),
            record.array("offsets", np.float64, 1, "bin"),
            record.array("stretches", np.float64, 1),
        )


@dataclass(frozen=True)
class PolynomialSweep:
    """A bivariate quadratic map, as MATLAB's ``fitgeotrans(..., 'polynomial', 2)`` makes it.

    ``u = c . [1, x, y, x*y, x^2, y^2]`` in normalised 0-based coordinates, x = column, y = row,
    alike for v = raw row.

    Parameters
    ----------
    column_coefficients, row_coefficients : (6,) array
    rectified_origin, rectified_scale, raw_origin, raw_scale : (2,) array
        (x, y) normalisation: ``normalised = (pixel - origin) / scale``.
    """

    column_coefficients: FloatArray
    row_coefficients: FloatArray
    rectified_origin: FloatArray
    rectified_scale: FloatArray
    raw_origin: FloatArray
    raw_scale: FloatArray

    def __post_init__(self) -> None:
        for field in fields(self):
            values = np.asarray(getattr(self, field.name), dtype=np.float64)
            object.__setattr__(self, field.name, values)
            expected = (6,) if field.name.endswith("coefficients") else (2,)
            if values.shape != expected:
                raise ShapeError(f"polynomial sweep's {field.name}", expected, values.shape)
        if not (np.all(self.rectified_scale) and np.all(self.raw_scale)):
            raise CalibrationError("a polynomial sweep's scales must not be zero")

    def raw_position(self, row: FloatArray, column: FloatArray) -> tuple[FloatArray, FloatArray]:
        x = (np.asarray(column) - self.rectified_origin[0]) / self.rectified_scale[0]
        y = (np.asarray(row) - self.rectified_origin[1]) / self.rectified_scale[1]
        u = _evaluate_quadratic(self.column_coefficients, x, y)
        v = _evaluate_quadratic(self.row_coefficients, x, y)
        return (
            v * self.raw_scale[1] + self.raw_origin[1],
            u * self.raw_scale[0] + self.raw_origin[0],
        )

    def to_record(self) -> Record:
        return Record(
            "polynomial_sweep",
            {
                "column_coefficients": Field(self.column_coefficients),
                "row_coefficients": Field(self.row_coefficients),
                "rectified_origin": Field(self.rectified_origin, "px", ("xy",)),
                "rectified_scale": Field(self.rectified_scale, "px", ("xy",)),
                "raw_origin": Field(self.raw_origin, "px", ("xy",)),
                "raw_scale": Field(self.raw_scale, "px", ("xy",)),
            },
        )

    @classmethod
    def from_record(cls, record: Record) -> PolynomialSweep:
        return cls(
            record.array("column_coefficients", np.float64, 1),
            record.array("row_coefficients", np.float64, 1),
            record.array("rectified_origin", np.float64, 1, "px"),
            record.array("rectified_scale", np.float64, 1, "px"),
            record.array("raw_origin", np.float64, 1, "px"),
            record.array("raw_scale", np.float64, 1, "px"),
        )


@dataclass(frozen=True)
class ProjectiveSweep:
    """A homography: ``[raw column, raw row, 1] ~ matrix @ [column, row, 1]``, 0-based pixels.

    Parameters
    ----------
    matrix : (3, 3) array
    """

    matrix: FloatArray

    def __post_init__(self) -> None:
        object.__setattr__(self, "matrix", np.asarray(self.matrix, dtype=np.float64))
        if self.matrix.shape != (3, 3):
            raise ShapeError("projective sweep matrix", (3, 3), self.matrix.shape)

    def raw_position(self, row: FloatArray, column: FloatArray) -> tuple[FloatArray, FloatArray]:
        h = self.matrix
        weight = h[2, 0] * column + h[2, 1] * row + h[2, 2]
        raw_column = (h[0, 0] * column + h[0, 1] * row + h[0, 2]) / weight
        raw_row = (h[1, 0] * column + h[1, 1] * row + h[1, 2]) / weight
        return raw_row, raw_column

    def to_record(self) -> Record:
        return Record("projective_sweep", {"matrix": Field(self.matrix, "px")})

    @classmethod
    def from_record(cls, record: Record) -> ProjectiveSweep:
        return cls(record.array("matrix", np.float64, 2, "px"))


def sweep_from_record(record: Record) -> Sweep:
    """Rebuild whichever sweep `record` describes."""
    kinds: dict[str, type[SkewSweep] | type[PolynomialSweep] | type[ProjectiveSweep]] = {
        "skew_sweep": SkewSweep,
        "polynomial_sweep": PolynomialSweep,
        "projective_sweep": ProjectiveSweep,
    }
    if record.kind not in kinds:
        raise FileFormatError(record.origin, f"holds an unknown sweep '{record.kind}'")
    return kinds[record.kind].from_record(record)


def _evaluate_quadratic(c: FloatArray, x: FloatArray, y: FloatArray) -> FloatArray:
    value: FloatArray = c[0] + c[1] * x + c[2] * y + c[3] * x * y + c[4] * x**2 + c[5] * y**2
    return value


def _interpolate_linearly(
    position: FloatArray, knots: FloatArray, values: FloatArray
) -> FloatArray:
    """Piecewise linear interpolation whose end pieces go on beyond the outer knots."""
    if knots.size == 1:
        return np.full(np.shape(position), values[0])
    piece = np.clip(np.searchsorted(knots, position) - 1, 0, knots.size - 2)
    slope = np.diff(values) / np.diff(knots)
    extended: FloatArray = values[piece] + slope[piece] * (position - knots[piece])
    return extended
