"""Light fields of a simulated scene: a grid of pinhole cameras that all look the same way, their
pictures shifted to agree at one distance, under a distant lamp or under lamps that flash.

Light goes from a lamp to a surface and on to a view; a lamp that something else shades adds
nothing. Interreflections are left out.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from tofclip.arrays import AnyArray, Float32Array, FloatArray
from tofclip.errors import ShapeError, require
from tofclip.light_field import LightField
from tofclip.operators.base import View
from tofclip.simulate.bodies import (
    NO_BODY,
    Body,
    bin_by_time,
    cast_rays,
    compute_irradiance,
    look_up_reflectance,
    number_ray_pixels,
)
from tofclip.threads import limit_blas_threads, run_blocks
from tofclip.units import FWHM_PER_SIGMA, SPEED_OF_LIGHT

LIGHT_DIRECTION = (-0.35, -0.45, -0.82)  # towards the lamp: over the viewer's left shoulder


@dataclass(frozen=True)
class CameraArray:
    """Cameras at ``(u, v) * view_step`` metres in the plane z = 0, looking along z; x points right
    and y down. All counts and lengths are positive.
    """

    image_shape: tuple[int, int] = (128, 128)
    view_count: int = 8  # on a side; they are numbered ``-(n // 2), ...``
    focal_length_px: float = 160.0
    view_step: float = 0.0125  # between neighbours, m
    focus: float = 1.0  # distance at which all pictures agree (s = 0), m
    samples: int = 2  # rays on a side of each pixel
    view_rows: int | None = None  # as many as `view_count` if not given

    def __post_init__(self) -> None:
        counts = (*self.image_shape, *self._view_counts, self.samples)
        lengths = (*counts, self.focal_length_px, self.view_step, self.focus)
        require(
            all(np.isfinite(length) and length > 0 for length in lengths),
            "every count and length of a camera array must be positive",
        )

    @property
    def _view_counts(self) -> tuple[int, int]:
        """Cameras down and across."""
        return (self.view_count if self.view_rows is None else self.view_rows), self.view_count

    @property
    def views(self) -> FloatArray:
        """(v, u) of each camera in raster order, (views, 2)."""
        numbers = (np.arange(float(count)) - count // 2 for count in self._view_counts)
        return np.stack(np.meshgrid(*numbers, indexing="ij"), axis=-1).reshape(-1, 2)

    def position(self, view: View) -> FloatArray:
        """Where the camera at (v, u), which may be fractions, stands, (x, y, z) in metres."""
        return np.array([view[1] * self.view_step, view[0] * self.view_step, 0.0])

    def shear(self, depth: ArrayLike) -> FloatArray:
        """Shear of points at `depth` metres along z, pixels per view step (supplement Note 1)."""
        nearness = 1 / self.focus - 1 / np.asarray(depth, np.float64)
        return np.asarray(self.focal_length_px * self.view_step * nearness)

    def depth(self, shear: float) -> float:
        """Distance along z, m, of points with a shear; `InputError` where it lies beyond infinity."""
        inverse = 1 / self.focus - shear / (self.focal_length_px * self.view_step)
        require(
            inverse > 0,
            f"shear {shear} lies beyond infinity for this camera array; take a smaller one",
        )
        return 1 / inverse

    def point(self, x: float, y: float, shear: float) -> FloatArray:
        """The point (x, y, z), m, that the reference view sees `x` pixels right and `y` down of its
        centre at a shear, in pixels per view step.
        """
        depth = self.depth(shear)
        return np.array([x / self.focal_length_px * depth, y / self.focal_length_px * depth, depth])

    def rays(self, view: View, samples: int) -> tuple[FloatArray, FloatArray]:
        """Rays of one camera at (v, u), `samples` on a side of each pixel: the origin (3,), m, and
        directions (rows * samples * columns * samples, 3), as long as the way to the plane in focus.
        """
        rows, columns = self.image_shape
        origin = self.position(view)
        # in pixels from the middle of the picture's central pixel, number n // 2
        unit = self.focus / self.focal_length_px
        y, x = (
            ((np.arange(n * samples) + 0.5) / samples - 0.5 - n // 2) * unit
            for n in (rows, columns)
        )
        # all views' pictures agree on the plane in focus: rays of one pixel meet there
        at_focus = np.stack(np.broadcast_arrays(x, y[:, np.newaxis], self.focus), axis=-1)
        return origin, at_focus.reshape(-1, 3) - origin


@dataclass(frozen=True)
class Scene:
    """Bodies under one distant lamp; `light` points towards it, with any length."""

    bodies: tuple[Body, ...]
    light: tuple[float, float, float] = LIGHT_DIRECTION

    def __post_init__(self) -> None:
        require(self.bodies, "a scene needs at least one body")
        require(np.linalg.norm(self.light) > 0, "the direction towards the lamp must not be zero")


@dataclass(frozen=True)
class RenderedLightField:
    """A light field and the truth about it."""

    light_field: LightField
    # (rows, columns) float32, of what the reference view (0, 0) sees in the middle of each pixel;
    # infinite where it sees nothing
    shears: AnyArray


def render_light_field(scene: Scene, array: CameraArray) -> RenderedLightField:
    """Render every view of an array, and the reference view's map of shears; memory is about 200
    bytes for each ray of one view and thread.
    """
    views = array.views
    pictures = np.empty((len(views), *array.image_shape), np.float32)
    _for_each_view(array, pictures, lambda view: render_view(scene, array, view))
    return RenderedLightField(LightField(pictures, views), render_shear_map(scene, array))


def _for_each_view(
    array: CameraArray, pictures: AnyArray, render: Callable[[View], AnyArray]
) -> None:
    """Fill `pictures` (views, ...); the threads are used for views."""

    def fill(piece: slice) -> None:
        for number in range(piece.start, piece.stop):
            v, u = array.views[number].tolist()
            pictures[number] = render((v, u))

    with limit_blas_threads():
        run_blocks(fill, len(pictures), 1)


def render_view(scene: Scene, array: CameraArray, view: View) -> AnyArray:
    """Return what the camera at (v, u) sees, (rows, columns) float32; v and u may be fractions."""
    origin, directions = array.rays(view, array.samples)
    _, brightness = _shade_rays(scene, origin, directions)
    rows, columns = array.image_shape
    by_pixel = brightness.reshape(rows, array.samples, columns, array.samples)
    return by_pixel.mean(axis=(1, 3)).astype(np.float32)


def render_shear_map(scene: Scene, array: CameraArray) -> AnyArray:
    """Return the shear of what the reference view sees in the middle of each pixel, (rows, columns)
    float32, pixels per view step; infinite where it sees nothing.
    """
    origin, directions = array.rays((0.0, 0.0), 1)
    distance, _ = _shade_rays(scene, origin, directions)
    seen = np.isfinite(distance)
    depth = np.where(seen, distance, 1.0) * array.focus  # directions reach to the plane in focus
    return np.where(seen, array.shear(depth), np.inf).reshape(array.image_shape).astype(np.float32)


def _shade_rays(scene: Scene, origin: AnyArray, directions: AnyArray) -> tuple[AnyArray, AnyArray]:
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


@dataclass(frozen=True)
class PulsedScene:
    """Bodies and the lamps that flash at time zero, all with the same power: of a glossy body only
    the matt part sends light back.
    """

    bodies: tuple[Body, ...]
    lamps: FloatArray  # (lamps, 3), where they stand, m; all before the bodies

    def __post_init__(self) -> None:
        require(self.bodies, "a scene needs at least one body")
        if self.lamps.ndim != 2 or self.lamps.shape[1] != 3 or not len(self.lamps):
            raise ShapeError("the lamps' places", "(lamps, 3)", self.lamps.shape)


@dataclass(frozen=True)
class TimeAxis:
    """Bins of time, and how long the instrument's answer to an instant is."""

    start: float  # middle of the first bin, s after the lamps' flash
    bin_width: float  # s
    bins: int
    pulse_fwhm: float  # of lamp and detector together, a Gaussian, s

    def __post_init__(self) -> None:
        durations = (self.bin_width, self.bins, self.pulse_fwhm)
        require(
            np.isfinite(self.start) and all(np.isfinite(one) and one > 0 for one in durations),
            "bins, their width and the pulse must be positive, the start finite",
        )

    @property
    def times(self) -> FloatArray:
        """Middle of each bin, s."""
        return np.linspace(self.start, self.start + (self.bins - 1) * self.bin_width, self.bins)

    @classmethod
    def for_ranges(cls, near: float, far: float, bin_width: float, pulse_fwhm: float) -> TimeAxis:
        """Return an axis for surfaces from `near` to `far`, m; widths of bins and pulse in s."""
        start = 2 * near / SPEED_OF_LIGHT
        bins = int(np.ceil(2 * (far - near) / SPEED_OF_LIGHT / bin_width)) + 1
        return cls(start, bin_width, bins, pulse_fwhm)


def render_flash(scene: PulsedScene, array: CameraArray, time_axis: TimeAxis) -> Float32Array:
    """Return what every view sees at every instant, (views, rows, columns, bins). A surface of
    reflectance 1 that faces all lamps from the distance of the array's focus has brightness 1,
    summed over time. Memory beyond the result is about 1 kB for each ray of a view and thread.
    """
    views = array.views
    pictures = np.empty((len(views), *array.image_shape, time_axis.bins), np.float32)
    _for_each_view(array, pictures, lambda view: render_flash_view(scene, array, time_axis, view))
    return pictures


def render_flash_view(
    scene: PulsedScene, array: CameraArray, time_axis: TimeAxis, view: View
) -> AnyArray:
    """Return what the camera at (v, u) sees in every time bin, (rows, columns, bins) float32."""
    origin, directions = array.rays(view, array.samples)
    sight = cast_rays(scene.bodies, origin, directions)
    seen = np.flatnonzero(sight.body != NO_BODY)
    reflectance = look_up_reflectance(scene.bodies, sight)[seen]
    points = origin + sight.distance[seen, np.newaxis] * directions[seen]
    back = np.linalg.norm(points - origin, axis=1)
    pixel = number_ray_pixels(array.image_shape, array.samples)[seen]
    shape = (int(np.prod(array.image_shape)), time_axis.bins)
    sigma = time_axis.pulse_fwhm / FWHM_PER_SIGMA / time_axis.bin_width
    total = np.zeros(shape)
    for lamp in scene.lamps:
        light = compute_irradiance(scene.bodies, lamp, points, sight.normal[seen]) * reflectance
        lit = light > 0
        path = np.linalg.norm(points[lit] - lamp, axis=1) + back[lit]
        position = (path / SPEED_OF_LIGHT - time_axis.start) / time_axis.bin_width
        total += bin_by_time(pixel[lit], position, light[lit], sigma, shape)
    # so that a white surface that faces all lamps from the focus distance has brightness 1
    share = array.focus**2 / len(scene.lamps) / array.samples**2
    return (share * total).astype(np.float32).reshape(*array.image_shape, time_axis.bins)
