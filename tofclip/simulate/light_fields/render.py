"""Light fields under a distant lamp: what each camera of an array sees of a scene."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofclip.errors import InputError
from tofclip.light_field import LightField
from tofclip.operators.shear import View
from tofclip.simulate.bodies import Body
from tofclip.simulate.light_fields.array import CameraArray
from tofclip.simulate.rays import cast_rays
from tofclip.threads import limit_blas_threads, run_blocks

Array = NDArray[Any]

LIGHT_DIRECTION = (-0.35, -0.45, -0.82)
"""Towards the lamp: over the viewer's left shoulder."""


@dataclass(frozen=True)
class Scene:
    """Bodies under one distant lamp.

    Parameters
    ----------
    bodies : tuple of Body
    light : (float, float, float)
        Towards the lamp; any length.
    """

    bodies: tuple[Body, ...]
    light: tuple[float, float, float] = LIGHT_DIRECTION

    def __post_init__(self) -> None:
        if not self.bodies:
            raise InputError("a scene needs at least one body")
        if not np.linalg.norm(self.light) > 0:
            raise InputError("the direction towards the lamp must not be zero")


@dataclass(frozen=True)
class RenderedLightField:
    """A light field and the truth about it.

    Parameters
    ----------
    light_field : LightField
    shears : (rows, columns) float32 array
        Shear of what the reference view (0, 0) sees in the middle of each pixel; infinite where it
        sees nothing.
    """

    light_field: LightField
    shears: Array


def render_light_field(scene: Scene, array: CameraArray) -> RenderedLightField:
    """Render every view of an array; memory is about 200 bytes for each ray of one view and thread.

    Parameters
    ----------
    scene : Scene
    array : CameraArray

    Returns
    -------
    RenderedLightField
        Pictures (views, rows, columns) float32 and the reference view's map of shears.
    """
    views = array.views
    pictures = np.empty((len(views), *array.image_shape), np.float32)

    def some(which: slice) -> None:
        for number in range(which.start, which.stop):
            v, u = views[number]
            pictures[number] = render_view(scene, array, (float(v), float(u)))

    with limit_blas_threads():  # the threads are used for views
        run_blocks(some, len(views), 1)
    return RenderedLightField(LightField(pictures, views), render_shear_map(scene, array))


def render_view(scene: Scene, array: CameraArray, view: View) -> Array:
    """Return what the camera at (v, u) sees, (rows, columns) float32; fractions are cameras between
    the array's.

    Parameters
    ----------
    scene : Scene
    array : CameraArray
    view : (float, float)
        View steps down and to the right.

    Returns
    -------
    (rows, columns) float32 array
    """
    origin, directions = array.rays(view, array.samples)
    _, brightness = _shade_rays(scene, origin, directions)
    rows, columns = array.image_shape
    by_pixel = brightness.reshape(rows, array.samples, columns, array.samples)
    picture: Array = by_pixel.mean(axis=(1, 3)).astype(np.float32)
    return picture


def render_shear_map(scene: Scene, array: CameraArray, view: View = (0.0, 0.0)) -> Array:
    """Return the shear of what a view sees in the middle of each pixel, (rows, columns) float32;
    infinite: nothing.

    Parameters
    ----------
    scene : Scene
    array : CameraArray
    view : (float, float)
        View steps down and to the right.

    Returns
    -------
    (rows, columns) float32 array
        Pixels per view step.
    """
    origin, directions = array.rays(view, 1)
    distance, _ = _shade_rays(scene, origin, directions)
    seen = np.isfinite(distance)
    depth = np.where(seen, distance, 1.0) * array.focus  # directions reach to the plane in focus
    return np.where(seen, array.shear(depth), np.inf).reshape(array.image_shape).astype(np.float32)


def _shade_rays(scene: Scene, origin: Array, directions: Array) -> tuple[Array, Array]:
    """Distance to the nearest surface along each ray and the light that comes back from it."""
    sight = cast_rays(scene.bodies, origin, directions)
    brightness = np.zeros(len(directions))
    light = np.array(scene.light) / np.linalg.norm(scene.light)
    for index, body in enumerate(scene.bodies):
        own = np.flatnonzero(sight.body == index)
        brightness[own] = body.material.radiance(
            sight.pattern_position[own], sight.normal[own], directions[own], light
        )
    return sight.distance, brightness
