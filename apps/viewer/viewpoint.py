"""The viewer's virtual camera: where it stands, and where on the picture a point appears."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofclip.arrays import AnyArray, Float32Array, FloatArray

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
        forward = (self.target - self.eye) / np.linalg.norm(self.target - self.eye)
        right = np.cross(DOWN, forward)
        right /= np.linalg.norm(right)
        return np.stack([right, np.cross(forward, right), forward])

    def project(
        self, xyz: NDArray[np.floating], shape: tuple[int, int]
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return row, column and depth (m) of points in a picture; NaN behind the eye."""
        right, down, depth = self.axes @ (np.asarray(xyz, dtype=np.float64) - self.eye).T
        depth = np.where(depth > 0, depth, np.nan)
        focal = shape[0] / 2 / np.tan(self.field_of_view / 2)
        row = (shape[0] - 1) / 2 + focal * down / depth
        return row, (shape[1] - 1) / 2 + focal * right / depth, depth


SCALE_BAR_FRACTION = 0.4  # the scale bar is at most as long as this fraction of the box's width
# fractions of the box's depth, from its front: little stands before the scale bar, which farther in
# front would need much of the window, and neither hides the other's words from any side
SCALE_BAR_DEPTH, Z_MARK_DEPTH, X_MARK = 0.3, 0.85, 0.12
SCALE_BAR_DROP = 0.04  # of the box's height: on its floor the bar would lie along a flat box's edge
EDGES = [(n, n | bit) for bit in (1, 2, 4) for n in range(8) if not n & bit]  # by their corners


@dataclass(frozen=True)
class Box:
    """The box around nearly all points of a cloud."""

    low: FloatArray  # (3,), opposite corners, m
    high: FloatArray  # (3,), opposite corners, m

    @classmethod
    def around(cls, xyz: Float32Array) -> Box:
        """Return the box of points (n, 3), m, without the outermost half per cent on each side."""
        low, high = np.percentile(xyz, (0.5, 99.5), axis=0).astype(np.float64)
        return cls(low, high)

    @property
    def middle(self) -> FloatArray:
        return (self.low + self.high) / 2

    @property
    def reach(self) -> float:
        """Half of the diagonal, m."""
        return float(np.linalg.norm(self.high - self.low)) / 2

    @property
    def edges(self) -> FloatArray:
        """Both ends of the twelve edges, (12, 2, 3) in m."""
        bits = (np.arange(8)[:, np.newaxis] >> np.arange(3)) & 1
        return np.where(bits, self.high, self.low)[np.array(EDGES)]

    def scale_bar(self, eye: FloatArray) -> FloatArray:
        """Ends of a bar of a round length, m, below the floor on the eye's side."""
        right = Viewpoint(eye, self.middle).axes[0]
        ahead, sides = np.cross(right, DOWN), self.high - self.low
        width, depth = np.abs(right) @ sides, np.abs(ahead) @ sides
        length = round_length_down(SCALE_BAR_FRACTION * width) if width > 0 else 0.0
        middle = self.middle + (SCALE_BAR_DEPTH - 0.5) * depth * ahead
        middle[1] = self.high[1] + SCALE_BAR_DROP * sides[1]
        return middle + np.outer((-length / 2, length / 2), right)

    @property
    def length_marks(self) -> FloatArray:
        """Where the lengths of x, y and z are written, (3, 3) in m: at edges that are in sight."""
        (left, ceiling, front), (right, floor, back) = self.low, self.high
        y = self.middle[1]
        x = (1 - X_MARK) * left + X_MARK * right  # over the middle it would hide what stands there
        near_back = (1 - Z_MARK_DEPTH) * front + Z_MARK_DEPTH * back
        return np.array([[x, ceiling, back], [left, y, back], [right, floor, near_back]])


MAX_NEIGHBOUR_POINTS = 20_000  # points among which neighbours are looked for


def measure_point_spacing(xyz: Float32Array) -> float:
    """Return the median distance, m, of two or more points of surfaces from their neighbours."""
    from scipy.spatial import cKDTree

    thinned = xyz[:: max(1, len(xyz) // MAX_NEIGHBOUR_POINTS)]
    apart, _ = cKDTree(thinned).query(thinned, 2)
    # Of points on surfaces, n times as many are sqrt(n) times closer.
    return np.median(apart[:, 1]) * np.sqrt(len(thinned) / len(xyz))


def round_length_down(length: float) -> float:
    """Return the largest of 1, 2 and 5 times a power of ten that is not above a positive length."""
    power = 10.0 ** np.floor(np.log10(length))
    return float(max(nice * power for nice in (1, 2, 5) if nice * power <= length * (1 + 1e-9)))


def make_presets(xyz: Float32Array, aspect: float = 1.5) -> dict[str, Viewpoint]:
    """Return places to look at a cloud (n, 3), m, from, by name: ``"start"`` is `place_viewpoint`'s;
    ``"front"``, ``"top"`` and ``"side"`` see the whole cloud; ``"camera"`` is where it was taken
    from. `aspect`: width of the picture over its height.
    """
    views = {"start": place_viewpoint(xyz, aspect)}
    if len(xyz) == 0:
        return views
    box = Box.around(xyz)
    # the narrower side of the picture has to hold the ball around the box
    half_angle = np.arctan(np.tan(FIELD_OF_VIEW_RAD / 2) * min(1.0, aspect))
    away = VIEW_MARGIN * max(box.reach, 0.01) / np.sin(half_angle)
    # straight down, no direction would be up on the page
    directions = {"front": (0.0, 0.0, -1.0), "top": (0.0, -1.0, -0.01), "side": (1.0, 0.0, 0.0)}
    for name, towards in directions.items():
        views[name] = Viewpoint(box.middle + away * np.array(towards), box.middle)
    if np.linalg.norm(box.middle) > box.reach:  # the camera is outside of the cloud
        wide = _fit_field_of_view(Viewpoint(np.zeros(3), box.middle), xyz, box, aspect)
        views["camera"] = Viewpoint(np.zeros(3), box.middle, min(wide, np.deg2rad(120.0)))
    return views


def place_viewpoint(xyz: Float32Array, aspect: float = 1.5) -> Viewpoint:
    """Return a viewpoint close to the origin from which a cloud is seen whole."""
    if len(xyz) == 0:
        return Viewpoint(np.array([0.0, 0.0, -1.0]), np.zeros(3))
    box = Box.around(xyz)
    middle, is_in_front = box.middle, box.low[2] > 0
    away = np.linalg.norm(middle)
    backwards = -middle / away if is_in_front else np.array([0.0, 0.0, -1.0])
    aside = np.array([np.tan(SIDEWAYS_TILT_RAD), -np.tan(UPWARD_TILT_RAD), 0.0])
    direction = (backwards + aside) / np.linalg.norm(backwards + aside)
    near = Viewpoint(middle + max(away, 1e-3) * direction, middle)
    if (
        is_in_front
        and (wide := _fit_field_of_view(near, xyz, box, aspect)) <= MAX_FIELD_OF_VIEW_RAD
    ):
        return Viewpoint(near.eye, middle, wide)
    # of the tilted box
    half_width, half_height, half_depth = np.abs(near.axes) @ ((box.high - box.low) / 2)
    slope = np.tan(FIELD_OF_VIEW_RAD / 2)
    away = half_depth + VIEW_MARGIN * max(half_height / slope, half_width / (slope * aspect), 0.05)
    far = Viewpoint(middle + away * direction, middle)
    # seen aslant, or with points outside of the box, a cloud is wider than its box from the front
    wide = max(FIELD_OF_VIEW_RAD, _fit_field_of_view(far, xyz, box, aspect))
    return Viewpoint(far.eye, middle, wide)


def _fit_field_of_view(viewpoint: Viewpoint, xyz: AnyArray, box: Box, aspect: float) -> float:
    """Return the field of view that holds nearly all points and the scale bar below them."""
    fields = []
    for points in (xyz, box.scale_bar(viewpoint.eye)):
        right, down, depth = np.abs(viewpoint.axes @ (points - viewpoint.eye).T)
        slopes = np.maximum(down, right / aspect) / np.maximum(depth, 1e-6)
        # One stray point must not make everything else small: within bounds its tip may be cut off.
        most, farthest = np.percentile(slopes, (99.5, 100.0))
        tips = TIP_MARGIN * min(farthest, MAX_TIP * most)
        fields.append(2 * np.arctan(max(VIEW_MARGIN * most, tips)))
    return float(max(fields))


def move_camera(camera: Any, viewpoint: Viewpoint) -> None:
    """Move a camera of the page, or the one that pages start with, to a viewpoint."""
    camera.position, camera.look_at = viewpoint.eye, viewpoint.target
    camera.fov = max(viewpoint.field_of_view, math.radians(5.0))


def read_viewpoint(camera: Any) -> Viewpoint:
    """Return where a camera of the page stands."""
    # Copied, because the page goes on changing the camera's own arrays.
    return Viewpoint(camera.position.copy(), camera.look_at.copy(), camera.fov)


def aim_plotter(plotter: Any, viewpoint: Viewpoint) -> None:
    """Turn the camera of a pyvista plotter to a viewpoint."""
    camera = plotter.camera
    camera.position, camera.focal_point = viewpoint.eye.tolist(), viewpoint.target.tolist()
    # VTK turns the picture so that this points up; y of the clouds points down.
    camera.up, camera.view_angle = (-DOWN).tolist(), math.degrees(viewpoint.field_of_view)
    plotter.renderer.reset_camera_clipping_range()
