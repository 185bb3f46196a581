"""How the streak tube's sweep distorts the picture, as maps from rectified pixels to raw ones.

A *rectified* streak image has one row per instant, the same for all columns; its columns are the
slit's. A sweep says where in the *raw* image each rectified pixel lies, so that the raw image is
sampled there. Pixel coordinates are 0-based, pixel centres are whole numbers, row = time, column =
slit.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields

import numpy as np

from tofclip.arrays import FloatArray
from tofclip.errors import CalibrationError, FileFormatError, ShapeError
from tofclip.storage import Record, Storable, stored_array


@dataclass(frozen=True)
class Sweep(Storable):
    """Anything that says where a rectified pixel lies in the raw streak image, in float64 arrays."""

    def __post_init__(self) -> None:
        for item in fields(self):
            values = np.asarray(getattr(self, item.name), dtype=np.float64)
            object.__setattr__(self, item.name, values)

    def raw_position(self, row: FloatArray, column: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the raw (row, column) of rectified positions; arguments broadcast against each
        other.

        Parameters
        ----------
        row, column : float array
            Rectified, pixels.

        Returns
        -------
        raw_row, raw_column : float array
            Pixels, of the broadcast shape.
        """
        raise NotImplementedError


@dataclass(frozen=True)
class SkewSweep(Sweep):
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

    RECORD_KIND = "skew_sweep"

    centres_px: FloatArray = field(metadata=stored_array("px", "view", name="centres"))
    offsets_bin: FloatArray = field(metadata=stored_array("bin", "view", name="offsets"))
    stretches: FloatArray = field(metadata=stored_array("", "view"))

    def __post_init__(self) -> None:
        super().__post_init__()
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


@dataclass(frozen=True)
class PolynomialSweep(Sweep):
    """A bivariate quadratic map, as MATLAB's ``fitgeotrans(..., 'polynomial', 2)`` makes it.

    ``u = c . [1, x, y, x*y, x^2, y^2]`` in normalised 0-based coordinates, x = column, y = row,
    alike for v = raw row.

    Parameters
    ----------
    column_coefficients, row_coefficients : (6,) array
    rectified_origin, rectified_scale, raw_origin, raw_scale : (2,) array
        (x, y) normalisation: ``normalised = (pixel - origin) / scale``.
    """

    RECORD_KIND = "polynomial_sweep"

    column_coefficients: FloatArray = field(metadata=stored_array(dimensions=1))
    row_coefficients: FloatArray = field(metadata=stored_array(dimensions=1))
    rectified_origin: FloatArray = field(metadata=stored_array("px", "xy"))
    rectified_scale: FloatArray = field(metadata=stored_array("px", "xy"))
    raw_origin: FloatArray = field(metadata=stored_array("px", "xy"))
    raw_scale: FloatArray = field(metadata=stored_array("px", "xy"))

    def __post_init__(self) -> None:
        super().__post_init__()
        for item in fields(self):
            expected = (6,) if item.name.endswith("coefficients") else (2,)
            if (shape := getattr(self, item.name).shape) != expected:
                raise ShapeError(f"polynomial sweep's {item.name}", expected, shape)
        if not (np.all(self.rectified_scale) and np.all(self.raw_scale)):
            raise CalibrationError("a polynomial sweep's scales must not be zero")

    def raw_position(self, row: FloatArray, column: FloatArray) -> tuple[FloatArray, FloatArray]:
        # normalised coordinates keep the quadratic terms of the order of 1
        x = (np.asarray(column) - self.rectified_origin[0]) / self.rectified_scale[0]
        y = (np.asarray(row) - self.rectified_origin[1]) / self.rectified_scale[1]
        u, v = (
            c[0] + c[1] * x + c[2] * y + c[3] * x * y + c[4] * x**2 + c[5] * y**2
            for c in (self.column_coefficients, self.row_coefficients)
        )
        (x0, y0), (x_scale, y_scale) = self.raw_origin, self.raw_scale
        return v * y_scale + y0, u * x_scale + x0


@dataclass(frozen=True)
class ProjectiveSweep(Sweep):
    """A homography: ``[raw column, raw row, 1] ~ matrix @ [column, row, 1]``, 0-based pixels.

    Parameters
    ----------
    matrix : (3, 3) array
    """

    RECORD_KIND = "projective_sweep"

    matrix: FloatArray = field(metadata=stored_array("px", dimensions=2))

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.matrix.shape != (3, 3):
            raise ShapeError("projective sweep matrix", (3, 3), self.matrix.shape)

    def raw_position(self, row: FloatArray, column: FloatArray) -> tuple[FloatArray, FloatArray]:
        raw_column, raw_row, weight = (h[0] * column + h[1] * row + h[2] for h in self.matrix)
        return raw_row / weight, raw_column / weight


def sweep_from_record(record: Record) -> Sweep:
    """Rebuild whichever sweep `record` describes."""
    for kind in (SkewSweep, PolynomialSweep, ProjectiveSweep):
        if record.kind == kind.RECORD_KIND:
            return kind.from_record(record)
    raise FileFormatError(record.origin, f"holds an unknown sweep '{record.kind}'")


def _interpolate_linearly(
    position: FloatArray, knots: FloatArray, values: FloatArray
) -> FloatArray:
    """Piecewise linear interpolation whose end pieces go on beyond the outer knots."""
    if knots.size == 1:
        return np.full(np.shape(position), values[0])
    # the outer pieces go on beyond the knots, where np.interp would hold the end values
    piece = np.clip(np.searchsorted(knots, position) - 1, 0, knots.size - 2)
    slope = np.diff(values) / np.diff(knots)
    extended: FloatArray = values[piece] + slope[piece] * (position - knots[piece])
    return extended
