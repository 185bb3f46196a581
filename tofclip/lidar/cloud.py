"""Point clouds: where in space each return came from; and clouds cleaned, thinned and measured.

Organised clouds have one point for each pixel of the picture, row by row, NaN where nothing came
back: programs that work on neighbours take these from the rows and columns.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from tofclip.arrays import AnyArray, BoolArray, Float32Array, FloatArray, IndexArray
from tofclip.camera.model import compute_slopes
from tofclip.errors import FileFormatError, InputError, ShapeError, require_positive, require_type
from tofclip.files import import_open3d, require_suffix
from tofclip.io.archive import ArchiveEntry
from tofclip.lidar import export
from tofclip.lidar.export import Column
from tofclip.notebook import plot_points, render_html, require_package
from tofclip.shots import Returns
from tofclip.storage import (
    Field,
    Record,
    Storable,
    make_stand_in,
    read_outline,
    stored_array,
    stored_mapping,
)
from tofclip.units import MAD_TO_SIGMA, SPEED_OF_LIGHT

COLUMN_UNITS = {
    "x": "m",
    "y": "m",
    "z": "m",
    "intensity": "count",
    "range_sigma": "m",
    "range": "m",
    "return_number": "",
    "time": "s",
    "false_alarm": "",
    "reflectance": "percent",
}
"""The columns of a point cloud, in the order in which files hold them."""

PROPERTY_COLUMNS = tuple(name for name in COLUMN_UNITS if name not in "xyz")
OPTIONAL_COLUMNS = ("false_alarm", "reflectance")  # in files only where they are known of a point
FRONT_PIXELS = 64  # rows and columns of a cloud's picture in a notebook
COMMENTED_SUFFIXES = (".ply", ".pcd")  # whose comments hold the provenance
ORGANISED_SUFFIXES = (".pcd", ".ply", ".npz", ".csv")
"""Formats that can say what is missing; PCD says rows and columns as well."""


def _column(name: str, dtype: type = np.float32) -> dict[str, Any]:
    """Declare a column with one value for each point."""
    optional = name in OPTIONAL_COLUMNS
    return stored_array(COLUMN_UNITS[name], "point", dtype=dtype, optional=optional)


@dataclass(frozen=True)
class PointCloud(Storable):
    """Points in the reference view's frame: x right, y down, z forward, origin at the reference
    lenslet.

    Parameters
    ----------
    xyz : (n, 3) float32 array
        Positions, m.
    intensity : (n,) float32 array
        Counts, referred to a range of 1 m: proportional to reflectance.
    range_sigma : (n,) float32 array
        One standard deviation of the range, m.
    range : (n,) float32 array
        Distance from the origin, m.
    return_number : (n,) uint8 array
        1 for the nearest return of a pixel.
    time : (n,) float32 array
        Time of flight there and back, s.
    provenance : mapping
        How it came about; kept in HDF5, PLY and PCD files.
    false_alarm : (n,) float32 array, optional
        Probability that the point is false, noise or spread by the recovery; NaN, the default, where
        it is not known.
    reflectance : (n,) float32 array, optional
        Of the surface as if it faced the camera, percent; NaN, the default, where the camera has
        not seen a target of known reflectance.

    Raises
    ------
    ShapeError, InputError
        Columns of different length, or positions that are not finite.
    """

    RECORD_KIND = "cloud"

    xyz: Float32Array = field(metadata=stored_array("m", "point", "xyz", dtype=np.float32))
    intensity: Float32Array = field(metadata=_column("intensity"))
    range_sigma: Float32Array = field(metadata=_column("range_sigma"))
    range: Float32Array = field(metadata=_column("range"))
    return_number: NDArray[np.uint8] = field(metadata=_column("return_number", np.uint8))
    time: Float32Array = field(metadata=_column("time"))
    provenance: Mapping[str, Any] = stored_mapping("provenance")
    false_alarm: Float32Array = field(
        default_factory=lambda: np.empty(0, np.float32), metadata=_column("false_alarm")
    )
    reflectance: Float32Array = field(
        default_factory=lambda: np.empty(0, np.float32), metadata=_column("reflectance")
    )

    def __post_init__(self) -> None:
        xyz = np.ascontiguousarray(self.xyz, dtype=np.float32)
        if xyz.ndim != 2 or xyz.shape[1] != 3:
            raise ShapeError("the positions of a point cloud", "(points, 3)", xyz.shape)
        if not np.all(np.isfinite(xyz)):
            raise InputError("the positions of a point cloud must be finite")
        object.__setattr__(self, "xyz", xyz)
        for name in PROPERTY_COLUMNS:
            dtype = np.uint8 if name == "return_number" else np.float32
            column = np.ascontiguousarray(getattr(self, name), dtype=dtype)
            if name in OPTIONAL_COLUMNS and column.size == 0:
                column = np.full(xyz.shape[0], np.nan, np.float32)
            if column.shape != (xyz.shape[0],):
                raise ShapeError(f"{name} of a point cloud", (xyz.shape[0],), column.shape)
            object.__setattr__(self, name, column)

    def __len__(self) -> int:
        return int(self.xyz.shape[0])

    def __getitem__(self, points: Any) -> PointCloud:
        """Return some of the points: a slice, a mask or numbers, as ``cloud[cloud.range < 2]``."""
        if isinstance(points, (int, np.integer)):
            raise InputError(
                f"one point is cloud[{points}:{points + 1}]; cloud.xyz has its position"
            )
        try:
            chosen = {name: getattr(self, name)[points] for name in ("xyz", *PROPERTY_COLUMNS)}
        except (IndexError, TypeError) as fault:
            raise InputError(
                f"points are selected by a slice, a mask or numbers: {fault}"
            ) from fault
        return replace(self, **chosen)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> AnyArray:
        return np.asarray(self.xyz, dtype=dtype)

    def __repr__(self) -> str:
        if len(self) == 0:
            return "PointCloud(0 points)"
        return f"PointCloud({len(self)} points, range {self.range.min():.3g} to {self.range.max():.3g} m)"

    def _repr_html_(self) -> str:
        rows, light = {"points": str(len(self))}, None
        if len(self):
            x, y, z = self.xyz.T
            for axis, column in {"x": x, "y": y, "z": z, "range": self.range}.items():
                rows[axis] = f"{column.min():.3f} to {column.max():.3f} m"
            # of the points, as the camera sees them
            light = np.histogram2d(y, x, bins=FRONT_PIXELS, weights=self.intensity)[0]
            light = np.sqrt(np.maximum(light, 0))
        return render_html("PointCloud", rows, light)

    def plot(self, ax: Any = None) -> Any:
        """Draw the points as the camera sees them, coloured by range, into matplotlib Axes `ax`, by
        default the current figure's; return them.
        """
        ax = plot_points(self.xyz, self.range, ax)
        ax.set_title(f"{len(self)} points")
        return ax

    def to_pandas(self) -> Any:
        """Return a `pandas.DataFrame` with a row for each point, columns as in `COLUMN_UNITS`;
        `MissingDependencyError` where pandas is not installed.
        """
        columns = {column.name: column.values for column in self.columns}
        return require_package("pandas").DataFrame(columns)

    def to_open3d(self) -> Any:
        """Return an `open3d.geometry.PointCloud`: the positions, and the intensity as colours; see
        `to_open3d_tensor` for one with all columns. Open3D has what is not here, such as normals and
        registration. `MissingDependencyError` where it is not installed, or does not load.
        """
        return self.to_open3d_tensor().to_legacy()

    def to_open3d_tensor(self) -> Any:
        """Return an `open3d.t.geometry.PointCloud`: positions, the intensity as colours, and every
        other column as an attribute (points, 1), such as ``.point["range_sigma"]``, which
        `from_open3d` takes back from a cloud that was moved; `MissingDependencyError` as `to_open3d`.
        """
        tensors = import_open3d()
        shown = tensors.t.geometry.PointCloud(tensors.core.Tensor(self.xyz))
        shown.point["colors"] = tensors.core.Tensor(export.paint_brightness(self.intensity))
        for column in self.columns:
            if column.name not in "xyz":
                shown.point[column.name] = tensors.core.Tensor(column.values[:, np.newaxis])
        return shown

    @classmethod
    def from_open3d(cls, cloud: Any) -> PointCloud:
        """Make a point cloud of one of Open3D's, legacy or tensor, positions in m, x right, y down, z
        forward. Attributes named as in `COLUMN_UNITS` are taken over. What is missing is made up
        where it follows from the positions (range and time, first returns), is otherwise NaN;
        intensity is then the mean of the colours. `InputError` where `cloud` is none of Open3D's.
        """
        open3d = import_open3d()
        if isinstance(cloud, open3d.geometry.PointCloud):
            cloud = open3d.t.geometry.PointCloud.from_legacy(cloud)
        require_type(cloud, open3d.t.geometry.PointCloud, "from_open3d takes Open3D's point cloud")
        known = {name: values.cpu().numpy() for name, values in cloud.point.items()}
        xyz = known.get("positions", np.empty((0, 3))).astype(np.float64)
        if "colors" in known:
            known = {"intensity": known["colors"].mean(axis=1)} | known
        return complete_cloud(xyz, known)

    def to_torch(self) -> Any:
        """Return the positions as a PyTorch tensor (points, 3), m, which shares NumPy's memory;
        `MissingDependencyError` where PyTorch is not installed.
        """
        return require_package("torch").as_tensor(self.xyz)

    def save(self, path: str | Path) -> None:
        """Write the points to a file whose suffix says the format, whole or not at all.

        Parameters
        ----------
        path : path-like
            ``.ply`` and ``.pcd`` (binary, little endian, with colours by intensity and, up to 32
            kB, provenance), ``.csv``, ``.npz``, ``.las``, ``.laz`` (both need laspy, and hold
            colours too), ``.e57`` (needs pye57), or ``.h5`` (with provenance).

        Raises
        ------
        InputError
            Another suffix.
        StorageError
            The file could not be written; what was there before is left as it was.
        """
        require_suffix(path, *export.FORMATS, ".h5")
        if Path(path).suffix.lower() == ".h5":
            super().save(path)
        else:
            export.write_table(path, self.columns, provenance=self.provenance)

    @classmethod
    def load(cls, path: str | Path) -> PointCloud:
        """Read a point cloud that `save` wrote, in any of its formats; of an organised one the points
        that are there. `InputError`, `StorageError` or `FileFormatError` for a suffix of no known
        format, a file that cannot be read, or one that is damaged or lacks a column.
        """
        if Path(path).suffix.lower() == ".h5":
            return super().load(path)
        columns = _list_columns(path)
        values = {name: np.ravel(entry.load()) for name, entry in columns.items()}
        positions = np.stack([values.pop(axis) for axis in "xyz"], axis=-1)
        # An organised cloud has a place for every pixel, with or without a point.
        there = np.isfinite(positions).all(axis=1)
        positions = positions[there]
        properties: dict[str, Any] = {name: column[there] for name, column in values.items()}
        if Path(path).suffix.lower() in COMMENTED_SUFFIXES:
            properties["provenance"] = export.read_provenance(path)
        return cls(xyz=positions, **properties)

    @staticmethod
    def read_outline(path: str | Path) -> Record:
        """Describe a point cloud that `save` wrote, without reading its points; see
        `tofclip.storage.read_outline`. An organised one has a place for every pixel.
        """
        if Path(path).suffix.lower() == ".h5":
            return read_outline(path)
        columns = _list_columns(path)
        shape = columns["x"].shape
        axes = ("point",) if len(shape) == 1 else ("y", "x")
        fields = {"xyz": Field(make_stand_in((*shape, 3), np.float32), "m", (*axes, "xyz"))}
        for name, units in COLUMN_UNITS.items():
            if name in columns and name not in "xyz":
                dtype = np.uint8 if name == "return_number" else np.float32
                fields[name] = Field(make_stand_in(shape, dtype), units, axes)
        return Record("cloud", fields)

    def to_record(self) -> Record:
        """Return what is known of the points for storage."""
        record = super().to_record()
        known = {"xyz", *(column.name for column in self.columns)}
        fields = {name: one for name, one in record.fields.items() if name in known}
        return replace(record, fields=fields)

    @property
    def columns(self) -> list[Column]:
        """Everything that is known of the points, in the order in which files hold it."""
        values = dict(zip("xyz", self.xyz.T, strict=True))
        return [
            Column(name, unit, values[name] if name in values else getattr(self, name))
            for name, unit in COLUMN_UNITS.items()
            if name not in OPTIONAL_COLUMNS or np.isfinite(getattr(self, name)).any()
        ]


def complete_cloud(xyz: FloatArray, known: Mapping[str, AnyArray]) -> PointCloud:
    """Make a cloud of another program's positions (n, 3), m, and columns. What is missing is made up
    where it follows from the positions, is otherwise NaN.
    """
    unknown, distance = np.full(len(xyz), np.nan), np.linalg.norm(xyz, axis=1)
    columns: dict[str, Any] = {
        "intensity": unknown,
        "range_sigma": unknown,
        "range": distance,
        "return_number": np.ones(len(xyz)),
        "time": 2 * distance / SPEED_OF_LIGHT,
    }
    columns |= {name: np.ravel(known[name]) for name in PROPERTY_COLUMNS if name in known}
    return PointCloud(np.asarray(xyz, np.float32), **columns)


def point_cloud(returns: Returns) -> PointCloud:
    """Place each of the `returns` in space: its range along the direction in which its pixel looks.

    Heights that parallax displaced, because the picture was recovered at another shear than that of
    its range, are put right where the camera knows its lenslet pitch.
    """
    require_type(returns, Returns, "a point cloud is made of Returns, see tofclip.depth")
    right, down = compute_slopes(returns.camera, *returns.line_of_sight_px)
    depth = returns.range / np.sqrt(right * right + down * down + 1)
    xyz = np.empty((len(returns), 3), np.float32)
    xyz[:, 0], xyz[:, 1], xyz[:, 2] = right * depth, down * depth, depth
    return PointCloud(
        xyz=xyz,
        intensity=returns.intensity,
        range_sigma=returns.confidence,
        range=returns.range.astype(np.float32),
        return_number=returns.return_number,
        time=returns.time.astype(np.float32),
        provenance=returns.provenance,
        false_alarm=returns.false_alarm.astype(np.float32),
        reflectance=returns.reflectance,
    )


def _list_columns(path: str | Path) -> dict[str, ArchiveEntry]:
    """List the columns of a point cloud's table; refuse one that lacks any."""
    columns = export.list_columns(path)
    for name in COLUMN_UNITS:
        if name not in columns and name not in OPTIONAL_COLUMNS:
            raise FileFormatError(path, f"has no column '{name}': it was not written by tofclip")
    return {name: columns[name] for name in COLUMN_UNITS if name in columns}


def save_organised(returns: Returns, path: str | Path) -> int:
    """Write a place for every pixel, whole or not at all; return how many have a point. There is at
    most one return for each pixel (`Returns.select`). WIDTH and HEIGHT of PCD are the picture's,
    and NPZ holds pictures, (rows, columns).
    """
    suffix = Path(path).suffix.lower()
    if suffix not in ORGANISED_SUFFIXES:
        raise InputError(
            f"{path}: a file of this kind cannot hold an organised cloud; use one of "
            f"{', '.join(ORGANISED_SUFFIXES)}"
        )
    shape = returns.camera.image_shape
    pixel = returns.y.astype(np.int64) * shape[1] + returns.x
    if np.unique(pixel).size < pixel.size:
        raise InputError("an organised cloud has one point for a pixel: first, strongest or last")
    columns, cloud = [], point_cloud(returns)
    for column in cloud.columns:
        kind = column.values.dtype
        values = np.full(math.prod(shape), 0 if kind.kind == "u" else np.nan, kind)
        values[pixel] = column.values
        columns.append(replace(column, values=values))
    export.write_table(path, columns, shape, cloud.provenance)
    return len(returns)


MIN_SPACING_RATIO = 3.0
SIZE_PERCENTILES = (5.0, 95.0)  # of an object's points: a few strays do not widen it


@dataclass(frozen=True)
class Plane:
    """A plane ``normal . x = offset``."""

    normal: FloatArray  # (3,), unit vector, towards the camera
    offset: float  # its distance from the origin along the normal, m; not positive
    inliers: BoolArray  # (n,), points of the cloud that lie on it
    rms: float  # root mean square distance of these from it, m


def downsample_cloud(cloud: PointCloud, voxel: float) -> PointCloud:
    """Return one point for each occupied cube of side `voxel`, m: means of its points. Deviations
    of independent points shrink with their number; the return number is the least.
    """
    require_positive("the side of a voxel", voxel, "length")
    if len(cloud) == 0:
        return cloud
    cell = np.floor(cloud.xyz / np.float64(voxel)).astype(np.int64)
    _, group, number = np.unique(cell, axis=0, return_inverse=True, return_counts=True)
    group = group.ravel()

    def mean(values: AnyArray) -> FloatArray:
        return np.bincount(group, values.astype(np.float64), number.size) / number

    first = np.full(number.size, 255, np.uint8)
    np.minimum.at(first, group, cloud.return_number)
    columns: dict[str, Any] = {name: mean(getattr(cloud, name)) for name in PROPERTY_COLUMNS}
    # the error of a mean of n independent points is the root of their mean variance over n
    columns["range_sigma"] = np.sqrt(mean(cloud.range_sigma.astype(np.float64) ** 2) / number)
    columns["return_number"] = first
    columns["xyz"] = np.stack([mean(axis) for axis in cloud.xyz.T], axis=-1)
    return replace(cloud, **columns)


def find_outliers(cloud: PointCloud, neighbours: int = 16, deviations: float = 4.0) -> BoolArray:
    """Say which points lie further from their neighbours than those do from theirs.

    A surface at twice the range has its points twice as far apart, and one mean distance for all
    would take them for outliers. So each point's mean distance to its neighbours is compared with
    what is usual in the cloud at its range, and with what these neighbours have (a local outlier
    factor: M. M. Breunig et al., ACM SIGMOD Rec. 29, 93 (2000)), whichever is less.

    `deviations`: robust standard deviations of the logarithm of that ratio beyond which a point is
    an outlier. Returns (points,).
    """
    if neighbours < 1 or not deviations > 0:
        raise InputError("outliers need at least one neighbour and a positive number of deviations")
    if len(cloud) <= neighbours:
        return np.zeros(len(cloud), bool)
    xyz = cloud.xyz.astype(np.float64)
    # The nearest point to each is itself.
    apart, near = scipy.spatial.cKDTree(xyz).query(xyz, neighbours + 1)
    spacing = apart[:, 1:].mean(axis=1)
    tiny = np.finfo(np.float64).tiny
    per_range = spacing / np.maximum(cloud.range, tiny)
    usual = np.minimum(np.median(spacing[near[:, 1:]], axis=1), np.median(per_range) * cloud.range)
    ratio = np.log(np.maximum(spacing, tiny) / np.maximum(usual, tiny))
    middle = float(np.median(ratio))
    sigma = MAD_TO_SIGMA * float(np.median(np.abs(ratio - middle)))
    limit = max(middle + deviations * sigma, np.log(MIN_SPACING_RATIO))
    return ratio > limit


def fit_plane(cloud: PointCloud, reach: float, seed: int = 0) -> Plane:
    """Find the plane with most points within `reach`, m, by random sampling, and fit it to them."""
    if len(cloud) < 3 or not reach > 0:
        raise InputError("a plane needs at least three points and a positive reach")
    open3d = import_open3d()
    open3d.utility.random.seed(seed)
    _, found = cloud.to_open3d().segment_plane(reach, 3, 1000)
    inliers = np.zeros(len(cloud), dtype=bool)
    inliers[np.asarray(found, dtype=np.int64)] = True
    points = cloud.xyz[inliers].astype(np.float64)
    middle = points.mean(axis=0)
    normal = np.linalg.svd(points - middle, full_matrices=False)[2][2]
    normal *= -1 if normal @ middle > 0 else 1
    rms = float(np.sqrt(np.mean(((points - middle) @ normal) ** 2)))
    return Plane(normal, float(normal @ middle), inliers, rms)


@dataclass(frozen=True)
class DetectedObject:
    """One object."""

    points: IndexArray  # (n,), numbers of its points in the cloud
    range: float  # median distance from the camera, m
    range_sigma: float  # median of its points' expected standard deviations of range, m
    scatter: float  # robust standard deviation of its points' ranges, m: noise and its own depth
    centre: tuple[float, float, float]  # median position, m; x right, y down, z forward
    width: float  # extent along x and y of the inner nine tenths of its points, m
    height: float  # extent along x and y of the inner nine tenths of its points, m
    intensity: float  # median, counts referred to 1 m


def find_objects(cloud: PointCloud, reach: float, min_points: int = 40) -> list[DetectedObject]:
    """Group points that lie within `reach`, m, of each other, directly or through others; the
    nearest object first. `min_points`: smaller groups are left out.
    """
    if not (np.isfinite(reach) and reach > 0) or min_points < 1:
        raise InputError("objects need a positive reach, and at least one point")
    if len(cloud) == 0:
        return []
    pairs = scipy.spatial.cKDTree(cloud.xyz).query_pairs(reach, output_type="ndarray")
    # a point whose range is not known to half of that may lie on either of two objects
    known = ~(cloud.range_sigma > reach / 2)
    pairs = pairs[known[pairs].all(axis=1)]
    links = scipy.sparse.coo_array((np.ones(len(pairs)), tuple(pairs.T)), (len(cloud), len(cloud)))
    groups, label = scipy.sparse.csgraph.connected_components(links, directed=False)
    objects = []
    for group in np.flatnonzero(np.bincount(label, minlength=groups) >= min_points):
        points = np.flatnonzero(label == group)
        own = cloud[points]
        width, height, _ = np.ptp(np.percentile(own.xyz, SIZE_PERCENTILES, axis=0), axis=0)
        middle, sigma, bright = (
            float(np.median(one)) for one in (own.range, own.range_sigma, own.intensity)
        )
        scatter = MAD_TO_SIGMA * float(np.median(np.abs(own.range - middle)))
        x, y, z = (float(axis) for axis in np.median(own.xyz, axis=0))
        sizes = (x, y, z), float(width), float(height)
        objects.append(DetectedObject(points, middle, sigma, scatter, *sizes, bright))
    return sorted(objects, key=lambda seen: seen.range)
