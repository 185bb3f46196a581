"""A capture: transients on a relay wall, with the geometry and the time axis that they belong to.

From frames of a camera that looks at the relay wall to a capture: taking off the ways between wall
and camera.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.linalg import norm

from nlos.kernels import shift_signals
from tofclip.arrays import (
    AnyArray,
    Array,
    BoolArray,
    ComputeDevice,
    Float32Array,
    FloatArray,
    is_numpy,
    namespace,
    require_numpy,
    to_numpy,
)
from tofclip.errors import InputError, ShapeError, require, require_positive, require_type
from tofclip.notebook import render_html
from tofclip.shots import RELAY_WALL, Frames
from tofclip.storage import Storable, stored_array, stored_mapping, stored_value
from tofclip.units import PICOSECOND, SPEED_OF_LIGHT, require_credible_bin_width

MIN_BINS = 2


@dataclass(frozen=True)
class TimeAxis:
    """Evenly spaced time bins.

    Parameters
    ----------
    bins : int
        How many; at least 2.
    bin_width : float
        Duration of a bin, s.
    start : float
        Length of the path laser spot -> hidden point -> wall point that bin 0 holds, m.

    Raises
    ------
    InputError
        Too few bins, a width that is not positive, or a number that is not finite.
    """

    bins: int
    bin_width: float
    start: float = 0.0

    def __post_init__(self) -> None:
        if self.bins < MIN_BINS:
            raise InputError(f"a transient needs at least {MIN_BINS} time bins, got {self.bins}")
        require_positive("bin width", self.bin_width, "number of seconds")
        if not np.isfinite(self.start):
            raise InputError(
                f"the path length of bin 0 must be a finite number of metres, got {self.start}"
            )

    @property
    def spacing(self) -> float:
        """Path that light travels during one bin, m."""
        return SPEED_OF_LIGHT * self.bin_width

    @property
    def paths(self) -> FloatArray:
        """Path length of every bin, m, shape (bins,)."""
        return self.start + self.spacing * np.arange(self.bins, dtype=np.float64)


# m; a wider one was not measured in metres.
MAX_WALL_EXTENT_M = 1e3
# Wall points whose nearest neighbours tell the sampling of the wall.
MAX_SPACING_POINTS = 1000


def _name_places(axes: int) -> tuple[str, ...]:
    """Names of the axes of wall points, which may have any number."""
    return ("row", "column") if axes == 2 else tuple(f"wall_{i}" for i in range(axes))


def _name_coordinates(axes: int) -> tuple[str, ...]:
    return (*_name_places(axes - 1), "xyz")


@dataclass(frozen=True, eq=False)
class Capture(Storable):
    """What a detector saw at points of a relay wall while the laser lit one spot, or a spot for
    each point.

    A confocal scan has ``laser`` equal to ``wall``; a paired scan has another spot for every point;
    a grid of lasers that were all combined with all points becomes paired by `exhaustive`.

    Parameters
    ----------
    signal : (t, ...) array
        Brightness per time bin and wall point, kept as float32. May be negative (background taken
        off). An array of another library stays where it is, and is imaged there by the methods that
        can; the geometry is NumPy's.
    wall : (..., 3) array
        Wall points, m. Points with a NaN coordinate are left out, whatever their signal holds.
    laser : (3,) or (..., 3) array
        The laser spot on the wall, m; or one spot per wall point, equal to the wall for a confocal
        scan.
    bin_width, start
        As of `TimeAxis`.
    provenance : mapping
        How it came about.

    Raises
    ------
    ShapeError, InputError
        Shapes disagree, a used signal is not finite, no wall point is left, the time axis is
        unusable, lengths or durations are not in metres or seconds, or the laser spot lies far
        behind the wall.
    """

    RECORD_KIND = "capture"

    signal: Array = field(
        metadata=stored_array(
            "count", dtype=np.float32, layout=lambda axes: ("time", *_name_places(axes - 1))
        )
    )
    wall: FloatArray = field(metadata=stored_array("m", layout=_name_coordinates))
    laser: FloatArray = field(metadata=stored_array("m", layout=_name_coordinates))
    bin_width: float = field(metadata=stored_value("bin_width_s"))
    start: float = field(default=0.0, metadata=stored_value("start_m"))
    provenance: Mapping[str, Any] = stored_mapping("provenance")

    def __post_init__(self) -> None:
        object.__setattr__(self, "signal", _to_float_signal(self.signal))
        object.__setattr__(self, "wall", _to_real_array(self.wall, np.float64, "wall"))
        object.__setattr__(self, "laser", _to_real_array(self.laser, np.float64, "laser"))
        object.__setattr__(self, "bin_width", float(self.bin_width))
        object.__setattr__(self, "start", float(self.start))
        if self.wall.ndim == 0 or self.wall.shape[-1] != 3:
            raise ShapeError("wall", "(..., 3)", self.wall.shape)
        if self.signal.ndim != self.wall.ndim or self.signal.shape[1:] != self.wall.shape[:-1]:
            expected = ("t", *self.wall.shape[:-1])
            raise ShapeError("signal", f"{expected} like the wall", self.signal.shape)
        if self.laser.shape not in ((3,), self.wall.shape):
            raise ShapeError("laser", f"(3,) or the wall's {self.wall.shape}", self.laser.shape)
        if self.laser.shape == (3,) and not np.all(np.isfinite(self.laser)):
            raise InputError(f"the laser spot must be finite, got {self.laser}")
        TimeAxis(self.signal.shape[0], self.bin_width, self.start)
        require_credible_bin_width(self.bin_width)
        require(np.any(self.valid), "every wall point is NaN: nothing is left to image with")
        extent = measure_extent(self)
        if extent > MAX_WALL_EXTENT_M:
            raise InputError(f"a wall of {extent:g} m is not credible; give its points in metres")
        behind = float(self.points[:, 2].min() - self.lasers[:, 2].min())
        if len(self.points) > 1 and behind > extent / 2:
            raise InputError(
                f"the laser spot lies {behind:.3g} m behind the hindmost wall point: give the spot on the wall, not "
                "the device, and z growing from the wall into the hidden scene"
            )
        bad = _count_non_finite(self.signal, self.valid)
        if bad:
            raise InputError(
                f"{bad} samples of the signal are NaN or infinite; set them to 0, or their wall points to NaN"
            )

    def __repr__(self) -> str:
        points = " x ".join(map(str, self.wall.shape[:-1])) or "1"
        spots = "one laser spot" if self.laser.shape == (3,) else "a laser spot for each"
        return (
            f"Capture({points} wall points, {spots}, {self.signal.shape[0]} bins of "
            f"{self.bin_width / PICOSECOND:.3g} ps)"
        )

    def _repr_html_(self) -> str:
        low, high = self.points.min(axis=0), self.points.max(axis=0)
        last = self.start + self.signal.shape[0] * self.axis.spacing
        described = {
            "signal (time, wall)": " x ".join(map(str, self.signal.shape)),
            "wall": " x ".join(f"{side:.3f}" for side in high - low) + " m (x, y, z)",
            "laser": "one spot" if self.laser.shape == (3,) else "a spot for each wall point",
            "time bin": f"{self.bin_width / PICOSECOND:.4g} ps",
            "length of path": f"{self.start:.3f} to {last:.3f} m",
        }
        picture = to_numpy(self.signal).sum(axis=0) if self.wall.ndim == 3 else None
        return render_html("Capture", described, picture)

    @classmethod
    def exhaustive(
        cls,
        signal: Any,
        wall: Any,
        laser: Any,
        bin_width: float,
        start: float = 0.0,
        provenance: Mapping[str, Any] | None = None,
    ) -> Capture:
        """Take a record in which every laser spot of a grid was combined with every wall point.

        Parameters
        ----------
        signal : (t, lasers..., points...) array
        wall : (points..., 3) array
            Wall points, m.
        laser : (lasers..., 3) array
            Laser spots, m.
        bin_width, start, provenance
            As of `Capture`.

        Examples
        --------
        >>> import numpy as np
        >>> wall = np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.2, 0.0, 0.0]])
        >>> laser = np.array([[0.0, 0.1, 0.0], [0.0, 0.2, 0.0]])
        >>> signal = np.ones((8, 2, 3), np.float32)
        >>> len(Capture.exhaustive(signal, wall, laser, bin_width=10e-12).points)
        6
        """
        wall = _to_real_array(wall, np.float64, "wall")
        laser = _to_real_array(laser, np.float64, "laser")
        shape = (*laser.shape[:-1], *wall.shape[:-1], 3)
        every_laser = laser.reshape(*laser.shape[:-1], *[1] * (wall.ndim - 1), laser.shape[-1])
        if wall.shape[-1:] != (3,) or laser.shape[-1:] != (3,):
            raise ShapeError("wall and laser", "(..., 3)", (wall.shape, laser.shape))
        pairs = np.broadcast_to(wall, shape), np.broadcast_to(every_laser, shape)
        return cls(signal, *pairs, bin_width, start, provenance or {})

    @property
    def device(self) -> ComputeDevice:
        """Where the signal lives: library and device."""
        return ComputeDevice.of(self.signal)

    def on(self, device: ComputeDevice) -> Capture:
        """Return the capture with its signal on ``device``, such as `parse_device("cuda")`."""
        return replace(self, signal=device.put(self.signal))

    @property
    def axis(self) -> TimeAxis:
        """The time axis."""
        return TimeAxis(self.signal.shape[0], self.bin_width, self.start)

    @cached_property
    def valid(self) -> BoolArray:
        """Wall points whose position, and whose own laser spot, is known; shape (...)."""
        known = np.isfinite(self.wall) & np.isfinite(self.laser)
        return np.asarray(known.all(axis=-1))

    @cached_property
    def points(self) -> FloatArray:
        """Valid wall points in C order, m, shape (points, 3)."""
        return self.wall[self.valid]

    @cached_property
    def lasers(self) -> FloatArray:
        """Laser spots, m: (1, 3) if it stands still, else (points, 3) as `points`."""
        return self.laser[np.newaxis] if self.laser.shape == (3,) else self.laser[self.valid]

    @cached_property
    def spacing(self) -> float:
        """Median distance of wall points to their nearest, m; infinite for a lone one."""
        from scipy.spatial import cKDTree

        # An exhaustive capture names every wall point once per laser.
        places = np.unique(self.points, axis=0)
        if len(places) == 1:
            return float("inf")
        some = places[:: len(places) // MAX_SPACING_POINTS + 1]
        return float(np.median(cKDTree(places).query(some, 2)[0][:, 1]))

    def traces(self, selection: slice = slice(None)) -> Float32Array:
        """Signals (points, t) of the ``selection`` of `points`, NumPy's only; all of a complete wall
        are not copied, so that time is the slow axis in memory.
        """
        require_numpy("this treatment of a capture's signal", self.signal)
        in_time: Float32Array = self.signal.reshape(self.signal.shape[0], -1)
        if selection == slice(None) and self.valid.all():
            return in_time.T
        return np.ascontiguousarray(in_time[:, np.flatnonzero(self.valid)[selection]].T)

    @classmethod
    def from_frames(cls, frames: Frames) -> Capture:
        """Take the wall's part out of recovered frames and remove each wall point's way to the
        camera.

        The frames must carry a record ``"relay_wall"``: fields ``wall`` (rows, columns, 3),
        ``camera`` (3,) and ``laser`` (3,) in m; attributes ``row_offset`` and ``column_offset``,
        the pixel that saw the first wall point, and ``receive_delay_bins``, the number of bins that
        the record began after light of path 0.

        Coordinates stay as they are in the record.

        Raises
        ------
        InputError
            The frames carry no relay wall, or are a rendering of surfaces, the wall does not fit into
            the picture, or the frames are not evenly spaced in time.
        """
        require_type(frames, Frames, "a capture is made of Frames, see tofclip.recover")
        if frames.figures.get("method") == "surfaces":
            raise InputError(
                "these frames are a rendering of surfaces, without a wall's third bounce: recover by another method"
            )
        record = frames.attachments.get(RELAY_WALL)
        if record is None or record.kind != RELAY_WALL:
            raise InputError(
                "these frames carry no relay wall: recover them from a streak image converted with its wall's geometry"
            )
        wall = record.array("wall", np.float64, 3, "m")
        camera, laser = (
            _require_position(name, record.array(name, np.float64, 1, "m"))
            for name in ("camera", "laser")
        )
        bin_width, steps = frames.bin_width, np.diff(frames.times)
        if np.max(np.abs(steps - bin_width)) > STEP_TOLERANCE * bin_width:
            raise InputError(
                f"the frames are {steps.min():.3e} to {steps.max():.3e} s apart; imaging around a corner needs evenly "
                "spaced ones: recover with one `bin_width`"
            )
        row, column = (int(record.number(f"{name}_offset")) for name in ("row", "column"))
        if wall.shape[-1] != 3:
            raise ShapeError("wall", "(rows, columns, 3)", wall.shape)
        (rows, columns), (high, wide) = wall.shape[:2], frames.values.shape[1:]
        if min(row, column) < 0 or row + rows > high or column + columns > wide:
            raise InputError(
                f"a wall of {rows} x {columns} points from pixel ({row}, {column}) on does not fit into frames of "
                f"{high} x {wide} pixels"
            )
        seen = frames.values[:, row : row + rows, column : column + columns]
        delay = record.number("receive_delay_bins")
        start = SPEED_OF_LIGHT * (float(frames.times[0]) + delay * bin_width)
        legs = norm(wall - camera, axis=-1) - norm(laser - camera)
        signal = _shift_earlier(to_numpy(seen), legs / (SPEED_OF_LIGHT * bin_width))
        return cls(signal, wall, laser, bin_width, start, frames.provenance)

    def save(self, path: str | Path, compressed: bool = True) -> None:
        """Write the capture to an HDF5 file ``path``, whole or not at all; one that is not
        ``compressed`` is read several times faster.
        """
        self.to_record().save(path, compressed)


def measure_extent(capture: Capture) -> float:
    """Return the longest side of a box about a wall's points, m."""
    return float(np.ptp(capture.points, axis=0).max())


def select_lasers(capture: Capture, some: slice | AnyArray) -> FloatArray:
    """Return the laser spots of some of the `points`: the one, or theirs."""
    return capture.lasers if len(capture.lasers) == 1 else capture.lasers[some]


def _to_float_signal(values: Any) -> Array:
    if is_numpy(values):
        return _to_real_array(values, np.float32, "signal")
    xp = namespace(values)
    if not xp.isdtype(values.dtype, ("real floating", "integral", "bool")):
        raise InputError(f"signal must hold real numbers, got {values.dtype}")
    return xp.astype(values, xp.float32, copy=False)


def _count_non_finite(signal: Array, valid: BoolArray) -> int:
    """Count the samples (t, ...) that are NaN or infinite at valid wall points."""
    if is_numpy(signal):
        # One bad sample spoils the sum: only then are they looked for one by one.
        with np.errstate(over="ignore", invalid="ignore"):
            if np.isfinite(signal.sum(dtype=np.float32)):
                return 0
        return int(np.count_nonzero(~np.isfinite(signal[:, valid])))
    xp = namespace(signal)
    bad = ~xp.isfinite(signal) & ComputeDevice.of(signal).put(valid)
    return int(xp.sum(xp.astype(bad, xp.int64)))


def _to_real_array(values: Any, dtype: type, name: str) -> AnyArray:
    array = np.asarray(values)
    require(array.dtype.kind in "fiub", f"{name} must hold real numbers, got {array.dtype}")
    return np.ascontiguousarray(array, dtype=dtype)


# Of its mean, what steps of a time axis may differ by: less than a bin over 1000.
STEP_TOLERANCE = 1e-3


def remove_device_legs(capture: Capture, source: Any, camera: Any) -> Capture:
    """Take the legs device -> laser spot and wall point -> camera, (3,) positions in m, off a
    capture: signals are read ``(|r_L - source| + |r_p - camera|) / c`` earlier, linearly; what all
    have in common goes into the start.
    """
    source, camera = (_require_position(*one) for one in (("source", source), ("camera", camera)))
    require_numpy("unwarping", capture.signal)
    outward = norm(capture.laser - source, axis=-1)
    legs = outward + norm(capture.wall - camera, axis=-1)
    # shifts from the shortest leg on cut off as little of the record as possible
    common = float(legs[capture.valid].min())
    signal = _shift_earlier(np.nan_to_num(capture.signal), (legs - common) / capture.axis.spacing)
    return replace(capture, signal=signal, start=capture.start - common)


def _require_position(name: str, position: Any) -> FloatArray:
    place = np.asarray(position, dtype=np.float64)
    if place.shape != (3,) or not np.all(np.isfinite(place)):
        raise InputError(f"the {name} position must be three finite numbers, got {place}")
    return place


def _shift_earlier(signal: Float32Array, bins: FloatArray) -> Float32Array:
    # A shift by the whole record reads nothing but zeros.
    delay = np.nan_to_num(bins, nan=signal.shape[0] + 1.0).ravel()
    flat = np.ascontiguousarray(signal.reshape(signal.shape[0], -1))
    return shift_signals(flat, delay).reshape(signal.shape)
