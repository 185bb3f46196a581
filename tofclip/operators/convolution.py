"""Convolution of a picture with a point-spread function: what a lens, a mask or a diffuser puts on
a sensor, of one line too (supplement Note 4); and the point-spread functions: coded lines, those of
masks and phase plates in the aperture, traced with rays, and measured ones.

A ray through view (v, u) from a point at shear s meets the sensor at ``s (v, u)`` plus what the
element in the aperture deflects it by. The rays of one view make that view's PSF ``r(x, -u)``; all
of them, each view's moved by ``s u``, make the camera's depth-dependent PSF ``g(x, s)`` (supplement
Eq. 4 and 5).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, DTypeLike

from tofclip.arrays import AnyArray, Array, FloatArray
from tofclip.errors import ShapeError, require
from tofclip.operators.base import LinearOperator, LinearShear, View

if TYPE_CHECKING:
    from scipy.interpolate import RectBivariateSpline


class PointSpreadConvolution(LinearOperator):
    """A picture of `image_shape` convolved with a point-spread function (PSF), on the plane of the sensor
    (supplement Eq. 4), in `dtype` float32 or float64.

    `point_spread` (rows, columns) is the light on the sensor from a point of brightness 1, its origin pixel
    ``(rows // 2, columns // 2)``: a point in the picture's middle puts it, as it is, about the sensor's
    middle. `sensor_shape` is the picture's by default; a lensless camera sees more than its sensor covers:
    then the picture is the larger. The convolution is linear: the picture is dark beyond its border, and
    light that falls beside the sensor is lost. It runs over Fourier space, padded by just as much as keeps
    periodic images of the picture off the sensor. `ShapeError` or `InputError` where the PSF is larger than
    the picture, dark everywhere, or holds NaN or infinity.

    ``scipy.fft`` is used: 0.18 ms for both transforms of a 128 x 128 picture padded to 192 x 192. A
    pyFFTW plan takes 0.16 ms unmeasured and 0.12 ms measured, but owns its memory, so that threads
    would have to wait for each other.
    """

    def __init__(
        self,
        image_shape: tuple[int, int],
        point_spread: ArrayLike,
        sensor_shape: tuple[int, int] | None = None,
        dtype: DTypeLike = np.float32,
    ) -> None:
        import scipy.fft

        sensor_shape = image_shape if sensor_shape is None else sensor_shape
        super().__init__(image_shape, sensor_shape, dtype)
        spread = validate_point_spread(point_spread, image_shape)
        # dark rows and columns are cut off; the centre stays where it was
        lit = [np.flatnonzero(spread.any(axis=other)) for other in (1, 0)]
        centre = [size // 2 - int(one[0]) for size, one in zip(spread.shape, lit, strict=True)]
        spread = spread[lit[0][0] : lit[0][-1] + 1, lit[1][0] : lit[1][-1] + 1]
        sides = zip(image_shape, sensor_shape, strict=True)
        first = [image // 2 - sensor // 2 for image, sensor in sides]
        # long enough that no period's copy of the picture reaches the sensor
        self._padded = tuple(
            scipy.fft.next_fast_len(alias_free_length(*sizes), real=True)
            for sizes in zip(image_shape, sensor_shape, spread.shape, first, centre, strict=True)
        )
        placed = np.zeros(self._padded, self.dtype)
        placed[: spread.shape[0], : spread.shape[1]] = spread
        # pixel (0, 0) of the result is the sensor's first pixel, under the PSF's centre
        shift = [-(begin + middle) for begin, middle in zip(first, centre, strict=True)]
        self._spectrum = scipy.fft.rfft2(np.roll(placed, shift, (0, 1)))[..., np.newaxis]
        self._conjugate = self._spectrum.conj()  # correlation: it turns the convolution around

    def _forward(self, block: Array) -> Array:
        return self._apply_spectrum(block, self._spectrum, self.shape_out)

    def _adjoint(self, block: Array) -> Array:
        return self._apply_spectrum(block, self._conjugate, self.shape_in)

    def _apply_spectrum(self, block: Array, spectrum: AnyArray, shape: tuple[int, ...]) -> Array:
        import scipy.fft

        # One axis after the other: rows of padding need no transform along themselves.
        rows, columns = self._padded
        transformed = scipy.fft.rfft(block, columns, axis=1)
        transformed = scipy.fft.fft(transformed, rows, axis=0, overwrite_x=True)
        transformed *= spectrum
        kept = scipy.fft.ifft(transformed, axis=0, overwrite_x=True)[: shape[0]]
        filtered = scipy.fft.irfft(kept, columns, axis=1, overwrite_x=True)
        return np.ascontiguousarray(filtered[:, : shape[1]])


def validate_point_spread(point_spread: ArrayLike, image_shape: tuple[int, int]) -> FloatArray:
    """Return a PSF as float64 once it is known to fit pictures of `image_shape`."""
    spread = np.asarray(point_spread, dtype=np.float64)
    if spread.ndim != 2 or 0 in spread.shape:
        raise ShapeError("a point-spread function", "(rows, columns)", spread.shape)
    require(
        not any(size > limit for size, limit in zip(spread.shape, image_shape, strict=True)),
        f"a point-spread function of {spread.shape} px is larger than the picture of {tuple(image_shape)} px; "
        "crop it or bin it to the picture's pixels",
    )
    require(np.all(np.isfinite(spread)), "a point-spread function must not hold NaN or infinity")
    require(
        spread.any(),
        "a point-spread function that is dark everywhere shows nothing; check its background",
    )
    return spread


def alias_free_length(image: int, sensor: int, spread: int, first: int, centre: int) -> int:
    """Least period, pixels, for which no sensor pixel gets light from a periodic image of the picture.

    Sensor pixels lie at first ... first + sensor - 1 of the picture's own pixels 0 ... image - 1;
    the PSF reaches from -centre to spread - 1 - centre.
    """
    return max(image, sensor, spread, first + sensor + centre, image - first + spread - 1 - centre)


class SliceConvolution(LinearOperator):
    """The middle row of the convolution of a picture, of `image_shape`, with each of several PSFs: what 1D
    sensors read (Eq. 8), (lines * sensor_px,), PSF by PSF, in `dtype` float32 or float64.

    `point_spreads` (lines, rows, columns) are the light on the sensor's plane from a point in the middle,
    the origin being pixel ``(rows // 2, columns // 2)``; the sensors, of `sensor_px` pixels about the
    picture's middle, as many as its columns by default, lie at row ``(rows - 1) // 2``, from where a PSF as
    high as the picture reaches all rows.

    Along the sensor's direction the convolution is a product in Fourier space; across it, each of
    the picture's rows is weighed by its own row of the PSF and all are summed. So at every
    frequency k the measurements are a small matrix times the picture's column of the spectrum,
    ``L[k] = G_k P_k`` (supplement Eq. 15 and 16). Its cost and memory, 8 bytes for each PSF, row
    and frequency, do not depend on how large or how sparse the PSFs are.
    """

    def __init__(
        self,
        image_shape: tuple[int, int],
        point_spreads: ArrayLike,
        sensor_px: int | None = None,
        dtype: DTypeLike = np.float32,
    ) -> None:
        import scipy.fft

        spreads = np.asarray(point_spreads, dtype=dtype)
        if spreads.ndim != 3 or len(spreads) == 0:
            raise ShapeError("the PSFs of 1D sensors", "(lines, rows, columns)", spreads.shape)
        for spread in spreads:
            validate_point_spread(spread, image_shape)
        rows, columns = image_shape
        self.sensor_px = columns if sensor_px is None else sensor_px
        super().__init__(image_shape, (len(spreads) * self.sensor_px,), dtype)
        # The sensor's row sees row y of the picture through row `centre + sensor - y` of the PSF.
        mirrored = np.zeros((len(spreads), rows, spreads.shape[2]), self.dtype)
        seen_through = spreads.shape[1] // 2 + (rows - 1) // 2 - np.arange(rows)
        reached = (seen_through >= 0) & (seen_through < spreads.shape[1])
        mirrored[:, reached] = spreads[:, seen_through[reached]]
        centre = spreads.shape[2] // 2
        first = columns // 2 - self.sensor_px // 2
        least = alias_free_length(columns, self.sensor_px, spreads.shape[2], first, centre)
        self._padded = scipy.fft.next_fast_len(least, real=True)
        placed = np.zeros((len(spreads), rows, self._padded), self.dtype)
        placed[..., : spreads.shape[2]] = mirrored
        spectra = scipy.fft.rfft(np.roll(placed, -(first + centre), axis=2), axis=2)
        self.spectra = np.ascontiguousarray(np.moveaxis(spectra, 2, 0))
        """G_k of every frequency k of the padded sensor, (frequencies, lines, rows)."""

    def _forward(self, block: Array) -> Array:
        import scipy.fft

        columns = np.moveaxis(scipy.fft.rfft(block, self._padded, axis=1), 1, 0)
        lines = scipy.fft.irfft(self.spectra @ columns, self._padded, axis=0)[: self.sensor_px]
        return np.ascontiguousarray(np.moveaxis(lines, 0, 1)).reshape(*self.shape_out, -1)

    def _adjoint(self, block: Array) -> Array:
        import scipy.fft

        measurements = block.reshape(-1, self.sensor_px, block.shape[-1])
        lines = np.moveaxis(scipy.fft.rfft(measurements, self._padded, axis=1), 1, 0)
        # G^H l without a conjugated copy of G: conj(G^T conj(l)).
        columns = (self.spectra.swapaxes(1, 2) @ lines.conj()).conj()
        rows = scipy.fft.irfft(columns, self._padded, axis=0)[: self.shape_in[1]]
        return np.ascontiguousarray(np.moveaxis(rows, 0, 1))


def make_coded_line(
    shape: tuple[int, int], width_px: int, angle: float, random: np.random.Generator
) -> FloatArray:
    """Make a line PSF of sum 1 times a random 0/1 code of `width_px` (n_p) cells in each row (supplement
    Note 4). Each row's cells are moved by ``row * tan(angle)`` columns, `angle` being that of the line
    from the vertical, and shared between two columns where that is not a whole number.
    """
    rows, columns = shape
    require(
        1 <= width_px <= columns, f"a coded line must be 1 to {columns} px wide, got {width_px}"
    )
    require(
        abs(angle) < np.pi / 2,
        f"a line's angle from the vertical must lie between -90 and 90 degrees, got {angle} rad",
    )
    code = random.integers(0, 2, (rows, width_px))
    code[rows // 2, width_px // 2] = 1  # never dark altogether
    first = columns // 2 - width_px // 2
    slant = np.tan(angle) * (np.arange(rows)[:, None] - rows // 2)
    place = first + np.arange(width_px) + slant
    left = np.floor(place).astype(int)
    spread = np.zeros(shape)
    for column, share in ((left, 1 - place + left), (left + 1, place - left)):
        row, cell = np.nonzero((column >= 0) & (column < columns))
        np.add.at(spread, (row, column[row, cell]), (code * share)[row, cell])
    spread /= spread.sum()
    return spread


# Along each side of a view's patch of the aperture: 0.15 million for 8 x 8 views.
RAYS_PER_SIDE = 48


Rays = tuple[FloatArray, FloatArray, FloatArray]
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

    code: AnyArray  # (rows, columns), transmission of the mask's cells, which fill the aperture

    def trace_rays(self, v: FloatArray, u: FloatArray) -> Rays:
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

    def trace_rays(self, v: FloatArray, u: FloatArray) -> Rays:
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

    def trace_rays(self, v: FloatArray, u: FloatArray) -> Rays:
        phase = self._phase
        down, right = phase(v.ravel(), u.ravel(), dx=1), phase(v.ravel(), u.ravel(), dy=1)
        return np.ones(down.shape), down, right

    @cached_property
    def _phase(self) -> RectBivariateSpline:
        """The phase as one spline, whose slopes are the deflections in pixels."""
        from scipy.interpolate import RectBivariateSpline
        from scipy.ndimage import gaussian_filter

        require(
            self.grain > 0 and np.isfinite(self.spread_px),
            f"a diffuser's grain must be positive and its spread finite, got {self}",
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
) -> FloatArray:
    """Trace each view's PSF ``r(x, -u_k)``, (views, rows, columns): the light that passes its patch of
    the aperture, one view step wide, from a point at infinity. The patches fill the aperture; all PSFs
    together have the sum 1 for an element that lets all light pass onto `shape`.
    """
    grid = np.asarray(views, dtype=np.float64)
    middle = (grid.max(axis=0) + grid.min(axis=0)) / 2
    # every view looks through a part one view step wide, hence the + 1
    half = (np.ptp(grid, axis=0) + 1) / 2
    # Rays at the middles of even cells, the same for each view.
    within = (np.arange(RAYS_PER_SIDE) + 0.5) / RAYS_PER_SIDE - 0.5
    spreads = np.empty((len(grid), *shape))
    for spread, view in zip(spreads, grid, strict=True):
        v, u = (
            (place - centre + within) / size
            for place, centre, size in zip(view, middle, half, strict=True)
        )
        # an open aperture passes light 1, all views together
        transmission, down, right = element.trace_rays(v[:, np.newaxis], u[np.newaxis, :])
        spread[:] = _accumulate_rays(
            transmission / (RAYS_PER_SIDE**2 * len(grid)), down, right, shape
        )
    return spreads


def shear_point_spreads(
    spreads: AnyArray, views: Sequence[View], shear: float, reference: View = (0.0, 0.0)
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
        require(
            np.all(np.isfinite(depths)) and np.all(np.isfinite(light)) and np.all(light > 0),
            "every measured PSF must be finite and hold light; check its background",
        )
        require(
            np.unique(depths).size == depths.size,
            "two measured PSFs belong to the same shear; take the mean of both",
        )
        order = np.argsort(depths)
        self.shears = depths[order]
        # the same light at every depth, whatever the exposures were
        self.stack = (spreads / light[:, np.newaxis, np.newaxis])[order]

    def interpolate(self, shear: float) -> FloatArray:
        """Return the PSF at one depth, linearly between the two nearest that were measured."""
        require(
            self.shears[0] <= shear <= self.shears[-1],
            f"shear {shear} lies beyond the measured {self.shears[0]:g} ... {self.shears[-1]:g}; "
            "measure a PSF there or refocus nearer",
        )
        # Between two depths the PSFs are mixed: the shape changes slowly from one to the next.
        weights = [np.interp(shear, self.shears, own) for own in np.eye(self.shears.size)]
        return np.tensordot(weights, self.stack, 1)


def _accumulate_rays(
    light: FloatArray, down: FloatArray, right: FloatArray, shape: tuple[int, int]
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
