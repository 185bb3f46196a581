"""Bodies: a shape in its own coordinates, where it stands, and what it is made of."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofclip.errors import InputError, ShapeError

Array = NDArray[Any]
Vector = tuple[float, float, float]

AMBIENT_FRACTION = 0.4  # of the light, that comes from everywhere


@dataclass(frozen=True)
class Hits:
    """Where rays meet a shape.

    Parameters
    ----------
    distance : (rays,) array
        In lengths of the ray's direction; infinite where it misses.
    normal : (rays, 3) array
        Of length 1, towards the ray's origin.
    pattern_position : (rays, 2) array
        On the pattern, from 0 to 1, right and down; meaningless where the ray misses.
    """

    distance: Array
    normal: Array
    pattern_position: Array


class Shape(ABC):
    """A surface around the origin; x right, y down, z away from the reader."""

    @abstractmethod
    def intersect(self, origin: Array, directions: Array) -> Hits:
        """Return where rays from (3,) `origin`, m, first meet the surface along (rays, 3)
        `directions`, in whose lengths distances are counted.
        """

    @property
    @abstractmethod
    def half_extent(self) -> Array:
        """Half of the width, height and thickness of an upright box that holds the shape, m."""


@dataclass(frozen=True)
class Rectangle(Shape):
    """A flat plate in the plane z = 0.

    Parameters
    ----------
    width, height : float
        Metres.
    """

    width: float
    height: float

    @property
    def half_extent(self) -> Array:
        return np.array([self.width, self.height, 0.0]) / 2

    def intersect(self, origin: Array, directions: Array) -> Hits:
        """Return where rays meet the plate, from either side; see `Shape.intersect`."""
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = -origin[2] / directions[:, 2]
            met_at = origin[:2] + distance[:, np.newaxis] * directions[:, :2]
            place = met_at / (self.width, self.height) + 0.5
            right, down = place.T
            met = (distance > 0) & (right >= 0) & (right < 1) & (down >= 0) & (down < 1)
        normal = np.zeros_like(directions)
        normal[:, 2] = -np.sign(directions[:, 2])
        return Hits(np.where(met, distance, np.inf), normal, place)


@dataclass(frozen=True)
class Sphere(Shape):
    """A ball; its pattern runs around once, the middle facing the reader.

    Parameters
    ----------
    radius : float
        Metres.
    """

    radius: float

    @property
    def half_extent(self) -> Array:
        return np.full(3, self.radius)

    def intersect(self, origin: Array, directions: Array) -> Hits:
        """Return where rays from outside meet the ball; see `Shape.intersect`."""
        along, square = directions @ origin, np.einsum("ij,ij->i", directions, directions)
        # roots of |origin + t direction|^2 = radius^2; the smaller one is the near side
        below_root = along**2 - square * (origin @ origin - self.radius**2)
        distance = (-along - np.sqrt(np.maximum(below_root, 0))) / square
        normal = (origin + distance[:, np.newaxis] * directions) / self.radius
        around = np.arctan2(normal[:, 0], -normal[:, 2]) / (2 * np.pi) + 0.5
        down = np.arcsin(np.clip(normal[:, 1], -1, 1)) / np.pi + 0.5
        met = (below_root > 0) & (distance > 0)
        return Hits(np.where(met, distance, np.inf), normal, np.stack([around, down], axis=-1))


@dataclass(frozen=True)
class Box(Shape):
    """A block with the whole pattern on each face.

    Parameters
    ----------
    width, height, thickness : float
        Along x, y and z, metres.
    """

    width: float
    height: float
    thickness: float

    @property
    def half_extent(self) -> Array:
        return np.array([self.width, self.height, self.thickness]) / 2

    def intersect(self, origin: Array, directions: Array) -> Hits:
        """Return where rays from outside meet the block; see `Shape.intersect`.

        A ray is inside the block where it is inside all three pairs of faces: between the last
        entry and the first exit (slab method).
        """
        half = self.half_extent
        with np.errstate(divide="ignore", invalid="ignore"):
            slabs = np.sort([(side - origin) / directions for side in (-half, half)], axis=0)
        axis, distance = slabs[0].argmax(axis=1), slabs[0].max(axis=1)
        met = (distance > 0) & (distance <= slabs[1].min(axis=1))
        met_at = np.where(met, distance, 0.0)
        places = (origin + met_at[:, np.newaxis] * directions) / (2 * half) + 0.5
        normal = np.eye(3)[axis] * -np.sign(directions)
        shown = np.array([[2, 1], [0, 2], [0, 1]])[axis]  # the face's own two coordinates
        place = np.clip(np.take_along_axis(places, shown, axis=1), 0, 1 - 1e-9)
        return Hits(np.where(met, distance, np.inf), normal, place)


@dataclass(frozen=True)
class Lambertian:
    """A matt surface: as bright from every side.

    Parameters
    ----------
    pattern : (rows, columns) array
        Reflectance from 0 to 1; NaN where there is a hole.

    Raises
    ------
    ShapeError, InputError
        The pattern is not a picture, has nothing but holes, or a reflectance lies outside 0 to 1.
    """

    pattern: Array

    def __post_init__(self) -> None:
        known = self.pattern[np.isfinite(self.pattern)]
        if self.pattern.ndim != 2:
            raise ShapeError("a pattern of reflectances", "(rows, columns)", self.pattern.shape)
        if known.size == 0 or known.min() < 0 or known.max() > 1:
            raise InputError(
                "a pattern's reflectances must lie within 0..1 where they are not NaN, and some must be"
            )

    def reflectance(self, place: Array) -> Array:
        """Return the pattern's values at (points, 2) places from 0 to 1, right and down."""
        size = np.array(self.pattern.shape[::-1])
        column, row = np.clip((np.nan_to_num(place) * size).astype(np.int64), 0, size - 1).T
        found: Array = self.pattern[row, column]
        return found

    def is_solid(self, place: Array) -> Array:
        """Return where there is no hole."""
        return np.isfinite(self.reflectance(place))

    def radiance(self, place: Array, normal: Array, directions: Array, light: Array) -> Array:
        """Return the light that goes back along rays, (points,).

        `normal` of the surface and `light` towards the lamp have length 1, `directions` towards the
        surface any.
        """
        lit: Array = AMBIENT_FRACTION + (1 - AMBIENT_FRACTION) * np.maximum(normal @ light, 0)
        return self.reflectance(place) * lit


@dataclass(frozen=True)
class Specular(Lambertian):
    """A glossy surface: a matt one, and a lobe about the mirror's direction (B. T. Phong, Commun.
    ACM 18, 311, 1975).

    Parameters
    ----------
    gloss : float
        Brightness of the lobe at its peak.
    exponent : float
        The larger, the more like a mirror.
    """

    gloss: float = 1.0
    exponent: float = 200.0

    def radiance(self, place: Array, normal: Array, directions: Array, light: Array) -> Array:
        """Return the light that goes back along rays; arguments as for a matt surface."""
        matt = super().radiance(place, normal, directions, light)
        unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
        mirrored = unit - 2 * np.einsum("ij,ij->i", unit, normal)[:, np.newaxis] * normal
        shine: Array = self.gloss * np.maximum(mirrored @ light, 0) ** self.exponent
        return matt + shine


Material = Lambertian  # any of the two


@dataclass(frozen=True)
class Body:
    """A shape that stands somewhere.

    Parameters
    ----------
    shape : Shape
    material : Material
    centre : (3,) array
        Metres.
    axes : (3, 3) array
        Columns: where the shape's own x, y and z point; orthonormal, mirrored for a flipped body.
    """

    shape: Shape
    material: Material
    centre: Array
    axes: Array = field(default_factory=lambda: np.eye(3))

    def intersect(self, origin: Array, directions: Array) -> Hits:
        """Return where rays meet the body, holes of whose pattern let them pass; see
        `Shape.intersect`.
        """
        found = self.shape.intersect((origin - self.centre) @ self.axes, directions @ self.axes)
        solid = self.material.is_solid(found.pattern_position)
        return Hits(
            np.where(solid, found.distance, np.inf),
            found.normal @ self.axes.T,
            found.pattern_position,
        )

    def select_candidate_rays(self, origin: Array, directions: Array) -> Array:
        """Return the numbers of those rays, all with positive z, that may meet the body; most of a
        picture's do not.
        """
        x, y, z = self.centre - origin
        width, height, thickness = np.abs(self.axes) @ self.shape.half_extent
        if z <= thickness:
            return np.arange(len(directions))
        # slopes x / z under which the near face of the bounding box can still be seen
        beside, below = (
            (side + thickness * abs(off) / z) / (z - thickness)
            for side, off in ((width, x), (height, y))
        )
        slopes = directions[:, :2] / directions[:, 2:]
        return np.flatnonzero(
            (abs(slopes[:, 0] - x / z) <= beside) & (abs(slopes[:, 1] - y / z) <= below)
        )

    def shift(self, x: float, y: float, z: float = 0.0) -> Body:
        """Return the body moved by metres to the right, down and away."""
        return replace(self, centre=self.centre + np.array([x, y, z]))

    def flip(self) -> Body:
        """Return the body mirrored left to right in its own middle."""
        return self._turn(np.diag([-1.0, 1.0, 1.0]))

    def rotate(self, angle: float) -> Body:
        """Return the body turned clockwise, as seen, about its middle and the line of sight;
        `angle` in rad.
        """
        cosine, sine = np.cos(angle), np.sin(angle)
        return self._turn([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])

    def tilt(self, angle: float) -> Body:
        """Return the body turned about the upright line through its middle, its right side away;
        `angle` in rad.
        """
        cosine, sine = np.cos(angle), np.sin(angle)
        return self._turn([[cosine, 0, -sine], [0, 1, 0], [sine, 0, cosine]])

    def _turn(self, matrix: Any) -> Body:
        return replace(self, axes=np.array(matrix) @ self.axes)
