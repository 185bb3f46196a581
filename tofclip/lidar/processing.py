"""Point clouds cleaned, thinned, measured and laid over each other; their columns are kept.

Normals, planes and registration are Open3D's, which is loaded on first use; what also works where it
does not load is SciPy's.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy
from numpy.typing import ArrayLike

from tofclip.arrays import AnyArray, BoolArray, FloatArray, IndexArray
from tofclip.errors import InputError, ShapeError, require_positive
from tofclip.files import import_open3d
from tofclip.lidar.cloud import PROPERTY_COLUMNS, PointCloud
from tofclip.units import MAD_TO_SIGMA

MIN_SPACING_RATIO = 3.0
SIZE_PERCENTILES = (5.0, 95.0)  # of an object's points: a few strays do not widen it


@dataclass(frozen=True)
class Plane:
    """A plane ``normal . x = offset``."""

    normal: FloatArray  # (3,), unit vector, towards the camera
    offset: float  # its distance from the origin along the normal, m; not positive
    inliers: BoolArray  # (n,), points of the cloud that lie on it
    rms: float  # root mean square distance of these from it, m


@dataclass(frozen=True)
class Alignment:
    """How one cloud is laid over another."""

    pose: FloatArray  # (4, 4), rotation and translation (m) that takes the source to the target
    overlap: float  # share of the source's points with a neighbour in the target
    rms: float  # root mean square distance to these neighbours, m


def transform_cloud(cloud: PointCloud, pose: ArrayLike) -> PointCloud:
    """Return a cloud in another frame, such as that of a mount or of a map; ranges stay those from
    the camera. `pose` (4, 4): extrinsics: rotation and translation (m) from the camera's frame to
    the other.
    """
    matrix = np.asarray(pose, dtype=np.float64)
    if matrix.shape != (4, 4):
        raise ShapeError("a pose", (4, 4), matrix.shape)
    turn = matrix[:3, :3]
    if not (np.allclose(turn @ turn.T, np.eye(3), atol=1e-6) and np.linalg.det(turn) > 0):
        raise InputError("a pose must be a rotation and a translation, without scale or mirror")
    return replace(cloud, xyz=(cloud.xyz @ turn.T + matrix[:3, 3]).astype(np.float32))


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


def remove_outliers(cloud: PointCloud, neighbours: int = 16, deviations: float = 4.0) -> PointCloud:
    """Leave out what `find_outliers` finds."""
    return cloud[~find_outliers(cloud, neighbours, deviations)]


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


def estimate_normals(cloud: PointCloud, neighbours: int = 16) -> FloatArray:
    """Return each point's surface normal, (n, 3), towards the camera, from a plane through at least
    three neighbours.
    """
    if len(cloud) < 3 or neighbours < 3:
        raise InputError("a normal needs at least three points and three neighbours")
    open3d = import_open3d()
    shape = cloud.to_open3d()
    shape.estimate_normals(open3d.geometry.KDTreeSearchParamKNN(neighbours))
    shape.orient_normals_towards_camera_location(np.zeros(3))
    return np.asarray(shape.normals)


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


def align_clouds(
    source: PointCloud, target: PointCloud, reach: float, start: ArrayLike | None = None
) -> Alignment:
    """Lay a cloud over another one, such as the next of a sequence (point-to-plane iterated closest
    points). `reach`: largest distance of points that may belong together, m; `start` (4, 4): first
    guess.
    """
    if min(len(source), len(target)) < 3 or not reach > 0:
        raise InputError("registration needs three points in each cloud and a positive reach")
    open3d, surface = import_open3d(), target.to_open3d()
    surface.normals = open3d.utility.Vector3dVector(estimate_normals(target))
    registration = open3d.pipelines.registration
    first = np.eye(4) if start is None else np.asarray(start, dtype=np.float64)
    to_planes = registration.TransformationEstimationPointToPlane()
    found = registration.registration_icp(source.to_open3d(), surface, reach, first, to_planes)
    pose = np.asarray(found.transformation)
    return Alignment(pose, float(found.fitness), float(found.inlier_rmse))


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
