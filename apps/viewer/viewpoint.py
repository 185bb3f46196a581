"""The viewer's virtual camera: where it stands, and where on the picture a point appears."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofclip.errors import InputError

FIELD_OF_VIEW_RAD = math.radians(35.0)
# A cloud that fills more than this is looked at from further back than from where it was taken
MAX_FIELD_OF_VIEW_RAD = math.radians(60.0)
# how far the eye is moved off the camera's place, as seen from the scene's middle: objects do not
# hide each other more than they did, and depth can be seen
SIDEWAYS_TILT_RAD, UPWARD_TILT_RAD = math.radians(-1.0), math.radians(0.8)
# room around most points, and around the tips of what sticks out; farther out than by the last
# factor, points are strays, for which the others are not made small
VIEW_MARGIN, TIP_MARGIN, MAX_TIP = 1.1, 1.02, 1.3
DOWN = np.array([0.0, 1.0, 0.0])
FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Viewpoint:
    """An eye that looks at a point; y is down."""

    eye: FloatArray  # (3,), m
    target: FloatArray  # (3,), m
    field_of_view: float = FIELD_OF_VIEW_RAD  # from the lower to the upper edge of the picture, rad

    def is_close_to(self, other: Viewpoint) -> bool:
        """Whether another viewpoint shows the same, as far as one can see."""
        return bool(
            np.allclose(self.eye, other.eye, atol=1e-4)
            and np.allclose(self.target, other.target, atol=1e-4)
            and np.isclose(self.field_of_view, other.field_of_view, rtol=1e-3)
        )

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
        """
        right, down, depth = self.axes @ (np.asarray(xyz, dtype=np.float64) - self.eye).T
        depth = np.where(depth > 0, depth, np.nan)
        focal = shape[0] / 2 / np.tan(self.field_of_view / 2)
        return (
            (shape[0] - 1) / 2 + focal * down / depth,
            (shape[1] - 1) / 2 + focal * right / depth,
            depth,
        )


SCALE_BAR_FRACTION = 0.4  # the scale bar is at most as long as this fraction of the box's width
# fractions of the box's depth, from its front: little stands before the scale bar, which farther in
# front would need much of the window, and neither hides the other's words from any side
SCALE_BAR_DEPTH, Z_MARK_DEPTH = 0.3, 0.85


@dataclass(frozen=True)
class Box:
    """The box around nearly all points of a cloud."""

    low: FloatArray  # (3,), opposite corners, m
    high: FloatArray  # (3,), opposite corners, m

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

    @property
    def scale_bar(self) -> FloatArray:
        """Ends of a bar of a round length across the floor, near the front, (2, 3) in m."""
        width = float(self.high[0] - self.low[0])
        length = round_length_down(SCALE_BAR_FRACTION * width) if width > 0 else 0.0
        middle = (self.low + self.high) / 2
        depth = (1 - SCALE_BAR_DEPTH) * self.low[2] + SCALE_BAR_DEPTH * self.high[2]
        start = np.array([middle[0] - length / 2, self.high[1], depth])
        return np.stack([start, start + np.array([length, 0.0, 0.0])])

    @property
    def length_marks(self) -> FloatArray:
        """Where the lengths of the sides along x, y and z are written, (3, 3) in m: at edges of the
        far side, which is always in the picture, and of the floor close to it.
        """
        (left, ceiling, front), (right, floor, back) = self.low, self.high
        middle = (self.low + self.high) / 2
        near_back = (1 - Z_MARK_DEPTH) * front + Z_MARK_DEPTH * back
        return np.array(
            [[middle[0], ceiling, back], [left, middle[1], back], [right, floor, near_back]]
        )


MAX_NEIGHBOUR_POINTS = 20_000  # points among which neighbours are looked for


def measure_point_spacing(xyz: NDArray[np.float32]) -> float:
    """Return the median distance, m, of the points (n, 3) of surfaces from their neighbours; two
    points at least.
    """
    from scipy.spatial import cKDTree

    thinned = xyz[:: max(1, len(xyz) // MAX_NEIGHBOUR_POINTS)]
    apart, _ = cKDTree(thinned).query(thinned, 2)
    # Of points on surfaces, n times as many are sqrt(n) times closer.
    return float(np.median(apart[:, 1]) * np.sqrt(len(thinned) / len(xyz)))


def round_length_down(length: float) -> float:
    """Return the largest of 1, 2 and 5 times a power of ten that is not above a positive length."""
    power = 10.0 ** np.floor(np.log10(length))
    return float(max(nice * power for nice in (1, 2, 5) if nice * power <= length * (1 + 1e-9)))


def make_presets(xyz: NDArray[np.float32], aspect: float = 1.5) -> dict[str, Viewpoint]:
    """Return places to look at a cloud from, by name. `xyz` (n, 3): m; not empty; `aspect`: width
    of the picture over its height. Returns ``"start"`` is `place_viewpoint`'s; ``"front"``,
    ``"top"`` and ``"side"`` see the whole cloud; ``"camera"`` is where it was taken from.
    """
    box = Box.around(xyz)
    middle = (box.low + box.high) / 2
    reach = float(np.linalg.norm(box.high - box.low)) / 2
    # the narrower side of the picture has to hold the ball around the box
    half_angle = np.arctan(np.tan(FIELD_OF_VIEW_RAD / 2) * min(1.0, aspect))
    away = VIEW_MARGIN * max(reach, 0.01) / np.sin(half_angle)
    # straight down, no direction would be up on the page
    directions = {"front": (0.0, 0.0, -1.0), "top": (0.0, -1.0, -0.01), "side": (1.0, 0.0, 0.0)}
    views = {"start": place_viewpoint(xyz, aspect)}
    views |= {
        name: Viewpoint(middle + away * np.array(towards), middle)
        for name, towards in directions.items()
    }
    if np.linalg.norm(middle) > reach:  # the camera is outside of the cloud
        camera = Viewpoint(np.zeros(3), middle)
        wide = max(_fit_field_of_view(camera, one, aspect) for one in (xyz, box.scale_bar))
        views["camera"] = Viewpoint(np.zeros(3), middle, min(wide, np.deg2rad(120.0)))
    return views


def place_viewpoint(xyz: NDArray[np.float32], aspect: float = 1.5) -> Viewpoint:
    """Return a viewpoint close to the camera's own, the origin, from which a cloud is seen whole.
    `xyz` (n, 3): m; `aspect`: width of the picture over its height.
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
    if low[2] > 0:
        # the scale bar may lie lower in the picture than any point
        bar = Box(low, high).scale_bar
        found = max(_fit_field_of_view(near, one, aspect) for one in (xyz, bar))
        if found <= MAX_FIELD_OF_VIEW_RAD:
            return Viewpoint(near.eye, middle, found)
    half_width, half_height, half_depth = np.abs(near.axes) @ (
        (high - low) / 2
    )  # of the tilted box
    slope = np.tan(FIELD_OF_VIEW_RAD / 2)
    away = half_depth + VIEW_MARGIN * max(half_height / slope, half_width / (slope * aspect), 0.05)
    far = Viewpoint(middle + away * direction, middle)
    # seen aslant, or with points outside of the box, a cloud is wider than its box from the front
    wide = max(_fit_field_of_view(far, one, aspect) for one in (xyz, Box(low, high).scale_bar))
    return Viewpoint(far.eye, middle, max(far.field_of_view, wide))


def move_camera(camera: Any, viewpoint: Viewpoint) -> None:
    """Move a camera of the page, or the one that pages start with, to a viewpoint."""
    camera.position, camera.look_at = viewpoint.eye, viewpoint.target
    camera.fov = max(viewpoint.field_of_view, float(np.deg2rad(5.0)))


def _fit_field_of_view(viewpoint: Viewpoint, xyz: NDArray[Any], aspect: float) -> float:
    """Return the field of view that holds nearly all points."""
    right, down, depth = np.abs(viewpoint.axes @ (xyz - viewpoint.eye).T)
    slopes = np.maximum(down, right / aspect) / np.maximum(depth, 1e-6)
    # One stray point must not make everything else small: within bounds its tip may be cut off.
    most, farthest = np.percentile(slopes, (99.5, 100.0))
    tips = TIP_MARGIN * min(farthest, MAX_TIP * most)
    return float(2 * np.arctan(max(VIEW_MARGIN * most, tips)))
