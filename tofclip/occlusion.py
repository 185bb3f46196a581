"""What an occluder hides, and the recovery of what stands behind it.

The inactive region lies so close behind a solid occluder that no view can see it (supplement Note 10).
A time gate separates the light of occluder and target. The occluder's own return tells where it stands.
So it is known which pixels of which view it covers, and which lamps it keeps from which place of the
target; both go into the model F(d), and the recovery compares no measurement with light that could not
have come.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from tofclip.arrays import AnyArray, FloatArray, IntArray
from tofclip.errors import require, require_positive, require_shape
from tofclip.light_field.views import CameraSetup, ClipMeasurement
from tofclip.operators import Diagonal, LinearOperator, LinearShear, Stack
from tofclip.operators.base import View
from tofclip.operators.cameras import LightFieldCamera
from tofclip.recovery.light_field import MAX_ITERATIONS, OBJECTIVE_TOLERANCE, ClipRecovery
from tofclip.simulate.light_fields import CameraArray, TimeAxis
from tofclip.solvers import TotalVariation
from tofclip.units import SPEED_OF_LIGHT

__all__ = ["InactiveRegion"]


@dataclass(frozen=True)
class InactiveRegion:
    """The shadow that a solid occluder on the axis throws, were the whole aperture one lamp: its
    umbra.

    Everything happens in the plane of the axis and the aperture's width. A point is seen from
    somewhere on the aperture exactly if it is seen from one of its ends; hence views that stand at
    both ends and anywhere between see as far as a lens that fills the aperture would.
    """

    baseline: float  # L, between the outermost views, m
    width: float  # D, of the occluder's solid part along the baseline, m
    distance: float  # d, from the views to the occluder, m

    def __post_init__(self) -> None:
        for name in ("baseline", "width", "distance"):
            require_positive(f"the {name}", getattr(self, name), "length in metres")

    @property
    def is_bounded(self) -> bool:
        """Whether anything behind the occluder's middle is promised to be seen: D < L."""
        return self.width < self.baseline

    @property
    def length(self) -> float:
        """How far the region reaches behind the occluder, m: ``d D / (L - D)``; else infinite."""
        if not self.is_bounded:
            return float("inf")
        return self.distance * self.width / (self.baseline - self.width)

    def sees(self, place: ArrayLike, across: ArrayLike, behind: ArrayLike) -> AnyArray:
        """Return whether the line of sight passes the occluder, from a `place` on the aperture, m from the
        axis, to a point: m from the axis, and m behind the occluder. All three are broadcast.
        """
        behind = np.asarray(behind, np.float64)
        passed = np.asarray(across) * self.distance + np.asarray(place) * behind
        return np.asarray(2 * abs(passed) >= self.width * (self.distance + behind))

    def contains(self, across: ArrayLike, behind: ArrayLike) -> AnyArray:
        """Return whether a point is hidden from the whole aperture; arguments as for `sees`."""
        # a convex occluder on the axis hides a point from the whole aperture if it hides it from
        # both ends
        left, right = (self.sees(end * self.baseline / 2, across, behind) for end in (-1, 1))
        return np.asarray(~(left | right))


# Rise of a return above what is around it, in standard deviations of what the measurements say of it one
# by one. Noise of 2,304 measurements over 38 instants rose by up to 3.0.
MIN_SIGNIFICANCE = 5.0
# The same relative to the strongest return, of one that stands in another's light: the slope of a surface
# at several distances is not smooth.
MIN_PROMINENCE = 0.004
# The same relative to the return itself, of one that stands alone. However weak it is beside the
# strongest, then, its own noise decides.
MIN_OWN_PROMINENCE = 0.5
DISTANCE_SAMPLES = 2000  # of tabulated times of flight: steps below a hundredth of a bin


@dataclass(frozen=True)
class Rig:
    """The instrument: where views and lamps stand, and what each view reads."""

    array: CameraArray
    lamps: FloatArray  # (lamps, 3), m; they flash together
    setup: CameraSetup  # which nonlocal measurements the views get

    @cached_property
    def camera(self) -> LightFieldCamera:
        """The encoders of all views."""
        return self.setup.camera(self.array.image_shape, self.array.views)

    def compute_flight_time(self, distance: AnyArray) -> AnyArray:
        """Mean time of flight, s, over lamps and views, of points on the axis at `distance`, m."""
        places = np.stack([self.array.position((v, u)) for v, u in self.array.views])
        points = np.stack([0 * distance, 0 * distance, distance], axis=-1)[:, np.newaxis]
        ends = (self.lamps, places)
        ways = [np.linalg.norm(points - one, axis=-1).mean(axis=1) for one in ends]
        return np.asarray(sum(ways) / SPEED_OF_LIGHT)


@dataclass(frozen=True)
class Return:
    """What comes back from about one distance."""

    distance: float  # m along the axis
    bins: slice  # instants at which its light arrives


@dataclass(frozen=True)
class TimedMeasurements:
    """Measurements of every view at every instant."""

    values: AnyArray  # (measurements, bins)
    rig: Rig
    time_axis: TimeAxis

    def __post_init__(self) -> None:
        expected = (self.rig.camera.measurements, self.time_axis.bins)
        require_shape("the measurements of this rig", expected, self.values.shape)

    @property
    def history(self) -> AnyArray:
        """All measurements together at each instant, (bins,)."""
        return self.values.sum(axis=0, dtype=np.float64)

    def find_returns(self) -> tuple[Return, ...]:
        """Find the two strongest returns, the nearer first; a gate ends at the darkest instant
        between them. A return counts if it is above its own noise, even far below the other one.
        """
        peaks, prominences = self._find_peaks()
        if not peaks.size:
            return ()
        strongest = np.sort(peaks[np.argsort(prominences)[-2:]]).tolist()
        between = (low + np.argmin(self.history[low:high]) for low, high in pairwise(strongest))
        cuts = [0, *map(int, between), self.time_axis.bins]
        return tuple(self._locate_return(slice(*ends)) for ends in pairwise(cuts))

    def _find_peaks(self) -> tuple[IntArray, FloatArray]:
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
        """Divide the light by a gate that opens when that of a distance, m along the axis, arrives:
        what came before, and what came after; dark parts are left out.
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
        flight_times = self.rig.compute_flight_time(distances)
        return Return(float(np.interp(time, flight_times, distances)), bins)

    def sum_gate(self, bins: slice) -> AnyArray:
        """Return the measurements summed over some instants, (measurements,) float32."""
        return self.values[:, bins].sum(axis=1)

    def measurement(self, bins: slice) -> ClipMeasurement:
        """Return what an ordinary recovery takes, of some instants."""
        array = self.rig.array
        return ClipMeasurement(self.sum_gate(bins), array.views, array.image_shape, self.rig.setup)


def measure_views(pictures: AnyArray, rig: Rig, time_axis: TimeAxis) -> TimedMeasurements:
    """Measure true views, (views, rows, columns, bins), without noise."""
    camera = rig.camera
    values = camera.light_field_model()(pictures[list(camera.used_views)])
    return TimedMeasurements(values, rig, time_axis)


def add_poisson_noise(
    light: AnyArray, photons_per_unit: float, random: np.random.Generator
) -> AnyArray:
    """Return light as photon counts report it, in the unit it came in; below zero counts as zero."""
    photons = random.poisson(np.maximum(light, 0) * photons_per_unit)
    return np.asarray(photons / photons_per_unit, np.float32)


# Of total variation: of 1e-3, 3e-3, 5e-3 and 1e-2 the best for most scenes at sampling ratios 0.5 and 1.
TV_WEIGHT = 3e-3
GLINT_QUANTILE = 0.98  # of the pixels, that are no brighter than an occluder's usual ones


@dataclass(frozen=True)
class SeparatedImages:
    """Occluder and target, each from its own return."""

    # (rows, columns), as the reference view sees them at their own shears; the target as if nothing
    # stood before it
    occluder: AnyArray
    target: AnyArray
    plain: AnyArray  # (rows, columns), the target by the model that knows of no occluder
    # of what sent light back, as the times of flight tell, m: occluder and target, or the occluder
    # alone, and then the target's pictures are dark
    distances: tuple[float, ...]

    @property
    def sees_target(self) -> bool:
        """Whether anything came from behind the occluder."""
        return len(self.distances) > 1


def find_occlusion_mask(occluder: AnyArray) -> AnyArray:
    """Return the pixels that an occluder's picture fills, (rows, columns) from 0 to 1."""
    from skimage.filters import threshold_otsu

    # what enters the picture from beside it piles up there
    usual = np.minimum(occluder, np.quantile(occluder, GLINT_QUANTILE))
    return np.asarray(usual > threshold_otsu(usual), np.float32)


def build_occluded_model(
    rig: Rig, occlusion_mask: AnyArray, shears: tuple[float, float]
) -> LinearOperator:
    """Return F(d) of a target behind an occluder: lamps' shadows, shear, hidden pixels, encoder of
    each view. The mask is of the pixels that the occluder fills in the reference view; `shears` are
    those of occluder and target.
    """
    near, far = shears
    camera, array = rig.camera, rig.array
    steps = rig.lamps[:, 1::-1] / array.view_step  # (v, u) of each lamp
    shadows = [_shear_mask(occlusion_mask, near - far, (v, u)) for v, u in steps.tolist()]
    lit = 1 - np.mean(shadows, axis=0)
    views = [camera.views[number] for number in camera.used_views]
    parts = [
        encoder
        @ Diagonal(1 - _shear_mask(occlusion_mask, near, view))
        @ LinearShear(array.image_shape, far, view)
        for view, encoder in zip(views, camera.encoders, strict=True)
    ]
    return Stack(parts) @ Diagonal(lit)


def separate_occluder(
    measurements: TimedMeasurements, returns: tuple[Return, ...] | None = None
) -> SeparatedImages:
    """Recover occluder and target from their returns, by default those found in the measurements; of a
    single one the target's pictures are zero.
    """
    returns = measurements.find_returns() if returns is None else returns
    require(returns, "no light comes back; is the clock set to the scene's distances?")
    distances = tuple(one.distance for one in returns)
    shears = [float(measurements.rig.array.shear(distance)) for distance in distances]
    usual = ClipRecovery(weight=TV_WEIGHT)
    pictures = [
        usual.recover(measurements.measurement(one.bins), shear).picture
        for one, shear in zip(returns, shears, strict=True)
    ]
    occluder = pictures[0]
    if len(returns) == 1:
        return SeparatedImages(occluder, 0 * occluder, 0 * occluder, distances)
    rig, mask = measurements.rig, find_occlusion_mask(occluder)
    weighting = rig.camera.weighting()
    model = weighting @ build_occluded_model(rig, mask, (shears[0], shears[1]))
    gated = weighting(measurements.sum_gate(returns[1].bins))[:, np.newaxis]
    method = TotalVariation(TV_WEIGHT, MAX_ITERATIONS, OBJECTIVE_TOLERANCE)
    target = method.recover(model, gated).frames[0]
    return SeparatedImages(occluder, target, pictures[1], distances)


def _shear_mask(occlusion_mask: AnyArray, shear: float, view: View) -> AnyArray:
    """Return a cover as seen from elsewhere; nothing, if it has left the picture."""
    sides = zip(view, occlusion_mask.shape, strict=True)
    if any(abs(shear * step) >= size for step, size in sides):
        return np.zeros_like(occlusion_mask)
    return LinearShear(occlusion_mask.shape, shear, view)(occlusion_mask)
