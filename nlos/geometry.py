"""The grid of voxels on which a hidden scene is imaged, and the straight ways that lead to it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from tofclip.errors import InputError, ShapeError

if TYPE_CHECKING:
    from nlos.capture import Capture
    from nlos.plane import VirtualPlane
    from nlos.volume import Volume

FloatArray = NDArray[np.float64]

MAX_DEPTH_WALL_WIDTHS = 2.0
"""Deeper than this a wall is too narrow an aperture to resolve much."""

MAX_VOXELS_PER_AXIS = 1 << 20
"""No computer holds an image of more; the axes themselves would fill its memory before any plan could
say so."""

MIN_WALL_FRACTION, WALL_FRACTION_PER_DIGIT = 0.3, 0.2
"""Of the longest way, what a window about wall points holds at least, and how much more for each
digit of the tolerance: where the plane stands close to the wall, crossings are wide beside their
distance. Measured with noise, which comes by all ways alike; errors of 1e-2 and 1e-3 ask for 0.7
and 0.9.
"""

MAX_RIM_FRACTION, RIM_FRACTION, RIM_FRACTION_PER_DIGIT = 0.7, 1.5, 0.5
"""Of the fade towards the plane's rim, how wide a rim carries too little to be told from an image
of it a period away: at most, and how much less for each digit of the tolerance. Measured with
noise; none where the error is 1e-3.
"""


@dataclass(frozen=True, eq=False)
class Grid:
    """Voxel centres, the product of three axes.

    Parameters
    ----------
    x, y, z : (n,) array
        Coordinates in m, strictly increasing; x to the right, y down, z from the wall into the
        hidden scene.

    Raises
    ------
    ShapeError, InputError
        An axis is empty or not one-dimensional, holds NaN or infinity, or does not increase.
    """

    x: FloatArray
    y: FloatArray
    z: FloatArray

    def __post_init__(self) -> None:
        for name in ("x", "y", "z"):
            object.__setattr__(self, name, _validate_axis(getattr(self, name), name))

    @classmethod
    def box(
        cls,
        x: Sequence[float],
        y: Sequence[float],
        z: Sequence[float],
        voxel: float | Sequence[float],
    ) -> Grid:
        """Fill a box with voxels.

        Parameters
        ----------
        x, y, z : (float, float)
            First and last voxel centre along each axis, m.
        voxel : float or (float, float, float)
            Distance of neighbouring centres, m, for all axes or for x, y and z. It is met exactly:
            where a side is not a multiple of it, the voxels are centred in the box and the outer ones
            lie inside.

        Returns
        -------
        Grid

        Raises
        ------
        InputError
            The voxel size is not positive, or so small that a side has more than a million voxels.

        Examples
        --------
        >>> Grid.box((-0.4, 0.4), (-0.4, 0.4), (0.6, 1.0), voxel=0.05).shape
        (9, 17, 17)
        """
        sizes = np.broadcast_to(np.asarray(voxel, dtype=np.float64), (3,))
        if not np.all(np.isfinite(sizes) & (sizes > 0)):
            raise InputError(f"the voxel size must be a positive number of metres, got {voxel}")
        sides = {"x": x, "y": y, "z": z}
        return cls(
            *(_fill_axis(name, sides[name], size) for name, size in zip("xyz", sizes, strict=True))
        )

    @classmethod
    def in_front_of(
        cls, capture: Capture, voxel: float, near: float | None = None, far: float | None = None
    ) -> Grid:
        """Fill the space in front of a capture's wall, as wide and as high as the wall.

        Parameters
        ----------
        capture : Capture
        voxel : float
            Distance of neighbouring voxel centres, m.
        near, far : float, optional
            First and last z, m. They default to one voxel in front of the middle of the wall's
            relief, and to the depth that light reaches and returns from within the record, at most
            two wall widths.

        Returns
        -------
        Grid

        Raises
        ------
        InputError
            The record ends before anything hidden could be seen.
        """
        if not hasattr(capture, "points"):
            raise InputError(f"a grid lies before a Capture's wall, not a {type(capture).__name__}")
        low, high = capture.points.min(axis=0), capture.points.max(axis=0)
        width = float(max(high[0] - low[0], high[1] - low[1]))
        middle = float(low[2] + high[2]) / 2
        if near is None:
            near = middle + voxel
        if far is None:
            # light of the longest path has turned back at half of it at the latest
            far = middle + min(float(capture.axis.paths[-1]) / 2, MAX_DEPTH_WALL_WIDTHS * width)
        if far < near:
            raise InputError(
                f"no room for a hidden scene: z would run from {near:.3g} to {far:.3g} m; does the record "
                f"(paths up to {capture.axis.paths[-1]:.3g} m) start at the right time?"
            )
        return cls.box((low[0], high[0]), (low[1], high[1]), (near, far), voxel)

    @classmethod
    def around(cls, volume: Volume, voxel: float, fraction: float = 0.15) -> Grid:
        """Fill the smallest box that holds everything bright in a coarse volume, with one of its
        voxels to spare.

        Imaging coarsely first and then here finely costs a small part of imaging everything finely.

        Parameters
        ----------
        volume : Volume
            At least one voxel per half wavelength, or small objects may slip through.
        voxel : float
            Distance of neighbouring voxel centres, m.
        fraction : float
            What counts as bright, relative to the brightest voxel.

        Returns
        -------
        Grid

        Raises
        ------
        InputError
            The volume is dark everywhere.
        """
        indices = np.nonzero(volume.threshold(fraction).magnitude)
        if indices[0].size == 0:
            raise InputError(
                "the volume is dark everywhere: there is nothing to look at more closely"
            )
        axes = (volume.grid.z, volume.grid.y, volume.grid.x)
        z, y, x = (_widen_range(axis, bright) for axis, bright in zip(axes, indices, strict=True))
        return cls.box(x, y, z, voxel)

    @property
    def shape(self) -> tuple[int, int, int]:
        """Voxels along (z, y, x)."""
        return self.z.size, self.y.size, self.x.size

    @property
    def size(self) -> int:
        """Number of voxels."""
        return self.z.size * self.y.size * self.x.size

    def find_nearest(self, point: Sequence[float]) -> tuple[int, int, int]:
        """Index (z, y, x) of the voxel nearest to a point (x, y, z) in m."""
        x, y, z = (
            int(np.argmin(np.abs(a - p)))
            for a, p in zip((self.x, self.y, self.z), point, strict=True)
        )
        return z, y, x


def _validate_axis(values: Any, name: str) -> FloatArray:
    axis = np.array(values, dtype=np.float64)
    if axis.ndim != 1 or axis.size == 0:
        raise ShapeError(f"grid axis {name}", "(n,) with n >= 1", axis.shape)
    if not np.all(np.isfinite(axis)) or np.any(np.diff(axis) <= 0):
        raise InputError(f"grid axis {name} must be finite and strictly increasing")
    axis.flags.writeable = False
    return axis


def _widen_range(axis: FloatArray, indices: NDArray[np.intp]) -> tuple[float, float]:
    """Range of the axis that holds the indexed entries and, where there is one, the next on either
    side.
    """
    return float(axis[max(indices.min() - 1, 0)]), float(
        axis[min(indices.max() + 1, axis.size - 1)]
    )


def _fill_axis(name: str, side: Sequence[float], voxel: float) -> FloatArray:
    first, last = (float(end) for end in side)
    if not (np.isfinite(first) and np.isfinite(last) and first <= last):
        raise InputError(
            f"side {name} of the box must run from a smaller to a larger number, got {first}, {last}"
        )
    # A side that is a whole number of voxels up to rounding keeps its outer voxel.
    steps = int(np.floor(min((last - first) / voxel, MAX_VOXELS_PER_AXIS) + 1e-6))
    if steps >= MAX_VOXELS_PER_AXIS:
        raise InputError(
            f"side {name} of the box, {last - first:.3g} m, has millions of voxels of {voxel:.3g} m: "
            "use larger voxels, and check their unit"
        )
    return (first + last) / 2 + voxel * (np.arange(steps + 1, dtype=np.float64) - steps / 2)


@dataclass(frozen=True)
class StraightWays:
    """How far across straight ways from wall points to voxels lead, before and behind a virtual plane.

    What the plane carries to a voxel comes from about their crossings: elsewhere the phases of both
    parts of the way turn, and their sum cancels.
    """

    wall_to_plane: float  # along the plane, at most, m; with room about the crossings
    plane_to_voxels: float  # along the plane, at most, m; with room about the crossings
    # width along y and x of the plane's rim, where little of the field is left, m
    rim: tuple[float, float]
    first_depth: float  # z of the nearest voxels, m

    @classmethod
    def find(
        cls, points: NDArray[np.float64], plane: VirtualPlane, grid: Grid, tolerance: float
    ) -> StraightWays | None:
        """Find the straight ways between wall points and voxels through a plane.

        `points` (n, 3): of the wall, m; `plane`: in front of them; `tolerance`: relative error
        allowed. Returns none where voxels lie before the plane: no straight way to these crosses
        it.
        """
        first, last = float(grid.z[0]), float(grid.z[-1])
        if first <= plane.z:
            return None
        low, high = points.min(axis=0), points.max(axis=0)
        longest = np.hypot(
            max(grid.x[-1] - low[0], high[0] - grid.x[0]),
            max(grid.y[-1] - low[1], high[1] - grid.y[0]),
        )
        # Ways to the nearest voxels from the hindmost points cross the plane latest, those to the
        # farthest voxels from the foremost points soonest.
        before = (plane.z - low[2]) / (first - low[2])
        behind = (last - plane.z) / (last - high[2])
        room = MIN_WALL_FRACTION + WALL_FRACTION_PER_DIGIT * np.log10(1 / tolerance)
        rim = RIM_FRACTION + RIM_FRACTION_PER_DIGIT * np.log10(tolerance)
        rim = np.clip(rim, 0, MAX_RIM_FRACTION)
        fade_y, fade_x = plane.fade
        return cls(
            float(max(before, room) * longest),
            float(behind * longest),
            (float(rim * fade_y), float(rim * fade_x)),
            first,
        )
