"""Point-spread functions: of masks and phase plates in the aperture, traced with rays, and measured
ones.

A ray through view (v, u) from a point at shear s meets the sensor at ``s (v, u)`` plus what the
element in the aperture deflects it by. The rays of one view make that view's PSF ``r(x, -u)``; all
of them, each view's moved by ``s u``, make the camera's depth-dependent PSF ``g(x, s)`` (supplement
Eq. 4 and 5).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tofclip.arrays import FloatArray
from tofclip.errors import InputError, ShapeError
from tofclip.operators.shear import LinearShear, View

if TYPE_CHECKING:
    from scipy.interpolate import RectBivariateSpline

Coordinates = FloatArray

# Along each side of a view's patch of the aperture: 0.15 million for 8 x 8 views.
RAYS_PER_SIDE = 48


Rays = tuple[Coordinates, Coordinates, Coordinates]
"""(rays, rays) each: what fraction of each ray an element in the aperture passes, and by how many pixels
it deflects it down and to the right. Pupil coordinates v, (rays, 1), down and u, (1, rays), right go from
-1 to 1.
"""


@dataclass(frozen=True)
class CodedAperture:
    """An amplitude mask: ``g(x, s)`` is the code f, mirrored and scaled by s (supplement Eq. 6).
    ``g(x, s) = f(-x / s)`` up to the factor that keeps the light the same at every depth; at s = 0
    it is a point.
    """

    code: NDArray[Any]  # (rows, columns), transmission of the mask's cells, which fill the aperture

    def trace_rays(self, v: Coordinates, u: Coordinates) -> Rays:
        """View u looks through the mask at -u, as in Eq. 6."""
        cells = [
            np.clip(((1 - place) / 2 * size).astype(int), 0, size - 1)
            for place, size in zip((v, u), self.code.shape, strict=True)
        ]
        transmission = np.asarray(self.code, np.float64)[cells[0], cells[1]]
        # A mask takes light away and bends none of it.
        straight = np.zeros_like(transmission)
        return transmission, straight, straight


@dataclass(frozen=True)
class CubicPhasePlate:
    """A cubic phase plate (E. R. Dowski, W. T. Cathey, Appl. Opt. 34, 1859 (1995)): its PSF hardly
    changes with depth. The phase ``u^3 + v^3`` deflects by its gradient, so rays land at ``strength
    * (v^2, u^2)``, the middle taken off.
    """

    strength_px: float  # extent of the PSF on either axis

    def trace_rays(self, v: Coordinates, u: Coordinates) -> Rays:
        # 1/2 shifts the PSF as a whole, which lies about its own centre then
        passed = np.ones((v * u).shape)
        down, right = (self.strength_px * (pupil**2 - 0.5) * passed for pupil in (v, u))
        return passed, down, right


@dataclass(frozen=True)
class Diffuser:
    """A thin diffuser: a smooth random phase whose slopes throw a caustic pattern."""

    spread_px: float  # standard deviation of the deflection on either axis
    grain: float  # correlation length of the phase on the aperture, whose half width is 1
    seed: int

    def trace_rays(self, v: Coordinates, u: Coordinates) -> Rays:
        phase = self._phase
        down, right = phase(v.ravel(), u.ravel(), dx=1), phase(v.ravel(), u.ravel(), dy=1)
        return np.ones(down.shape), down, right

    @cached_property
    def _phase(self) -> RectBivariateSpline:
        """The phase as one spline, whose slopes are the deflections in pixels."""
        from scipy.interpolate import RectBivariateSpline
        from scipy.ndimage import gaussian_filter

        if not (self.grain > 0 and np.isfinite(self.spread_px)):
            raise InputError(
                f"a diffuser's grain must be positive and its spread finite, got {self}"
            )
        # four cells a grain, so that the spline adds no wiggles
        cells = max(16, round(8 / self.grain))
        noise = np.random.default_rng(self.seed).standard_normal((cells, cells))
        places = np.linspace(-1, 1, cells)
        # Wrapped around, so that grains at the rim are as strong as in the middle.
        phase = gaussian_filter(noise, self.grain / (places[1] - places[0]), mode="wrap")
        surface = RectBivariateSpline(places, places, phase)
        sampled = np.linspace(-1, 1, 4 * cells)
        # Rays go where the slope of the phase sends them: the spread of the slopes is that of the
        # spot.
        slopes = np.std([surface(sampled, sampled, dx=1), surface(sampled, sampled, dy=1)])
        return RectBivariateSpline(places, places, phase * (self.spread_px / slopes))


ApertureElement = CodedAperture | CubicPhasePlate | Diffuser
"""A mask or a thin phase plate in the aperture."""


def trace_view_point_spreads(
    element: ApertureElement,
    views: Sequence[View],
    shape: tuple[int, int],
    rays: int = RAYS_PER_SIDE,
) -> FloatArray:
    """Trace each view's PSF ``r(x, -u_k)``, (views, rows, columns): the light that passes its patch of
    the aperture, one view step wide, from a point at infinity. The patches fill the aperture; all PSFs
    together have the sum 1 for an element that lets all light pass onto `shape`. There are `rays` along
    each side of a patch.
    """
    grid = np.asarray(views, dtype=np.float64)
    middle = (grid.max(axis=0) + grid.min(axis=0)) / 2
    # every view looks through a part one view step wide, hence the + 1
    half = (np.ptp(grid, axis=0) + 1) / 2
    # Rays at the middles of even cells, the same for each view.
    within = (np.arange(rays) + 0.5) / rays - 0.5
    spreads = np.empty((len(grid), *shape))
    for spread, view in zip(spreads, grid, strict=True):
        v, u = (
            (place - centre + within) / size
            for place, centre, size in zip(view, middle, half, strict=True)
        )
        # an open aperture passes light 1, all views together
        transmission, down, right = element.trace_rays(v[:, np.newaxis], u[np.newaxis, :])
        spread[:] = _accumulate_rays(transmission / (rays**2 * len(grid)), down, right, shape)
    return spreads


def shear_point_spreads(
    spreads: NDArray[Any], views: Sequence[View], shear: float, reference: View = (0.0, 0.0)
) -> FloatArray:
    """Move each view's PSF, (views, rows, columns), by ``s (u - u_ref)``: convolving with it is shearing
    the picture and convolving then. Their sum is the camera's ``g(x, s)`` (supplement Eq. 4).
    """
    shape = (spreads.shape[1], spreads.shape[2])
    pairs = zip(spreads, views, strict=True)
    return np.stack(
        [LinearShear(shape, shear, view, reference, np.float64)(spread) for spread, view in pairs]
    )


class MeasuredPointSpreads:
    """PSFs measured once with a point source at several depths (supplement Note 4), and those in
    between. `stack` (depths, rows, columns): background taken off. Each PSF is brought to the sum
    1: a point source looks brighter when it is near; `shears` (depths,): s of each depth, in pixels
    per view step; any order.
    """

    def __init__(self, stack: ArrayLike, shears: ArrayLike) -> None:
        spreads, depths = np.asarray(stack, np.float64), np.asarray(shears, np.float64)
        if spreads.ndim != 3 or depths.shape != spreads.shape[:1] or depths.size == 0:
            expected = "(depths, rows, columns) and (depths,)"
            raise ShapeError("PSFs and their shears", expected, (spreads.shape, depths.shape))
        light = spreads.sum(axis=(1, 2))
        if not (np.all(np.isfinite(depths)) and np.all(np.isfinite(light)) and np.all(light > 0)):
            raise InputError(
                "every measured PSF must be finite and hold light; check its background"
            )
        if np.unique(depths).size != depths.size:
            raise InputError("two measured PSFs belong to the same shear; take the mean of both")
        order = np.argsort(depths)
        self.shears = depths[order]
        # the same light at every depth, whatever the exposures were
        self.stack = (spreads / light[:, np.newaxis, np.newaxis])[order]

    def interpolate(self, shear: float) -> FloatArray:
        """Return the PSF at one depth, (rows, columns), linearly between the two nearest that were
        measured.
        """
        if not self.shears[0] <= shear <= self.shears[-1]:
            raise InputError(
                f"shear {shear} lies beyond the measured {self.shears[0]:g} ... {self.shears[-1]:g}; "
                "measure a PSF there or refocus nearer"
            )
        # Between two depths the PSFs are mixed: the shape changes slowly from one to the next.
        weights = [np.interp(shear, self.shears, own) for own in np.eye(self.shears.size)]
        return np.tensordot(weights, self.stack, 1)


def _accumulate_rays(
    light: Coordinates, down: Coordinates, right: Coordinates, shape: tuple[int, int]
) -> FloatArray:
    """Gather rays on pixels; each is shared between the four nearest."""
    total = np.zeros(shape[0] * shape[1])
    # A ray that lands between pixels is shared out by its distance to each, which keeps the light.
    row, column = down + shape[0] // 2, right + shape[1] // 2
    top, left = np.floor(row).astype(int), np.floor(column).astype(int)
    for y, along_y in ((top, 1 - row + top), (top + 1, row - top)):
        for x, along_x in ((left, 1 - column + left), (left + 1, column - left)):
            seen = (y >= 0) & (y < shape[0]) & (x >= 0) & (x < shape[1])
            weight = (light * along_y * along_x)[seen]
            total += np.bincount(y[seen] * shape[1] + x[seen], weight, total.size)
    return total.reshape(shape)
