"""The surface model A(r): amplitudes of surface points to a raw streak image, and back.

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
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from tofclip.camera import Camera
from tofclip.lidar import compute_ray_directions
from tofclip.recovery.surfaces.basis import SmoothBasis
from tofclip.recovery.surfaces.patches import MIN_BEHIND_FRACTION
from tofclip.recovery.surfaces.places import Footprint, PointRays, spread_points
from tofclip.recovery.surfaces.pulse import (
    EXTENT_SIGMAS,
    FWHM_PER_SIGMA,
    SPLINE_LEFT_VARIANCE,
    ShotPulse,
    make_pulse,
)
from tofclip.recovery.surfaces.state import SurfaceState
from tofclip.recovery.surfaces.weights import compare_smoothed, weigh_measurements
from tofclip.shots import Streak
from tofclip.threads import map_parallel, split_blocks, thread_count

FloatArray = NDArray[np.float64]
Image = NDArray[np.float32]
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
