"""The surface model A(r): amplitudes of surface points to a raw streak image, and back.

A point p of surface k at range r_k(p) falls, in view v, on

    slit column   centres_v + X - Y tan(angle_v) + shear(z) u_v
    raw row       sweep((r + |point - view|) / c + time zero) + delay_v + stretch_v (row / rows - 1/2)

and its light is spread over the slit by the pixel's own size and over time by the view's pulse.
Nothing is rectified, so that the noise of the measurements stays independent.
"""

from __future__ import annotations

import copy
import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeVar

import numpy as np
import scipy
from numpy.typing import NDArray

from tofclip.camera import Camera, estimate_dark_level
from tofclip.lidar import compute_ray_directions
from tofclip.recovery.surface_patches import MIN_BEHIND_FRACTION, SmoothBasis
from tofclip.recovery.surface_pulse import FWHM_PER_SIGMA, ShotPulse
from tofclip.shots import Streak
from tofclip.threads import map_parallel, split_blocks, thread_count
from tofclip.units import SPEED_OF_LIGHT

FloatArray = NDArray[np.float64]
Image = NDArray[np.float32]
Result = TypeVar("Result")

MODEL_ERROR_FRACTION = (
    0.015  # of the brightest measurement: what the model leaves even without noise
)
EXTENT_SIGMAS = 3.5  # 5e-4 of a pulse lie outside
MAX_LENGTHENING = 1.5  # pulses that turn out longer than the camera's are cut off beyond
SLIT_PIXELS, SUBROWS = 4, 3
SMOOTHING_PX = 2.0
WIDTH_STEP = 0.02  # relative; for the derivative by a pulse's width
MIN_INVERSE_DEPTH = 1e-3  # 1/m; a surface that bends away ends a kilometre off
MIN_BEHIND_PX = 100  # of a surface, seen through another
FRONT_FRACTION = 0.5  # of a surface's usual brightness: it ends where its rim is darker
MIN_VARIANCE = 0.02  # rows^2, of the smoothing that is left of a pulse shorter than a row


@dataclass
class SurfaceState:
    """What is solved for beside the amplitudes.

    Parameters
    ----------
    coefficients : list of (n,) float arrays
        Inverse depths of each surface, 1/m, over its basis.
    gains : (views,) float array
    delays : (views,) float array
        Rows by which light at the views' centres is later than the camera's sweep says. Between two
        centres they are interpolated, as a sweep is a smooth function of the slit column.
    stretches : (views,) float array
        Rows by which those delays grow over the streak image.
    widths : (views,) float array
        Pulse widths, relative to the camera's.
    shading : (surfaces, views) float array
        Logarithms of how bright each view sees what lies behind another surface, relative to the
        mean over the views. Through gauze the view beside the lamp sees just what the lamp lights,
        and the others see a part of it.
    """

    coefficients: list[FloatArray]
    gains: FloatArray
    delays: FloatArray
    stretches: FloatArray
    widths: FloatArray
    shading: FloatArray

    @classmethod
    def start(cls, coefficients: Sequence[FloatArray], camera: Camera) -> SurfaceState:
        """Return the state in which views are as the camera has them.

        Parameters
        ----------
        coefficients : sequence of (n,) float arrays
        camera : Camera
        """
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


class ViewPlaces(NamedTuple):
    """Where the points of all surfaces fall in one view, and in which fractions."""

    row: NDArray[np.int32]
    row_shares: Image
    column: NDArray[np.int32]
    slit_shares: Image
    first_column: int
    columns: int
    lit_rows: NDArray[np.int64]
    reached_rows: NDArray[np.int64]
    rows_per_instant: float
    before: NDArray[np.intp]
    fraction: FloatArray

    def weigh_centre(self, view: int) -> FloatArray:
        """How much of the sweep at a view's centre each point's place on the slit has."""
        upto = np.where(self.before == view, 1 - self.fraction, 0.0)
        return upto + np.where(self.before + 1 == view, self.fraction, 0.0)


class Derivatives(NamedTuple):
    """Derivatives of the streak image by some unknowns, on the part of it that they change.

    Attributes
    ----------
    names : list of (str, int, int)
        Field of `SurfaceState`, number of the surface or 0, number of the entry.
    row, column : int
        Of the part's corner.
    images : (unknowns, rows, columns) float32 array
    """

    names: list[tuple[str, int, int]]
    row: int
    column: int
    images: Image


class SurfaceModel:
    """A(r) for one shot.

    Parameters
    ----------
    streak : Streak
    camera : Camera
        With its sweep.
    masks : (surfaces, rows, columns) bool array
        Where each surface may be.
    bases : sequence of SmoothBasis
        Of the surfaces' inverse depths.
    state : SurfaceState
    pulse : ShotPulse, optional
        A Gaussian of the camera's width by default.

    Notes
    -----
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
        self._directions = compute_ray_directions(camera, y, x)
        self.ray_length = 1 / self._directions[:, 2]
        axis_row, axis_column = camera.optical_axis_px
        self._x, self._y = x - axis_column, y - axis_row
        self.behind = np.zeros(self.surface.size, bool)
        self.place(state)

    def place(self, state: SurfaceState) -> None:
        """Move the surfaces to where `state` has them."""
        self.state = state
        inverse = np.concatenate(
            [m @ c for m, c in zip(self.monomials, state.coefficients, strict=True)]
        )
        self.distance: FloatArray = self.ray_length / np.maximum(inverse, MIN_INVERSE_DEPTH)
        sigma = self.pulse.sigma
        self._core_half = int(np.ceil(EXTENT_SIGMAS * MAX_LENGTHENING * sigma)) + 1
        self._half = self._core_half + self.pulse.reach
        self._margin = self._half + 3
        points = self._directions * self.distance[:, np.newaxis]
        self._views = self._map_views(lambda view: self._place_view(view, points))
        self._sigmas = sigma * np.array([one.rows_per_instant for one in self._views])
        self.kernels = [self._make_kernel(width) for width in self._sigmas * state.widths]

    def _make_kernel(self, sigma: float, variance: float = 1 / 6) -> Image:
        """The pulse of a core of `sigma` rows, of which `variance` is already there."""
        return self.pulse.extend(make_pulse(sigma, self._core_half, variance))

    def find_behind(self, amplitude: Image) -> None:
        """Find the points that lie behind another surface and are seen through it.

        Parameters
        ----------
        amplitude : (points,) float32 array
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

        Parameters
        ----------
        surface : int
        amplitude : (points,) float32 array
            The quadratic follows the points that are lit.
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

    def _place_view(self, view: int, points: FloatArray) -> ViewPlaces:
        from tofclip.recovery.surface_kernels import (
            SPLINE_SAMPLES,
            split_between_rows,
            split_over_slit,
        )

        row, column, pace, before, fraction = self._locate(view, points)
        # Nothing of what misses the streak image is kept: a surface may run off without end, and one
        # that comes close is spread over all of the slit's plane.
        rows, columns = self.image.shape
        away, last = self._margin + SPLINE_SAMPLES, rows + self._margin - SPLINE_SAMPLES
        first, shares = split_between_rows(np.clip(row, -away, rows + away))
        shares[(first < -self._margin) | (first > last)] = 0
        np.clip(first, -self._margin, last, out=first)
        slit_first = np.empty(row.size, np.int32)
        slit = np.empty((row.size, SLIT_PIXELS), np.float32)
        along = np.clip(column, -SLIT_PIXELS, columns + SLIT_PIXELS)
        split_over_slit(along, np.tan(self.camera.angles[view]), SUBROWS, slit_first, slit)
        slit[along != column] = 0
        left = int(slit_first.min(initial=0))
        right = int(slit_first.max(initial=0)) + SLIT_PIXELS
        hit = np.bincount(first + self._margin, minlength=rows + 2 * self._margin)
        reached = np.convolve(hit, np.ones(SPLINE_SAMPLES))[: hit.size] > 0
        lit = np.convolve(reached, np.ones(2 * self._half + 1), "same")
        return ViewPlaces(
            first,
            shares,
            slit_first - np.int32(left),
            slit,
            left,
            right - left,
            np.flatnonzero(lit[self._margin : -self._margin] > 0),
            np.flatnonzero(reached),
            pace,
            before,
            fraction,
        )

    def _locate(
        self, view: int, points: FloatArray
    ) -> tuple[FloatArray, FloatArray, float, NDArray[np.intp], FloatArray]:
        """Raw row and column of every point in a view, raw rows per instant there, and between which
        two centres the points lie, and where.
        """
        camera, position = self.camera, self.camera.view_positions[view]
        viewpoint = np.array([camera.lenslet_pitch * position, 0.0, 0.0])
        back = np.linalg.norm(points - viewpoint, axis=1)
        time = (self.distance + back) / SPEED_OF_LIGHT + camera.time_zero
        column = (
            camera.centres_px[view]
            + self._x
            - self._y * np.tan(camera.angles[view])
            + camera.shear_at(points[:, 2]) * position
        )
        before, fraction = self._split_between_centres(column)
        row, pace = find_rows(self.times, time), 1.0
        if camera.sweep is not None:
            later, _ = camera.sweep.raw_position(row + 0.5, column)
            row, raw_column = camera.sweep.raw_position(row, column)
            pace = 2 * float(np.mean(later - row)) if row.size else 1.0
            column = np.array(raw_column, np.float64)
        after, state = np.minimum(before + 1, camera.views - 1), self.state
        delay, stretch = (
            (1 - fraction) * values[before] + fraction * values[after]
            for values in (state.delays, state.stretches)
        )
        return row + delay + stretch * self._height(row), column, pace, before, fraction

    def _split_between_centres(self, column: FloatArray) -> tuple[NDArray[np.intp], FloatArray]:
        """The centre before each place on the slit, and the way to the next one, 0 to 1; beyond the
        outer centres the sweep goes on linearly.
        """
        centres = self.camera.centres_px
        if centres.size == 1:
            return np.zeros(column.size, np.intp), np.zeros(column.size)
        before = np.clip(np.searchsorted(centres, column) - 1, 0, centres.size - 2)
        return before, (column - centres[before]) / (centres[before + 1] - centres[before])

    def _height(self, row: NDArray[Any]) -> FloatArray:
        """Rows as fractions of the streak image from its middle."""
        height: FloatArray = row / self.image.shape[0] - 0.5
        return height

    def project(
        self,
        view: int,
        amplitude: Image,
        kernel: Image,
        part: slice = slice(None),
        rows: tuple[int, int] | None = None,
    ) -> Image:
        """Return what a view of gain 1 receives from some points, (rows, its columns).

        Parameters
        ----------
        view : int
        amplitude : (points,) float32 array
            Of the points in `part`.
        kernel : (taps,) float32 array
            Of the pulse.
        part : slice
            Of the points; all by default.
        rows : (int, int), optional
            First row and the one after the last; all by default.
        """
        from tofclip.recovery.surface_kernels import add_light, smooth_rows

        place, margin = self._views[view], self._margin
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
        images = self._map_views(lambda view: self.project(view, amplitude, self.kernels[view]))
        for view, image in enumerate(images):
            image *= np.float32(self.state.gains[view])
            own, slit = self._overlap(view)
            total[:, slit] += image[:, own]
        return total

    def render_part(self, amplitude: Image, part: slice, rows: tuple[int, int]) -> Image:
        """Return the light of some points, on some rows.

        Parameters
        ----------
        amplitude : (points,) float32 array
            Of the points in `part`.
        part : slice
        rows : (int, int)
            First row and the one after the last; they must hold all light of the points.
        """
        total = np.zeros((rows[1] - rows[0], self.image.shape[1]), np.float32)
        for view, kernel in enumerate(self.kernels):
            own, slit = self._overlap(view)
            image = self.project(view, amplitude, kernel, part, rows)
            total[:, slit] += np.float32(self.state.gains[view]) * image[:, own]
        return total

    def _overlap(self, view: int) -> tuple[slice, slice]:
        """The part of a view's columns that lies on the slit, and where."""
        first, columns = self._views[view].first_column, self._views[view].columns
        left, right = max(first, 0), min(first + columns, self.image.shape[1])
        right = max(left, right)
        return slice(left - first, right - first), slice(left, right)

    def gather(self, image: Image, squared: bool = False) -> Image:
        """Return A' of an image, (points,); squared: with the squares of all entries."""
        from tofclip.recovery.surface_kernels import gather_light, smooth_rows

        def work(view: int) -> Image:
            place, kernel = self._views[view], self.kernels[view]
            gain, slit_shares = self.state.gains[view], place.slit_shares
            if squared:  # a pulse is smooth: the square of its samples between rows is theirs
                whole = self._make_kernel(self._sigmas[view] * self.state.widths[view], 0.0)
                kernel, gain, slit_shares = whole**2, gain**2, slit_shares**2
            own, slit = self._overlap(view)
            part = np.zeros((image.shape[0], place.columns), np.float32)
            part[:, own] = image[:, slit]
            smooth = np.zeros((image.shape[0] + 2 * self._margin, place.columns), np.float32)
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

        Parameters
        ----------
        view : int
        amplitude : (points,) float32 array
            Of the points in `part`.
        part : slice
            Of the points; all by default.
        """
        behind = self.behind[part]
        if not behind.any():
            return amplitude
        brightness = np.exp(self.state.shading[self.surface[part], view])
        return np.where(behind, amplitude * brightness, amplitude).astype(np.float32)

    def misfit(self, amplitude: Image) -> float:
        """Half the weighted squared misfit."""
        error = self.render(amplitude) - self.image
        return float(np.sum(self.weights * error**2, dtype=np.float64)) / 2

    def iterate_derivatives(self, amplitude: Image) -> Iterator[Derivatives]:
        """Yield the image's derivatives by the unknowns of the state, each view's and surface's.

        The reference view keeps its delay and stretch: time zero is its own. Derivatives by gains
        and widths are by their logarithms.
        """
        reference = self.reference
        views = range(self.camera.views)
        yield from map_parallel(lambda view: self._differentiate_view(view, amplitude), views)
        yield from map_parallel(
            lambda view: self._differentiate_sweep(view, amplitude),
            [view for view in views if view != reference],
        )
        yield from map_parallel(
            lambda surface: self._differentiate_surface(surface, amplitude),
            range(len(self.masks)),
        )

    def _differentiate_view(self, view: int, amplitude: Image) -> Derivatives:
        kernel, own = self.kernels[view], self._overlap(view)
        wider = self._make_kernel(self._sigmas[view] * self.state.widths[view] * (1 + WIDTH_STEP))
        images = {
            "gains": self.project(view, amplitude, kernel),
            "widths": self.project(view, amplitude, (wider - kernel) / np.float32(WIDTH_STEP)),
        }
        unknowns = [(name, 0, view) for name in images]
        projected = list(images.values())
        for surface in np.unique(self.surface[self.behind]):
            chosen = self.behind & (self.surface == surface)
            unknowns.append(("shading", int(surface), view))
            projected.append(self.project(view, amplitude * chosen, kernel))
        stacked = np.stack(projected)[:, :, own[0]] * np.float32(self.state.gains[view])
        return Derivatives(unknowns, 0, own[1].start, stacked)

    def _differentiate_sweep(self, view: int, amplitude: Image) -> Derivatives:
        """By delay and stretch at a view's centre, which the views beside it feel as well."""
        felt = []
        for other, place in enumerate(self._views):
            weight = place.weigh_centre(view)
            if not weight.any():
                continue
            slope = differentiate_pulse(self.kernels[other])
            slope *= np.float32(self.state.gains[other])
            light = amplitude * weight
            late = light * self._height(place.row)
            own, slit = self._overlap(other)
            images = [
                self.project(other, one.astype(np.float32), slope)[:, own] for one in (light, late)
            ]
            felt.append((slit, images))
        first = min((slit.start for slit, _ in felt), default=0)
        last = max((slit.stop for slit, _ in felt), default=first + 1)
        total = np.zeros((2, self.image.shape[0], last - first), np.float32)
        for slit, images in felt:
            total[:, :, slit.start - first : slit.stop - first] += images
        return Derivatives([("delays", 0, view), ("stretches", 0, view)], 0, first, total)

    def _differentiate_surface(self, surface: int, amplitude: Image) -> Derivatives:
        part, monomials = self.parts[surface], self.monomials[surface]
        first = min(int(one.row[part].min(initial=0)) for one in self._views) - self._half
        last = max(int(one.row[part].max(initial=0)) for one in self._views) + self._half + 3
        first = min(max(first, 0), self.image.shape[0] - 1)
        last = max(min(last, self.image.shape[0]), first + 1)
        there = 2 * self.distance[part] / SPEED_OF_LIGHT + self.camera.time_zero
        rows_per_metre = 2 / SPEED_OF_LIGHT / np.interp(there, self.times, np.gradient(self.times))
        # range = length / inverse depth
        by_inverse = -(self.distance[part] ** 2) / self.ray_length[part] * rows_per_metre
        in_range = (amplitude[part] * by_inverse)[:, np.newaxis] * monomials
        lights = np.ascontiguousarray(in_range.T, np.float32)
        images = np.zeros((len(lights), last - first, self.image.shape[1]), np.float32)
        for view, place in enumerate(self._views):
            slope = differentiate_pulse(self.kernels[view])
            slope *= np.float32(self.state.gains[view] * place.rows_per_instant)
            own, slit = self._overlap(view)
            for number, light in enumerate(lights):
                image = self.project(view, light, slope, part, (first, last))
                images[number, :, slit] += image[:, own]
        names = [("coefficients", surface, number) for number in range(len(lights))]
        return Derivatives(names, first, 0, images)


def find_rows(times: FloatArray, time: FloatArray) -> FloatArray:
    """Return where instants lie on a time axis, which need not be even, in rows.

    Parameters
    ----------
    times : (rows,) float array
        Rising, s; beyond its ends the axis goes on as there.
    time : float array
        s.
    """
    first, last = times[1] - times[0], times[-1] - times[-2]
    before, after = np.minimum(time - times[0], 0) / first, np.maximum(time - times[-1], 0) / last
    rows: FloatArray = np.interp(time, times, np.arange(times.size)) + before + after
    return rows


def compare_smoothed(predicted: Image, measured: Image, valid: NDArray[np.bool_]) -> float:
    """Return the norm of what is left over that of the measurements, both smoothed.

    Parameters
    ----------
    predicted, measured : (rows, columns) float32 array
    valid : (rows, columns) bool array

    Returns
    -------
    float
    """
    error, image = (
        scipy.ndimage.gaussian_filter(one * valid, SMOOTHING_PX)
        for one in (measured - predicted, measured)
    )
    signal = float(np.linalg.norm(image))
    return float(np.linalg.norm(error)) / signal if signal else 1.0


def weigh_measurements(streak: Streak, camera: Camera) -> tuple[Image, Image]:
    """Return the measurements above the dark level, and one over their variance.

    Parameters
    ----------
    streak : Streak
    camera : Camera

    Returns
    -------
    image, weights : (rows, columns) float32 array
        Weights are 0 where a measurement is not valid.
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


def make_pulse(sigma: float, half: int, variance: float = 1 / 6) -> Image:
    """Return the samples of a Gaussian pulse that are left to smooth with.

    Parameters
    ----------
    sigma : float
        Standard deviation of the pulse, rows.
    half : int
        Samples to either side.
    variance : float
        Already there, rows^2: the B-spline's 1/4 without the 1/12 of the row itself.
    """
    rest = max(sigma**2 - variance, MIN_VARIANCE)
    taps = np.arange(-half, half + 1)
    pulse = np.exp(-(taps**2) / (2 * rest))
    pulse[np.abs(taps) > EXTENT_SIGMAS * np.sqrt(rest) + 1] = 0  # which smoothing skips
    found: Image = (pulse / pulse.sum()).astype(np.float32)
    return found


def differentiate_pulse(kernel: Image) -> Image:
    """Derivative of a smoothed image by the light's row, as a kernel of the same length."""
    steepness = -2j * np.pi * np.fft.rfftfreq(kernel.size)  # light that is later moves on
    slope = np.fft.irfft(steepness * np.fft.rfft(kernel), kernel.size)
    return slope.astype(np.float32)
