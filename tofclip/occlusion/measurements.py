"""Measurements of a light-field camera at every instant, and the returns that follow each other in
them.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofclip.errors import ShapeError
from tofclip.light_field.measurement import CameraSetup, ClipMeasurement
from tofclip.operators.light_field_camera import LightFieldCamera
from tofclip.simulate.light_fields import CameraArray, TimeAxis
from tofclip.units import SPEED_OF_LIGHT

Array = NDArray[Any]

MIN_SIGNIFICANCE = 5.0
"""Rise of a return above what is around it, in standard deviations of what the measurements say of
it one by one. Noise of 2,304 measurements over 38 instants rose by up to 3.0."""

MIN_PROMINENCE = 0.004
"""The same relative to the strongest return, of one that stands in another's light: the slope of a
surface at several distances is not smooth."""

MIN_OWN_PROMINENCE = 0.5
"""The same relative to the return itself, of one that stands alone. However weak it is beside the
strongest, then, its own noise decides."""

DISTANCE_SAMPLES = (
    2000  # distances at which times of flight are tabulated: steps below a hundredth of a bin
)


@dataclass(frozen=True)
class Rig:
    """The instrument: where views and lamps stand, and what each view reads."""

    array: CameraArray
    lamps: NDArray[np.float64]  # (lamps, 3), m; they flash together
    setup: CameraSetup  # which nonlocal measurements the views get

    @cached_property
    def camera(self) -> LightFieldCamera:
        """The encoders of all views."""
        return self.setup.camera(self.array.image_shape, self.array.views)

    def compute_flight_time(self, distance: Array) -> Array:
        """Return the mean time of flight, over lamps and views, of points on the axis, s;
        `distance` (n,) in m.
        """
        places = np.stack([self.array.position((v, u)) for v, u in self.array.views])
        points = np.stack([0 * distance, 0 * distance, distance], axis=-1)[:, np.newaxis]
        ways = (
            np.linalg.norm(points - ends, axis=-1).mean(axis=1) for ends in (self.lamps, places)
        )
        time: Array = sum(ways) / SPEED_OF_LIGHT
        return time


@dataclass(frozen=True)
class Return:
    """What comes back from about one distance."""

    distance: float  # m along the axis
    bins: slice  # instants at which its light arrives


@dataclass(frozen=True)
class TimedMeasurements:
    """Measurements of every view at every instant."""

    values: Array  # (measurements, bins)
    rig: Rig
    time_axis: TimeAxis

    def __post_init__(self) -> None:
        expected = (self.rig.camera.measurements, self.time_axis.bins)
        if self.values.shape != expected:
            raise ShapeError("the measurements of this rig", expected, self.values.shape)

    @property
    def history(self) -> Array:
        """All measurements together at each instant, (bins,)."""
        total: Array = self.values.sum(axis=0, dtype=np.float64)
        return total

    def find_returns(self) -> tuple[Return, ...]:
        """Find the two strongest returns, the nearer first; a gate ends at the darkest instant
        between them.

        A return counts if it is above its own noise, even far below the other one.
        """
        peaks, prominences = self._find_peaks()
        if not peaks.size:
            return ()
        strongest = np.sort(peaks[np.argsort(prominences)[-2:]])
        between = (
            int(low + np.argmin(self.history[low:high]))
            for low, high in pairwise(strongest.tolist())
        )
        return tuple(
            self._locate_return(slice(*ends))
            for ends in pairwise([0, *between, self.time_axis.bins])
        )

    def _find_peaks(self) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Instants of the history's peaks that are no noise, and their prominences."""
        from scipy.signal import find_peaks

        # A return may begin or end with the record: it is dark before and after.
        values = np.pad(self.values, ((0, 0), (1, 1))).astype(np.float64)
        history = values.sum(axis=0)
        peaks, found = find_peaks(history, prominence=0)
        prominence = found["prominences"]
        left, right = found["left_bases"], found["right_bases"]
        higher = np.where(history[left] > history[right], left, right)
        # What each measurement says of the rise; together they are as sure as they agree.
        rises = values[:, peaks] - values[:, higher]
        scatter = np.sqrt(np.sum(rises**2, axis=0))
        least = np.minimum(MIN_PROMINENCE * history.max(), MIN_OWN_PROMINENCE * history[peaks])
        certain = (prominence >= least) & (prominence > MIN_SIGNIFICANCE * scatter)
        return peaks[certain] - 1, prominence[certain]

    def split_returns(self, distance: float) -> tuple[Return, ...]:
        """Divide the light by a gate that opens when that of a distance arrives.

        `distance`: m along the axis. Returns what came before the gate opened, and what came after;
        dark parts are left out.
        """
        opens = float(self.rig.compute_flight_time(np.array([distance]))[0])
        cut = int(np.searchsorted(self.time_axis.times, opens))
        bright = self.history > MIN_PROMINENCE * self.history.max()
        bright[self._find_peaks()[0]] = True
        parts = slice(0, cut), slice(cut, self.time_axis.bins)
        return tuple(self._locate_return(bins) for bins in parts if bright[bins].any())

    def _locate_return(self, bins: slice) -> Return:
        weight = np.maximum(self.history[bins], 0)
        time = float(weight @ self.time_axis.times[bins] / weight.sum())
        reach = self.time_axis.times[[0, -1]] * SPEED_OF_LIGHT / 2
        distances = np.linspace(0.5 * reach[0], 1.1 * reach[1], DISTANCE_SAMPLES)
        return Return(
            float(np.interp(time, self.rig.compute_flight_time(distances), distances)), bins
        )

    def sum_gate(self, bins: slice) -> Array:
        """Return the measurements summed over some instants, (measurements,) float32."""
        total: Array = self.values[:, bins].sum(axis=1)
        return total

    def measurement(self, bins: slice) -> ClipMeasurement:
        """Return what an ordinary recovery takes, of some instants."""
        array = self.rig.array
        return ClipMeasurement(self.sum_gate(bins), array.views, array.image_shape, self.rig.setup)


def measure_views(pictures: Array, rig: Rig, time_axis: TimeAxis) -> TimedMeasurements:
    """Measure true views, (views, rows, columns, bins), without noise.

    `pictures` (views, rows, columns, bins); `rig`: camera and geometry; `time_axis`: of the bins.
    """
    camera = rig.camera
    return TimedMeasurements(
        camera.light_field_model()(pictures[list(camera.used_views)]), rig, time_axis
    )


def add_poisson_noise(light: Array, photons_per_unit: float, random: np.random.Generator) -> Array:
    """Return light as photon counts report it, in the unit it came in.

    `light`: any shape; what is below zero counts as zero; `photons_per_unit`: mean photons where
    `light` is 1. Returns of the same shape.
    """
    photons = random.poisson(np.maximum(light, 0) * photons_per_unit)
    found: Array = (photons / photons_per_unit).astype(np.float32)
    return found
