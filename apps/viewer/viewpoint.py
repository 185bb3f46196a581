"""Where the eye is, and where on the picture a point appears."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tofclip.errors import InputError

FIELD_OF_VIEW_RAD = np.deg2rad(35.0)
MAX_FIELD_OF_VIEW_RAD = np.deg2rad(60.0)
"""A cloud that fills more than this is looked at from further back than from where it was taken."""

SIDEWAYS_TILT_RAD, UPWARD_TILT_RAD = np.deg2rad(-1.0), np.deg2rad(0.8)
"""How far the eye is moved off the camera's place, as seen from the scene's middle: objects do not hide each other
more than they did, and depth can be seen."""

VIEW_MARGIN = 1.1
DOWN = np.array([0.0, 1.0, 0.0])
FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Viewpoint:
    """An eye that looks at a point; y is down.

    Parameters
    ----------
    eye, target : (3,) array
        m.
    field_of_view : float
        From the lower to the upper edge of the picture, rad.
    """

    eye: FloatArray
    target: FloatArray
    field_of_view: float = float(FIELD_OF_VIEW_RAD)

    @property
    def axes(self) -> FloatArray:
        """Directions to the right, down and forward as rows, (3, 3)."""
        forward = self.target - self.eye
        length = np.linalg.norm(forward)
        if not length > 0:
            raise InputError("an eye cannot look at itself")
        forward = forward / length
        right = np.cross(DOWN, forward)
        right /= np.linalg.norm(right)
        return np.stack([right, np.cross(forward, right), forward])

    def project(
        self, xyz: NDArray[np.floating], shape: tuple[int, int]
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return row, column and depth (m) of points in a picture of `shape` pixels; NaN behind the
        eye.

        Parameters
        ----------
        xyz : (n, 3) array
            Metres.
        shape : (int, int)
            Rows and columns.

        Returns
        -------
        row, column, depth : (n,) float64 array
            Pixels, pixels and metres.
        """
        right, down, depth = self.axes @ (np.asarray(xyz, dtype=np.float64) - self.eye).T
        depth = np.where(depth > 0, depth, np.nan)
        focal = shape[0] / 2 / np.tan(self.field_of_view / 2)
        return (
            (shape[0] - 1) / 2 + focal * down / depth,
            (shape[1] - 1) / 2 + focal * right / depth,
            depth,
        )


@dataclass(frozen=True)
class Box:
    """The box around nearly all points of a cloud.

    Parameters
    ----------
    low, high : (3,) array
        Opposite corners, m.
    """

    low: FloatArray
    high: FloatArray

    @classmethod
    def around(cls, xyz: NDArray[np.float32]) -> Box:
        """Return the box of points (n, 3), m, without the outermost half per cent on each side."""
        low, high = np.percentile(xyz, (0.5, 99.5), axis=0).astype(np.float64)
        return cls(low, high)

    @property
    def corners(self) -> FloatArray:
        """Corner n has the larger x, y or z where bit 0, 1 or 2 of n is set, (8, 3)."""
        bits = (np.arange(8)[:, np.newaxis] >> np.arange(3)) & 1
        return np.where(bits, self.high, self.low)

    @property
    def edges(self) -> list[tuple[int, int]]:
        """The twelve edges, by their corners."""
        return [(n, n | bit) for bit in (1, 2, 4) for n in range(8) if not n & bit]


def make_presets(xyz: NDArray[np.float32]) -> dict[str, Viewpoint]:
    """Return places to look at a cloud from, by name.

    Parameters
    ----------
    xyz : (n, 3) array
        m; not empty.

    Returns
    -------
    dict of str to Viewpoint
        ``"front"``, ``"top"`` and ``"side"`` see the whole cloud; ``"camera"`` is where it was taken
        from.
    """
    box = Box.around(xyz)
    middle = (box.low + box.high) / 2
    reach = float(np.linalg.norm(box.high - box.low)) / 2
    away = VIEW_MARGIN * max(reach, 0.01) / np.sin(FIELD_OF_VIEW_RAD / 2)
    # straight down, no direction would be up on the page
    directions = {"front": (0.0, 0.0, -1.0), "top": (0.0, -1.0, -0.01), "side": (1.0, 0.0, 0.0)}
    views = {
        name: Viewpoint(middle + away * np.array(towards), middle)
        for name, towards in directions.items()
    }
    if np.linalg.norm(middle) > reach:  # the camera is outside of the cloud
        views["camera"] = Viewpoint(np.zeros(3), middle)
    return views


def place_viewpoint(xyz: NDArray[np.float32], aspect: float = 1.5) -> Viewpoint:
    """Return a viewpoint close to the camera's own, the origin, from which a cloud is seen whole.

    Parameters
    ----------
    xyz : (n, 3) array
        m.
    aspect : float
        Width of the picture over its height.

    Returns
    -------
    Viewpoint
    """
    if len(xyz) == 0:
        return Viewpoint(np.array([0.0, 0.0, -1.0]), np.zeros(3))
    low, high = np.percentile(xyz, (0.5, 99.5), axis=0).astype(np.float64)
    middle = (low + high) / 2
    away = float(np.linalg.norm(middle))
    backwards = -middle / away if low[2] > 0 else np.array([0.0, 0.0, -1.0])
    aside = np.array([np.tan(SIDEWAYS_TILT_RAD), -np.tan(UPWARD_TILT_RAD), 0.0])
    direction = (backwards + aside) / np.linalg.norm(backwards + aside)
    near = Viewpoint(middle + max(away, 1e-3) * direction, middle)
    if low[2] > 0 and (found := _fit_field_of_view(near, xyz, aspect)) <= MAX_FIELD_OF_VIEW_RAD:
        return Viewpoint(near.eye, middle, found)
    half_width, half_height, half_depth = np.abs(near.axes) @ (
        (high - low) / 2
    )  # of the tilted box
    slope = np.tan(FIELD_OF_VIEW_RAD / 2)
    away = half_depth + VIEW_MARGIN * max(half_height / slope, half_width / (slope * aspect), 0.05)
    return Viewpoint(middle + away * direction, middle)


def _fit_field_of_view(viewpoint: Viewpoint, xyz: NDArray[np.float32], aspect: float) -> float:
    """Return the field of view that holds nearly all points."""
    right, down, depth = np.abs(viewpoint.axes @ (xyz - viewpoint.eye).T)
    slopes = np.maximum(down, right / aspect) / np.maximum(depth, 1e-6)
    return float(2 * np.arctan(VIEW_MARGIN * np.percentile(slopes, 99.5)))
