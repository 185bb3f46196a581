"""Where the points of surfaces are, and where their light falls.

A point p of surface k at range r_k(p) falls, in view v, on

    slit column   centres_v + X - Y tan(angle_v) + shear(z) u_v
    raw row       sweep((r + |point - view|) / c + time zero) + delay_v + stretch_v (row / rows - 1/2)

and its light is spread over the slit by the pixel's own size, and over time by how much of its
surface's range a pixel spans.
"""

from __future__ import annotations

import copy
import itertools
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from tofclip.arrays import FloatArray
from tofclip.camera import Camera
from tofclip.camera.model import interpolate_linearly
from tofclip.lidar import compute_ray_directions
from tofclip.recovery.surfaces.pulse import (
    EXTENT_SIGMAS,
    TINY,
    Image,
    ShotPulse,
)
from tofclip.recovery.surfaces.shapes import (
    KnownBasis,
    QuadricBasis,
    SmoothBasis,
    evaluate_monomials,
    fit_quadric,
)
from tofclip.shots import Streak
from tofclip.threads import map_parallel, split_blocks, thread_count
from tofclip.units import FWHM_PER_SIGMA, SPEED_OF_LIGHT

Job = TypeVar("Job")
Result = TypeVar("Result")
Shape = tuple[SmoothBasis, FloatArray]  # of a surface's inverse depth, with its coefficients

# Rows that a part of a pixel spans where a surface is turned far, those from which on a side has two parts, and parts
# along a side at most. A pulse of a row or more hardly tells so narrow a ramp from an instant; but a pixel of a ball is
# not where its middle is: with one part in the middle of the ball it was 0.1 mm too near there, and too far about it.
PART_ROWS, LEVEL_ROWS, BENT_ROWS, MAX_PARTS = 1.5, 1.0, 0.5, 6
LEAST_FILLED = 0.1  # of a pixel's side, by a surface that ends in it
MAX_LENGTHENING = 1.5  # pulses that turn out longer than the camera's are cut off beyond
MIN_INVERSE_DEPTH = 1e-3  # 1/m; a surface that bends away ends a kilometre off
PACE_PLACES = 16  # one of so many says how long rows take, on average
# Threads are not worth their beginning below: of a room and a bush, 128 x 128 px, two took 15 to 18 and 40 s of
# processor time in 12 to 15 and 34 s, one 13 and 29 in 12 and 27.
PARALLEL_POINTS = 60_000


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


class Places(NamedTuple):
    """Parts of the points' pixels, each so small that its light arrives at one instant: a pixel on
    a surface that is turned far spans many bins of range.
    """

    point: NDArray[np.intp]  # (places,), the point of which each is a part; ascending
    starts: NDArray[np.intp]  # (points + 1,), number of each point's first
    offset: FloatArray  # (2, places), from the pixel's middle along columns and rows, px
    size: FloatArray  # (2, places), along columns and rows, px
    distance: FloatArray  # (places,), m
    share: Image  # (places,), of its point's light
    # (points,), sum of squares of what parts have in common, over that of the pulse alone
    overlap: Image
    narrower: FloatArray  # (2, points), squared sides of the whole less those of a part, px^2

    @classmethod
    def split(
        cls,
        distance: FloatArray,
        slopes: FloatArray,
        aside: FloatArray,
        bent: NDArray[np.bool_],
        pulse_rows: float,
        row_m: float,
    ) -> Places:
        """Split points by the slopes of their surfaces, m per pixel; `aside`: where the middle of their
        light is, px from the pixel's; both (2, points); `bent` (points,): those of
        surfaces of second order in space.
        """
        filled = 1 - 2 * np.abs(aside)
        slopes = slopes * filled
        rows = np.abs(slopes) / row_m
        least = 1 + (rows > np.where(bent, BENT_ROWS, LEVEL_ROWS))
        counts = np.clip(np.ceil(rows / PART_ROWS), least, MAX_PARTS).astype(np.intp)
        total = counts[0] * counts[1]
        point = np.repeat(np.arange(distance.size), total)
        starts = np.concatenate([[0], np.cumsum(total)])
        right, down = np.divmod(np.arange(point.size) - starts[point], counts[1, point])
        size, begin, steep = (
            np.take(one, point, axis=1)
            for one in (filled / counts, aside - 0.5 * filled, slopes / filled)
        )
        offset = (np.stack([right, down]) + 0.5) * size + begin
        away = np.sum(offset * steep, axis=0)
        ramp = np.hypot(*slopes) / row_m / pulse_rows  # pulses that a pixel spans
        overlap = (1 / np.sqrt(1 + ramp**2 / 12)).astype(np.float32)
        share, narrower = (1 / total[point]).astype(np.float32), filled**2 * (1 - 1 / counts**2)
        return cls(point, starts, offset, size, distance[point] + away, share, overlap, narrower)

    def choose(self, distance: FloatArray, light: FloatArray) -> Places:
        """Return those that have light, (places,), at such distances."""
        kept = np.flatnonzero(light > 0)
        point = self.point[kept]
        share = light[kept] / np.bincount(point, light[kept])[point]
        return self._replace(
            point=point,
            starts=np.concatenate([[0], np.cumsum(np.bincount(point))]),
            offset=np.take(self.offset, kept, axis=1),
            size=np.take(self.size, kept, axis=1),
            distance=distance[kept],
            share=share.astype(np.float32),
        )


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


class SurfacePoints:
    """The points of surfaces before one shot, and where each view has their light.

    `camera`: with its sweep; `masks` (surfaces, rows, columns): where each surface may be; `bases`:
    of the surfaces' inverse depths; `pulse`: A Gaussian of the camera's width by default.

    Memory: 40 bytes for each part of a point and view.
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
        self.camera, self.shape = camera, streak.counts.shape
        self.times, self.bin_width = streak.times, float(np.mean(np.diff(streak.times)))
        self.reference = int(np.argmin(np.abs(camera.view_positions)))
        self.row_m = self.bin_width * SPEED_OF_LIGHT / 2
        self.pulse = pulse or ShotPulse(camera.pulse_fwhm / self.bin_width / FWHM_PER_SIGMA)
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
        axis_row, axis_column = self.camera.optical_axis_px
        self._x, self._y = self.column - axis_column, self.row - axis_row
        self.ray_length = 1 / compute_ray_directions(self.camera, self.row, self.column)[:, 2]
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
    ) -> Self:
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

    def cover(self, masks: NDArray[np.bool_]) -> Self:
        """Return the same surfaces, each where its mask is; those without any are left out."""
        left, state = np.flatnonzero(masks.any(axis=(1, 2))), self.state.copy()
        bases, shapes = [self.bases[k] for k in left], [state.coefficients[k] for k in left]
        state = replace(state, coefficients=shapes, shading=state.shading[left])
        return self.lay_out(masks[left], bases, state, self._draw_points(len(masks))[:, left])

    def add(self, masks: NDArray[np.bool_], inverse: FloatArray) -> Self:
        """Return the same surfaces, and behind them others whose inverse depths are known, 1/m; both
        (surfaces, rows, columns).
        """
        known = [KnownBasis(self.camera.image_shape, inverse=one) for one in inverse]
        shapes = [*self.state.coefficients, *([np.ones(1)] * len(known))]
        shading = np.pad(self.state.shading, ((0, len(known)), (0, 0)))
        state = replace(self.state.copy(), coefficients=shapes, shading=shading)
        masks = np.concatenate([self.masks, masks])
        return self.lay_out(masks, [*self.bases, *known], state, self._draw_points(len(masks)))

    def reshape(self, shapes: dict[int, Shape]) -> Self:
        """Return the same surfaces, some of them of other shapes."""
        other, state = copy.copy(self), self.state.copy()
        other.bases, other.functions = list(self.bases), list(self.functions)
        for surface, (basis, coefficients) in shapes.items():
            state.coefficients[surface], other.bases[surface] = coefficients, basis
            other.functions[surface] = basis.evaluate(self.pixel[self.parts[surface]])
        other.place(state)
        return other

    def place(self, state: SurfaceState) -> None:
        """Move the surfaces to where `state` has them."""
        self.state = state
        shapes = list(zip(self.bases, self.functions, state.coefficients, strict=True))
        inverse = np.concatenate([basis.compute_inverse(f, c) for basis, f, c in shapes])
        # of each surface, (points, coefficients), of the inverse depths
        self.derivatives = [basis.differentiate(f, c) for basis, f, c in shapes]
        self.distance = np.asarray(self.ray_length / np.maximum(inverse, MIN_INVERSE_DEPTH))
        bent = np.isin(np.arange(len(self.bases)), list(self._list_quadrics()))[self.surface]
        slopes = self.compute_slopes()
        self.places = Places.split(
            self.distance, slopes, self.aside, bent, self.pulse.sigma, self.row_m
        )
        self._follow_limbs()
        # (views, outer points), the fraction by which each view sees more or less of a point in the
        # picture's outer columns than the reference view, if its picture ends where its own does
        depth = self.distance[self.outer] / self.ray_length[self.outer]
        left = np.where(self.column[self.outer] == 0, 1, -1) * self.camera.shear_at(depth)
        self.excess = np.clip(np.outer(self.camera.view_positions, left), -1, 1)
        # places there, the number of each one's point among these, and the side on which it lies
        there = self.column[self.places.point]
        outer = np.flatnonzero((there == 0) | (there == self.masks.shape[2] - 1))
        number = np.searchsorted(self.outer, self.places.point[outer])
        self._outer_parts = outer, number, np.where(there[outer] == 0, -1, 1)
        self.half = int(np.ceil(EXTENT_SIGMAS * MAX_LENGTHENING * self.pulse.sigma)) + 1
        self.margin = self.half + 3
        # rows before and behind the streak image whose light reaches it later or earlier
        self.before = int(max(self.pulse.lags.max(), 0))
        self._rows = self.before + self.shape[0] + int(max(-self.pulse.lags.min(), 0))
        where = self._find_parts()
        spread = self.share_out(
            lambda views: [self._spread_view(view, *where) for view in views], self.camera.views
        )
        self.footprints = list(itertools.chain.from_iterable(spread))

    def _list_quadrics(self) -> dict[int, QuadricBasis]:
        """Surfaces of second order in space, by number."""
        return {k: one for k, one in enumerate(self.bases) if isinstance(one, QuadricBasis)}

    def _follow_limbs(self) -> None:
        """Put parts of pixels where surfaces of second order are, as bright as they face the camera, and leave
        out those beyond a limb: there a pixel spans so much range that no line follows it. A point is where
        all that is left of it is on average.
        """
        places, size = self.places, self.distance.size
        # of each point, how much of its light turning away leaves, and whether its surface ends in it or before
        self.facing, self.at_limb = np.ones(size), np.zeros(size, bool)
        curved = self._list_quadrics()
        if not curved:
            return
        distance = places.distance.copy()
        within, area, light = np.ones((3, places.point.size))
        for surface, basis in curved.items():
            part, coefficients = self.parts[surface], self.state.coefficients[surface]
            own = slice(int(places.starts[part.start]), int(places.starts[part.stop]))
            point, offset = places.point[own], places.offset[:, own]
            seen = self.pixel[point], offset, places.size[:, own], coefficients
            inverse, slope, within[own] = basis.look_between(*seen)
            inverse = np.maximum(inverse, MIN_INVERSE_DEPTH)
            there = np.bincount(point - part.start, within[own])[point - part.start] > 0
            _, _, ways = self._aim_at(point, offset)
            distance[own] = np.where(there, 1 / ways[:, 2] / inverse, distance[own])
            facing = 1 / np.hypot(1, self.camera.focal_length_px * slope / inverse)
            area[own] = np.where(there, within[own], 1)
            light[own] = np.where(there, facing * within[own], 1)
        self.places = places.choose(distance, light)
        parts, found = np.diff(places.starts), (within, light, area, area * distance)
        inside, lights, areas, total = (np.bincount(places.point, one) for one in found)
        self.facing, self.at_limb = lights / parts, inside < parts
        for surface in curved:
            part = self.parts[surface]
            self.distance[part] = total[part] / areas[part]

    def fill_partly(self, amplitude: Image) -> None:
        """Put the light of pixels that a surface fills in part on the side of the brighter of the pixels
        beside them: as much as is missing from what these, going on as they do, would make it, if all
        faced the camera.
        """
        amplitude = (amplitude / self.facing).astype(np.float32)
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
        # towards a limb light ends where the surface does
        self.aside[:, self.at_limb | self.at_limb[self.beside].any(axis=(0, 1))] = 0
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

    def _aim_at(
        self, point: NDArray[np.intp], offset: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Where parts of points are, (n,), from the optical axis of the picture, px, to the right and down, and
        the directions of their rays, (n, 3).
        """
        axis_row, axis_column = self.camera.optical_axis_px
        x, y = self._x[point] + offset[0], self._y[point] + offset[1]
        return x, y, compute_ray_directions(self.camera, y + axis_row, x + axis_column)

    def _find_parts(self) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Where parts of points are, (places,) each: from the optical axis of the picture, px, to the right
        and down; from that of the lens, m, to the right; and by how much views see them sheared.
        """
        x, y, ways = self._aim_at(self.places.point, self.places.offset)
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

        rows, margin, slits = self._rows, self.margin, kernels.SLIT_PIXELS
        row, column, slit, pace = self._locate(view, x, y, right, shear)
        first_parts = self.places.starts[:-1]
        place = slit[first_parts], self.measure_height(row[first_parts])
        row += self.before
        reached, columns = np.zeros(rows + 2 * margin, bool), self.shape[1]
        first, slit_first = np.empty((2, row.size), np.int32)
        shares = np.empty((row.size, kernels.SPLINE_SAMPLES), np.float32)
        kernels.split_between_rows(row, self.places.share, margin, first, shares, reached)
        slit_shares = np.empty((row.size, slits), np.float32)
        tangent = float(np.tan(self.camera.angles[view]))
        across, down = self._reach_out(view, column), self.places.size[1]
        kernels.split_over_slit(column, across, down, tangent, columns, slit_first, slit_shares)
        left = int(slit_first.min(initial=columns))
        wide = max(int(slit_first.max(initial=-slits)) + slits - left, 0)
        lit = np.convolve(reached, np.ones(2 * self.half + 1), "same")[margin:-margin] > 0
        lines = np.flatnonzero(lit)
        top = int(lines.min(initial=rows)) - margin
        high = int(lines.max()) + margin + 1 - top if lines.size else 0
        first -= np.int32(top)
        slit_first -= np.int32(left)
        light = first, shares, slit_first, slit_shares, (high, wide), top, left
        reached_rows = np.flatnonzero(reached) - margin - top
        return Footprint(*light, lines - top, reached_rows, *place, pace)

    def _reach_out(self, view: int, column: FloatArray) -> FloatArray:
        """Return how wide parts of points are, (places,), px, where a view's picture ends beyond the outer
        columns; their places on the slit, `column`, are moved.
        """
        across = self.places.size[0].copy()
        outer, further, side = self._outer_parts
        further = self.state.borders * self.excess[view, further]
        column[outer] += side * further * (0.5 + side * self.places.offset[0, outer])
        across[outer] *= 1 + further
        return across

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
            moved = np.append(row, row[few] + 0.5), np.append(column, column[few])
            raw_row, raw_column = camera.sweep.raw_position(*moved)
            row, later = np.split(raw_row, [row.size])
            pace = 2 * float(np.mean(later - row[few])) if row.size else 1.0
            column = np.array(raw_column[: row.size], np.float64)
        delay, stretch = (
            interpolate_linearly(slit, camera.centres_px, one)
            for one in (self.state.delays, self.state.stretches)
        )
        return row + delay + stretch * self.measure_height(row), column, slit, pace

    def measure_height(self, row: NDArray[Any]) -> FloatArray:
        """Return rows as fractions of the streak image from its middle."""
        return np.asarray(row / self.times.size - 0.5)

    def compute_slopes(self) -> FloatArray:
        """Return how steeply the ranges change along columns and rows, (2, points), m per pixel."""
        before, behind = self.beside[:, 0], self.beside[:, 1]
        own = np.arange(self.distance.size)
        apart = np.maximum((before != own).astype(int) + (behind != own), 1)
        return np.asarray((self.distance[behind] - self.distance[before]) / apart)

    def find_quadratic(self, points: NDArray[np.intp], amplitude: Image) -> Shape:
        """Return the quadratic that is nearest to some points, the more the brighter they are."""
        light = np.sqrt(amplitude[points].astype(np.float64))
        design = evaluate_monomials(self.pixel[points], self.masks.shape[1:])
        inverse = light * self.ray_length[points] / self.distance[points]
        nearest, *_ = np.linalg.lstsq(light[:, np.newaxis] * design, inverse)
        return SmoothBasis(self.camera.image_shape), nearest.astype(np.float64)

    def find_quadric(self, points: NDArray[np.intp]) -> Shape:
        """Return the surface of second order in space that is nearest to some points."""
        inverse = self.ray_length[points] / self.distance[points]
        return fit_quadric(self.pixel[points], inverse, self.camera.image_shape)

    def estimate_deviation(self, covariances: Sequence[FloatArray]) -> FloatArray:
        """Standard deviations of all ranges, (points,), by covariances of surfaces' coefficients."""
        known = zip(self.derivatives, covariances, strict=True)
        variance = np.concatenate([np.sum((m @ c) * m, axis=1) for m, c in known])
        # range = length / inverse depth
        return np.asarray(self.distance**2 / self.ray_length * np.sqrt(variance))

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
