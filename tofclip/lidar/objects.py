"""The objects of a cloud: groups of points that hang together, with range, its deviation, and size."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from tofclip.errors import InputError
from tofclip.lidar.cloud import PointCloud

SIZE_PERCENTILES = (
    5.0,
    95.0,
)  # percent of an object's points that count for its size: a few strays do not widen it


@dataclass(frozen=True)
class DetectedObject:
    """One object."""

    points: NDArray[np.intp]  # (n,), numbers of its points in the cloud
    range: float  # median distance from the camera, m
    range_sigma: float  # median of its points' expected standard deviations of range, m
    scatter: float  # robust standard deviation of its points' ranges, m: noise and its own depth
    centre: tuple[float, float, float]  # median position, m; x right, y down, z forward
    width: float  # extent along x and y of the inner nine tenths of its points, m
    height: float  # extent along x and y of the inner nine tenths of its points, m
    intensity: float  # median, counts referred to 1 m


def find_objects(cloud: PointCloud, reach: float, min_points: int = 40) -> list[DetectedObject]:
    """Group points that lie within `reach`, m, of each other, directly or through others; the
    nearest object first.

    `min_points`: smaller groups are left out.
    """
    if not (np.isfinite(reach) and reach > 0) or min_points < 1:
        raise InputError("objects need a positive reach, and at least one point")
    if len(cloud) == 0:
        return []
    pairs = scipy.spatial.cKDTree(cloud.xyz).query_pairs(reach, output_type="ndarray")
    links = scipy.sparse.coo_array(
        (np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), (len(cloud), len(cloud))
    )
    groups, label = scipy.sparse.csgraph.connected_components(links, directed=False)
    members = (np.flatnonzero(label == group) for group in range(groups))
    return sorted(
        (_measure_object(cloud, one) for one in members if one.size >= min_points),
        key=lambda seen: seen.range,
    )


def _measure_object(cloud: PointCloud, points: NDArray[np.intp]) -> DetectedObject:
    xyz, distance = cloud.xyz[points], cloud.range[points]
    low, high = np.percentile(xyz, SIZE_PERCENTILES, axis=0)
    middle = float(np.median(distance))
    x, y, z = (float(one) for one in np.median(xyz, axis=0))
    return DetectedObject(
        points=points,
        range=middle,
        range_sigma=float(np.median(cloud.range_sigma[points])),
        scatter=1.4826 * float(np.median(np.abs(distance - middle))),
        centre=(x, y, z),
        width=float(high[0] - low[0]),
        height=float(high[1] - low[1]),
        intensity=float(np.median(cloud.intensity[points])),
    )
