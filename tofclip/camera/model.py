"""The camera model: calibration in, forward operator out; how the streak tube's sweep distorts the
picture, as maps from rectified pixels to raw ones; and where pixels look.

A *rectified* streak image has one row per instant, the same for all columns; its columns are the
slit's. A sweep says where in the *raw* image each rectified pixel lies, so that the raw image is
sampled there. Pixel coordinates are 0-based, pixel centres are whole numbers, row = time, column =
slit.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.polynomial import Polynomial
from numpy.typing import ArrayLike, DTypeLike

from tofclip.arrays import BoolArray, FloatArray
from tofclip.camera.range_calibration import RangeCalibration, empty_array
from tofclip.errors import (
    CalibrationError,
    FileFormatError,
    ShapeError,
    require_consistent,
    require_shape,
)
from tofclip.notebook import render_html
from tofclip.operators import LineProjection
from tofclip.storage import Record, Storable, stored_array, stored_child, stored_value

FAR_SPANS = 1e3  # of knots: as far beyond them nothing is interpolated


@dataclass(frozen=True)
class Sweep(Storable):
    """Anything that says where a rectified pixel lies in the raw streak image, in float64 arrays."""

    def __post_init__(self) -> None:
        for item in fields(self):
            values = np.asarray(getattr(self, item.name), dtype=np.float64)
            object.__setattr__(self, item.name, values)

    def raw_position(self, row: FloatArray, column: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the raw (row, column) of rectified positions `row` and `column`, pixels."""
        raise NotImplementedError


@dataclass(frozen=True)
class SkewSweep(Sweep):
    """A time skew per view: ``raw row = offset_k + (1 + stretch_k) * row`` at each view's centre.
    `centres_px` (views,) are slit columns, increasing, `offsets_bin` (views,) the rows by which
    a view is late, `stretches` (views,) the relative excess of rows per instant.

    The sweep's distortion is a smooth function of the slit column: everywhere, offset and stretch follow
    the parabolas nearest to those of the views, and what these leave is interpolated linearly.
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

    @cached_property
    def _parabolas(self) -> list[tuple[Polynomial, FloatArray]]:
        """Of offsets and stretches, the nearest parabola, and what it leaves of each view's. Lines from view to
        view would cut the corners of a sweep that is curved, and turn what lies beyond the outer ones: walls by
        0.2 mm, where the outer views come 0.6 rows later than on a line.
        """
        found, centres = [], self.centres_px
        for values in (self.offsets_bin, self.stretches):
            parabola = Polynomial.fit(centres, values, min(2, centres.size - 1)).convert()
            found.append((parabola, values - parabola(centres)))
        return found

    def raw_position(self, row: FloatArray, column: FloatArray) -> tuple[FloatArray, FloatArray]:
        offset, stretch = (
            parabola(column) + interpolate_linearly(column, self.centres_px, left)
            for parabola, left in self._parabolas
        )
        raw_row, raw_column = np.broadcast_arrays(offset + (1.0 + stretch) * row, column)
        return raw_row, raw_column


@dataclass(frozen=True)
class PolynomialSweep(Sweep):
    """A bivariate quadratic map, as MATLAB's ``fitgeotrans(..., 'polynomial', 2)`` makes it.

    ``u = c . [1, x, y, x*y, x^2, y^2]`` in normalised 0-based coordinates, x = column, y = row, with the
    `column_coefficients` (6,), alike for v = raw row with the `row_coefficients`; `rectified_origin`,
    `rectified_scale`, `raw_origin` and `raw_scale` (2,) normalise (x, y) by ``(pixel - origin) / scale``.
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
            require_shape(
                f"polynomial sweep's {item.name}", expected, getattr(self, item.name).shape
            )
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
    """A homography: ``[raw column, raw row, 1] ~ matrix @ [column, row, 1]``; `matrix` (3, 3)."""

    RECORD_KIND = "projective_sweep"

    matrix: FloatArray = field(metadata=stored_array("px", dimensions=2))

    def __post_init__(self) -> None:
        super().__post_init__()
        require_shape("projective sweep matrix", (3, 3), self.matrix.shape)

    def raw_position(self, row: FloatArray, column: FloatArray) -> tuple[FloatArray, FloatArray]:
        raw_column, raw_row, weight = (h[0] * column + h[1] * row + h[2] for h in self.matrix)
        return raw_row / weight, raw_column / weight


@dataclass(frozen=True)
class MergedSweep(Sweep):
    """A `sweep` for pictures in each of whose rows a `number` of successive ones are added up."""

    sweep: Sweep
    number: int

    def __post_init__(self) -> None:
        pass  # no arrays

    def raw_position(self, row: FloatArray, column: FloatArray) -> tuple[FloatArray, FloatArray]:
        middle = (self.number - 1) / 2  # of the first row's
        raw_row, raw_column = self.sweep.raw_position(self.number * row + middle, column)
        return (raw_row - middle) / self.number, raw_column


def sweep_from_record(record: Record) -> Sweep:
    """Rebuild whichever sweep `record` describes."""
    for kind in (SkewSweep, PolynomialSweep, ProjectiveSweep):
        if record.kind == kind.RECORD_KIND:
            return kind.from_record(record)
    raise FileFormatError(record.origin, f"holds an unknown sweep '{record.kind}'")


def interpolate_linearly(position: FloatArray, knots: FloatArray, values: FloatArray) -> FloatArray:
    """Piecewise linear interpolation whose end pieces go on beyond the outer knots."""
    if knots.size == 1:
        return np.full(np.shape(position), values[0])
    # np.interp would hold the values of the outer knots: there are some where no position is
    far = FAR_SPANS * (knots[-1] - knots[0])
    beyond, reached = np.empty((2, knots.size + 2))
    beyond[1:-1], reached[1:-1] = knots, values
    for end, inner, way in ((0, 1, -far), (-1, -2, far)):
        beyond[end] = knots[end] + way
        slope = (values[inner] - values[end]) / (knots[inner] - knots[end])
        reached[end] = values[end] + way * slope
    return np.asarray(np.interp(position, beyond, reached))


# Mean over three set-ups of the same family of instruments (244, 271 and 282 px), fitted to the measured
# positions of the wall points that their pixels see. A camera with other lenslets needs its own.
DEFAULT_FOCAL_LENGTH_PX = 265.0
PINHOLE_FIELD_OF_VIEW_DEG = 30.0  # width of the picture of a pinhole of which nothing is known


@dataclass(frozen=True)
class Camera(Storable):
    """A row of cylindrical lenslets in front of a line sensor.

    Scene point (X, Y), in pixels from the optical axis of view k, falls on slit column
    ``centres_px[k] + X - Y * tan(angles[k]) + s * view_positions[k]`` where s is the shear in
    pixels per view step.

    Parameters
    ----------
    centres_px : (views,) array
        0-based slit column of each view's optical axis; real numbers.
    angles : (views,) array
        Angle of each view's line response from the vertical, rad. Its sign mirrors the picture:
        images cannot settle it, the calibration has to say it.
    image_shape : (int, int)
        Rows and columns of the recovered picture. Its optical axis is pixel ``(rows // 2, columns
        // 2)``.
    slit_width_px : int
        Number of columns of the streak image.
    gains : (views,) array, optional
        Relative brightness of the views.
    view_positions : (views,) array, optional
        Position u_k of each view in view steps, relative to the reference view; defaults to whole
        steps with 0 at the middle view.
    sweep : Sweep, optional
        How the raw streak image has to be rectified. None: it has to be estimated from the data.
    dead_columns : (slit_width_px,) bool array, optional
        Slit columns that never carry a signal.
    time_zero : float
        Reading of the streak's time axis at which light of range 0 would arrive, s.
    pulse_fwhm : float
        Full width at half maximum of the instrument's response to a short pulse, s.
    focal_length_px : float
        Distance from the lenslet to the picture in image pixels, which turns pixels into
        directions.
    lenslet_pitch : float
        Distance between the viewpoints of neighbouring view steps, m; 0 where the parallax is not
        known or none.
    focus_distance : float
        Depth at which the views coincide (shear 0), m; may be infinite.
    distortion : (5,) array, optional
        Lens distortion k1, k2, p1, p2, k3 (Brown and Conrady, in OpenCV's order), of directions x/z
        and y/z; none by default.
    centre_uncertainty_px, angle_uncertainty : (views,) array, optional
        One standard deviation of the calibration.
    range_calibration : RangeCalibration, optional
        Range walk, offsets and response of the pixels, and reflectance; none by default.

    Raises
    ------
    CalibrationError
        Arrays disagree in length, a number is not finite, a centre lies off the slit, or a gain is
        not positive.
    """

    RECORD_KIND = "camera"

    centres_px: FloatArray = field(metadata=stored_array("px", "view", name="centres"))
    angles: FloatArray = field(metadata=stored_array("rad", "view"))
    image_shape: tuple[int, int] = field(metadata=stored_array("px", "yx", dtype=np.int64))
    slit_width_px: int = field(metadata=stored_value("slit_width_px", dtype=int))
    gains: FloatArray = empty_array("", "view")
    view_positions: FloatArray = empty_array("view step", "view")
    sweep: Sweep | None = field(
        default=None, metadata=stored_child(sweep_from_record, optional=True)
    )
    dead_columns: BoolArray = empty_array("", "column", dtype=bool)
    time_zero: float = field(default=0.0, metadata=stored_value("time_zero_s"))
    pulse_fwhm: float = field(default=60e-12, metadata=stored_value("pulse_fwhm_s"))
    focal_length_px: float = field(
        default=DEFAULT_FOCAL_LENGTH_PX, metadata=stored_value("focal_length_px")
    )
    lenslet_pitch: float = field(
        default=0.0, metadata=stored_value("lenslet_pitch_m", optional=True)
    )
    focus_distance: float = field(
        default=np.inf, metadata=stored_value("focus_distance_m", optional=True)
    )
    distortion: FloatArray = field(
        default_factory=lambda: np.zeros(5), metadata=stored_array("", "coefficient", optional=True)
    )
    centre_uncertainty_px: FloatArray = empty_array("px", "view", name="centre_uncertainty")
    angle_uncertainty: FloatArray = empty_array("rad", "view")
    range_calibration: RangeCalibration | None = field(
        default=None,
        metadata=stored_child(RangeCalibration.from_record, "range_calibration", optional=True),
    )

    def __post_init__(self) -> None:
        views = np.size(self.centres_px)
        unknown = np.full(views, np.nan)
        defaults = {
            "centres_px": (),
            "angles": (),
            "gains": np.ones(views),
            # The middle view is the reference, or the right one of the two in the middle.
            "view_positions": np.arange(views) - views // 2,
            "distortion": (),
            "centre_uncertainty_px": unknown,
            "angle_uncertainty": unknown,
        }
        for name, default in defaults.items():
            value = getattr(self, name)
            # A copy that cannot be written to: operators made from it would go on with the old numbers.
            array = np.array(value if np.size(value) else default, dtype=np.float64)
            array.flags.writeable = False
            object.__setattr__(self, name, array)
        dead = np.asarray(self.dead_columns, dtype=bool)
        dead = dead if dead.size else np.zeros(self.slit_width_px, dtype=bool)
        object.__setattr__(self, "dead_columns", dead)
        if np.size(self.image_shape) != 2:
            raise CalibrationError(f"a picture has two sides, got {self.image_shape}")
        rows, columns = (int(side) for side in self.image_shape)
        object.__setattr__(self, "image_shape", (rows, columns))
        require_consistent(self._list_conditions())
        if self.range_calibration is not None:
            self.range_calibration.require_shape(self.image_shape)

    def _list_conditions(self) -> Iterator[tuple[object, str]]:
        """What holds of every camera, and what to say where it does not."""
        views, width, centres = self.views, self.slit_width_px, self.centres_px
        yield views > 0, "a camera needs at least one view"
        for name in ("centres_px", "angles", "gains", "view_positions"):
            values = getattr(self, name)
            good = values.shape == (views,) and bool(np.all(np.isfinite(values)))
            yield good, f"{name} must be {views} finite numbers, got {values}"
        sizes = f"picture {self.image_shape} and slit {width} must not be empty"
        yield min(*self.image_shape, width) >= 1, sizes
        off = centres[(centres < 0) | (centres > width - 1)]
        where = f"lies off the sensor (columns 0..{width - 1})"
        yield not off.size, f"slit centre {next(iter(off), 0.0):.1f} px {where}"
        dead = self.dead_columns.shape
        yield dead == (width,), f"dead_columns must have {width} entries, got {dead}"
        yield np.all(self.gains > 0), f"view gains must be positive, got {self.gains}"
        steep = np.abs(self.angles) >= np.pi / 2
        yield not steep.any(), "line angles must lie within 90 degrees of the vertical"
        lengths = ("pulse width", self.pulse_fwhm), ("focal length", self.focal_length_px)
        for what, value in lengths:
            yield 0 < value < np.inf, f"the {what} must be a positive number, got {value}"
        yield np.isfinite(self.time_zero), f"time zero must be finite, got {self.time_zero}"
        yield (
            0 <= self.lenslet_pitch < np.inf and self.focus_distance > 0,
            "the lenslet pitch must not be negative, the focus distance must be positive",
        )
        yield (
            self.distortion.shape == (5,) and np.all(np.isfinite(self.distortion)),
            f"lens distortion must be 5 finite numbers, got {self.distortion}",
        )

    def __repr__(self) -> str:
        rows, columns = self.image_shape
        zero = f"time zero {1e9 * self.time_zero:.3f} ns" if self.time_zero else "no time zero"
        return f"Camera({self.views} views, pictures of {rows} x {columns} pixels, {zero})"

    def _repr_html_(self) -> str:
        rows, columns = self.image_shape
        described = {
            "views": str(self.views),
            "pictures (y, x)": f"{rows} x {columns} px",
            "slit": f"{self.slit_width_px} px",
            "centres": ", ".join(f"{centre:.1f}" for centre in self.centres_px) + " px",
            "line angles": ", ".join(f"{angle:.1f}" for angle in np.rad2deg(self.angles)) + "°",
            "sweep": "unknown: found from each shot" if self.sweep is None else "known",
            "time zero": f"{1e9 * self.time_zero:.3f} ns" if self.time_zero else "not given",
        }
        return render_html("Camera", described, None)

    @classmethod
    def pinhole(
        cls,
        image_shape: tuple[int, int],
        focal_length_px: float | None = None,
        pulse_fwhm: float = 60e-12,
        field_of_view_deg: float = PINHOLE_FIELD_OF_VIEW_DEG,
    ) -> Self:
        """Return a camera of one view that only says where its pixels look: that of a direct sensor,
        as a SPAD array or a kit of histograms, or of frames of one's own.

        Parameters
        ----------
        image_shape : (int, int)
            Rows and columns.
        focal_length_px : float, optional
            Distance of the pinhole from the picture, in pixels; the optical axis meets pixel
            ``(rows // 2, columns // 2)``. By default from the field of view.
        pulse_fwhm : float
            Full width at half maximum of a return, s.
        field_of_view_deg : float
            Width of the whole picture, degrees, where no focal length is given.

        Raises
        ------
        CalibrationError
            A focal length or a field of view that no pinhole has.
        """
        rows, columns = (int(side) for side in image_shape)
        if not 0 < field_of_view_deg < 180:
            raise CalibrationError(
                f"a field of view lies between 0 and 180 degrees, got {field_of_view_deg}"
            )
        if focal_length_px is None:
            focal_length_px = columns / 2 / float(np.tan(np.deg2rad(field_of_view_deg) / 2))
        centre = np.array([min(columns / 2, columns - 1)])
        optics: Any = {"pulse_fwhm": pulse_fwhm, "focal_length_px": focal_length_px}
        return cls(centre, np.zeros(1), (rows, columns), columns, **optics)

    @property
    def views(self) -> int:
        """Number of views."""
        return int(self.centres_px.size)

    @property
    def optical_axis_px(self) -> tuple[int, int]:
        """(row, column) of the optical axis in the recovered picture."""
        return self.image_shape[0] // 2, self.image_shape[1] // 2

    def operator(self, shear: float = 0.0, dtype: DTypeLike = np.float32) -> LineProjection:
        """Return F(d), which maps a (rows, columns) picture refocused at `shear` onto (slit pixels,),
        in `dtype` float32 or float64 (supplement Eq. 21). Because a line integral turns a 2D shift
        into a 1D one, refocusing only moves the views on the slit. Pixels per view step, negative
        for objects nearer than the calibrated depth (SPEC: ``s = -a/d``).
        """
        return LineProjection(
            self.image_shape,
            self.slit_width_px,
            # A shift along X only: line responses are straight, so that moving the picture by s u
            # in X moves what falls on the slit by as much.
            self.centres_px + shear * self.view_positions,
            self.angles,
            self.gains,
            dtype,
        )

    def shear_at(self, distance: ArrayLike) -> FloatArray:
        """Shear of a surface at `distance`, m: ``s(d) = -f * pitch * (1/d - 1/focus_distance)``,
        pixels per view step, negative nearer than the focus; 0 everywhere where no lenslet pitch is
        known.

        The distance is the depth z. A range along the line of sight does in its place as long as
        the field of view is narrow: at an angle a from the axis it is longer by 1/cos(a), 2 % at 11
        degrees.
        """
        # An infinite focus distance gives 0 here, so that views coincide at infinity.
        nearness = 1 / np.asarray(distance, dtype=np.float64) - 1 / self.focus_distance
        return -self.focal_length_px * self.lenslet_pitch * nearness

    @property
    def displacement_per_shear(self) -> tuple[float, float]:
        """(rows, columns) by which a picture moves if it is recovered at a shear of one too little.

        Parallax adds ``s * u_k`` to a view's slit position, ``X - Y * tan(angle_k)``. The part of
        u_k that is a constant plus a multiple of tan(angle_k) is a translation of the picture,
        found here by least squares; only the rest defocuses. Where tan(angle) grows evenly along
        the views (the depth-of-field arrangement) hardly any does.
        """
        # A single view has no parallax to fit; its picture moves as its slit position does.
        if self.views == 1:
            return 0.0, float(self.view_positions[0])
        # What a view measures of a picture moved by (rows, columns): -rows tan(angle) + columns.
        design = np.stack([-np.tan(self.angles), np.ones(self.views)], axis=1)
        rows, columns = np.linalg.lstsq(design, self.view_positions, rcond=None)[0]
        return float(rows), float(columns)

    def replace(self, **changes: Any) -> Camera:
        """Return a copy with some entries changed, validated afresh."""
        return replace(self, **changes)

    @classmethod
    def load(cls, path: str | Path) -> Camera:
        """Read a camera from its own file or from a streak or frames file that carries one."""
        record = Record.load(path, "camera", "streak", "frames")
        if record.kind == "camera":
            return cls.from_record(record)
        return cls.from_record(record.child("camera", "camera"))


def split_by_shear(
    camera: Camera, distance: FloatArray, tolerance_px: float, *others: FloatArray
) -> list[tuple[slice, float]]:
    """Cut instants, whose light comes from a `distance` (n,), m, each, into pieces that share an
    operator, and return them with their mean shear: no view lies further off its place on the slit
    than the tolerance, and none of the `others` (n,) changes.
    """
    shears = camera.shear_at(distance)
    # a piece reaches the tolerance to either side of its mean shear at the outermost view
    step = 2 * tolerance_px / np.abs(camera.view_positions).max(initial=1.0)
    numbers = np.floor((shears - shears[0]) / step), *others
    changed = np.logical_or.reduce([np.diff(one) != 0 for one in numbers])
    cuts = np.flatnonzero(np.concatenate([[True], changed, [True]])).tolist()
    parts = [slice(*ends) for ends in pairwise(cuts)]
    return [(part, float(shears[part].mean())) for part in parts]


MAX_UNDISTORTIONS = 50
DIRECTION_TOLERANCE = 1e-10  # in units of the focal length; far below a thousandth of a pixel


def compute_ray_directions(camera: Camera, rows: ArrayLike, columns: ArrayLike) -> FloatArray:
    """Return the direction in which each pixel of the reference view looks, at `rows` and `columns` (n,), not
    necessarily whole numbers: unit vectors (n, 3), x right, y down, z forward.

    A pinhole ``((column - column_0) / f, (row - row_0) / f, 1)``, normalised, with the lens distortion of
    `camera` undone; `CalibrationError` where that is so strong that no direction leads to a pixel.
    """
    right, down = compute_slopes(camera, rows, columns)
    forward = 1 / np.sqrt(right * right + down * down + 1)
    return np.stack([right * forward, down * forward, forward], axis=-1)


def compute_slopes(
    camera: Camera, rows: ArrayLike, columns: ArrayLike
) -> tuple[FloatArray, FloatArray]:
    """Slopes x / z and y / z of the directions of `compute_ray_directions`."""
    axis_row, axis_column = camera.optical_axis_px
    right = (np.asarray(columns, dtype=np.float64) - axis_column) / camera.focal_length_px
    down = (np.asarray(rows, dtype=np.float64) - axis_row) / camera.focal_length_px
    if camera.distortion.any():
        right, down = undistort_directions(right, down, camera.distortion)
    return right, down


def distort_directions(
    right: FloatArray, down: FloatArray, coefficients: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Where a lens puts the direction (right, down, 1), in units of the focal length; k1, k2, p1, p2,
    k3 are those of D. C. Brown, "Close-range camera calibration", Photogramm. Eng. 37, 855 (1971).
    """
    k1, k2, p1, p2, k3 = coefficients
    square = right**2 + down**2
    radial = 1 + square * (k1 + square * (k2 + square * k3))
    return (
        right * radial + 2 * p1 * right * down + p2 * (square + 2 * right**2),
        down * radial + p1 * (square + 2 * down**2) + 2 * p2 * right * down,
    )


def undistort_directions(
    right: FloatArray, down: FloatArray, coefficients: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Undo `distort_directions`, by a fixed-point iteration."""
    x, y = right.copy(), down.copy()
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(MAX_UNDISTORTIONS):
            seen_x, seen_y = distort_directions(x, y, coefficients)
            x += right - seen_x
            y += down - seen_y
        left = np.hypot(right - seen_x, down - seen_y).max(initial=0.0)
    if not left < DIRECTION_TOLERANCE:
        raise CalibrationError(
            "the camera's lens distortion is too strong to be undone within the picture"
        )
    return x, y
