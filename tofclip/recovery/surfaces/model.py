"""The surface model A(r): amplitudes of surface points to a raw streak image, and back.

A point p of surface k at range r_k(p) falls, in view v, on

    slit column   centres_v + X - Y tan(angle_v) + shear(z) u_v
    raw row       sweep((r + |point - view|) / c + time zero) + delay_v + stretch_v (row / rows - 1/2)

and its light is spread over the slit by the pixel's own size and over time by the view's pulse.
Nothing is rectified, so that the noise of the measurements stays independent.

In this package: an amplitude is (points,), of all surfaces' points one after the other; an image is
(rows, columns), as the raw streak image; ranges are metres, and of rows i reaches from i - 1/2 to
i + 1/2.
"""

from __future__ import annotations

import copy
import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeVar

import numpy as np
import scipy
from numpy.typing import NDArray

from tofclip.camera import Camera, estimate_dark_level
from tofclip.lidar import compute_ray_directions
from tofclip.recovery.surfaces.patches import MIN_BEHIND_FRACTION, FloatArray, SmoothBasis
from tofclip.recovery.surfaces.pulse import (
    EXTENT_SIGMAS,
    FWHM_PER_SIGMA,
    SPLINE_LEFT_VARIANCE,
    Image,
    ShotPulse,
    make_pulse,
)
from tofclip.shots import Streak
from tofclip.threads import map_parallel, split_blocks, thread_count
from tofclip.units import SPEED_OF_LIGHT

Result = TypeVar("Result")

MODEL_ERROR_FRACTION = 0.015  # of the brightest measurement: what the model leaves without noise
SMOOTHING_PX = 2.0
SLIT_PIXELS, SUBROWS = 4, 3
MAX_LENGTHENING = 1.5  # pulses that turn out longer than the camera's are cut off beyond
MIN_INVERSE_DEPTH = 1e-3  # 1/m; a surface that bends away ends a kilometre off
MIN_BEHIND_PX = 100  # of a surface, seen through another; fewer are a rim, of which each has a part
FRONT_FRACTION = 0.5  # of a surface's usual brightness: it ends where its rim is darker


@dataclass
class SurfaceState:
    """What is solved for beside the amplitudes: shapes, and what is uncertain of the camera."""

    coefficients: list[FloatArray]  # inverse depths of each surface, 1/m, over its basis
    gains: FloatArray  # (views,)
    # (views,), rows by which light at the views' centres is later than the camera's sweep says.
    # Between two centres they are interpolated, as a sweep is a smooth function of the slit column
    delays: FloatArray
    stretches: FloatArray  # (views,), rows by which those delays grow over the streak image
    widths: FloatArray  # (views,), pulse widths, relative to the camera's
    # (surfaces, views), logarithms of how bright each view sees what lies behind another surface,
    # relative to the mean over the views. Through gauze the view beside the lamp sees just what the
    # lamp lights, and the others see a part of it
    shading: FloatArray

    @classmethod
    def start(cls, coefficients: Sequence[FloatArray], camera: Camera) -> SurfaceState:
        """Return the state in which views are as the camera has them."""
        none = np.zeros(camera.views)
        even = np.zeros((len(coefficients), camera.views))
        return cls(list(coefficients), camera.gains.copy(), none, none.copy(), none + 1, even)

    def copy(self) -> SurfaceState:
        """Return a state that can be changed without changing this one."""
        return copy.deepcopy(self)


def weigh_measurements(streak: Streak, camera: Camera) -> tuple[Image, Image]:
    """Return the image above the dark level, and one over its variance; 0 where it is not valid."""
    dark = estimate_dark_level(streak.counts)
    image = (streak.counts - np.float32(dark)).astype(np.float32)
    smooth = np.maximum(scipy.ndimage.gaussian_filter(streak.counts.astype(np.float32), 1.0), 0)
    # A measurement's variance is its photons; the floor stands for what the model cannot explain.
    weights = 1 / (smooth + MODEL_ERROR_FRACTION * smooth.max() + max(dark, 0.0))
    if streak.saturated is not None:
        weights[streak.saturated] = 0
    weights[:, camera.dead_columns] = 0
    return image, weights.astype(np.float32)


def compare_smoothed(predicted: Image, measured: Image, valid: NDArray[np.bool_]) -> float:
    """Norm of what is left over that of the measurements, smoothed: photons' noise hardly counts."""
    error, signal = (
        float(np.linalg.norm(scipy.ndimage.gaussian_filter(one * valid, SMOOTHING_PX)))
        for one in (measured - predicted, measured)
    )
    return error / signal if signal else 1.0


class BetweenCentres(NamedTuple):
    """Between which two views' centres points fall on the slit."""

    before: NDArray[np.intp]  # (points,), the centre before each
    # (points,), the way from there to the next centre, 0 to 1; outside the outer centres below or
    # beyond, as the sweep goes on linearly there
    fraction: FloatArray

    @classmethod
    def find(cls, centres: FloatArray, column: FloatArray) -> BetweenCentres:
        """Return where places on the slit lie between the centres."""
        if centres.size == 1:
            return cls(np.zeros(column.size, np.intp), np.zeros(column.size))
        before = np.clip(np.searchsorted(centres, column) - 1, 0, centres.size - 2)
        return cls(before, (column - centres[before]) / (centres[before + 1] - centres[before]))

    def interpolate(self, values: FloatArray) -> FloatArray:
        """Return what each point has of values at the centres, (views,)."""
        after = np.minimum(self.before + 1, values.size - 1)
        return np.asarray((1 - self.fraction) * values[self.before] + self.fraction * values[after])

    def weigh_centre(self, view: int) -> FloatArray:
        """Return how much each point has of the value at one centre."""
        upto = np.where(self.before == view, 1 - self.fraction, 0.0)
        return upto + np.where(self.before + 1 == view, self.fraction, 0.0)


def find_rows(times: FloatArray, time: FloatArray) -> FloatArray:
    """Return where instants lie on a time axis, in rows; it need not be even, and goes on beyond its
    ends as there.
    """
    first, last = times[1] - times[0], times[-1] - times[-2]
    before, after = np.minimum(time - times[0], 0) / first, np.maximum(time - times[-1], 0) / last
    return np.asarray(np.interp(time, times, np.arange(times.size)) + before + after)


class Footprint(NamedTuple):
    """The rows and columns of a view on which points have light, and in which fractions. Rows count
    from the streak image's first, columns from `first_column`.
    """

    row: NDArray[np.int32]  # (points,), first of those that a point reaches
    row_shares: Image  # (points, 3), before the pulse smooths them
    column: NDArray[np.int32]  # (points,), first of those that a point reaches
    slit_shares: Image  # (points, 4)
    first_column: int  # of the slit, of which the view has a part
    columns: int
    lit_rows: NDArray[np.int64]  # (n,), which smoothed light reaches
    reached_rows: NDArray[np.int64]  # (n,), before it is smoothed; from `margin` above the first on
    between: BetweenCentres
    rows_per_instant: float  # raw rows in the time of one, on average


class SurfaceModel:
    """A(r) for one shot.

    `camera`: with its sweep; `masks` (surfaces, rows, columns): where each surface may be; `bases`:
    of the surfaces' inverse depths; `pulse`: A Gaussian of the camera's width by default.

    Memory: 40 bytes for each point and view, and the raw image some four times.
    """

    def __init__(
        self,
        streak: Streak,
        camera: Camera,
        masks: NDArray[np.bool_],
        bases: Sequence[SmoothBasis],
        state: SurfaceState,
        pulse: ShotPulse | None = None,
    ) -> None:
        self.camera, self.masks, self.bases = camera, masks, list(bases)
        self.times, self.bin_width = streak.times, float(np.mean(np.diff(streak.times)))
        self.reference = int(np.argmin(np.abs(camera.view_positions)))
        self.pulse = pulse or ShotPulse(camera.pulse_fwhm / FWHM_PER_SIGMA / self.bin_width)
        self.image, self.weights = weigh_measurements(streak, camera)
        self.surface, y, x = np.nonzero(masks)
        self.pixel = y * masks.shape[2] + x
        ends = np.searchsorted(self.surface, np.arange(len(masks) + 1))
        self.parts = [slice(int(a), int(b)) for a, b in itertools.pairwise(ends)]
        self.monomials = self._evaluate(self.pixel)
        self._directions = compute_ray_directions(camera, y, x)
        axis_row, axis_column = camera.optical_axis_px
        self._x, self._y = x - axis_column, y - axis_row
        self.ray_length = 1 / self._directions[:, 2]
        self.behind = np.zeros(self.surface.size, bool)
        self.place(state)

    def _evaluate(self, pixel: NDArray[np.intp]) -> list[FloatArray]:
        """The functions of each surface's basis, at one pixel for each point."""
        bases = zip(self.bases, self.parts, strict=True)
        return [basis.evaluate(pixel[part]) for basis, part in bases]

    def place(self, state: SurfaceState) -> None:
        """Move the surfaces to where `state` has them."""
        self.state = state
        self.distance = self._find_ranges(self.monomials, self.ray_length)
        self._core_half = int(np.ceil(EXTENT_SIGMAS * MAX_LENGTHENING * self.pulse.sigma)) + 1
        self.half = self._core_half + self.pulse.reach
        self._margin = self.half + 3
        self.footprints = self._map_views(self._spread_view)
        self.kernels = [self.make_kernel(view) for view in range(self.camera.views)]

    def _find_ranges(self, monomials: list[FloatArray], ray_length: FloatArray) -> FloatArray:
        shapes = zip(monomials, self.state.coefficients, strict=True)
        inverse = np.concatenate([m @ c for m, c in shapes])
        return np.asarray(ray_length / np.maximum(inverse, MIN_INVERSE_DEPTH))

    def _spread_view(self, view: int) -> Footprint:
        """Return which rows and columns of a view the light of points reaches. Nothing of what
        misses the streak image is kept: a surface may run off without end, and one that comes close
        is spread over all of the slit's plane.
        """
        from tofclip.recovery.surfaces import kernels

        (rows, columns), margin, samples = self.image.shape, self._margin, kernels.SPLINE_SAMPLES
        row, column, between, pace = self._locate(view)
        away, last = margin + samples, rows + margin - samples
        first, shares = kernels.split_between_rows(np.clip(row, -away, rows + away))
        shares[(first < -margin) | (first > last)] = 0
        np.clip(first, -margin, last, out=first)
        slit_first = np.empty(row.size, np.int32)
        slit = np.empty((row.size, SLIT_PIXELS), np.float32)
        along = np.clip(column, -SLIT_PIXELS, columns + SLIT_PIXELS)
        tangent = float(np.tan(self.camera.angles[view]))
        kernels.split_over_slit(along, tangent, SUBROWS, slit_first, slit)
        slit[along != column] = 0
        left = int(slit_first.min(initial=0))
        wide = int(slit_first.max(initial=0)) + SLIT_PIXELS - left
        hit = np.bincount(first + margin, minlength=rows + 2 * margin)
        reached = np.convolve(hit, np.ones(samples))[: hit.size] > 0
        lit = np.convolve(reached, np.ones(2 * self.half + 1), "same")[margin:-margin] > 0
        slit_first -= np.int32(left)
        lines = np.flatnonzero(lit), np.flatnonzero(reached)
        return Footprint(first, shares, slit_first, slit, left, wide, *lines, between, pace)

    def _locate(self, view: int) -> tuple[FloatArray, FloatArray, BetweenCentres, float]:
        """Where points fall in a view, (points,): row and column of the raw streak image, between
        which centres, and how many raw rows the time of one takes.
        """
        camera, position = self.camera, self.camera.view_positions[view]
        points = self._directions * self.distance[:, np.newaxis]
        viewpoint = np.array([camera.lenslet_pitch * position, 0.0, 0.0])
        back = np.linalg.norm(points - viewpoint, axis=1)
        column = (
            camera.centres_px[view]
            + self._x
            - self._y * np.tan(camera.angles[view])
            + camera.shear_at(points[:, 2]) * position
        )
        between = BetweenCentres.find(camera.centres_px, column)
        time = (self.distance + back) / SPEED_OF_LIGHT + camera.time_zero
        row, pace = find_rows(self.times, time), 1.0
        if camera.sweep is not None:
            later, _ = camera.sweep.raw_position(row + 0.5, column)
            row, raw_column = camera.sweep.raw_position(row, column)
            pace = 2 * float(np.mean(later - row)) if row.size else 1.0
            column = np.array(raw_column, np.float64)
        delay, stretch = (
            between.interpolate(one) for one in (self.state.delays, self.state.stretches)
        )
        return row + delay + stretch * self.measure_height(row), column, between, pace

    def measure_height(self, row: NDArray[Any]) -> FloatArray:
        """Return rows as fractions of the streak image from its middle."""
        return np.asarray(row / self.times.size - 0.5)

    def make_kernel(
        self, view: int, relative_width: float = 1.0, variance: float = SPLINE_LEFT_VARIANCE
    ) -> Image:
        """Return the pulse with which light between rows is smoothed, of so many widths of the view's
        own and less the variance, rows^2, that is there already.
        """
        rows_per_instant = self.footprints[view].rows_per_instant
        sigma = self.pulse.sigma * rows_per_instant * self.state.widths[view] * relative_width
        return self.pulse.extend(make_pulse(sigma, self._core_half, variance))

    def find_behind(self, amplitude: Image) -> None:
        """Find the points that lie behind another surface and are seen through it."""
        brightness = np.zeros(amplitude.size)
        for part in self.parts:
            light = amplitude[part]
            brightness[part] = light / np.median(light[light > 0]) if light.any() else 0
        nearest = np.full(self.masks[0].size, np.inf)
        front = brightness > FRONT_FRACTION
        np.minimum.at(nearest, self.pixel[front], self.distance[front])
        behind = (self.distance > nearest[self.pixel]) & (brightness > MIN_BEHIND_FRACTION)
        count = np.bincount(self.surface[behind], minlength=len(self.masks))
        self.behind = behind & (count >= MIN_BEHIND_PX)[self.surface]

    def see(self, streak: Streak) -> SurfaceModel:
        """Return the same surfaces before another shot of the camera."""
        other = copy.copy(self)
        other.image, other.weights = weigh_measurements(streak, self.camera)
        return other

    def unexplained(self, amplitude: Image) -> float:
        """What is left of the signal, as a fraction."""
        return compare_smoothed(self.render(amplitude), self.image, self.weights > 0)

    def straighten(self, surface: int, amplitude: Image) -> SurfaceModel:
        """Return the same surfaces, one of splines replaced by the quadratic that is nearest to it
        where it is lit.
        """
        other, part = copy.copy(self), self.parts[surface]
        basis = SmoothBasis(self.bases[surface].image_shape)
        design, lit = basis.evaluate(self.pixel[part]), amplitude[part] > 0
        inverse = self.ray_length[part] / self.distance[part]
        state = self.state.copy()
        nearest, *_ = np.linalg.lstsq(design[lit], inverse[lit])
        state.coefficients[surface] = nearest.astype(np.float64)
        other.bases, other.monomials = list(self.bases), list(self.monomials)
        other.bases[surface], other.monomials[surface] = basis, design
        other.place(state)
        return other

    def estimate_deviation(self, covariances: Sequence[FloatArray]) -> FloatArray:
        """Standard deviations of all ranges, (points,), by covariances of surfaces' coefficients."""
        known = zip(self.monomials, covariances, strict=True)
        variance = np.concatenate([np.einsum("pi,ij,pj->p", m, c, m) for m, c in known])
        # range = length / inverse depth
        return np.asarray(self.distance**2 / self.ray_length * np.sqrt(variance))

    def compute_slopes(self) -> FloatArray:
        """Return how steeply the ranges change along columns and rows, (2, points), m per pixel."""
        rows, columns = self.camera.image_shape
        y, x = np.divmod(self.pixel, columns)
        steps = []
        for down, right in ((0, 1), (1, 0)):
            # at the picture's end the step goes back
            sign = np.where((y + down < rows) & (x + right < columns), 1, -1)
            below, beside = y + sign * down, x + sign * right
            length = 1 / compute_ray_directions(self.camera, below, beside)[:, 2]
            there = self._find_ranges(self._evaluate(below * columns + beside), length)
            steps.append(sign * (there - self.distance))
        return np.stack(steps)

    def _map_views(self, work: Callable[[int], Result]) -> list[Result]:
        """Return ``work(view)`` of all views; each thread takes its share of them at once."""
        views = self.camera.views
        shares = split_blocks(views, -(-views // thread_count()))
        found = map_parallel(lambda share: [work(v) for v in range(views)[share]], shares)
        return [one for part in found for one in part]

    def project(
        self,
        view: int,
        amplitude: Image,
        kernel: Image,
        part: slice = slice(None),
        rows: tuple[int, int] | None = None,
    ) -> Image:
        """Return what a view of gain 1 receives from some points, (rows, its columns). `amplitude`:
        of the points in `part`; `kernel` (taps,): of the pulse; `rows`: first and the one after the
        last; all by default.
        """
        from tofclip.recovery.surfaces.kernels import add_light, smooth_rows

        place, margin = self.footprints[view], self._margin
        amplitude = self.shade(view, amplitude, part)
        first, last = (0, self.image.shape[0]) if rows is None else rows
        light = np.zeros((last - first + 2 * margin, place.columns), np.float32)
        down = place.row[part] + np.int32(margin - first), place.row_shares[part]
        add_light(amplitude, *down, place.column[part], place.slit_shares[part], light)
        image = np.zeros((last - first, place.columns), np.float32)
        wanted = place.lit_rows if rows is None else np.arange(last - first)
        smooth_rows(light, kernel, wanted, margin, image)
        return image

    def render(
        self, amplitude: Image, part: slice = slice(None), rows: tuple[int, int] | None = None
    ) -> Image:
        """Return A a, (rows, columns); or of some points, on the rows that hold all their light."""
        first, last = (0, self.image.shape[0]) if rows is None else rows
        total = np.zeros((last - first, self.image.shape[1]), np.float32)
        kernels = [
            kernel * np.float32(gain)
            for kernel, gain in zip(self.kernels, self.state.gains, strict=True)
        ]
        images = self._map_views(lambda v: self.project(v, amplitude, kernels[v], part, rows))
        for view, image in enumerate(images):
            own, slit = self.overlap(view)
            total[:, slit] += image[:, own]
        return total

    def overlap(self, view: int) -> tuple[slice, slice]:
        """Return the part of a view's columns that lies on the slit, and where."""
        place, width = self.footprints[view], self.image.shape[1]
        left = max(place.first_column, 0)
        right = max(left, min(place.first_column + place.columns, width))
        return slice(left - place.first_column, right - place.first_column), slice(left, right)

    def gather(self, image: Image, squared: bool = False) -> Image:
        """Return A' of an image, (points,); squared: with the squares of all entries."""
        from tofclip.recovery.surfaces.kernels import gather_light, smooth_rows

        def work(view: int) -> Image:
            place, kernel = self.footprints[view], self.kernels[view]
            gain, slit_shares = self.state.gains[view], place.slit_shares
            if squared:  # a pulse is smooth: the square of its samples between rows is theirs
                whole = self.make_kernel(view, variance=0.0)
                kernel, gain, slit_shares = whole**2, gain**2, slit_shares**2
            own, slit = self.overlap(view)
            part = np.zeros((image.shape[0], place.columns), np.float32)
            part[:, own] = image[:, slit]
            smooth = np.empty((image.shape[0] + 2 * self._margin, place.columns), np.float32)
            smooth_rows(part, kernel[::-1].copy(), place.reached_rows, -self._margin, smooth)
            found = np.zeros(self.surface.size, np.float32)
            row = place.row + np.int32(self._margin)
            gather_light(smooth, gain, row, place.row_shares, place.column, slit_shares, found)
            found = self.shade(view, found)
            return self.shade(view, found) if squared else found

        total = np.zeros(self.surface.size, np.float32)
        for found in self._map_views(work):
            total += found
        return total

    def shade(self, view: int, amplitude: Image, part: slice = slice(None)) -> Image:
        """Return amplitudes, of the points in `part`, as a view sees them."""
        behind = self.behind[part]
        if not behind.any():
            return amplitude
        brightness = np.exp(self.state.shading[self.surface[part], view])
        return np.where(behind, amplitude * brightness, amplitude).astype(np.float32)
