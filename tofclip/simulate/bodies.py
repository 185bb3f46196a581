"""Bodies, each a shape in its own coordinates, where it stands and what it is made of; and the ray caster:
bodies and rays in, first hits, light from lamps, and bins of time out.

Both simulators cast rays here: streak images of lenslets behind a slit (`tofclip.simulate.streak`) and
light fields of camera arrays (`tofclip.simulate.light_fields`).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import scipy

from tofclip.arrays import AnyArray, IndexArray
from tofclip.errors import require, require_axes

Vector = tuple[float, float, float]

AMBIENT_FRACTION = 0.4  # of the light, that comes from everywhere


@dataclass(frozen=True)
class Hits:
    """Where rays meet a shape: `distance` (rays,) in lengths of the ray's direction, infinite
    where it misses; `normal` (rays, 3) of length 1, towards the ray's origin;
    `pattern_position` (rays, 2) on the pattern, from 0 to 1, right and down, meaningless where
    the ray misses.
    """

    distance: AnyArray
    normal: AnyArray
    pattern_position: AnyArray


class Shape(ABC):
    """A surface around the origin; x right, y down, z away from the reader."""

    @abstractmethod
    def intersect(self, origin: AnyArray, directions: AnyArray) -> Hits:
        """Return where rays from (3,) `origin`, m, first meet the surface along (rays, 3)
        `directions`, in whose lengths distances are counted.
        """

    @property
    @abstractmethod
    def half_extent(self) -> AnyArray:
        """Half of the width, height and thickness of an upright box that holds the shape, m."""


@dataclass(frozen=True)
class Rectangle(Shape):
    """A flat plate in the plane z = 0, its `width` and `height` in m."""

    width: float
    height: float

    @property
    def half_extent(self) -> AnyArray:
        return np.array([self.width, self.height, 0.0]) / 2

    def intersect(self, origin: AnyArray, directions: AnyArray) -> Hits:
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
    """A ball of `radius`, m; its pattern runs around once, the middle facing the reader."""

    radius: float

    @property
    def half_extent(self) -> AnyArray:
        return np.full(3, self.radius)

    def intersect(self, origin: AnyArray, directions: AnyArray) -> Hits:
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
    """A block with the pattern on each face; `width`, `height` and `thickness` along x, y, z, m."""

    width: float
    height: float
    thickness: float

    @property
    def half_extent(self) -> AnyArray:
        return np.array([self.width, self.height, self.thickness]) / 2

    def intersect(self, origin: AnyArray, directions: AnyArray) -> Hits:
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
    """A matt surface, as bright from every side, of a `pattern` (rows, columns): reflectance from
    0 to 1, NaN where there is a hole. `ShapeError` or `InputError` where it is not a picture,
    has nothing but holes, or a reflectance lies outside 0 to 1.
    """

    pattern: AnyArray

    def __post_init__(self) -> None:
        known = self.pattern[np.isfinite(self.pattern)]
        require_axes("a pattern of reflectances", "rows, columns", self.pattern.shape)
        require(
            known.size != 0 and known.min() >= 0 and known.max() <= 1,
            "a pattern's reflectances must lie within 0..1 where they are not NaN, and some must be",
        )

    def reflectance(self, place: AnyArray) -> AnyArray:
        """Return the pattern's values at (points, 2) places from 0 to 1, right and down."""
        size = np.array(self.pattern.shape[::-1])
        column, row = np.clip((np.nan_to_num(place) * size).astype(np.int64), 0, size - 1).T
        return self.pattern[row, column]

    def radiance(
        self, place: AnyArray, normal: AnyArray, directions: AnyArray, light: AnyArray
    ) -> AnyArray:
        """Return the light that goes back along rays, (points,), from each `place` on the surface.

        `normal` of the surface and `light` towards the lamp have length 1, `directions` towards the
        surface any.
        """
        lit = AMBIENT_FRACTION + (1 - AMBIENT_FRACTION) * np.maximum(normal @ light, 0)
        return self.reflectance(place) * lit


@dataclass(frozen=True)
class Specular(Lambertian):
    """A glossy surface: a matt one, and a lobe about the mirror's direction (B. T. Phong, Commun.
    ACM 18, 311, 1975), of brightness `gloss` at its peak; the larger the `exponent`, the more
    like a mirror.
    """

    gloss: float = 1.0
    exponent: float = 200.0

    def radiance(
        self, place: AnyArray, normal: AnyArray, directions: AnyArray, light: AnyArray
    ) -> AnyArray:
        matt = super().radiance(place, normal, directions, light)
        unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
        mirrored = unit - 2 * np.einsum("ij,ij->i", unit, normal)[:, np.newaxis] * normal
        shine = self.gloss * np.maximum(mirrored @ light, 0) ** self.exponent
        return matt + shine


Material = Lambertian  # any of the two


@dataclass(frozen=True)
class Body:
    """A `shape` of a `material` that stands somewhere: `centre` (3,), m; the columns of `axes` (3,
    3) say where the shape's own x, y and z point, orthonormal, mirrored for a flipped body.
    """

    shape: Shape
    material: Material
    centre: AnyArray
    axes: AnyArray = field(default_factory=lambda: np.eye(3))

    def intersect(self, origin: AnyArray, directions: AnyArray) -> Hits:
        """Return where rays meet the body, holes let them pass; see `Shape.intersect`."""
        found = self.shape.intersect((origin - self.centre) @ self.axes, directions @ self.axes)
        solid = np.isfinite(self.material.reflectance(found.pattern_position))
        return Hits(
            np.where(solid, found.distance, np.inf),
            found.normal @ self.axes.T,
            found.pattern_position,
        )

    def select_candidate_rays(self, origin: AnyArray, directions: AnyArray) -> AnyArray:
        """Return the numbers of those rays, all with positive z, that may meet the body, as for
        `Shape.intersect`; most of a picture's do not.
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
        """Return the body moved by metres to the right, `x`, down, `y`, and away, `z`."""
        return replace(self, centre=self.centre + np.array([x, y, z]))

    def flip(self) -> Body:
        """Return the body mirrored left to right in its own middle."""
        return self._turn(np.diag([-1.0, 1.0, 1.0]))

    def rotate(self, angle: float) -> Body:
        """Return the body turned clockwise, as seen, about the line of sight; `angle` in rad."""
        cosine, sine = np.cos(angle), np.sin(angle)
        return self._turn([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])

    def tilt(self, angle: float) -> Body:
        """Return the body turned about its upright, its right side away; `angle` in rad."""
        cosine, sine = np.cos(angle), np.sin(angle)
        return self._turn([[cosine, 0, -sine], [0, 1, 0], [sine, 0, cosine]])

    def _turn(self, matrix: Any) -> Body:
        return replace(self, axes=np.array(matrix) @ self.axes)


NO_BODY = -1
SHADOW_MARGIN = 1e-6  # relative; with less, rounding makes a surface shade itself

EXTENT_SIGMAS = 5.0  # a Gaussian leaves 6e-7 of its energy outside


@dataclass(frozen=True)
class FirstHits(Hits):
    """What rays meet first, of several bodies."""

    body: AnyArray  # (rays,), number of the body; `NO_BODY` where there is none


def cast_rays(bodies: Sequence[Body], origin: AnyArray, directions: AnyArray) -> FirstHits:
    """Follow rays from `origin` along (rays, 3) `directions`, z > 0, to what is nearest."""
    count = len(directions)
    nearest, number = np.full(count, np.inf), np.full(count, NO_BODY, np.intp)
    normal, place = np.zeros((count, 3)), np.zeros((count, 2))
    for index, body in enumerate(bodies):
        rays = body.select_candidate_rays(origin, directions)
        found = body.intersect(origin, directions[rays])
        # the nearest body so far wins, as in a depth buffer
        closer = found.distance < nearest[rays]
        seen = rays[closer]
        nearest[seen], number[seen] = found.distance[closer], index
        normal[seen], place[seen] = found.normal[closer], found.pattern_position[closer]
    return FirstHits(nearest, normal, place, number)


def look_up_reflectance(bodies: Sequence[Body], hits: FirstHits) -> AnyArray:
    """Return the pattern's value where each ray hits, (rays,) float64; 0 where it hits nothing."""
    found = np.zeros(hits.body.size)
    for number, one in enumerate(bodies):
        own = hits.body == number
        found[own] = one.material.reflectance(hits.pattern_position[own])
    return found


def compute_irradiance(
    bodies: Sequence[Body], lamp: AnyArray, points: AnyArray, normal: AnyArray
) -> AnyArray:
    """Return how strongly a lamp lights points (points, 3), all of larger z, on surfaces that face
    along `normal`: cosine over distance squared, 1 / m^2, nothing in the shadow of a body.
    """
    rays = points - lamp
    distance = np.linalg.norm(rays, axis=1)
    # Lambert's cosine; surfaces that face away from the lamp get nothing
    facing = -np.einsum("ij,ij->i", rays, normal) / distance
    candidates = np.flatnonzero(facing > 0)
    nearest = cast_rays(bodies, lamp, rays[candidates]).distance
    light = np.zeros(len(points))
    # rays end at the points: a hit at 1 is the surface itself, a nearer one a shadow
    lit = candidates[nearest > 1 - SHADOW_MARGIN]
    light[lit] = facing[lit] / distance[lit] ** 2
    return light


def number_ray_pixels(image_shape: tuple[int, int], rays_per_side: int) -> IndexArray:
    """Return the raster number of each ray's pixel, in raster order of rays over the picture."""
    numbers = np.arange(int(np.prod(image_shape))).reshape(image_shape)
    return numbers.repeat(rays_per_side, axis=0).repeat(rays_per_side, axis=1).ravel()


def accumulate_cells(cell: IndexArray, amount: AnyArray, shape: tuple[int, ...]) -> AnyArray:
    """Add each amount to its cell, numbered in raster order, of a float64 array of `shape`."""
    total = np.bincount(cell.ravel(), amount.ravel(), minlength=int(np.prod(shape)))
    return np.asarray(total, dtype=np.float64).reshape(shape)


def spread_pulse(position: AnyArray, sigma: AnyArray) -> tuple[IndexArray, AnyArray]:
    """Integrate Gaussian pulses at `position` (n,), in bins, over the bins around them; bin i
    reaches from i - 1/2 to i + 1/2. Returns the first bin of each pulse, and (n, reach) fractions
    of its energy in that bin and those after it.
    """
    if position.size == 0:
        return np.zeros(0, dtype=np.intp), np.zeros((0, 1))
    half = int(np.ceil(EXTENT_SIGMAS * sigma.max() + 0.5))
    first = np.round(position).astype(np.intp) - half
    edges = first[:, np.newaxis] + np.arange(2 * half + 2) - 0.5
    return first, np.diff(
        scipy.special.ndtr((edges - position[:, np.newaxis]) / sigma[:, np.newaxis]), axis=1
    )


def bin_by_time(
    pixel: IndexArray, position: AnyArray, light: AnyArray, sigma: float, shape: tuple[int, int]
) -> AnyArray:
    """Add the light of rays to the bins of their pixels, (pixels, bins), each spread over its pulse
    about its arrival, in bins; light outside of the axis is lost.
    """
    first, shares = spread_pulse(position, np.full(position.shape, sigma))
    bins = first[:, np.newaxis] + np.arange(shares.shape[1])
    inside = (bins >= 0) & (bins < shape[1])
    cell = pixel[:, np.newaxis] * shape[1] + bins
    return accumulate_cells(cell[inside], (shares * light[:, np.newaxis])[inside], shape)
