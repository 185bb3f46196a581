"""Time of flight in light fields: which instant brings which light to which pixel of each view,
lamps and shadows included.

Light goes from a lamp to a surface and on to a view; a lamp that something else shades adds
nothing. Interreflections are left out.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofclip.errors import InputError, ShapeError
from tofclip.operators.shear import View
from tofclip.simulate.bodies import Body
from tofclip.simulate.light_fields.array import CameraArray
from tofclip.simulate.rays import (
    FWHM_PER_SIGMA,
    NO_BODY,
    bin_by_time,
    cast_rays,
    compute_irradiance,
    look_up_reflectance,
    number_ray_pixels,
)
from tofclip.threads import limit_blas_threads, run_blocks
from tofclip.units import SPEED_OF_LIGHT

Array = NDArray[Any]


@dataclass(frozen=True)
class PulsedScene:
    """Bodies and the lamps that flash at time zero, all with the same power.

    Parameters
    ----------
    bodies : tuple of Body
        Matt: of a glossy one only the matt part sends light back.
    lamps : (lamps, 3) array
        Where they stand, m; all before the bodies.

    Raises
    ------
    InputError, ShapeError
        There is no body, or the lamps are not a list of places.
    """

    bodies: tuple[Body, ...]
    lamps: NDArray[np.float64]

    def __post_init__(self) -> None:
        if not self.bodies:
            raise InputError("a scene needs at least one body")
        if self.lamps.ndim != 2 or self.lamps.shape[1] != 3 or not len(self.lamps):
            raise ShapeError("the lamps' places", "(lamps, 3)", self.lamps.shape)


@dataclass(frozen=True)
class TimeAxis:
    """Bins of time, and how long the instrument's answer to an instant is.

    Parameters
    ----------
    start : float
        Middle of the first bin, s after the lamps' flash.
    bin_width : float
        s.
    bins : int
    pulse_fwhm : float
        Full width at half maximum of lamp and detector together, a Gaussian, s.

    Raises
    ------
    InputError
        A duration is not positive.
    """

    start: float
    bin_width: float
    bins: int
    pulse_fwhm: float

    def __post_init__(self) -> None:
        durations = (self.bin_width, self.bins, self.pulse_fwhm)
        if not (np.isfinite(self.start) and all(np.isfinite(one) and one > 0 for one in durations)):
            raise InputError("bins, their width and the pulse must be positive, the start finite")

    @property
    def times(self) -> NDArray[np.float64]:
        """Middle of each bin, s."""
        return np.linspace(self.start, self.start + (self.bins - 1) * self.bin_width, self.bins)

    @classmethod
    def for_ranges(cls, near: float, far: float, bin_width: float, pulse_fwhm: float) -> TimeAxis:
        """Return a time axis for surfaces from `near` to `far` metres away, lamps beside the views.

        Parameters
        ----------
        near, far : float
            Metres.
        bin_width : float
            Seconds.
        pulse_fwhm : float
            Full width at half maximum of the instrument's response, seconds.

        Returns
        -------
        TimeAxis
        """
        start = 2 * near / SPEED_OF_LIGHT
        return cls(
            start,
            bin_width,
            int(np.ceil(2 * (far - near) / SPEED_OF_LIGHT / bin_width)) + 1,
            pulse_fwhm,
        )


def render_flash(
    scene: PulsedScene, array: CameraArray, time_axis: TimeAxis
) -> NDArray[np.float32]:
    """Return what every view sees at every instant, (views, rows, columns, bins).

    A surface of reflectance 1 that faces all lamps from the distance of the array's focus has
    brightness 1, summed over time. Memory beyond the result is about 1 kB for each ray of a view
    and thread.

    Parameters
    ----------
    scene : PulsedScene
        Bodies and lamps.
    array : CameraArray
    time_axis : TimeAxis

    Returns
    -------
    (views, rows, columns, bins) float32 array
    """
    views = array.views
    pictures = np.empty((len(views), *array.image_shape, time_axis.bins), np.float32)

    def some(which: slice) -> None:
        for number in range(which.start, which.stop):
            pictures[number] = render_flash_view(
                scene, array, time_axis, (views[number, 0], views[number, 1])
            )

    with limit_blas_threads():  # the threads are used for views
        run_blocks(some, len(views), 1)
    return pictures


def render_flash_view(
    scene: PulsedScene, array: CameraArray, time_axis: TimeAxis, view: View
) -> Array:
    """Return what the camera at (v, u) sees in every time bin.

    Parameters
    ----------
    scene : PulsedScene
    array : CameraArray
    time_axis : TimeAxis
    view : (float, float)
        View steps down and to the right.

    Returns
    -------
    (rows, columns, bins) float32 array
    """
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
