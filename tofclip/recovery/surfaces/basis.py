"""Smooth functions over the picture, of which the inverse depths of surfaces are sums.

A surface's inverse depth 1/z is a quadratic of the picture's coordinates, which a plane's is exactly,
or a spline where a quadratic does not follow its returns. Range is ``length / (1/z)``, with the length
of the ray ``(X/f, Y/f, 1)``.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
Pixels = NDArray[np.intp]

COEFFICIENTS = 6  # of a quadratic
SPLINE_DEGREE = 3


@dataclass(frozen=True)
class SmoothBasis:
    """Smooth functions over the picture, of which a surface's inverse depth is a sum."""

    image_shape: tuple[int, int]
    # first row and column, and those after the last, over which splines run
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
        """Return the functions' values at raster numbers, (pixels, n)."""
        if self.is_quadratic:
            return evaluate_monomials(pixels, self.image_shape)
        y, x = np.divmod(pixels, self.image_shape[1])
        top, left, bottom, right = self.box
        down = _evaluate_splines((y - top + 0.5) / (bottom - top), self.pieces[0])
        across = _evaluate_splines((x - left + 0.5) / (right - left), self.pieces[1])
        return (down[:, :, np.newaxis] * across[:, np.newaxis]).reshape(pixels.size, -1)

    def split_quadratic(self) -> tuple[FloatArray, FloatArray]:
        """Return the coefficients of the six monomials over this basis, (n, 6), and what of each
        function is such a quadratic, (6, n), both as least squares over the splines' box.
        """
        if self.is_quadratic:
            return np.eye(COEFFICIENTS), np.eye(COEFFICIENTS)
        top, left, bottom, right = self.box
        y, x = np.mgrid[top:bottom, left:right].reshape(2, -1)
        pixels = y * self.image_shape[1] + x
        inside = (x >= 0) & (x < self.image_shape[1]) & (y >= 0) & (y < self.image_shape[0])
        functions, monomials = (
            evaluate(pixels[inside])
            for evaluate in (self.evaluate, lambda one: evaluate_monomials(one, self.image_shape))
        )
        coefficients, *_ = np.linalg.lstsq(functions, monomials)
        quadratic, *_ = np.linalg.lstsq(monomials, functions)
        return coefficients.astype(np.float64), quadratic.astype(np.float64)


def _evaluate_splines(place: FloatArray, pieces: int) -> FloatArray:
    """Uniform cubic B-splines over 0..1, (points, pieces + 3); beyond the ends as at the ends."""
    from scipy.interpolate import BSpline

    knots = np.arange(-SPLINE_DEGREE, pieces + SPLINE_DEGREE + 1) / pieces
    inside = np.clip(place, 0.0, 1 - 1e-9)
    found: FloatArray = BSpline.design_matrix(inside, knots, SPLINE_DEGREE).toarray()
    return found


def make_second_differences(pieces: tuple[int, int]) -> FloatArray:
    """Return the matrix of second differences of neighbouring coefficients, along rows and columns."""
    rows, columns = (number + SPLINE_DEGREE for number in pieces)
    down, across = (np.diff(np.eye(number), 2, axis=0) for number in (rows, columns))
    return np.concatenate([np.kron(down, np.eye(columns)), np.kron(np.eye(rows), across)])


def evaluate_monomials(pixels: Pixels, image_shape: tuple[int, int]) -> FloatArray:
    """Return 1, x, y, x^2, xy and y^2 of pixels, (n, 6), in halves of the picture from its middle.

    `pixels` (n,): raster numbers.
    """
    rows, columns = image_shape
    y, x = np.divmod(pixels, columns)
    down, right = 2 * y / rows - 1, 2 * x / columns - 1
    return np.stack([np.ones_like(x), right, down, right**2, right * down, down**2], axis=-1)
