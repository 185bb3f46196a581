"""Which point is meant by a click, what is known about it, and how far it is from another."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from apps.viewer.colouring import format_length
from apps.viewer.source import Waveform
from tofclip.lidar import PointCloud
from tofclip.units import NANOSECOND

MAX_MISS_RAD = 0.012
"""rad; a click that misses every point by more, 10 pixels on a usual screen, means none of them."""

CLOSE_MISS_RAD = 0.004
"""rad; of all points missed by less, the nearest one is in front."""


@dataclass(frozen=True)
class Pick:
    """A point that was chosen."""

    position: tuple[float, float, float]  # x, y, z in m
    range: float  # m; the confidence is one standard deviation of the range
    confidence: float  # m; the confidence is one standard deviation of the range
    intensity: float  # counts, referred to 1 m
    return_number: int
    time: float  # time of flight, s
    pixel: tuple[int, int] | None = None  # row and column that saw it
    waveform: Waveform | None = None  # that pixel's signal over time
    # time of flight of every return that was found in that pixel and is shown, s
    return_times: tuple[float, ...] = ()

    @property
    def description(self) -> str:
        """One line for each thing that is known."""
        x, y, z = self.position
        lines = [
            f"x {x:.4f}, y {y:.4f}, z {z:.4f} m",
            f"range {self.range:.4f} m ± {format_length(self.confidence)}",
            f"{self.time / NANOSECOND:.3f} ns, {self.intensity:.4g} counts, return {self.return_number}",
        ]
        if self.pixel is not None:
            lines.append(f"pixel row {self.pixel[0]}, column {self.pixel[1]}")
        return "\n".join(lines)


def find_point_on_ray(
    xyz: NDArray[np.float32], origin: ArrayLike, direction: ArrayLike
) -> int | None:
    """Return the number of the point that a ray from the eye hits, None where it hits none.

    Of the points that the ray misses closely the one nearest to the eye is meant; with none so
    close, the one missed by the smallest angle.

    `xyz` (n, 3): m; `origin, direction` (3,): of the ray, in the same frame.
    """
    along = np.asarray(direction, dtype=np.float64)
    away = xyz - np.asarray(origin, dtype=np.float64)
    depth = away @ (along / np.linalg.norm(along))
    square = np.einsum("ij,ij->i", away, away)
    with np.errstate(divide="ignore", invalid="ignore"):
        # Tangent of the angle by which a point is missed; rounding may make the square negative.
        miss = np.sqrt(np.maximum(square - depth**2, 0)) / depth
    miss[~(depth > 0)] = np.inf  # behind the eye
    close = np.flatnonzero(miss < CLOSE_MISS_RAD)
    if close.size:
        return int(close[np.argmin(depth[close])])
    if miss.size == 0 or miss.min() > MAX_MISS_RAD:
        return None
    return int(np.argmin(miss))


def make_pick(
    cloud: PointCloud,
    number: int,
    pixel: tuple[int, int] | None = None,
    waveform: Waveform | None = None,
    return_times: tuple[float, ...] = (),
) -> Pick:
    """Return what is known about point `number` of a cloud.

    `number`: of the point; `pixel`: row and column that the point comes from; `waveform`: of that
    pixel; `return_times`: time of flight of that pixel's returns, s.
    """
    x, y, z = (float(value) for value in cloud.xyz[number])
    return Pick(
        (x, y, z),
        float(cloud.range[number]),
        float(cloud.range_sigma[number]),
        float(cloud.intensity[number]),
        int(cloud.return_number[number]),
        float(cloud.time[number]),
        pixel,
        waveform,
        return_times,
    )


def measure_distance(first: Pick, second: Pick) -> float:
    """Distance of two points, m.

    Returns metres.
    """
    return float(np.linalg.norm(np.subtract(first.position, second.position)))
