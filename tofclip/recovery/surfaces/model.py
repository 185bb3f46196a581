"""The surface model A(r): amplitudes of surface points to a raw streak image, and back.

What falls on a row and a column of a view (`SurfacePoints`) is smoothed along rows by the view's pulse,
and followed by its afterglow. Nothing is rectified, so that the noise of the measurements stays
independent.

In this package: an amplitude is (points,), of all surfaces' points one after the other; an image is
(rows, columns), as the raw streak image; ranges are metres, and of rows i reaches from i - 1/2 to
i + 1/2.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial, reduce
from typing import Any, Self

import numpy as np
import scipy
from numpy.typing import NDArray

from tofclip.camera import Camera, estimate_dark_level
from tofclip.camera.model import MergedSweep
from tofclip.recovery.defects import estimate_noise
from tofclip.recovery.surfaces.patches import MIN_BEHIND_FRACTION
from tofclip.recovery.surfaces.points import SurfacePoints, SurfaceState
from tofclip.recovery.surfaces.pulse import (
    EXTENT_SIGMAS,
    SPLINE_LEFT_VARIANCE,
    TINY,
    Image,
    ShotPulse,
    make_pulse,
)
from tofclip.recovery.surfaces.shapes import SmoothBasis
from tofclip.shots import Streak

Box = tuple[NDArray[np.int64], slice]  # rows, ascending, and columns

MODEL_ERROR_FRACTION = 0.015  # of the brightest measurement: what the model leaves without noise
DARK_VARIANCES = 2.0  # of the dark: dark measurements hold more of what the model lacks
SMOOTHING_PX = 2.0
LONGER_ROWS = 3.0  # of merged ones, a long pulse's deviation: no more are needed
MIN_BEHIND_PX = 100  # of a surface, seen through another; fewer are a rim, of which each has a part
FRONT_FRACTION = 0.5  # of a surface's usual brightness: it ends where its rim is darker


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


def smooth_slit(images: Image, sigma_px: float) -> Image:
    """Smooth images, (n, rows, columns), along the slit; its own adjoint."""
    from tofclip.recovery.surfaces.kernels import smooth_columns

    kernel = make_pulse(sigma_px, int(np.ceil(EXTENT_SIGMAS * sigma_px)), 0.0)
    smooth = np.empty_like(images, order="C")
    smooth_columns(images, kernel, smooth)
    return smooth


def smooth_rows_evenly(image: Image, sigma: float) -> Image:
    """Smooth an image, (rows, columns), from row to row; beyond it is dark. That of scipy takes four times as
    long.
    """
    from tofclip.recovery.surfaces.kernels import smooth_rows

    half = int(np.ceil(EXTENT_SIGMAS * sigma))
    kernel, lags = make_pulse(sigma, half, 0.0), np.arange(-half, half + 1)
    smooth = np.zeros((1, *image.shape), np.float32)
    smooth_rows(image[np.newaxis], kernel, lags, np.arange(len(image)), 0, 0, smooth)
    return smooth[0]


def smooth_evenly(image: Image, sigma_px: float) -> Image:
    """Smooth an image, (rows, columns), in both directions."""
    return smooth_rows_evenly(smooth_slit(image[np.newaxis], sigma_px)[0], sigma_px)


def compare_smoothed(predicted: Image, measured: Image, valid: NDArray[np.bool_]) -> float:
    """Norm of what is left over that of the measurements, smoothed: photons' noise hardly counts."""
    error, signal = (
        float(np.linalg.norm(smooth_evenly(one * valid, SMOOTHING_PX)))
        for one in (measured - predicted, measured)
    )
    return error / signal if signal else 1.0


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


class SurfaceModel(SurfacePoints):
    """A(r) for one shot, with its image and what each measurement of it weighs.

    Memory: beside that of the points the raw image some four times.
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
        self.dark = estimate_dark_variance(streak)
        self.image, self.weights = weigh_measurements(streak, camera, self.dark)
        self.blur_px = 0.0
        super().__init__(streak, camera, masks, bases, state, pulse)

    def place(self, state: SurfaceState) -> None:
        super().place(state)
        self._lags = np.arange(-self.half, self.half + 1)
        self.kernels = [self.make_kernel(view) for view in range(self.camera.views)]
        # rows that light of any view reaches, as those of `Footprint` count, and of the streak image
        rows = np.concatenate([place.first_row + place.lit_rows for place in self.footprints])
        last = int(rows.max(initial=-1)) + 1
        self._lit_before = slice(int(rows.min(initial=last)), last)
        first = self._lit_before.start - self.before + int(self.pulse.lags.min())
        last = min(last - self.before + int(self.pulse.lags.max()), self.shape[0])
        self.lit = slice(min(max(first, 0), max(last, 0)), max(last, 0))
        self._find_shades()

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

    def see(self, streak: Streak) -> Self:
        """Return the same surfaces before another shot of the camera, as noisy in the dark."""
        other = copy.copy(self)
        other.image, other.weights = weigh_measurements(streak, self.camera, self.dark)
        return other

    def respond(self, pulse: ShotPulse) -> Self:
        """Return the same surfaces as another pulse shows them."""
        other = copy.copy(self)
        other.pulse = pulse
        other.place(self.state)
        return other

    def lengthen(self, sigma: float, amplitude: Image) -> Self:
        """Return the same surfaces before the shot as a longer pulse shows it, smoothed along rows: there those that
        are several pulses off still meet their light. Few rows hold it, in each of which several are added up. What
        is not valid is taken to be as amplitudes say.
        """
        number = max(int(sigma / LONGER_ROWS), 1)
        whole = self.times.size // number * number

        def merge(rows: NDArray[Any]) -> NDArray[Any]:
            return rows[:whole].reshape(-1, number, *rows.shape[1:])

        longer, camera, state = copy.copy(self), self.camera, self.state
        if camera.sweep is not None:
            longer.camera = camera.replace(sweep=MergedSweep(camera.sweep, number))
        longer.times = merge(self.times).mean(axis=1)
        longer.shape = longer.times.size, self.shape[1]
        longer.bin_width, longer.row_m = number * self.bin_width, number * self.row_m
        lags, own = np.unique(
            np.round(self.pulse.lags / number).astype(np.intp), return_inverse=True
        )
        width = float(np.hypot(self.pulse.sigma, sigma)) / number
        longer.pulse = ShotPulse(
            width, lags, np.bincount(own, self.pulse.shares).astype(np.float64)
        )
        valid = self.weights > 0
        image = np.where(valid, self.image, self.render(amplitude))
        variance = valid / np.maximum(self.weights, TINY)
        longer.image, around = (
            smooth_rows_evenly(merge(one).sum(axis=1, dtype=np.float32), sigma / number)
            for one in (image, variance)
        )
        # variance of one measurement over that of a weighted mean of independent ones
        averaged = np.float32(2 * np.sqrt(np.pi) * sigma / number)
        longer.weights = (
            merge(valid).mean(axis=1, dtype=np.float32) * averaged / np.maximum(around, TINY)
        )
        delays, stretches = state.delays / number, state.stretches / number
        longer.place(replace(state, delays=delays, stretches=stretches))
        return longer

    def blur(self, sigma_px: float) -> Self:
        """Return the same surfaces as an instrument shows them that blurs along the slit."""
        other = copy.copy(self)
        other.blur_px = sigma_px
        return other

    def _blur(self, images: Image) -> Image:
        """Smooth images, (n, rows, columns), as the instrument does; its own adjoint."""
        return smooth_slit(images, self.blur_px) if self.blur_px else images

    def unexplained(self, amplitude: Image) -> float:
        """What is left of the signal, as a fraction."""
        return compare_smoothed(self.render(amplitude), self.image, self.weights > 0)

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
        reach = int(np.ceil(EXTENT_SIGMAS * self.blur_px))
        left, right = (
            min(max(place.first_column + one, 0), self.shape[1])
            for one in (columns.start - reach, columns.stop + reach)
        )
        light = np.zeros((len(lights), bottom - top, right - left), np.float32)
        self._project(view, lights, kernel, part, box, (top, left), light)
        first = max(top - self.before + int(self.pulse.lags.min()), 0)
        last = min(bottom - self.before + int(self.pulse.lags.max()), self.shape[0])
        return Window(first, left, self._trail(light, first + self.before - top, last - first))

    def _find_box(self, view: int, part: slice) -> Box:
        """Rows and columns of a view's picture that the light of some points reaches."""
        from tofclip.recovery.surfaces.kernels import SLIT_PIXELS, SPLINE_SAMPLES

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

        place, (rows, columns), margin = self.footprints[view], box, self.margin
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
            return self._blur(light[:, first : first + rows])
        images = np.zeros((len(light), rows, light.shape[2]), np.float32)
        shares = self.pulse.shares.astype(np.float32)
        smooth_rows(light, shares, self.pulse.lags, np.arange(rows), first, 0, images)
        return self._blur(images)

    def render(self, amplitude: Image) -> Image:
        """Return A a, (rows, columns)."""
        image = np.zeros_like(self.image)
        image[self.lit] = self.render_lit(amplitude)
        return image

    def render_instants(self, amplitude: Image) -> Image:
        """Return the image, (rows, columns), of a pulse of an instant, without what follows it."""
        plain = self.respond(ShotPulse(self.pulse.sigma)) if self.pulse.reach else self
        image, instant = np.zeros_like(self.image), (self._lags == 0).astype(np.float32)
        for view in range(self.camera.views):
            window = plain.receive(view, amplitude, instant)
            image[window.area] += window.images[0]
        return image

    def render_lit(self, amplitude: Image) -> Image:
        """The rows of A a that light reaches."""
        rows = self._lit_before

        def work(views: range) -> Image:
            seen = np.zeros((1, rows.stop - rows.start, self.shape[1]), np.float32)
            for view in views:
                place, lights = self.footprints[view], amplitude[np.newaxis]
                box, corner = (place.lit_rows, slice(0, place.shape[1])), (rows.start, 0)
                self._project(view, lights, self.kernels[view], slice(None), box, corner, seen)
            return seen

        light = reduce(np.add, self.share_out(work, self.camera.views))
        first = self.lit.start + self.before - rows.start
        return self._trail(light, first, self.lit.stop - self.lit.start)[0]

    def pull(self, amplitude: Image, image: Image | None = None) -> Image:
        """Return A'W(A a - image), (points,), how the misfit changes with amplitudes; without an image
        A'WA a.
        """
        rest = self.render_lit(amplitude)
        if image is not None:
            rest -= image[self.lit]
        rest *= self.weights[self.lit]
        return self.gather_lit(rest)

    def gather(self, image: Image, squared: bool = False) -> Image:
        """Return A' of an image, (points,); squared: with the squares of all entries."""
        return self.gather_lit(image[self.lit], squared)

    def gather_views(self, image: Image) -> list[Image]:
        """Return what each view adds to A' of an image, (points,) each."""
        lit = self._spread_back(image[self.lit])
        return [self._gather(lit, (view,)) for view in range(self.camera.views)]

    def gather_lit(self, image: Image, squared: bool = False) -> Image:
        """A' of the rows of an image that light reaches."""
        seen = self._blur(image[np.newaxis])[0] if squared else self._spread_back(image)
        shares = self.share_out(partial(self._gather, seen, squared=squared), self.camera.views)
        return reduce(np.add, shares)

    def _spread_back(self, image: Image) -> Image:
        """The adjoint of `_trail`, from the rows of an image that light reaches."""
        from tofclip.recovery.surfaces.kernels import smooth_rows

        image = self._blur(image[np.newaxis])[0]
        if not self.pulse.reach:
            return image
        rows = self._lit_before
        seen = np.zeros((1, rows.stop - rows.start, image.shape[1]), np.float32)
        lines = np.arange(seen.shape[1]), rows.start - self.lit.start - self.before
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
            above = self.lit.start + self.before
        for view in views:
            place, kernel, shares = self.footprints[view], self.kernels[view], self._shares[view]
            if not place.lit_rows.size:
                continue
            slit_shares = place.slit_shares
            if squared:  # a pulse is smooth: the square of its samples between rows is theirs
                kernel = self.pulse.extend(self.make_kernel(view, variance=0.0)) ** 2
                slit_shares = slit_shares**2
                lags = np.arange(kernel.size) - kernel.size // 2
                # of a square pixel on those of the slit, and of its parts, which lie beside each other there
                square = np.tan(self.camera.angles[view]) ** 2
                slit_px = np.sqrt((2 + square) / 12)
                blurred = np.float32(slit_px / np.hypot(slit_px, self.blur_px))
                overlap, (wide, high) = self.places.overlap, self.places.narrower
                beside = 1 - overlap * (1 - np.sqrt(1 - (wide + high * square) / (2 + square)))
                shares = (shares**2 * overlap * blurred * beside).astype(np.float32)
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
        """How bright each view sees each point, (views, points), beside its amplitude, and as its gain has it."""
        shading = np.ones((self.camera.views, self.surface.size))
        shading[:, self.behind] = np.exp(self.state.shading[self.surface[self.behind]].T)
        shading[:, self.outer] *= np.maximum(1 + self.state.borders * self.excess, 0)
        self._shades = shading.astype(np.float32)
        shading *= self.state.gains[:, np.newaxis]
        self._shares = shading.astype(np.float32)
