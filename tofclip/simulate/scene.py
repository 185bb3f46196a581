"""What stands in front of the camera: flat plates with a printed or cut-out pattern, and a lamp."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tofclip.errors import InputError, ShapeError

FloatArray = NDArray[np.float64]
Vector = tuple[float, float, float]

SHADOW_MARGIN = (
    1e-6  # relative distance before a surface at which rounding no longer makes it shade itself
)
NO_PLATE = -1


@dataclass(frozen=True)
class Plate:
    """A flat, diffusely reflecting rectangle.

    Parameters
    ----------
    centre : (float, float, float)
        Position of its middle, m; x right, y down, z away from the camera.
    size : (float, float)
        Width and height, m.
    reflectance : (rows, columns) array
        Diffuse reflectance over the rectangle, 0..1, row 0 on top. NaN: cut out, light passes.
    yaw, pitch : float
        Turn about the vertical axis (positive: the right side goes back) and then about the plate's
        own horizontal axis (positive: the upper side goes back), rad. Both zero: facing the camera.

    Raises
    ------
    ShapeError, InputError
        A reflectance that is no picture or lies outside 0..1, a size that is not positive, or
        nothing but holes.
    """

    centre: Vector
    size: tuple[float, float]
    reflectance: NDArray[np.float32]
    yaw: float = 0.0
    pitch: float = 0.0

    def __post_init__(self) -> None:
        reflectance = np.array(self.reflectance, dtype=np.float32)
        if reflectance.ndim != 2 or reflectance.size == 0:
            raise ShapeError("a plate's reflectance", "(rows, columns)", reflectance.shape)
        solid = reflectance[~np.isnan(reflectance)]
        if solid.size == 0 or solid.min() < 0 or solid.max() > 1:
            raise InputError(
                "a plate's reflectance must lie within 0..1 where it is not NaN, and be so somewhere"
            )
        if min(self.size) <= 0 or not np.all(
            np.isfinite([*self.centre, *self.size, self.yaw, self.pitch])
        ):
            raise InputError("a plate needs a finite position and a positive size")
        object.__setattr__(self, "reflectance", reflectance)

    @property
    def axes(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Unit vectors to the plate's right, down, and along its normal."""
        right = np.array([np.cos(self.yaw), 0.0, np.sin(self.yaw)])
        ahead = np.array([-np.sin(self.yaw), 0.0, np.cos(self.yaw)])
        down = np.cos(self.pitch) * np.array([0.0, 1.0, 0.0]) - np.sin(self.pitch) * ahead
        return right, down, np.cross(right, down)

    def intersect(
        self, origin: FloatArray, directions: FloatArray
    ) -> tuple[FloatArray, NDArray[np.float32]]:
        """Where rays from `origin` meet the plate, in lengths of `directions` (inf: they miss), and
        what is there.

        Parameters
        ----------
        origin : (3,) array
            m.
        directions : (n, 3) array

        Returns
        -------
        distance : (n,) float64 array
        reflectance : (n,) float32 array
        """
        right, down, normal = self.axes
        offset = np.asarray(self.centre) - origin
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = (offset @ normal) / (directions @ normal)
            column = (distance * (directions @ right) - offset @ right) / self.size[0] + 0.5
            row = (distance * (directions @ down) - offset @ down) / self.size[1] + 0.5
        inside = (distance > 0) & (row >= 0) & (row < 1) & (column >= 0) & (column < 1)
        rows, columns = self.reflectance.shape
        reflectance = np.full(distance.shape, np.nan, dtype=np.float32)
        reflectance[inside] = self.reflectance[
            (row[inside] * rows).astype(np.intp), (column[inside] * columns).astype(np.intp)
        ]
        return np.where(np.isnan(reflectance), np.inf, distance), reflectance


class Hits(NamedTuple):
    """What the rays of one viewpoint see, ray by ray.

    Attributes
    ----------
    plate : (n,) int array
        Number of the plate; `NO_PLATE` where the ray meets none.
    path : (n,) array
        Half the way of the light from the lamp over the surface to the viewpoint, m.
    distance : (n,) array
        Distance of the surface from the lamp, m.
    reflectance : (n,) array
        Diffuse reflectance times the cosine of incidence; 0 in shadow.
    """

    plate: NDArray[np.intp]
    path: FloatArray
    distance: FloatArray
    reflectance: FloatArray


@dataclass(frozen=True)
class Scene:
    """Plates lit by one pulsed point source.

    Parameters
    ----------
    plates : tuple of Plate
    lamp : (float, float, float)
        Position of the source, m. At the origin it is co-located with the reference view, which
        then sees no shadow.
    """

    plates: tuple[Plate, ...]
    lamp: Vector = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        if not self.plates:
            raise InputError("a scene needs at least one plate")

    def cast_rays(self, viewpoint: FloatArray, directions: FloatArray) -> Hits:
        """Follow rays from `viewpoint` along `directions`, (n, 3), to the nearest surface."""
        reach, plate, reflectance = self._find_nearest(viewpoint, directions)
        seen = plate != NO_PLATE
        path, distance, shade = (np.zeros(plate.shape) for _ in range(3))
        points = viewpoint + reach[seen, np.newaxis] * directions[seen]
        rays = points - np.asarray(self.lamp)
        distance[seen] = np.linalg.norm(rays, axis=1)
        path[seen] = (distance[seen] + np.linalg.norm(points - viewpoint, axis=1)) / 2
        normals = np.stack([one.axes[2] for one in self.plates])[plate[seen]]
        cosine = np.abs(np.sum(rays * normals, axis=1)) / distance[seen]
        lit = self._find_nearest(np.asarray(self.lamp), rays)[0] > 1 - SHADOW_MARGIN
        shade[seen] = reflectance[seen] * cosine * lit
        return Hits(plate, path, distance, shade)

    def _find_nearest(
        self, origin: FloatArray, directions: FloatArray
    ) -> tuple[FloatArray, NDArray[np.intp], NDArray[np.float32]]:
        reach = np.full(directions.shape[0], np.inf)
        plate = np.full(directions.shape[0], NO_PLATE, dtype=np.intp)
        reflectance = np.zeros(directions.shape[0], dtype=np.float32)
        for number, candidate in enumerate(self.plates):
            distance, here = candidate.intersect(origin, directions)
            nearer = distance < reach
            reach[nearer], plate[nearer], reflectance[nearer] = (
                distance[nearer],
                number,
                here[nearer],
            )
        return reach, plate, reflectance
