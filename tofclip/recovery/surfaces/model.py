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
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial, reduce
from typing import Any, NamedTuple, TypeVar

import numpy as np
import scipy
from numpy.typing import NDArray

from tofclip.arrays import FloatArray
from tofclip.camera import Camera, estimate_dark_level
from tofclip.camera.model import interpolate_linearly
from tofclip.lidar import compute_ray_directions
from tofclip.recovery.defects import estimate_noise
from tofclip.recovery.surfaces.patches import MIN_BEHIND_FRACTION
from tofclip.recovery.surfaces.pulse import (
    EXTENT_SIGMAS,
    FWHM_PER_SIGMA,
    SPLINE_LEFT_VARIANCE,
    TINY,
    Image,
    ShotPulse,
    make_pulse,
)
from tofclip.recovery.surfaces.shapes import KnownBasis, SmoothBasis, evaluate_monomials
from tofclip.shots import Streak
from tofclip.threads import map_parallel, split_blocks, thread_count
from tofclip.units import SPEED_OF_LIGHT

Job = TypeVar("Job")
Result = TypeVar("Result")
Box = tuple[NDArray[np.int64], slice]  # rows, ascending, and columns

MODEL_ERROR_FRACTION = 0.015  # of the brightest measurement: what the model leaves without noise
DARK_VARIANCES = 2.0  # of the dark: dark measurements hold more of what the model lacks
SMOOTHING_PX = 2.0
SLIT_PIXELS = 4
# Rows that a part of a pixel spans where a surface is turned far, and parts along a side at most:
# a pulse of a row or more does not tell so narrow a ramp from an instant
PART_ROWS, MAX_PARTS = 1.5, 6
LEAST_FILLED = 0.1  # of a pixel's side, by a surface that ends in it
MAX_LENGTHENING = 1.5  # pulses that turn out longer than the camera's are cut off beyond
MIN_INVERSE_DEPTH = 1e-3  # 1/m; a surface that bends away ends a kilometre off
SWEEP_LEFT_FRACTION = 0.15  # of the corrections to a sweep, lines: what is left of its shape
PACE_PLACES = 16  # one of so many says how long rows take, on average
PARALLEL_POINTS = 20_000  # threads take as long to begin as so many need
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
    centres: FloatArray  # (views,), px by which views lie farther along the slit than the camera's
    # (surfaces, views), logarithms of how bright each view sees what lies behind another surface,
    # relative to the mean over the views. Through gauze the view beside the lamp sees just what the
    # lamp lights, and the others see a part of it
    shading: FloatArray
    # (1,), how far the views' pictures end each where its own does, 1, or all where the reference's
    # does, 0: by its parallax a view sees more or less of what the picture's outer columns see
    borders: FloatArray

    @classmethod
    def start(cls, coefficients: Sequence[FloatArray], camera: Camera) -> SurfaceState:
        """Return the state in which views are as the camera has them."""
        none = np.zeros(camera.views)
        even = np.zeros((len(coefficients), camera.views))
        apart = camera.gains.copy(), none, none.copy(), none + 1, none.copy()
        return cls(list(coefficients), *apart, even, np.zeros(1))

    def copy(self) -> SurfaceState:
        """Return a state that can be changed without changing this one."""
        return copy.deepcopy(self)


def estimate_dark_variance(streak: Streak) -> float:
    """Return what fluctuates in the dark, in the unit of the light's own variance: a camera may add any
    constant.
    """
    _, noise, gain = estimate_noise(streak.counts)
    return noise**2 / gain


def weigh_measurements(streak: Streak, camera: Camera, dark: float) -> tuple[Image, Image]:
    """Return the image above the dark level, and one over its variance; 0 where it is not valid. `dark`: of
    `estimate_dark_variance`.
    """
    image = (streak.counts - np.float32(estimate_dark_level(streak.counts))).astype(np.float32)
    light = np.maximum(scipy.ndimage.gaussian_filter(image, 1.0), 0)
    # A measurement's variance is its photons; the floor stands for what the model cannot explain.
    weights = 1 / (light + MODEL_ERROR_FRACTION * light.max() + DARK_VARIANCES * dark)
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


class Places(NamedTuple):
    """Parts of the points' pixels, each so small that its light arrives at one instant: a pixel on
    a surface that is turned far spans many bins of range.
    """

    point: NDArray[np.intp]  # (places,), the point of which each is a part; ascending
    starts: NDArray[np.intp]  # (points + 1,), number of each point's first
    offset: FloatArray  # (2, places), from the pixel's middle along columns and rows, px
    size: FloatArray  # (2, places), along columns and rows, px
    distance: FloatArray  # (places,), m
    share: Image  # (points,), of a point's light that each of its places has
    # (points,), sum of squares of what parts have in common, over that of the pulse alone
    overlap: Image

    @classmethod
    def split(
        cls,
        distance: FloatArray,
        slopes: FloatArray,
        aside: FloatArray,
        pulse_rows: float,
        row_m: float,
    ) -> Places:
        """Split points by the slopes of their surfaces, m per pixel; `aside`: where the middle of their
        light is, px from the pixel's; both (2, points).
        """
        filled = 1 - 2 * np.abs(aside)
        slopes = slopes * filled
        counts = np.clip(np.ceil(np.abs(slopes) / row_m / PART_ROWS), 1, MAX_PARTS).astype(np.intp)
        total = counts[0] * counts[1]
        point = np.repeat(np.arange(distance.size), total)
        starts = np.concatenate([[0], np.cumsum(total)])
        right, down = np.divmod(np.arange(point.size) - starts[point], counts[1, point])
        size = (filled / counts)[:, point]
        offset = (np.stack([right, down]) + 0.5) * size - 0.5 * filled[:, point] + aside[:, point]
        away = np.sum(offset * (slopes / filled)[:, point], axis=0)
        ramp = np.hypot(*slopes) / row_m / pulse_rows  # pulses that a pixel spans
        overlap = (1 / np.sqrt(1 + ramp**2 / 6)).astype(np.float32)
        share = (1 / total).astype(np.float32)
        return cls(point, starts, offset, size, distance[point] + away, share, overlap)


class Footprint(NamedTuple):
    """The rows and columns of a view on which points have light, and in which fractions: those of a
    picture of its own, of what light reaches, with dark rows before and behind.
    """

    row: NDArray[np.int32]  # (places,), first of those that a part of a pixel reaches
    row_shares: Image  # (places, 3), before the pulse smooths them
    column: NDArray[np.int32]  # (places,), first of those that a part reaches
    slit_shares: Image  # (places, 4)
    shape: tuple[int, int]  # of the view's picture
    first_row: int  # of it, as rows count from the first whose afterglow reaches the streak image
    first_column: int  # of the slit, of which the view has a part
    lit_rows: NDArray[np.int64]  # (n,), which smoothed light reaches; none where the view is dark
    reached_rows: NDArray[np.int64]  # (n,), before it is smoothed
    slit: FloatArray  # (points,), columns before the sweep distorts them
    height: FloatArray  # (points,), see `measure_height`
    rows_per_instant: float  # raw rows in the time of one, on average


@dataclass(frozen=True)
class Window:
    """A part of streak images."""

    row: int  # of its corner
    column: int
    images: Image  # (n, rows, columns)

    @property
    def area(self) -> tuple[slice, slice]:
        """Where it lies."""
        _, rows, columns = self.images.shape
        return slice(self.row, self.row + rows), slice(self.column, self.column + columns)


class SurfaceModel:
    """A(r) for one shot.

    `camera`: with its sweep; `masks` (surfaces, rows, columns): where each surface may be; `bases`:
    of the surfaces' inverse depths; `pulse`: A Gaussian of the camera's width by default.

    Memory: 40 bytes for each part of a point and view, and the raw image some four times.
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
        self.camera = camera
        self.times, self.bin_width = streak.times, float(np.mean(np.diff(streak.times)))
        self.reference = int(np.argmin(np.abs(camera.view_positions)))
        self.row_m = self.bin_width * SPEED_OF_LIGHT / 2
        self.pulse = pulse or ShotPulse(camera.pulse_fwhm / self.bin_width / FWHM_PER_SIGMA)
        self.dark = estimate_dark_variance(streak)
        self.image, self.weights = weigh_measurements(streak, camera, self.dark)
        self._cover(masks, bases)
        self.place(state)

    def _cover(self, masks: NDArray[np.bool_], bases: Sequence[SmoothBasis]) -> None:
        """Have points where surfaces may be."""
        self.masks, self.bases = masks, list(bases)
        self.surface, self.row, self.column = np.nonzero(masks)
        self.pixel = self.row * masks.shape[2] + self.column
        ends = np.searchsorted(self.surface, np.arange(len(masks) + 1))
        self.parts = [slice(int(a), int(b)) for a, b in itertools.pairwise(ends)]
        places = (self.pixel[part] for part in self.parts)
        self.functions = [basis.evaluate(p) for basis, p in zip(bases, places, strict=True)]
        self._directions = compute_ray_directions(self.camera, self.row, self.column)
        axis_row, axis_column = self.camera.optical_axis_px
        self._x, self._y = self.column - axis_column, self.row - axis_row
        self.ray_length = 1 / self._directions[:, 2]
        self.beside = self._find_neighbours()
        self.outer = np.flatnonzero(np.isin(self.column, [0, masks.shape[2] - 1]))
        self.behind = np.zeros(self.surface.size, bool)
        self.aside = np.zeros((2, self.surface.size))

    def lay_out(
        self,
        masks: NDArray[np.bool_],
        bases: Sequence[SmoothBasis],
        state: SurfaceState,
        seen: FloatArray | None = None,
    ) -> SurfaceModel:
        """Return a model of other surfaces before the same shot; `seen` (3, surfaces, rows, columns): of
        `_draw_points`, as far as it is known.
        """
        other = copy.copy(self)
        other._cover(masks, bases)
        if seen is not None:
            behind, *aside = seen[:, masks]
            other.behind, other.aside = behind > 0, np.array(aside)
        other.place(state)
        return other

    def _draw_points(self, surfaces: int) -> FloatArray:
        """Which points lie behind another surface, and where in its pixel the middle of each one's light is,
        px to the right and down, (3, surfaces, rows, columns).
        """
        seen = np.zeros((3, surfaces, *self.masks.shape[1:]))
        seen[:, self.surface, self.row, self.column] = self.behind, *self.aside
        return seen

    def cover(self, masks: NDArray[np.bool_]) -> SurfaceModel:
        """Return the same surfaces, each where its mask is; those without any are left out."""
        left, state = np.flatnonzero(masks.any(axis=(1, 2))), self.state.copy()
        bases, shapes = [self.bases[k] for k in left], [state.coefficients[k] for k in left]
        state = replace(state, coefficients=shapes, shading=state.shading[left])
        return self.lay_out(masks[left], bases, state, self._draw_points(len(masks))[:, left])

    def add(self, masks: NDArray[np.bool_], inverse: FloatArray) -> SurfaceModel:
        """Return the same surfaces, and behind them others whose inverse depths are known, 1/m; both
        (surfaces, rows, columns).
        """
        known = [KnownBasis(self.camera.image_shape, inverse=one) for one in inverse]
        shapes = [*self.state.coefficients, *([np.ones(1)] * len(known))]
        shading = np.pad(self.state.shading, ((0, len(known)), (0, 0)))
        state = replace(self.state.copy(), coefficients=shapes, shading=shading)
        masks = np.concatenate([self.masks, masks])
        return self.lay_out(masks, [*self.bases, *known], state, self._draw_points(len(masks)))

    def place(self, state: SurfaceState) -> None:
        """Move the surfaces to where `state` has them."""
        self.state = state
        shapes = list(zip(self.bases, self.functions, state.coefficients, strict=True))
        inverse = np.concatenate([basis.compute_inverse(f, c) for basis, f, c in shapes])
        # of each surface, (points, coefficients), of the inverse depths
        self.derivatives = [basis.differentiate(f, c) for basis, f, c in shapes]
        self.distance = np.asarray(self.ray_length / np.maximum(inverse, MIN_INVERSE_DEPTH))
        self.places = Places.split(
            self.distance, self.compute_slopes(), self.aside, self.pulse.sigma, self.row_m
        )
        # (views, outer points), the fraction by which each view sees more or less of a point in the
        # picture's outer columns than the reference view, if its picture ends where its own does
        depth = self.distance[self.outer] / self.ray_length[self.outer]
        left = np.where(self.column[self.outer] == 0, 1, -1) * self.camera.shear_at(depth)
        self.excess = np.clip(np.outer(self.camera.view_positions, left), -1, 1)
        self.half = int(np.ceil(EXTENT_SIGMAS * MAX_LENGTHENING * self.pulse.sigma)) + 1
        self._margin = self.half + 3
        self._lags = np.arange(-self.half, self.half + 1)
        # rows before and behind the streak image whose light reaches it later or earlier
        self.before = int(max(self.pulse.lags.max(), 0))
        self._rows = self.before + self.image.shape[0] + int(max(-self.pulse.lags.min(), 0))
        where = self._find_parts()
        spread = self.share_out(
            lambda views: [self._spread_view(view, *where) for view in views], self.camera.views
        )
        self.footprints = list(itertools.chain.from_iterable(spread))
        self.kernels = [self.make_kernel(view) for view in range(self.camera.views)]
        # rows that light of any view reaches, as those of `Footprint` count, and of the streak image
        rows = np.concatenate([place.first_row + place.lit_rows for place in self.footprints])
        last = int(rows.max(initial=-1)) + 1
        self._lit_before = slice(int(rows.min(initial=last)), last)
        first = self._lit_before.start - self.before + int(self.pulse.lags.min())
        last = min(last - self.before + int(self.pulse.lags.max()), self.image.shape[0])
        self._lit = slice(min(max(first, 0), max(last, 0)), max(last, 0))
        self._find_shades()

    def fill_partly(self, amplitude: Image) -> None:
        """Put the light of pixels that a surface fills in part on the side of the brighter of the pixels
        beside them: as much as is missing from what these, going on as they do, would make it.
        """
        beyond = np.take_along_axis(self.beside, self.beside, axis=-1)
        before, behind = self.find_light_beside(amplitude).swapaxes(0, 1)
        ahead, after = amplitude[beyond].swapaxes(0, 1)
        dark, bright = np.minimum(before, behind), np.maximum(before, behind)
        further = np.where(behind > before, after, ahead)
        whole = np.clip(2 * bright - further, dark, bright)
        light = np.clip(amplitude, dark, whole)
        part = (light - dark) / np.maximum(whole - dark, TINY)
        away = (
            (1 - np.maximum(part, LEAST_FILLED)) / 2 * (light - dark) / np.maximum(amplitude, TINY)
        )
        self.aside = np.where(behind > before, away, -away).astype(np.float64)
        self.place(self.state)

    def find_light_beside(self, amplitude: Image) -> Image:
        """Return the amplitudes of the points beside each, as `beside`, (2, 2, points); 0 where none is."""
        own = np.arange(amplitude.size)
        return np.where(self.beside == own, 0, amplitude[self.beside])

    def _find_neighbours(self) -> NDArray[np.intp]:
        """Numbers of the points of the same surface beside each, (2, 2, points): along columns and
        rows, before and behind; its own where there is none. What is only known at single pixels is
        no surface.
        """
        surfaces, rows, columns = self.masks.shape
        number = np.full((surfaces, rows + 2, columns + 2), -1)
        own = np.arange(self.surface.size)
        y, x = self.row + 1, self.column + 1
        number[self.surface, y, x] = own
        single = np.array([isinstance(basis, KnownBasis) for basis in self.bases], bool)
        number[single] = -1
        steps = [[(0, -1), (0, 1)], [(-1, 0), (1, 0)]]
        found = [
            [number[self.surface, y + down, x + right] for down, right in pair] for pair in steps
        ]
        return np.where(np.array(found) < 0, own, found)

    def _find_parts(self) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Where parts of points are, (places,) each: from the optical axis of the picture, px, to the right
        and down; from that of the lens, m, to the right; and by how much views see them sheared.
        """
        axis_row, axis_column = self.camera.optical_axis_px
        x, y = (
            one[self.places.point] + off
            for one, off in zip((self._x, self._y), self.places.offset, strict=True)
        )
        ways = compute_ray_directions(self.camera, y + axis_row, x + axis_column)
        right, _, depth = self.places.distance * ways.T
        return x, y, right, self.camera.shear_at(depth)

    def _spread_view(
        self, view: int, x: FloatArray, y: FloatArray, right: FloatArray, shear: FloatArray
    ) -> Footprint:
        """Return which rows and columns of a view the light of points reaches. Nothing of what
        misses the streak image is kept: a surface may run off without end, and one that comes close
        is spread over all of the slit's plane.
        """
        from tofclip.recovery.surfaces import kernels

        rows, margin, samples = self._rows, self._margin, kernels.SPLINE_SAMPLES
        row, column, slit, pace = self._locate(view, x, y, right, shear)
        first_parts = self.places.starts[:-1]
        place = slit[first_parts], self.measure_height(row[first_parts])
        row += self.before
        columns = self.image.shape[1]
        away, last = margin + samples, rows + margin - samples
        first, shares = kernels.split_between_rows(np.clip(row, -away, rows + away))
        dark = (first <= -margin) | (first >= last)
        shares[dark] = 0
        seen = first[~dark]  # the others are among these
        np.clip(first, seen.min(initial=last), seen.max(initial=-margin), out=first)
        slit_first = np.empty(row.size, np.int32)
        slit_shares = np.empty((row.size, SLIT_PIXELS), np.float32)
        outward, further = self._reach_out(view)
        column += outward
        along = np.clip(column, -SLIT_PIXELS, columns + SLIT_PIXELS)
        tangent = float(np.tan(self.camera.angles[view]))
        across, down = self.places.size
        across = across * (1 + further)
        kernels.split_over_slit(along, across, down, tangent, slit_first, slit_shares)
        slit_shares[along != column] = 0
        left = int(slit_first.min(initial=columns))
        wide = max(int(slit_first.max(initial=-SLIT_PIXELS)) + SLIT_PIXELS - left, 0)
        hit = np.bincount(first + margin, minlength=rows + 2 * margin)
        reached = np.convolve(hit, np.ones(samples))[: hit.size] > 0
        lit = np.convolve(reached, np.ones(2 * self.half + 1), "same")[margin:-margin] > 0
        lines = np.flatnonzero(lit)
        top = int(lines.min(initial=rows)) - margin
        high = int(lines.max()) + margin + 1 - top if lines.size else 0
        first -= np.int32(top)
        slit_first -= np.int32(left)
        light = first, shares, slit_first, slit_shares, (high, wide), top, left
        reached_rows = np.flatnonzero(reached) - margin - top
        return Footprint(*light, lines - top, reached_rows, *place, pace)

    def _reach_out(self, view: int) -> tuple[FloatArray, FloatArray]:
        """Where a view's picture ends beyond the outer columns: by how much parts of points lie further to
        the right, px, and are wider, relative, (places,) each.
        """
        further, side = np.zeros((2, self.surface.size))
        further[self.outer] = self.state.borders * self.excess[view]
        side[self.outer] = np.where(self.column[self.outer] == 0, -1, 1)
        further, side = further[self.places.point], side[self.places.point]
        return side * further * (0.5 + side * self.places.offset[0]), further

    def _locate(
        self, view: int, x: FloatArray, y: FloatArray, right: FloatArray, shear: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray, float]:
        """Where parts of points fall in a view, (places,): row and column of the raw streak image, and
        column before the sweep distorts it; and how many raw rows the time of one takes.
        """
        camera, position = self.camera, self.camera.view_positions[view]
        distance, aside = self.places.distance, camera.lenslet_pitch * position
        back = np.sqrt(distance**2 + aside * (aside - 2 * right))
        column = slit = (
            camera.centres_px[view]
            + self.state.centres[view]
            + x
            - y * np.tan(camera.angles[view])
            + shear * position
        )
        time = (distance + back) / SPEED_OF_LIGHT + camera.time_zero
        row, pace = interpolate_linearly(time, self.times, np.arange(float(self.times.size))), 1.0
        if camera.sweep is not None:
            few = slice(None, None, PACE_PLACES)
            later, _ = camera.sweep.raw_position(row[few] + 0.5, column[few])
            row, raw_column = camera.sweep.raw_position(row, column)
            pace = 2 * float(np.mean(later - row[few])) if row.size else 1.0
            column = np.array(raw_column, np.float64)
        delay, stretch = (
            interpolate_linearly(slit, camera.centres_px, one)
            for one in (self.state.delays, self.state.stretches)
        )
        return row + delay + stretch * self.measure_height(row), column, slit, pace

    def measure_height(self, row: NDArray[Any]) -> FloatArray:
        """Return rows as fractions of the streak image from its middle."""
        return np.asarray(row / self.times.size - 0.5)

    def make_kernel(
        self, view: int, relative_width: float = 1.0, variance: float = SPLINE_LEFT_VARIANCE
    ) -> Image:
        """Return the pulse's core with which light between rows is smoothed, of so many widths of the
        view's own and less the variance, rows^2, that is there already.
        """
        rows_per_instant = self.footprints[view].rows_per_instant
        sigma = self.pulse.sigma * rows_per_instant * self.state.widths[view] * relative_width
        return make_pulse(sigma, self.half, variance)

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
        self._find_shades()

    def see(self, streak: Streak) -> SurfaceModel:
        """Return the same surfaces before another shot of the camera, as noisy in the dark."""
        other = copy.copy(self)
        other.image, other.weights = weigh_measurements(streak, self.camera, self.dark)
        return other

    def respond(self, pulse: ShotPulse) -> SurfaceModel:
        """Return the same surfaces as another pulse shows them."""
        other = copy.copy(self)
        other.pulse = pulse
        other.place(self.state)
        return other

    def unexplained(self, amplitude: Image) -> float:
        """What is left of the signal, as a fraction."""
        return compare_smoothed(self.render(amplitude), self.image, self.weights > 0)

    def find_quadratic(self, points: NDArray[np.intp], amplitude: Image) -> FloatArray:
        """Return the coefficients, (6,), of the quadratic that is nearest to some points, the more the
        brighter they are.
        """
        light = np.sqrt(amplitude[points].astype(np.float64))
        design = evaluate_monomials(self.pixel[points], self.masks.shape[1:])
        inverse = light * self.ray_length[points] / self.distance[points]
        nearest, *_ = np.linalg.lstsq(light[:, np.newaxis] * design, inverse)
        return nearest.astype(np.float64)

    def straighten(self, quadratics: dict[int, FloatArray]) -> SurfaceModel:
        """Return the same surfaces, some of them quadratics of such coefficients, (6,) each."""
        other, state = copy.copy(self), self.state.copy()
        other.bases, other.functions = list(self.bases), list(self.functions)
        for surface, coefficients in quadratics.items():
            basis = SmoothBasis(self.bases[surface].image_shape)
            state.coefficients[surface], other.bases[surface] = coefficients, basis
            other.functions[surface] = basis.evaluate(self.pixel[self.parts[surface]])
        other.place(state)
        return other

    def estimate_deviation(self, covariances: Sequence[FloatArray]) -> FloatArray:
        """Standard deviations of all ranges, (points,), by covariances of surfaces' coefficients."""
        known = zip(self.derivatives, covariances, strict=True)
        variance = np.concatenate([np.sum((m @ c) * m, axis=1) for m, c in known])
        # range = length / inverse depth
        return np.asarray(self.distance**2 / self.ray_length * np.sqrt(variance))

    def estimate_sweep_error(self) -> float:
        """Return by how much all ranges may be off, m, because the sweep is of another shape than is
        solved for: a part of what the fit had to correct of it.
        """
        # a height is even between -1/2 and 1/2
        corrected = np.mean(self.state.delays**2 + self.state.stretches**2 / 12)
        return SWEEP_LEFT_FRACTION * float(np.sqrt(corrected)) * self.row_m

    def compute_slopes(self) -> FloatArray:
        """Return how steeply the ranges change along columns and rows, (2, points), m per pixel."""
        before, behind = self.beside[:, 0], self.beside[:, 1]
        own = np.arange(self.distance.size)
        apart = np.maximum((before != own).astype(int) + (behind != own), 1)
        return np.asarray((self.distance[behind] - self.distance[before]) / apart)

    def share_out(self, work: Callable[[range], Result], jobs: int) -> list[Result]:
        """Return ``work(share)`` of each thread's share of all views or surfaces."""
        threads = thread_count() if self.is_large else 1
        shares = [range(jobs)[own] for own in split_blocks(jobs, -(-jobs // threads))]
        return list(self.map(work, shares))

    def map(self, work: Callable[[Job], Result], jobs: Iterable[Job]) -> Iterator[Result]:
        """Yield ``work(job)`` for each view or surface, on several threads if it is worth them."""
        return map_parallel(work, jobs) if self.is_large else map(work, jobs)

    @property
    def is_large(self) -> bool:
        """Whether threads are worth their beginning."""
        return self.surface.size >= PARALLEL_POINTS

    def receive(
        self, view: int, amplitude: Image, kernel: Image, part: slice = slice(None)
    ) -> Window:
        """Return what streak images receive of some points by a view. `amplitude`: of the points in
        `part`, (points,), or for each of n images (n, points); `kernel` (taps,): of the pulse's core.
        """
        lights, place = np.atleast_2d(amplitude), self.footprints[view]
        rows, columns = box = self._find_box(view, part)
        first, last = (int(rows[0]), int(rows[-1]) + 1) if rows.size else (0, 0)
        top, bottom = place.first_row + first, place.first_row + last
        left, right = (
            min(max(place.first_column + one, 0), self.image.shape[1])
            for one in (columns.start, columns.stop)
        )
        light = np.zeros((len(lights), bottom - top, right - left), np.float32)
        self._project(view, lights, kernel, part, box, (top, left), light)
        first = max(top - self.before + int(self.pulse.lags.min()), 0)
        last = min(bottom - self.before + int(self.pulse.lags.max()), self.image.shape[0])
        return Window(first, left, self._trail(light, first + self.before - top, last - first))

    def _find_box(self, view: int, part: slice) -> Box:
        """Rows and columns of a view's picture that the light of some points reaches."""
        from tofclip.recovery.surfaces.kernels import SPLINE_SAMPLES

        place = self.footprints[view]
        begin, end, _ = part.indices(self.surface.size)
        own = slice(int(self.places.starts[begin]), int(self.places.starts[end]))
        row, column = place.row[own], place.column[own]
        if not (row.size and place.lit_rows.size):
            return place.lit_rows[:0], slice(0, 0)
        reach = int(row.min()) - self.half, int(row.max()) + SPLINE_SAMPLES + self.half
        own = slice(*np.searchsorted(place.lit_rows, reach))
        return place.lit_rows[own], slice(int(column.min()), int(column.max()) + SLIT_PIXELS)

    def _project(
        self,
        view: int,
        lights: Image,
        kernel: Image,
        part: slice,
        box: Box,
        corner: tuple[int, int],
        images: Image,
    ) -> None:
        """Add what a view sees of some points, (n, points), without their afterglow, to n images.
        `box`: that they reach; `corner`: the images' first row, as those of `Footprint` count, and column.
        """
        from tofclip.recovery.surfaces.kernels import add_light, smooth_rows

        place, (rows, columns), margin = self.footprints[view], box, self._margin
        if not rows.size:
            return
        top, left = int(rows[0]) - margin, columns.start
        size = int(rows[-1]) + 1 + margin - top, columns.stop - left
        light = np.zeros((len(lights), *size), np.float32)
        begin, end, _ = part.indices(self.surface.size)
        starts, shares = self.places.starts[begin : end + 1], self._shares[view, part]
        spread = place.row, place.row_shares, place.column, place.slit_shares
        add_light(lights, shares, starts, *spread, top, left, light)
        below, aside = corner[0] - place.first_row, corner[1] - place.first_column
        smooth_rows(light, kernel, self._lags, rows - below, below - top, aside - left, images)

    def _trail(self, light: Image, first: int, rows: int) -> Image:
        """Some rows of light, (n, rows, columns), with its afterglow, from row `first` of it on."""
        from tofclip.recovery.surfaces.kernels import smooth_rows

        rows = max(rows, 0)
        if not self.pulse.reach:
            return light[:, first : first + rows]
        images = np.zeros((len(light), rows, light.shape[2]), np.float32)
        shares = self.pulse.shares.astype(np.float32)
        smooth_rows(light, shares, self.pulse.lags, np.arange(rows), first, 0, images)
        return images

    def render(self, amplitude: Image) -> Image:
        """Return A a, (rows, columns)."""
        image = np.zeros_like(self.image)
        image[self._lit] = self._render_lit(amplitude)
        return image

    def render_instants(self, amplitude: Image) -> Image:
        """Return the image, (rows, columns), of a pulse of an instant, without what follows it."""
        plain = self.respond(ShotPulse(self.pulse.sigma)) if self.pulse.reach else self
        image, instant = np.zeros_like(self.image), (self._lags == 0).astype(np.float32)
        for view in range(self.camera.views):
            window = plain.receive(view, amplitude, instant)
            image[window.area] += window.images[0]
        return image

    def _render_lit(self, amplitude: Image) -> Image:
        """The rows of A a that light reaches."""
        rows = self._lit_before

        def work(views: range) -> Image:
            seen = np.zeros((1, rows.stop - rows.start, self.image.shape[1]), np.float32)
            for view in views:
                place, lights = self.footprints[view], amplitude[np.newaxis]
                box, corner = (place.lit_rows, slice(0, place.shape[1])), (rows.start, 0)
                self._project(view, lights, self.kernels[view], slice(None), box, corner, seen)
            return seen

        light = reduce(np.add, self.share_out(work, self.camera.views))
        first = self._lit.start + self.before - rows.start
        return self._trail(light, first, self._lit.stop - self._lit.start)[0]

    def pull(self, amplitude: Image, image: Image | None = None) -> Image:
        """Return A'W(A a - image), (points,), how the misfit changes with amplitudes; without an image
        A'WA a.
        """
        rest = self._render_lit(amplitude)
        if image is not None:
            rest -= image[self._lit]
        rest *= self.weights[self._lit]
        return self._gather_lit(rest)

    def gather(self, image: Image, squared: bool = False) -> Image:
        """Return A' of an image, (points,); squared: with the squares of all entries."""
        return self._gather_lit(image[self._lit], squared)

    def gather_views(self, image: Image) -> list[Image]:
        """Return what each view adds to A' of an image, (points,) each."""
        lit = self._spread_back(image[self._lit])
        return [self._gather(lit, (view,)) for view in range(self.camera.views)]

    def _gather_lit(self, image: Image, squared: bool = False) -> Image:
        """A' of the rows of an image that light reaches."""
        seen = image if squared else self._spread_back(image)
        shares = self.share_out(partial(self._gather, seen, squared=squared), self.camera.views)
        return reduce(np.add, shares)

    def _spread_back(self, image: Image) -> Image:
        """The adjoint of `_trail`, from the rows of an image that light reaches."""
        from tofclip.recovery.surfaces.kernels import smooth_rows

        if not self.pulse.reach:
            return image
        rows = self._lit_before
        seen = np.zeros((1, rows.stop - rows.start, image.shape[1]), np.float32)
        lines = np.arange(seen.shape[1]), rows.start - self._lit.start - self.before
        shares = self.pulse.shares.astype(np.float32)
        smooth_rows(image[np.newaxis], shares, -self.pulse.lags, *lines, 0, seen)
        return seen[0]

    def _gather(self, seen: Image, views: Sequence[int], squared: bool = False) -> Image:
        """What some views find for points in light before its afterglow, (points,); squared: with the
        squares of all entries, of which the afterglow is a part.
        """
        from tofclip.recovery.surfaces.kernels import gather_light, smooth_rows

        found = np.zeros((1, self.surface.size), np.float32)
        above, lags = self._lit_before.start, self._lags
        if squared or not self.pulse.reach:
            above = self._lit.start + self.before
        for view in views:
            place, kernel, shares = self.footprints[view], self.kernels[view], self._shares[view]
            if not place.lit_rows.size:
                continue
            slit_shares = place.slit_shares
            if squared:  # a pulse is smooth: the square of its samples between rows is theirs
                kernel = self.pulse.extend(self.make_kernel(view, variance=0.0)) ** 2
                slit_shares = slit_shares**2
                lags = np.arange(kernel.size) - kernel.size // 2
                shares = shares**2 * self.places.overlap / self.places.share
            light = np.zeros((1, *place.shape), np.float32)
            below = place.first_row - above
            lines = -lags, place.reached_rows, below, place.first_column
            smooth_rows(seen[np.newaxis], kernel, *lines, light)
            spread = place.row, place.row_shares, place.column, slit_shares
            gather_light(light, shares, self.places.point, *spread, found)
        return found[0]

    def shade(self, view: int, amplitude: Image) -> Image:
        """Return amplitudes, (points,), as a view sees them."""
        return np.asarray(amplitude * self._shades[view], np.float32)

    def _find_shades(self) -> None:
        """How bright each view sees each point, (views, points), beside its amplitude; and how much light
        it has of each of the point's places.
        """
        shading = np.exp(np.where(self.behind, self.state.shading.T[:, self.surface], 0))
        shading[:, self.outer] *= np.maximum(1 + self.state.borders * self.excess, 0)
        self._shades = shading.astype(np.float32)
        shading *= self.state.gains[:, np.newaxis]
        self._shares = (shading * self.places.share).astype(np.float32)
