"""What stands in front of a streak camera: bodies, most of them flat plates, and one pulsed lamp."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tofclip.errors import InputError
from tofclip.simulate.bodies import Body, Lambertian, Rectangle, Vector
from tofclip.simulate.rays import NO_BODY, cast_rays, compute_irradiance, look_up_reflectance

FloatArray = NDArray[np.float64]


def make_plate(
    centre: Vector,
    size: tuple[float, float],
    reflectance: ArrayLike,
    yaw: float = 0.0,
    pitch: float = 0.0,
) -> Body:
    """Return a flat, diffusely reflecting rectangle.

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

    Returns
    -------
    Body

    Raises
    ------
    ShapeError, InputError
        A reflectance that is not a picture or lies outside 0..1, a size that is not positive, or
        nothing but holes.

    Examples
    --------
    >>> import numpy as np
    >>> plate = make_plate((0, 0, 2.0), (0.3, 0.2), np.full((1, 1), 0.8))
    >>> plate.intersect(np.zeros(3), np.array([[0.0, 0.0, 1.0]])).distance
    array([2.])
    """
    material = Lambertian(np.array(reflectance, dtype=np.float32))
    if min(size) <= 0 or not np.all(np.isfinite([*centre, *size, yaw, pitch])):
        raise InputError("a plate needs a finite position and a positive size")
    right = np.array([np.cos(yaw), 0.0, np.sin(yaw)])
    # The plate is turned about the vertical first, so that its own horizontal axis stays level.
    ahead = np.array([-np.sin(yaw), 0.0, np.cos(yaw)])
    down = np.cos(pitch) * np.array([0.0, 1.0, 0.0]) - np.sin(pitch) * ahead
    # A right-handed frame; its third axis is the normal, which points away from the camera.
    axes = np.stack([right, down, np.cross(right, down)], axis=-1)
    return Body(Rectangle(*size), material, np.asarray(centre, np.float64), axes)


class RayCast(NamedTuple):
    """What the rays of one viewpoint see, ray by ray.

    Parameters
    ----------
    body : (n,) int array
        Number of the body; `NO_BODY` where the ray meets none.
    path : (n,) array
        Half of the path of the light from the lamp over the surface to the viewpoint, m.
    distance : (n,) array
        Distance of the surface from the lamp, m.
    reflectance : (n,) array
        Diffuse reflectance times the cosine of incidence; 0 in shadow.
    """

    body: NDArray[np.intp]
    path: FloatArray
    distance: FloatArray
    reflectance: FloatArray


@dataclass(frozen=True)
class Scene:
    """Bodies lit by one pulsed point source.

    Parameters
    ----------
    bodies : tuple of Body
    lamp : (float, float, float)
        Position of the source, m, before the bodies. At the origin it is co-located with the
        reference view, which then sees no shadow.

    Raises
    ------
    InputError
        There is no body.
    """

    bodies: tuple[Body, ...]
    lamp: Vector = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        if not self.bodies:
            raise InputError("a scene needs at least one body")

    def trace(self, viewpoint: FloatArray, directions: FloatArray) -> RayCast:
        """Follow rays to the nearest surface and from there to the lamp.

        Parameters
        ----------
        viewpoint : (3,) float array
            m.
        directions : (n, 3) float array
            All with z > 0.

        Returns
        -------
        RayCast
        """
        first, lamp = cast_rays(self.bodies, viewpoint, directions), np.asarray(self.lamp)
        seen = first.body != NO_BODY
        # Only what is seen is lit: a missed ray has an infinite distance, which would spread as
        # NaN.
        points = viewpoint + first.distance[seen, np.newaxis] * directions[seen]
        lamp_distance = np.linalg.norm(points - lamp, axis=1)
        irradiance = compute_irradiance(self.bodies, lamp, points, first.normal[seen])

        def scatter(values: Any) -> FloatArray:
            spread = np.zeros(seen.shape)
            spread[seen] = values
            return spread

        return RayCast(
            first.body,
            # Half of the way there and back, which is what a time of flight says of a co-located
            # source.
            scatter((lamp_distance + np.linalg.norm(points - viewpoint, axis=1)) / 2),
            scatter(lamp_distance),
            # The fall-off to the lamp is taken out of the irradiance: who renders puts it back with
            # the whole path.
            look_up_reflectance(self.bodies, first) * scatter(irradiance * lamp_distance**2),
        )
