"""Recovery while one looks, at any shear: by the linear inverse, each prepared once, or by a method of
iterations.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from apps.viewer.source import LINEAR_NOTE, FloatArray, Gate, View, list_camera_notes
from tofclip.camera import Camera
from tofclip.lidar import Detection, PointCloud, Returns, depth, point_cloud
from tofclip.lidar.detection import SCENE_BRIGHTNESS_QUANTILE
from tofclip.lidar.processing import select_points
from tofclip.sequences.cache import get_cached_camera, prepare_inverse
from tofclip.shots import Frames
from tofclip.solvers import LinearInverse, Method, PreparedInverse

Readings = NDArray[np.float32]

SHEAR_LIMITS = (-3.0, 3.0)
"""Pixels per view step between which a picture can be refocused."""

MIN_PIXEL_SHARE = 0.3
"""Of the strongest return of its pixel; weaker ones before it are mostly rays, which would hide it."""

MIN_FRAMES = 3
"""Without a neighbour on either side no return is located."""


class ShotRecovery:
    """Turns the measurements of one camera into frames, at any shear.

    `times` (frames,): time of flight of each column of measurements, s; `method`: the linear
    inverse by default.

    Memory of the linear inverse: one operator and one matrix (columns, columns) for each of the last
    16 shears, which every recovery of this process shares (`tofclip.sequences.cache`). Safe to share
    by threads.
    """

    def __init__(self, camera: Camera, times: FloatArray, method: Method | None = None) -> None:
        self.camera, self.times = camera, times
        self.method: Method = LinearInverse() if method is None else method
        self._cached_camera = get_cached_camera(camera)

    @property
    def is_linear(self) -> bool:
        """Whether frames are a quick look, by the linear inverse."""
        return isinstance(self.method, LinearInverse)

    def frames(self, measurements: Readings, shear: float, gate: Gate) -> Frames:
        """Recover the frames of a gate.

        `measurements` (columns, frames): rectified, of the whole shot; `shear`: pixels per view
        step.
        """
        part = np.ascontiguousarray(measurements[:, gate.frames])
        if self.is_linear:
            found = self._prepare_inverse(shear).recover(part).frames
        elif part.max(initial=0.0) > 0:
            valid = np.broadcast_to(~self.camera.dead_columns[:, np.newaxis], part.shape)
            found = self.method.recover(self.camera.operator(shear), part, valid).frames
        else:  # a dark gate has no brightest frame to set a prior's weight by
            found = np.zeros((part.shape[1], *self.camera.image_shape), np.float32)
        times = self.times[gate.frames]
        return Frames(found, times, self.camera, shears=np.full(times.size, shear))

    def view(
        self, measurements: Readings, shear: float, gate: Gate, least_intensity: float = 0.0
    ) -> View:
        """Recover the frames of a gate and locate their returns.

        `measurements, shear, gate`: as for `frames`; `least_intensity`: weaker returns are left
        out: a threshold relative to the gate would find noise in a dark one. Counts, referred to 1
        m.
        """
        found = make_view(depth(self.frames(measurements, shear, self._widen_gate(gate))))
        return found if least_intensity <= 0 else select_brighter(found, least_intensity)

    def _widen_gate(self, gate: Gate) -> Gate:
        first = max(0, min(gate.first, self.times.size - MIN_FRAMES))
        return Gate(first, max(gate.stop, first + MIN_FRAMES))

    def _prepare_inverse(self, shear: float) -> PreparedInverse:
        # Rounded, because sliders give numbers that differ by rounding only.
        operator = self._cached_camera.operator(round(shear, 6))
        return prepare_inverse(LinearInverse(), operator, ~self.camera.dead_columns)


def list_recovery_notes(recovery: ShotRecovery) -> tuple[str, ...]:
    """Return what has to be said about clouds that were recovered while one looks."""
    quick = (LINEAR_NOTE,) if recovery.is_linear else ()
    return quick + list_camera_notes(recovery.camera)


def make_view(returns: Returns, cloud: PointCloud | None = None) -> View:
    """Return the points of returns and which pixel saw them.

    `cloud`: of these returns, where they have been placed in space already.
    """
    points = point_cloud(returns) if cloud is None else cloud
    return View(points, np.stack([returns.y, returns.x], axis=-1))


def find_min_intensity(whole: PointCloud) -> float:
    """Return the intensity below which a return of a shot does not count, as `Detection` has it for
    all of its frames.

    `whole`: of all frames.
    """
    light = whole.intensity
    return (
        float(np.quantile(light, SCENE_BRIGHTNESS_QUANTILE)) * Detection().min_scene_fraction
        if light.size
        else 0.0
    )


def select_brighter(view: View, intensity: float) -> View:
    """Return the points with a minimum number of counts.

    `intensity`: counts.
    """
    return _select(view, view.cloud.intensity >= intensity)


def leave_out_rays(view: View) -> View:
    """Return a view without dim points: of the whole scene, and beside a brighter one of their pixel.

    `view`: of all frames, with pixels.
    """
    found = select_brighter(view, find_min_intensity(view.cloud))
    if found.pixels is None or len(found.cloud) == 0:
        return found
    strongest = np.zeros(found.pixels.max(axis=0) + 1, np.float32)
    row, column = found.pixels.T
    np.maximum.at(strongest, (row, column), found.cloud.intensity)
    return _select(found, found.cloud.intensity >= MIN_PIXEL_SHARE * strongest[row, column])


def _select(view: View, kept: NDArray[np.bool_]) -> View:
    return View(select_points(view.cloud, kept), None if view.pixels is None else view.pixels[kept])
