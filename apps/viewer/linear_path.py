"""Recovery while one looks: the linear inverse at any shear, each prepared once."""

from __future__ import annotations

import threading
from collections import OrderedDict

import numpy as np
from numpy.typing import NDArray

from apps.viewer.source import FloatArray, Gate, View
from tofclip.camera import Camera
from tofclip.lidar import Detection, Returns, depth, point_cloud
from tofclip.lidar.detection import BRIGHT_QUANTILE
from tofclip.lidar.processing import selected
from tofclip.shots import Frames
from tofclip.solvers import LinearInverse
from tofclip.solvers.direct import PreparedInverse

Readings = NDArray[np.float32]

MOST_SHEARS = 6
SHEARS = (-3.0, 3.0)
"""Pixels per view step between which a picture can be focused anew."""

FEWEST_FRAMES = 3
"""Without a neighbour on either side no return is located."""


class LinearPath:
    """Turns the readings of one camera into frames, at any shear.

    Parameters
    ----------
    camera : Camera
    times : (frames,) array
        Time of flight of each reading, s.

    Notes
    -----
    Memory: one operator and one matrix (columns, columns) for each of the last 6 shears. Safe to share by threads.
    """

    def __init__(self, camera: Camera, times: FloatArray) -> None:
        self.camera, self.times = camera, times
        self._prepared: OrderedDict[float, PreparedInverse] = OrderedDict()
        self._lock = threading.Lock()

    def frames(self, readings: Readings, shear: float, gate: Gate) -> Frames:
        """Recover the frames of a gate.

        Parameters
        ----------
        readings : (columns, frames) array
            Rectified, of the whole shot.
        shear : float
            Pixels per view step.
        gate : Gate
        """
        part = np.ascontiguousarray(readings[:, gate.frames])
        found = self._inverse(shear).recover(part).frames
        times = self.times[gate.frames]
        return Frames(found, times, self.camera, shears=np.full(times.size, shear))

    def view(self, readings: Readings, shear: float, gate: Gate, least_intensity: float = 0.0) -> View:
        """Recover the frames of a gate and locate their returns.

        Parameters
        ----------
        readings, shear, gate
            As for `frames`.
        least_intensity : float
            Weaker returns are left out: a dark gate does not tell by itself that it is dark. Counts, referred to 1 m.
        """
        found = view_of(depth(self.frames(readings, shear, self._wide_enough(gate))))
        return found if least_intensity <= 0 else brighter(found, least_intensity)

    def _wide_enough(self, gate: Gate) -> Gate:
        first = max(0, min(gate.first, self.times.size - FEWEST_FRAMES))
        return Gate(first, max(gate.stop, first + FEWEST_FRAMES))

    def _inverse(self, shear: float) -> PreparedInverse:
        key = round(shear, 6)
        with self._lock:
            if key not in self._prepared:
                self._prepared[key] = LinearInverse().prepare(self.camera.operator(key), ~self.camera.dead_columns)
                if len(self._prepared) > MOST_SHEARS:
                    self._prepared.popitem(last=False)
            self._prepared.move_to_end(key)
            return self._prepared[key]


def view_of(returns: Returns) -> View:
    """Place returns in space and keep which pixel saw them."""
    return View(point_cloud(returns), np.stack([returns.y, returns.x], axis=-1))


def least_intensity(whole: View) -> float:
    """Return the intensity below which a return of a shot does not count, as `Detection` has it for all of its frames.

    Parameters
    ----------
    whole : View
        Of all frames.
    """
    light = whole.cloud.intensity
    return float(np.quantile(light, BRIGHT_QUANTILE)) * Detection().share_of_scene if light.size else 0.0


def brighter(view: View, intensity: float) -> View:
    """Return the points of at least so many counts."""
    kept = view.cloud.intensity >= intensity
    return View(selected(view.cloud, kept), None if view.pixels is None else view.pixels[kept])
