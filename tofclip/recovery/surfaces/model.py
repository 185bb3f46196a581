"""What is solved for beside the amplitudes: the surfaces' shapes, and what is uncertain of the camera.

What a shot says, and how surely: measurements above the dark with weights, and what is left of them.

Where light of surface points falls on the raw streak image, view by view.

The surface model A(r): amplitudes of surface points to a raw streak image, and back.

A point p of surface k at range r_k(p) falls, in view v, on

    slit column   centres_v + X - Y tan(angle_v) + shear(z) u_v
    raw row       sweep((r + |point - view|) / c + time zero) + delay_v + stretch_v (row / rows - 1/2)

(`places`) and its light is spread over the slit by the pixel's own size and over time by the view's
pulse (`pulse`). Nothing is rectified, so that the noise of the measurements stays independent.
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
from tofclip.recovery.surfaces.patches import MIN_BEHIND_FRACTION, SmoothBasis
from tofclip.recovery.surfaces.pulse import (
    EXTENT_SIGMAS,
    FWHM_PER_SIGMA,
    SPLINE_LEFT_VARIANCE,
    ShotPulse,
    make_pulse,
)
from tofclip.shots import Streak
from tofclip.threads import map_parallel, split_blocks, thread_count
from tofclip.units import SPEED_OF_LIGHT

FloatArray = NDArray[np.float64]


@dataclass
class SurfaceState:
    """What is solved for beside the amplitudes."""

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
        return SurfaceState(
            [one.copy() for one in self.coefficients],
            self.gains.copy(),
            self.delays.copy(),
            self.stretches.copy(),
            self.widths.copy(),
            self.shading.copy(),
        )


Image = NDArray[np.float32]

# Of the brightest measurement: what the model leaves even without noise.
MODEL_ERROR_FRACTION = 0.015
SMOOTHING_PX = 2.0


def weigh_measurements(streak: Streak, camera: Camera) -> tuple[Image, Image]:
    """Return the measurements above the dark level, and one over their variance.

    Returns `image, weights` (rows, columns): weights are 0 where a measurement is not valid.
    """
    dark = estimate_dark_level(streak.counts)
    image = (streak.counts - np.float32(dark)).astype(np.float32)
    smooth = np.maximum(scipy.ndimage.gaussian_filter(streak.counts.astype(np.float32), 1.0), 0)
    # The variance of a measurement is its photons; the floor stands for what the model cannot explain.
    weights = 1 / (smooth + MODEL_ERROR_FRACTION * smooth.max() + max(dark, 0.0))
    if streak.saturated is not None:
        weights[streak.saturated] = 0
    weights[:, camera.dead_columns] = 0
    return image, weights.astype(np.float32)


def compare_smoothed(predicted: Image, measured: Image, valid: NDArray[np.bool_]) -> float:
    """Return the norm of what is left over that of the measurements, both smoothed.

    `predicted, measured` (rows, columns); `valid` (rows, columns).
    """
    error, image = (
        scipy.ndimage.gaussian_filter(one * valid, SMOOTHING_PX)
        for one in (measured - predicted, measured)
    )
    signal = float(np.linalg.norm(image))
    return float(np.linalg.norm(error)) / signal if signal else 1.0


SLIT_PIXELS, SUBROWS = 4, 3


class BetweenCentres(NamedTuple):
    """Between which two views' centres points fall on the slit."""

    before: NDArray[np.intp]  # (points,), the centre before each
    # (points,), the way from there to the next centre, 0 to 1; outside the outer centres below or
    # beyond, as the sweep goes on linearly there
    fraction: FloatArray

    @classmethod
    def find(cls, centres: FloatArray, column: FloatArray) -> BetweenCentres:
        """Return where places on the slit lie between the centres.

        `centres` (views,); `column` (points,).
        """
        if centres.size == 1:
            return cls(np.zeros(column.size, np.intp), np.zeros(column.size))
        before = np.clip(np.searchsorted(centres, column) - 1, 0, centres.size - 2)
        return cls(before, (column - centres[before]) / (centres[before + 1] - centres[before]))

    def interpolate(self, values: FloatArray) -> FloatArray:
        """Return what each point has of values at the centres, (views,)."""
        after = np.minimum(self.before + 1, values.size - 1)
        found: FloatArray = (1 - self.fraction) * values[self.before] + self.fraction * values[
            after
        ]
        return found

    def weigh_centre(self, view: int) -> FloatArray:
        """Return how much each point has of the value at one centre."""
        upto = np.where(self.before == view, 1 - self.fraction, 0.0)
        return upto + np.where(self.before + 1 == view, self.fraction, 0.0)


class PointPlaces(NamedTuple):
    """Where points fall in one view."""

    row: FloatArray  # (points,), of the raw streak image; row i reaches from i - 1/2 to i + 1/2
    column: FloatArray  # (points,), of the raw streak image; row i reaches from i - 1/2 to i + 1/2
    between: BetweenCentres
    rows_per_instant: float  # raw rows in the time of one, on average


@dataclass(frozen=True)
class PointRays:
    """The rays on which surface points lie."""

    directions: FloatArray  # (points, 3), of length 1
    x: NDArray[Any]  # (points,), pixels from the optical axis
    y: NDArray[Any]  # (points,), pixels from the optical axis

    @classmethod
    def of_pixels(cls, camera: Camera, y: NDArray[np.intp], x: NDArray[np.intp]) -> PointRays:
        """Return the rays of some pixels.

        `y, x` (points,).
        """
        axis_row, axis_column = camera.optical_axis_px
        return cls(compute_ray_directions(camera, y, x), x - axis_column, y - axis_row)

    def locate(
        self,
        view: int,
        distance: FloatArray,
        camera: Camera,
        state: SurfaceState,
        times: FloatArray,
    ) -> PointPlaces:
        """Return where the points fall in a view.

        `distance` (points,): range of each point, m; `state`: with the delays and stretches of the
        views; `times` (rows,): time axis of the streak image, s.
        """
        points, position = self.directions * distance[:, np.newaxis], camera.view_positions[view]
        viewpoint = np.array([camera.lenslet_pitch * position, 0.0, 0.0])
        back = np.linalg.norm(points - viewpoint, axis=1)
        time = (distance + back) / SPEED_OF_LIGHT + camera.time_zero
        column = (
            camera.centres_px[view]
            + self.x
            - self.y * np.tan(camera.angles[view])
            + camera.shear_at(points[:, 2]) * position
        )
        between = BetweenCentres.find(camera.centres_px, column)
        row, pace = find_rows(times, time), 1.0
        if camera.sweep is not None:
            later, _ = camera.sweep.raw_position(row + 0.5, column)
            row, raw_column = camera.sweep.raw_position(row, column)
            pace = 2 * float(np.mean(later - row)) if row.size else 1.0
            column = np.array(raw_column, np.float64)
        delay, stretch = (between.interpolate(one) for one in (state.delays, state.stretches))
        row = row + delay + stretch * measure_height(row, times.size)
        return PointPlaces(row, column, between, pace)


def measure_height(row: NDArray[Any], rows: int) -> FloatArray:
    """Return rows as fractions of the streak image from its middle.

    `rows`: of the streak image.
    """
    height: FloatArray = row / rows - 0.5
    return height


def find_rows(times: FloatArray, time: FloatArray) -> FloatArray:
    """Return where instants lie on a time axis, which need not be even, in rows.

    `times` (rows,): rising, s; beyond its ends the axis goes on as there; `time`: s.
    """
    first, last = times[1] - times[0], times[-1] - times[-2]
    before, after = np.minimum(time - times[0], 0) / first, np.maximum(time - times[-1], 0) / last
    rows: FloatArray = np.interp(time, times, np.arange(times.size)) + before + after
    return rows


class Footprint(NamedTuple):
    """The rows and columns of a view on which points have light, and in which fractions."""

    # (points,), first of those that a point reaches; columns count from `first_column`
    row: NDArray[np.int32]
    row_shares: Image  # (points, 3), before the pulse smooths them
    # (points,), first of those that a point reaches; columns count from `first_column`
    column: NDArray[np.int32]
    slit_shares: Image  # (points, 4)
    first_column: int  # of the slit, of which the view has a part
    columns: int  # of the slit, of which the view has a part
    lit_rows: NDArray[np.int64]  # (n,), of the streak image, which smoothed light reaches
    # (n,), those that light reaches before it is smoothed, counted from `margin` above the first
    # one
    reached_rows: NDArray[np.int64]
    between: BetweenCentres
    rows_per_instant: float  # as of `PointPlaces`

    def overlap(self, slit_width: int) -> tuple[slice, slice]:
        """Return the part of the view's columns that lies on the slit, and where."""
        left, right = max(self.first_column, 0), min(self.first_column + self.columns, slit_width)
        right = max(left, right)
        return slice(left - self.first_column, right - self.first_column), slice(left, right)


def spread_points(
    places: PointPlaces, tangent: float, shape: tuple[int, ...], margin: int, half: int
) -> Footprint:
    """Return which rows and columns the light of points reaches.

    Nothing of what misses the streak image is kept: a surface may run off without end, and one that
    comes close is spread over all of the slit's plane.

    `tangent`: of the view's line angle; `shape`: rows and columns of the streak image; `margin`:
    rows above and below it that may hold light; `half`: rows to either side over which the pulse
    smooths it.
    """
    from tofclip.recovery.surfaces.kernels import (
        SPLINE_SAMPLES,
        split_between_rows,
        split_over_slit,
    )

    rows, columns = shape
    row, column = places.row, places.column
    away, last = margin + SPLINE_SAMPLES, rows + margin - SPLINE_SAMPLES
    first, shares = split_between_rows(np.clip(row, -away, rows + away))
    shares[(first < -margin) | (first > last)] = 0
    np.clip(first, -margin, last, out=first)
    slit_first = np.empty(row.size, np.int32)
    slit = np.empty((row.size, SLIT_PIXELS), np.float32)
    along = np.clip(column, -SLIT_PIXELS, columns + SLIT_PIXELS)
    split_over_slit(along, tangent, SUBROWS, slit_first, slit)
    slit[along != column] = 0
    left = int(slit_first.min(initial=0))
    right = int(slit_first.max(initial=0)) + SLIT_PIXELS
    hit = np.bincount(first + margin, minlength=rows + 2 * margin)
    reached = np.convolve(hit, np.ones(SPLINE_SAMPLES))[: hit.size] > 0
    lit = np.convolve(reached, np.ones(2 * half + 1), "same")
    return Footprint(
        first,
        shares,
        slit_first - np.int32(left),
        slit,
        left,
        right - left,
        np.flatnonzero(lit[margin:-margin] > 0),
        np.flatnonzero(reached),
        places.between,
        places.rows_per_instant,
    )


Result = TypeVar("Result")

MAX_LENGTHENING = 1.5  # pulses that turn out longer than the camera's are cut off beyond
MIN_INVERSE_DEPTH = 1e-3  # 1/m; a surface that bends away ends a kilometre off
MIN_BEHIND_PX = 100  # of a surface, seen through another
FRONT_FRACTION = 0.5  # of a surface's usual brightness: it ends where its rim is darker


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
        self.bin_width = float(np.mean(np.diff(streak.times)))
        self.times = streak.times
        self.reference = int(np.argmin(np.abs(camera.view_positions)))
        self.pulse = pulse or ShotPulse(camera.pulse_fwhm / FWHM_PER_SIGMA / self.bin_width)
        self.image, self.weights = weigh_measurements(streak, camera)
        self.surface, y, x = np.nonzero(masks)
        self.pixel = y * masks.shape[2] + x
        ends = np.searchsorted(self.surface, np.arange(len(masks) + 1))
        self.parts = [slice(int(a), int(b)) for a, b in itertools.pairwise(ends)]
        self.monomials = [
            basis.evaluate(self.pixel[part])
            for basis, part in zip(self.bases, self.parts, strict=True)
        ]
        self.rays = PointRays.of_pixels(camera, y, x)
        self.ray_length = 1 / self.rays.directions[:, 2]
        self.behind = np.zeros(self.surface.size, bool)
        self.place(state)

    def place(self, state: SurfaceState) -> None:
        """Move the surfaces to where `state` has them."""
        self.state = state
        inverse = np.concatenate(
            [m @ c for m, c in zip(self.monomials, state.coefficients, strict=True)]
        )
        self.distance: FloatArray = self.ray_length / np.maximum(inverse, MIN_INVERSE_DEPTH)
        self._core_half = int(np.ceil(EXTENT_SIGMAS * MAX_LENGTHENING * self.pulse.sigma)) + 1
        self.half = self._core_half + self.pulse.reach
        self._margin = self.half + 3
        self.footprints = self._map_views(self._spread_view)
        self.kernels = [self.make_kernel(view) for view in range(self.camera.views)]

    def _spread_view(self, view: int) -> Footprint:
        places = self.rays.locate(view, self.distance, self.camera, self.state, self.times)
        tangent = float(np.tan(self.camera.angles[view]))
        return spread_points(places, tangent, self.image.shape, self._margin, self.half)

    def make_kernel(
        self, view: int, relative_width: float = 1.0, variance: float = SPLINE_LEFT_VARIANCE
    ) -> Image:
        """Return the pulse with which light between rows is smoothed.

        `relative_width`: in widths of the view's own pulse; `variance`: already there, rows^2.
        """
        rows_per_instant = self.footprints[view].rows_per_instant
        sigma = self.pulse.sigma * rows_per_instant * self.state.widths[view] * relative_width
        return self.pulse.extend(make_pulse(sigma, self._core_half, variance))

    def find_behind(self, amplitude: Image) -> None:
        """Find the points that lie behind another surface and are seen through it.

        `amplitude` (points,).
        """
        brightness = np.zeros(amplitude.size)
        for part in self.parts:
            light = amplitude[part]
            brightness[part] = light / np.median(light[light > 0]) if light.any() else 0
        nearest = np.full(self.masks[0].size, np.inf)
        front = brightness > FRONT_FRACTION
        np.minimum.at(nearest, self.pixel[front], self.distance[front])
        behind = (self.distance > nearest[self.pixel]) & (brightness > MIN_BEHIND_FRACTION)
        # a few pixels are a rim, where each surface has a part of the light
        count = np.bincount(self.surface[behind], minlength=len(self.masks))
        self.behind = behind & (count >= MIN_BEHIND_PX)[self.surface]

    def see(self, streak: Streak) -> SurfaceModel:
        """Return the same surfaces before another shot of the camera."""
        other = copy.copy(self)
        other.image, other.weights = weigh_measurements(streak, self.camera)
        return other

    def unexplained(self, amplitude: Image) -> float:
        """What is left of the signal, as a fraction, smoothed so that photons' noise hardly counts."""
        return compare_smoothed(self.render(amplitude), self.image, self.weights > 0)

    def straighten(self, surface: int, amplitude: Image) -> SurfaceModel:
        """Return the same surfaces, one of splines replaced by the quadratic that is nearest to it.

        `amplitude` (points,): the quadratic follows the points that are lit.
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
        """Return the standard deviations of all ranges, (points,), m.

        `covariances`: of each surface's coefficients.
        """
        variance = np.concatenate(
            [
                np.einsum("pi,ij,pj->p", m, c, m)
                for m, c in zip(self.monomials, covariances, strict=True)
            ]
        )
        # range = length / inverse depth
        deviation: FloatArray = self.distance**2 / self.ray_length * np.sqrt(variance)
        return deviation

    def compute_slopes(self) -> FloatArray:
        """Return how steeply the ranges change along columns and rows, (2, points), m per pixel."""
        rows, columns = self.camera.image_shape
        y, x = np.divmod(self.pixel, columns)
        steps = []
        for down, right in ((0, 1), (1, 0)):
            # at the picture's end the step goes back
            sign = np.where((y + down < rows) & (x + right < columns), 1, -1)
            below, beside = y + sign * down, x + sign * right
            pixel = below * columns + beside
            inverse = np.concatenate(
                [
                    basis.evaluate(pixel[part]) @ c
                    for basis, part, c in zip(
                        self.bases, self.parts, self.state.coefficients, strict=True
                    )
                ]
            )
            length = 1 / compute_ray_directions(self.camera, below, beside)[:, 2]
            there = length / np.maximum(inverse, MIN_INVERSE_DEPTH)
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
        """Return what a view of gain 1 receives from some points, (rows, its columns).

        `amplitude` (points,): of the points in `part`; `kernel` (taps,): of the pulse; `part`: of
        the points; all by default; `rows`: first row and the one after the last; all by default.
        """
        from tofclip.recovery.surfaces.kernels import add_light, smooth_rows

        place, margin = self.footprints[view], self._margin
        amplitude = self.shade(view, amplitude, part)
        first, last = (0, self.image.shape[0]) if rows is None else rows
        light = np.zeros((last - first + 2 * margin, place.columns), np.float32)
        add_light(
            amplitude,
            place.row[part] + np.int32(margin - first),
            place.row_shares[part],
            place.column[part],
            place.slit_shares[part],
            light,
        )
        image = np.zeros((last - first, place.columns), np.float32)
        wanted = place.lit_rows if rows is None else np.arange(last - first)
        smooth_rows(light, kernel, wanted, margin, image)
        return image

    def render(self, amplitude: Image) -> Image:
        """Return A a, (rows, columns), of amplitudes (points,)."""
        total = np.zeros(self.image.shape, np.float32)
        kernels = [
            kernel * np.float32(gain)
            for kernel, gain in zip(self.kernels, self.state.gains, strict=True)
        ]
        images = self._map_views(lambda view: self.project(view, amplitude, kernels[view]))
        for view, image in enumerate(images):
            own, slit = self.overlap(view)
            total[:, slit] += image[:, own]
        return total

    def render_part(self, amplitude: Image, part: slice, rows: tuple[int, int]) -> Image:
        """Return the light of some points, on some rows.

        `amplitude` (points,): of the points in `part`; `rows`: first row and the one after the
        last; they must hold all light of the points.
        """
        total = np.zeros((rows[1] - rows[0], self.image.shape[1]), np.float32)
        for view, kernel in enumerate(self.kernels):
            own, slit = self.overlap(view)
            kernel = kernel * np.float32(self.state.gains[view])
            total[:, slit] += self.project(view, amplitude, kernel, part, rows)[:, own]
        return total

    def overlap(self, view: int) -> tuple[slice, slice]:
        """Return the part of a view's columns that lies on the slit, and where."""
        return self.footprints[view].overlap(self.image.shape[1])

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
            reached = place.reached_rows
            smooth_rows(part, kernel[::-1].copy(), reached, -self._margin, smooth)
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
        """Return amplitudes as a view sees them.

        `amplitude` (points,): of the points in `part`; `part`: of the points; all by default.
        """
        behind = self.behind[part]
        if not behind.any():
            return amplitude
        brightness = np.exp(self.state.shading[self.surface[part], view])
        return np.where(behind, amplitude * brightness, amplitude).astype(np.float32)
