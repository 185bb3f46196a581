"""Shots: the streak image that was measured, and what is recovered from it: frames and returns."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofclip.arrays import (
    AnyArray,
    Array,
    BoolArray,
    Float32Array,
    FloatArray,
    namespace,
    to_numpy,
)
from tofclip.camera import Camera
from tofclip.camera.range_calibration import empty_array
from tofclip.errors import (
    InputError,
    MissingTimeAxisError,
    ShapeError,
    require,
    require_known,
    require_positive,
    require_shape,
    require_type,
)
from tofclip.notebook import make_data_array, plot_picture, render_html, require_package
from tofclip.storage import (
    Field,
    Record,
    Scalar,
    Storable,
    make_stand_in,
    stored_array,
    stored_child,
    stored_mapping,
    stored_origin,
)
from tofclip.units import SPEED_OF_LIGHT, require_credible_bin_width

RETURN_CHOICES = ("first", "strongest", "last", "all")  # which return of a pixel counts
RELAY_WALL = "relay_wall"  # the attachment of shots whose light is a wall's, not that of surfaces
MAX_ROW_S = 1e-3  # the slowest sweeps of streak cameras last milliseconds in all
PICTURE_COLUMNS = ("range", "intensity", "confidence", "return_number", "time")


@dataclass(frozen=True)
class Streak(Storable):
    """A streak image with whatever its file said about it.

    Parameters
    ----------
    counts : (rows, columns) array
        Sensor measurements, kept as float32. May hold negative values (background already subtracted).
    row_times : (rows,) array or None
        Instant of each row, s, strictly increasing, not necessarily evenly. None where the file has
        no time axis.
    saturated : (rows, columns) bool array or None
        Pixels that reached the sensor's limit.
    metadata : mapping of str to str
        The file's own text, key by key.
    camera : Camera or None
        The camera that took it, where the file carries one.
    attachments : mapping of str to Record
        Further records that belong to the shot and travel on to its frames unchanged, such as a
        relay wall.
    source : str
        Where it came from, for messages.
    provenance : mapping
        How it came about.

    Raises
    ------
    InputError
        Not a 2D array, empty, holding NaN or infinity, all zero, or with a time axis that does not
        increase.
    """

    RECORD_KIND = "streak"

    counts: Float32Array = field(metadata=stored_array("count", "time", "column", dtype=np.float32))
    row_times: FloatArray | None = field(
        default=None, metadata=stored_array("s", "time", optional=True)
    )
    saturated: BoolArray | None = field(
        default=None, metadata=stored_array("", "time", "column", dtype=bool, optional=True)
    )
    metadata: Mapping[str, str] = stored_mapping("texts")
    camera: Camera | None = field(
        default=None, metadata=stored_child(Camera.from_record, optional=True)
    )
    attachments: Mapping[str, Record] = stored_mapping("attachments")
    source: str = field(default="streak image", metadata=stored_origin())
    provenance: Mapping[str, Any] = stored_mapping("provenance")

    def __post_init__(self) -> None:
        with np.errstate(over="ignore"):  # too large becomes infinite, which is refused below
            counts = np.ascontiguousarray(self.counts, dtype=np.float32)
        object.__setattr__(self, "counts", counts)
        if counts.ndim != 2 or counts.size == 0:
            raise ShapeError(f"{self.source}: a streak image", "(rows, columns)", counts.shape)
        bad = counts.size - int(np.count_nonzero(np.isfinite(counts)))
        require(
            not bad,
            f"{self.source}: {bad} pixels are NaN or infinite; replace them or mark them as saturated",
        )
        require(np.any(counts), f"{self.source}: every pixel is zero; was the shutter closed?")
        if self.saturated is not None:
            require_shape("saturated", counts.shape, self.saturated.shape)
        if self.row_times is not None:
            times = np.asarray(self.row_times, dtype=np.float64)
            require_shape(f"{self.source}: the time axis", counts.shape[:1], times.shape)
            require(
                np.all(np.isfinite(times)) and not np.any(np.diff(times) <= 0),
                f"{self.source}: the time axis must be finite and increase row by row",
            )
            if times.size > 1:
                require_credible_bin_width(float(np.diff(times).mean()), longest=MAX_ROW_S)
            object.__setattr__(self, "row_times", times)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> AnyArray:
        return np.asarray(self.counts, dtype=dtype)

    def __repr__(self) -> str:
        rows, columns = self.counts.shape
        return (
            f"Streak({rows} x {columns} counts (time, column), {self._time_text}, "
            f"{'no camera' if self.camera is None else 'with its camera'})"
        )

    def _repr_html_(self) -> str:
        described = {
            "counts (time, column)": " x ".join(map(str, self.counts.shape)),
            "time axis": self._time_text,
            "camera": "none" if self.camera is None else repr(self.camera),
            "source": self.source,
        }
        return render_html("Streak image", described, np.sqrt(np.maximum(self.counts, 0)))

    @property
    def _time_text(self) -> str:
        if self.row_times is None:
            return "no time axis"
        return f"{1e9 * self.row_times[0]:.3f} to {1e9 * self.row_times[-1]:.3f} ns"

    def plot(self, ax: Any = None) -> Any:
        """Draw the counts into matplotlib Axes `ax`, by default the current figure's; return them."""
        ax = plot_picture(self.counts, f"streak image, {self._time_text}", ax)
        ax.set(xlabel="slit column (px)", ylabel="time (rows)")
        return ax

    def to_xarray(self) -> Any:
        """Return an `xarray.DataArray` (time, column), or (row, column) where no times are known;
        `MissingDependencyError` where xarray is not installed.
        """
        rows, columns = map(np.arange, self.counts.shape)
        down = ("row", (rows, "px")) if self.row_times is None else ("time", (self.times, "s"))
        return make_data_array(
            self.counts, dict([down, ("column", (columns, "px"))]), "counts", "counts"
        )

    @property
    def times(self) -> FloatArray:
        """Instant of each row, s; raises `MissingTimeAxisError` where none is known."""
        if self.row_times is None:
            raise MissingTimeAxisError(
                f"{self.source} has no time axis: give the duration of a row (`bin_width`)"
            )
        return self.row_times

    def with_bin_width(self, bin_width: float) -> Streak:
        """Return the same picture with evenly spaced rows of `bin_width` seconds, the first at 0."""
        require_positive("bin width", bin_width, "number of seconds")
        require_credible_bin_width(bin_width, longest=MAX_ROW_S)
        return replace(self, row_times=np.arange(len(self.counts), dtype=np.float64) * bin_width)


def outline_streak(
    shape: tuple[int, ...],
    has_times: bool,
    has_limit: bool,
    metadata: Mapping[str, str],
    camera: Camera | None = None,
    attachments: Mapping[str, Record] | None = None,
) -> Record:
    """Describe a streak image of rows and columns whose pixels are not read, as `read_outline`
    does; whether the instants of its rows, and the limit of its pixels, are known.
    """
    axes = ("time", "column")
    fields = {"counts": Field(make_stand_in(shape, np.float32), "count", axes)}
    if has_times:
        fields["row_times"] = Field(make_stand_in(shape[:1], np.float64), "s", axes[:1])
    if has_limit:
        fields["saturated"] = Field(make_stand_in(shape, np.uint8), "", axes)
    children = {**(attachments or {}), "metadata": Record("metadata", attributes=dict(metadata))}
    if camera is not None:
        children["camera"] = camera.to_record()
    return Record(Streak.RECORD_KIND, fields, children=children)


def number_returns(pixel: AnyArray) -> NDArray[np.uint8]:
    """Return the number of each return in its pixel, from 1; `pixel` (n,) does not decrease."""
    first = np.flatnonzero(np.diff(pixel, prepend=-1))
    rank = np.arange(pixel.size) - np.repeat(first, np.diff(first, append=pixel.size))
    return np.asarray(rank + 1, dtype=np.uint8)


@dataclass(frozen=True)
class Returns(Storable):
    """A list of returns, pixel by pixel in raster order, nearest first within a pixel.

    Parameters
    ----------
    y, x : (n,) int32 array
        Row and column of the pixel.
    range : (n,) float64 array
        Distance from the camera along the line of sight, m.
    intensity : (n,) float32 array
        Counts of the return times (range / 1 m)^2: proportional to the surface's reflectance.
    confidence : (n,) float32 array
        Expected standard deviation of the range, m; smaller is surer.
    return_number : (n,) uint8 array
        1 for the nearest return of a pixel.
    time : (n,) float64 array
        Time of flight there and back, s.
    camera : Camera
        The camera that saw them.
    provenance : mapping
        How they came about.
    shear : (n,) float64 array, optional
        Shear at which the picture of that instant was recovered; 0 by default.
    false_alarm : (n,) float64 array, optional
        Probability that the return is false, noise or spread by the recovery; NaN, the default, where
        it is not known.
    """

    RECORD_KIND = "returns"

    y: NDArray[np.int32] = field(metadata=stored_array("px", "return", dtype=np.int32))
    x: NDArray[np.int32] = field(metadata=stored_array("px", "return", dtype=np.int32))
    range: FloatArray = field(metadata=stored_array("m", "return"))
    intensity: Float32Array = field(metadata=stored_array("count", "return", dtype=np.float32))
    confidence: Float32Array = field(metadata=stored_array("m", "return", dtype=np.float32))
    return_number: NDArray[np.uint8] = field(metadata=stored_array("", "return", dtype=np.uint8))
    time: FloatArray = field(metadata=stored_array("s", "return"))
    camera: Camera = field(metadata=stored_child(Camera.from_record, "camera"))
    provenance: Mapping[str, Any] = stored_mapping("provenance")
    shear: FloatArray = empty_array("px", "return", optional=True)
    false_alarm: FloatArray = empty_array("", "return", optional=True)

    def __post_init__(self) -> None:
        for name, unknown in (("shear", 0.0), ("false_alarm", np.nan)):
            if getattr(self, name).size == 0:
                object.__setattr__(self, name, np.full(self.y.shape, unknown))
        for name, column in self._columns.items():
            require_shape(f"{name} of the returns", self.y.shape, column.shape)

    @property
    def _columns(self) -> dict[str, Any]:
        values = {one.name: getattr(self, one.name) for one in fields(self)}
        return {name: one for name, one in values.items() if isinstance(one, np.ndarray)}

    def __len__(self) -> int:
        return self.y.size

    def __repr__(self) -> str:
        if len(self) == 0:
            return "Returns(none)"
        near, far = self.range.min(), self.range.max()
        return f"Returns({len(self)} returns, range {near:.3g} to {far:.3g} m)"

    @property
    def line_of_sight_px(self) -> tuple[FloatArray, FloatArray]:
        """(rows, columns) of the reference view's pixels in which the returns lie.

        A picture that was not recovered at the shear of its range is displaced by the parallax;
        here that is undone.
        """
        missing = self.camera.shear_at(self.range) - self.shear
        rows, columns = self.camera.displacement_per_shear
        known = self.camera.lenslet_pitch > 0
        return self.y - known * rows * missing, self.x - known * columns * missing

    @property
    def range_sigma(self) -> Float32Array:
        """`confidence` by the name that clouds have for it: one standard deviation, m."""
        return self.confidence

    @property
    def reflectance(self) -> Float32Array:
        """Reflectance of the surfaces as if they faced the camera, percent; NaN where the camera has
        not seen a target of known reflectance.
        """
        known = self.camera.range_calibration
        if known is None:
            return np.full(self.y.shape, np.nan, np.float32)
        return known.compute_reflectance(self.intensity, self.y, self.x).astype(np.float32)

    def __getitem__(self, chosen: AnyArray) -> Returns:
        """Return some of the returns, by a mask or by numbers."""
        return replace(self, **{name: column[chosen] for name, column in self._columns.items()})

    def merge(self, others: Returns) -> Returns:
        """Return these and others of the same camera, in order, each pixel's numbered anew."""
        columns: dict[str, Any] = {
            name: np.append(one, getattr(others, name)) for name, one in self._columns.items()
        }
        pixel = columns["y"].astype(np.int64) * self.camera.image_shape[1] + columns["x"]
        order = np.lexsort((columns["range"], pixel))
        columns["return_number"][order] = number_returns(pixel[order])
        return replace(self, **columns)[order]

    def select(self, which: str) -> Returns:
        """Return one return of each pixel, or all of them; `which` is ``"first"``, the nearest of a
        pixel, ``"last"``, the furthest, ``"strongest"``, of the highest intensity, or ``"all"``;
        `InputError` for another.
        """
        require_known("return", which, RETURN_CHOICES)
        if which == "all":
            return self
        ranks: dict[str, AnyArray] = {
            "first": self.range,
            "last": -self.range,
            "strongest": -self.intensity,
        }
        pixel = self.y.astype(np.int64) * self.camera.image_shape[1] + self.x
        order = np.lexsort((ranks[which], pixel))
        first_of_pixel = np.flatnonzero(np.diff(pixel[order], prepend=-1))
        return self[np.sort(order[first_of_pixel])]

    def image(self, name: str) -> Float32Array:
        """Picture (y, x) of one of `PICTURE_COLUMNS`, of the most intense return; NaN: none."""
        require(name in PICTURE_COLUMNS, f"returns have no property '{name}' to show as a picture")
        picture = np.full(self.camera.image_shape, np.nan, dtype=np.float32)
        upwards = np.argsort(self.intensity, kind="stable")  # the last one written wins
        picture[self.y[upwards], self.x[upwards]] = getattr(self, name)[upwards]
        return picture


@dataclass(frozen=True)
class Frames(Storable):
    """A transient cube with its axes and the camera that saw it.

    Parameters
    ----------
    values : (time, y, x) array
        Brightness in counts, float32, y pointing down. Of any library: what is done with the frames
        is done there, if it can be, and what can be done in NumPy only says so. Files hold NumPy's.
    times : (time,) array
        Time of flight of each frame, s, strictly increasing: the camera's time zero is already
        taken off.
    camera : Camera
        The camera, with the gains and the sweep that were used for this shot.
    figures : mapping
        Scalars of the recovery, such as ``relative_residual``.
    attachments : mapping of str to Record
        What travelled along with the streak image.
    provenance : mapping
        How they came about.
    shears : (time,) array, optional
        Shear at which each frame was recovered, pixels per view step; 0 everywhere by default.
    returns : Returns, optional
        Where the recovery found them itself: the surfaces of which the frames are a rendering.
    measured : (columns, time) array, optional
        The rectified measurements that the frames explain, NaN where one was not used: by them returns
        are judged. Without elements where they are not known.
    """

    RECORD_KIND = "frames"

    values: Array = field(metadata=stored_array("count", "time", "y", "x", dtype=np.float32))
    times: FloatArray = field(metadata=stored_array("s", "time"))
    camera: Camera = field(metadata=stored_child(Camera.from_record, "camera"))
    figures: Mapping[str, Scalar] = stored_mapping("attributes")
    attachments: Mapping[str, Record] = stored_mapping("attachments")
    provenance: Mapping[str, Any] = stored_mapping("provenance")
    shears: FloatArray = empty_array("px", "time", optional=True)
    returns: Returns | None = field(
        default=None, metadata=stored_child(Returns.from_record, "returns", optional=True)
    )
    measured: Float32Array = empty_array(
        "count", "column", "time", dtype=np.float32, optional=True, skip_empty=True
    )

    def __post_init__(self) -> None:
        require_type(self.camera, Camera, "frames belong to a Camera")
        times = np.asarray(self.times, dtype=np.float64)
        object.__setattr__(self, "times", times)
        if not hasattr(self.values, "shape"):
            require_type(self.values, np.ndarray, "the values of frames are an array (time, y, x)")
        expected = (times.size, *self.camera.image_shape)
        if self.values.shape != expected:
            raise ShapeError("frames", f"(time, y, x) = {expected}", tuple(self.values.shape))
        require(
            times.size != 0 and np.all(np.isfinite(times)) and not np.any(np.diff(times) <= 0),
            "frame times must be finite and increase",
        )
        if times.size > 1:
            require_credible_bin_width(self.bin_width)
        shears = np.asarray(self.shears, dtype=np.float64)
        object.__setattr__(self, "shears", shears if shears.size else np.zeros(times.size))
        if self.shears.shape != times.shape or not np.all(np.isfinite(self.shears)):
            raise ShapeError("the frames' shears", f"{times.shape}, finite", self.shears.shape)
        slit = self.camera.slit_width_px, times.size
        if self.measured.size:
            require_shape("the frames' measurements", slit, self.measured.shape)
        xp = namespace(self.values)
        require(xp.all(xp.isfinite(self.values)), "frames must not hold NaN or infinity")

    def __len__(self) -> int:
        return int(self.times.size)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> AnyArray:
        return np.asarray(to_numpy(self.values), dtype=dtype)

    def __getitem__(self, frames: Any) -> Any:
        """Return `Frames` by a slice, such as ``frames[100:200]``, with the returns of their time;
        what else NumPy understands picks from the values: ``frames[5]`` is a picture, and
        ``frames[:, 20, 30]`` a pixel's waveform.
        """
        if not isinstance(frames, slice):
            try:
                return self.values[frames]
            except (IndexError, TypeError) as fault:
                raise InputError(f"frames are (time, y, x) = {self.shape}: {fault}") from fault
        require(self.times[frames].size != 0, f"no frame is selected of {len(self)}")
        require(
            (frames.step or 1) > 0, "frames stay in the order of time; a step cannot be negative"
        )
        returns = self.returns
        if returns is not None:
            # A return belongs to the frame nearest in time.
            nearest = np.searchsorted((self.times[1:] + self.times[:-1]) / 2, returns.time)
            taken = np.arange(len(self))[frames]
            returns = returns[(taken[0] <= nearest) & (nearest <= taken[-1])]
        own = {name: getattr(self, name)[frames] for name in ("values", "times", "shears")}
        own["measured"] = self.measured[:, frames]
        return replace(self, **own, returns=returns)

    def sel(
        self,
        *,
        range: tuple[float, float] | None = None,  # noqa: A002 - the field's word
        time: tuple[float, float] | None = None,
    ) -> Frames:
        """Return the frames of a `range`, (nearest, furthest), m, or of a `time` of flight, (first,
        last), s, ends included. `InputError` where neither is given, or both are, or no frame lies
        between.
        """
        require(
            (range is None) != (time is None),
            "sel takes either range=(near, far) in m or time=(first, last) in s",
        )
        try:
            limits = np.asarray(time if range is None else range, dtype=np.float64)
        except (TypeError, ValueError) as fault:
            raise InputError(f"limits are two numbers: {fault}") from fault
        if limits.shape != (2,):
            raise ShapeError("the limits of sel", "(lower, upper)", limits.shape)
        at = self.times if range is None else self.ranges
        first, stop = np.searchsorted(at, limits[0]), np.searchsorted(at, limits[1], side="right")
        require(first < stop, f"no frame lies between {limits[0]:g} and {limits[1]:g}")
        return self[int(first) : int(stop)]

    @property
    def shape(self) -> tuple[int, int, int]:
        """Frames, rows and columns."""
        frames, rows, columns = self.values.shape
        return frames, rows, columns

    @property
    def ranges(self) -> FloatArray:
        """Range of each frame (time,), m; see `time_zero_note`."""
        return SPEED_OF_LIGHT * self.times / 2

    def max(self, axis: int | tuple[int, ...] | None = None, **options: Any) -> Any:
        """Return the largest value, or along each `axis` of (time, y, x), counts; `options` as NumPy's."""
        return np.asarray(self).max(axis, **options)

    @property
    def time_zero_note(self) -> str:
        """Said beside ranges, which are right up to a constant where no time zero was given."""
        return "" if self.camera.time_zero else " up to a constant, no time zero given"

    @property
    def _range_text(self) -> str:
        near, far = self.ranges[[0, -1]]
        return f"{near:.3g} to {far:.3g} m{self.time_zero_note}"

    def __repr__(self) -> str:
        frames, rows, columns = self.shape
        return f"Frames({frames} frames of {rows} x {columns} pixels, range {self._range_text})"

    def _repr_html_(self) -> str:
        rows = {
            "values (time, y, x)": " x ".join(map(str, self.values.shape)),
            "time of flight": f"{1e9 * self.times[0]:.3f} to {1e9 * self.times[-1]:.3f} ns",
            "range": self._range_text,
            "method": str(self.figures.get("method", "unknown")),
        }
        return render_html("Frames", rows, np.asarray(self).max(axis=0))

    def plot(self, ax: Any = None) -> Any:
        """Draw the sum of all frames into Axes `ax`, by default the current ones; return them."""
        title = f"{len(self)} frames, {self._range_text}"
        return plot_picture(np.asarray(self).sum(axis=0), title, ax)

    def to_xarray(self) -> Any:
        """Return an `xarray.DataArray` (time, y, x) with times in s, ranges in m and pixels as
        coordinates; `MissingDependencyError` where xarray is not installed.
        """
        y, x = map(np.arange, self.shape[1:])
        axes = {"time": (self.times, "s"), "y": (y, "px"), "x": (x, "px")}
        return make_data_array(np.asarray(self), axes, "brightness", "counts", self.ranges)

    def to_torch(self) -> Any:
        """Return the values as a PyTorch tensor (time, y, x), which shares NumPy's memory;
        `MissingDependencyError` where PyTorch is not installed.
        """
        return require_package("torch").as_tensor(np.asarray(self))

    @property
    def bin_width(self) -> float:
        """Mean time between frames, s."""
        require(self.times.size != 1, "a single frame has no bin width")
        return float((self.times[-1] - self.times[0]) / (self.times.size - 1))
