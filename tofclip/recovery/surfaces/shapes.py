"""Functions that a surface's inverse depth may be: quadratics and splines over the picture, and surfaces
of second order in space. Pixels are raster numbers.

A ball, a rod, a cone, any surface of second order, has

    1/z = l(x, y) +- sqrt(q(x, y))

over the picture, with l linear and q quadratic, exactly. Where q becomes negative it ends, and its
range is steeper there than any polynomial or spline.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from tofclip.arrays import FloatArray
from tofclip.recovery.surfaces.pulse import Image

Pixels = NDArray[np.intp]

COEFFICIENTS = 6  # of a quadratic
LINEAR = 3  # of these
ROUND_COEFFICIENTS = LINEAR + COEFFICIENTS  # of a surface of second order in space
SPLINE_DEGREE = 3
TINY = float(np.finfo(np.float32).eps)
# Derivatives of monomials, as in `evaluate_monomials`, along x and y: sums of these.
BY_X, BY_Y = np.zeros((2, COEFFICIENTS, COEFFICIENTS))
BY_X[[0, 1, 2], [1, 3, 4]] = 1, 2, 1
BY_Y[[0, 1, 2], [2, 4, 5]] = 1, 1, 2
# Of the change of q over a pixel: the mean of sqrt(q) over what a pixel at the limb sees of a surface
# is sqrt(q) at the pixel's middle, of which as much is rounded off.
LIMB = 0.44
LIMB_LEVELS = np.array([1.0, 1.5, 2.0, 3.0, 5.0])
# Of robust fits: each only has to be nearer than the one before, whose errors it weighs by.
FIT_ROUNDS, FIT_STEPS, FIT_TOLERANCE = 3, 30, 1e-3
# Of the nearest in first order: what keeps it straight where nothing bends it, per value; how far it is bent at
# least, as a root cannot be straight; and the least slope, in its units.
STRAIGHT, LEAST_BEND, LEAST_SLOPE, GUESS_ROUNDS = 1e-4, 0.01, 0.05, 3
FITTED_RETURNS = 500  # of nine unknowns, evenly chosen: with more a start is no better


@dataclass(frozen=True)
class SmoothBasis:
    """Smooth functions over the picture, of which a surface's inverse depth is a sum."""

    image_shape: tuple[int, int]
    # first row and column, and those after the last, over which splines run or a quadric is scaled
    box: tuple[int, int, int, int] = (0, 0, 0, 0)
    # of the splines along rows and columns; without any it is the six monomials of a quadratic
    pieces: tuple[int, int] = (0, 0)
    # (n, n), half of ``c' bending c`` is added to the objective: what is known of coefficients c
    # without the shot. By default nothing is
    bending: FloatArray = field(default_factory=lambda: np.zeros((COEFFICIENTS, COEFFICIENTS)))

    @property
    def is_quadratic(self) -> bool:
        """Whether the functions are the monomials of a quadratic, and not splines."""
        return self.pieces == (0, 0)

    def evaluate(self, pixels: Pixels) -> FloatArray:
        """Return the functions' values, (pixels, n): monomials, or uniform cubic B-splines, which
        are beyond their box as at its ends.
        """
        if self.is_quadratic:
            return evaluate_monomials(pixels, self.image_shape)
        if pixels.size == 0:  # which scipy refuses
            return np.zeros((0, math.prod(pieces + SPLINE_DEGREE for pieces in self.pieces)))
        from scipy.interpolate import BSpline

        along = []
        ends = zip(self.box[:2], self.box[2:], strict=True)
        places = zip(np.divmod(pixels, self.image_shape[1]), ends, self.pieces, strict=True)
        for place, (first, last), pieces in places:
            knots = np.arange(-SPLINE_DEGREE, pieces + SPLINE_DEGREE + 1) / pieces
            inside = np.clip((place - first + 0.5) / (last - first), 0.0, 1 - 1e-9)
            along.append(BSpline.design_matrix(inside, knots, SPLINE_DEGREE).toarray())
        return np.asarray(np.einsum("pi,pj->pij", *along).reshape(pixels.size, -1))

    def compute_inverse(self, functions: FloatArray, coefficients: FloatArray) -> FloatArray:
        """Return inverse depths, (pixels,), from the functions' values."""
        return np.asarray(functions @ coefficients)

    def differentiate(self, functions: FloatArray, coefficients: FloatArray) -> FloatArray:
        """Return the derivatives of inverse depths by the coefficients, (pixels, n)."""
        return functions

    def take_step(
        self, functions: FloatArray, coefficients: FloatArray, change: FloatArray, light: Image
    ) -> FloatArray:
        """Return the coefficients after a change, (n,); `light`: of the pixels."""
        return coefficients + change

    @cached_property
    def quadratic_parts(self) -> tuple[FloatArray, FloatArray]:
        """Coefficients of the six monomials over this basis, (n, 6), and what of each function is such a
        quadratic, (6, n), both as least squares over the splines' box.
        """
        if self.is_quadratic:
            return np.eye(COEFFICIENTS), np.eye(COEFFICIENTS)
        inside = np.zeros(self.image_shape, bool)
        inside[max(self.box[0], 0) : self.box[2], max(self.box[1], 0) : self.box[3]] = True
        pixels = np.flatnonzero(inside)
        functions, monomials = self.evaluate(pixels), evaluate_monomials(pixels, self.image_shape)
        coefficients, *_ = np.linalg.lstsq(functions, monomials)
        quadratic, *_ = np.linalg.lstsq(monomials, functions)
        return coefficients.astype(np.float64), quadratic.astype(np.float64)


def evaluate_monomials(pixels: Pixels, image_shape: tuple[int, int]) -> FloatArray:
    """Return 1, x, y, x^2, xy and y^2 of pixels, (n, 6), in halves of the picture from its middle."""
    y, x = np.divmod(pixels, image_shape[1])
    return _stack_monomials(2 * x / image_shape[1] - 1, 2 * y / image_shape[0] - 1)


def _stack_monomials(x: FloatArray, y: FloatArray) -> FloatArray:
    return np.stack([np.ones_like(x), x, y, x**2, x * y, y**2], axis=-1)


@dataclass(frozen=True)
class QuadricBasis(SmoothBasis):
    """Inverse depths ``l + sign sqrt(2 unit q)``: coefficients are the 3 of l and the 6 of q, over
    monomials in halves of the box from its middle.
    """

    sign: float = 1.0
    unit: float = 1.0  # 1/m; where the root is as large, inverse depths change as much by q as by l
    bending: FloatArray = field(
        default_factory=lambda: np.zeros((ROUND_COEFFICIENTS, ROUND_COEFFICIENTS))
    )

    @property
    def is_quadratic(self) -> bool:
        return False

    def evaluate(self, pixels: Pixels) -> FloatArray:
        """Return the monomials at some pixels, (pixels, 6)."""
        return self._stack(*np.divmod(pixels, self.image_shape[1]))

    def _stack(self, row: NDArray[Any], column: NDArray[Any]) -> FloatArray:
        (top, left), (high, wide) = self.box[:2], self._measure_box()
        x, y = 2 * (column - left + 0.5) / wide - 1, 2 * (row - top + 0.5) / high - 1
        return _stack_monomials(x, y)

    @cached_property
    def quadratic_parts(self) -> tuple[FloatArray, FloatArray]:
        """No quadratic follows a limb: all functions count on their own, (9, 9)."""
        return np.eye(ROUND_COEFFICIENTS), np.eye(ROUND_COEFFICIENTS)

    def _measure_box(self) -> tuple[int, int]:
        return self.box[2] - self.box[0], self.box[3] - self.box[1]

    def compute_inverse(self, functions: FloatArray, coefficients: FloatArray) -> FloatArray:
        inside, *_ = self._round_off(functions, coefficients)
        root = np.sqrt(inside / 2)
        return np.asarray(functions[:, :LINEAR] @ coefficients[:LINEAR] + self.sign * root)

    def differentiate(self, functions: FloatArray, coefficients: FloatArray) -> FloatArray:
        inside, size, slopes = self._round_off(functions, coefficients)
        by_limb = sum(slope[:, None] * (functions @ way) for slope, way in slopes)
        by_q = (inside / size)[:, None] * (2 * self.unit * functions)
        by_q += (LIMB**2 / size)[:, None] * by_limb
        by_q /= (4 * np.sqrt(inside / 2))[:, None]
        return np.concatenate([functions[:, :LINEAR], self.sign * by_q], axis=1)

    def take_step(
        self, functions: FloatArray, coefficients: FloatArray, change: FloatArray, light: Image
    ) -> FloatArray:
        """The same, so that inverse depths change as their derivatives say, as nearly as those of a
        surface of second order can where there is light. Along what a shot hardly says anything about
        l and q make up for each other, but only in small steps: q by a square.
        """
        lit = np.flatnonzero(light)
        if lit.size < coefficients.size:
            return coefficients + change
        some = lit[:: 1 + lit.size // FITTED_RETURNS]
        functions, sure = functions[some], np.sqrt(light[some].astype(np.float64) / light.max())
        aim = self.compute_inverse(functions, coefficients)
        aim = aim + self.differentiate(functions, coefficients) @ change
        found = scipy.optimize.least_squares(
            lambda own: sure * (self.compute_inverse(functions, own) - aim) / self.unit,
            coefficients,
            lambda own: sure[:, np.newaxis] * self.differentiate(functions, own) / self.unit,
            method="lm",
            x_scale="jac",
            max_nfev=FIT_STEPS,
        )
        return np.asarray(found.x)

    def look_between(
        self, pixels: Pixels, offset: FloatArray, size: FloatArray, coefficients: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return inverse depths of parts of pixels, (n,), `offset` from the pixels' middles and of a `size`, (2, n),
        px to the right and down, with nothing rounded off; by how much they change from pixel to pixel; and how
        much of each part is within the limb. All of it changes evenly as the limb moves.
        """
        row, column = np.divmod(pixels, self.image_shape[1])
        functions = self._stack(row + offset[1], column + offset[0])
        q, slopes = self._differentiate_square(functions, coefficients)
        linear, tiny = coefficients[:LINEAR], np.finfo(np.float64).tiny
        across, down = (one * slope for one, (slope, _) in zip(size, slopes, strict=True))
        change = np.hypot(across, down) + tiny
        filled = np.clip(q / change + 0.5, 0, 1)
        # of a part that the limb crosses, the middle of what is within
        root = np.sqrt(np.where(filled < 1, filled * change / 2 + tiny, q))
        steepness = [
            2 / side * along + self.sign * slope / (2 * root)
            for along, side, (slope, _) in zip(
                linear[1:], self._measure_box()[::-1], slopes, strict=True
            )
        ]
        inverse = functions[:, :LINEAR] @ linear + self.sign * root
        return inverse, np.hypot(*steepness), filled

    def _differentiate_square(
        self, functions: FloatArray, coefficients: FloatArray
    ) -> tuple[FloatArray, list[tuple[FloatArray, FloatArray]]]:
        """q, and its slopes to the right and down, 1/px, each with what makes of monomials its derivatives by
        q's coefficients.
        """
        own, (high, wide) = coefficients[LINEAR:], self._measure_box()
        ways = 4 * self.unit / wide * BY_X, 4 * self.unit / high * BY_Y
        slopes = [(functions @ (way @ own), way) for way in ways]
        return 2 * self.unit * (functions @ own), slopes

    def _round_off(self, functions: FloatArray, coefficients: FloatArray) -> tuple[Any, ...]:
        """Twice the square of the root, which is q inside and rounded off at the limb; its size there;
        and the slopes of q, as `_differentiate_square` has them.
        """
        q, slopes = self._differentiate_square(functions, coefficients)
        limb = LIMB * np.hypot(*(slope for slope, _ in slopes)) + np.finfo(np.float64).tiny
        size = np.hypot(q, limb)
        # without the difference of large numbers beyond the limb
        inside = np.where(q > 0, q + size, limb**2 / (size + np.abs(q)))
        return inside, size, slopes


@dataclass(frozen=True)
class KnownBasis(SmoothBasis):
    """One function: inverse depths that are known point by point, 1/m, (rows, columns)."""

    inverse: FloatArray = field(default_factory=lambda: np.ones((0, 0)))
    bending: FloatArray = field(default_factory=lambda: np.zeros((1, 1)))

    def evaluate(self, pixels: Pixels) -> FloatArray:
        """Return the inverse depths at some pixels, (pixels, 1)."""
        return self.inverse.ravel()[pixels, np.newaxis]


def guess_quadric(
    pixels: Pixels, inverse: FloatArray, image_shape: tuple[int, int]
) -> tuple[QuadricBasis, FloatArray]:
    """Return the surface of second order, and its basis, that is nearest to inverse depths in first order (G. Taubin,
    IEEE Trans. Pattern Anal. Mach. Intell. 13, 1115, 1991), where they differ least in sum.

    With u, an inverse depth from their middle on in units, ``a u^2 + (1 + b x + c y) u + p(x, y)`` is 0 on such a
    surface, and linear in what is looked for. Beside it u is off by this value over its slope.
    """
    basis, middle = _frame_quadric(pixels, inverse, image_shape)
    some = slice(None, None, 1 + pixels.size // FITTED_RETURNS)
    functions, u = basis.evaluate(pixels[some]), (inverse[some] - middle) / basis.unit
    ways = functions[:, 1:LINEAR]
    terms = np.column_stack([u * u, u[:, np.newaxis] * ways, functions, u])
    straight = np.full(ROUND_COEFFICIENTS, u.size * TINY)
    straight[:LINEAR] = u.size * STRAIGHT
    sure, middle_error = np.ones(u.size), u.size // 2
    for _ in range(GUESS_ROUNDS):
        weighed = sure[:, np.newaxis] * terms
        normal = weighed.T @ weighed
        found = -np.linalg.solve(normal[:-1, :-1] + np.diag(straight), normal[:-1, -1])
        slope = np.maximum(1 + 2 * found[0] * u + ways @ found[1:LINEAR], LEAST_SLOPE)
        error = np.abs(terms @ np.append(found, 1.0)) / slope
        usual = np.partition(error, middle_error)[middle_error]
        sure = 1 / (slope * np.sqrt(np.maximum(error, usual / 2 + TINY)))
        sure /= sure.max()
    bend, across, down = found[:LINEAR]
    bend = np.copysign(max(abs(bend), LEAST_BEND), bend)
    linear = -basis.unit / (2 * bend) * np.array([1, across, down]) + [middle, 0, 0]
    square = [1, 2 * across, 2 * down, across**2, 2 * across * down, down**2]
    q = basis.unit / (8 * bend**2) * (square - 4 * bend * found[LINEAR:])
    return replace(basis, sign=float(np.sign(bend))), np.concatenate([linear, q])


def _frame_quadric(
    pixels: Pixels, inverse: FloatArray, image_shape: tuple[int, int]
) -> tuple[QuadricBasis, float]:
    """A basis for some inverse depths, and their middle."""
    corners = np.stack(np.divmod(pixels, image_shape[1]))
    ends = corners.min(axis=1), corners.max(axis=1) + 1
    unit = float(np.std(inverse)) + TINY
    box = tuple(np.concatenate(ends).tolist())
    return QuadricBasis(image_shape, box, unit=unit), float(np.median(inverse))


def fit_quadric(
    pixels: Pixels, inverse: FloatArray, image_shape: tuple[int, int]
) -> tuple[QuadricBasis, FloatArray]:
    """Fit the inverse depths of returns robustly; return the basis and its coefficients."""
    basis, middle = _frame_quadric(pixels, inverse, image_shape)
    unit = basis.unit
    some = slice(None, None, 1 + pixels.size // FITTED_RETURNS)
    functions, inverse = basis.evaluate(pixels[some]), inverse[some]
    plain, *_ = np.linalg.lstsq(functions, inverse)
    # what bulges towards the camera has its greatest inverse depth in the middle
    basis = replace(basis, sign=1.0 if plain[3] + plain[5] < 0 else -1.0)

    def measure(coefficients: FloatArray) -> FloatArray:
        return np.asarray((basis.compute_inverse(functions, coefficients) - inverse) / unit)

    # Their squares are arctan((error / scale)^2): what is far off hardly counts, and MINPACK, which knows sums
    # of squares alone, takes half as long as `least_squares` does with a loss, and ends as near.
    def soften(coefficients: FloatArray) -> FloatArray:
        error = measure(coefficients) / scale
        return np.asarray(np.sign(error) * np.sqrt(np.arctan(error**2)))

    def differentiate(coefficients: FloatArray) -> FloatArray:
        error = np.abs(measure(coefficients)) / scale + TINY
        by_error = error / (np.sqrt(np.arctan(error**2)) * (1 + error**4) * scale * unit)
        return np.asarray(by_error[:, np.newaxis] * basis.differentiate(functions, coefficients))

    # With a constant l, q is a quadratic fit to squares: of some constants, the best is the start.
    starts = []
    for limb in middle - basis.sign * unit * LIMB_LEVELS:
        height = np.maximum(basis.sign * (inverse - limb), unit / 10)
        sure = 1 / height
        q, *_ = np.linalg.lstsq(2 * unit * sure[:, np.newaxis] * functions, height)
        starts.append(np.concatenate([[limb, 0, 0], q]))
    found = min(starts, key=lambda one: float(np.median(np.abs(measure(one)))))
    # frames' returns at a limb are far too near, all of them: what the others do not share hardly counts
    before = np.inf
    for _ in range(FIT_ROUNDS if len(functions) >= ROUND_COEFFICIENTS else 0):
        scale = float(np.median(np.abs(measure(found)))) + TINY
        if abs(scale - before) < FIT_TOLERANCE * scale:
            break
        before = scale
        settings = {"method": "lm", "x_scale": "jac", "ftol": FIT_TOLERANCE, "max_nfev": FIT_STEPS}
        found = scipy.optimize.least_squares(soften, found, differentiate, **settings).x
    return basis, found
