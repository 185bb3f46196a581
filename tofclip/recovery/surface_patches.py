"""Smooth surfaces in a picture of ranges: connected patches, and a robust quadratic fit to each.

A surface's inverse depth 1/z is a quadratic function of the picture's coordinates: a plane's is
linear, exactly, and what is curved bends it gently. Range is ``length / (1/z)``, with the length of
the ray ``(X/f, Y/f, 1)``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

NEIGHBOUR_BINS = 1.6  # neighbouring pixels whose ranges differ by less lie on one surface
MIN_PATCH_PX = 25  # fewer returns are not a surface of their own
MERGE_BINS = 0.5  # misfit of either of two patches to one surface for both
MERGE_REACH_BINS = 7.0  # of the larger's fit at the smaller: further off it is not tried
FIT_ITERATIONS = 10
CURVATURE_PENALTY = 1e-3  # keeps small patches from bending
COEFFICIENTS = 6


@dataclass(frozen=True)
class Patch:
    """Returns that lie on one smooth surface.

    Parameters
    ----------
    pixels : (n,) int array
        Raster numbers.
    coefficients : (6,) float array
        Inverse depth, 1/m, over `evaluate_monomials`.
    """

    pixels: NDArray[np.intp]
    coefficients: FloatArray


def evaluate_monomials(pixels: NDArray[np.intp], image_shape: tuple[int, int]) -> FloatArray:
    """Return 1, x, y, x^2, xy and y^2 of pixels, (n, 6), in halves of the picture from its middle.

    Parameters
    ----------
    pixels : (n,) int array
        Raster numbers.
    image_shape : (int, int)
    """
    rows, columns = image_shape
    y, x = np.divmod(pixels, columns)
    down, right = 2 * y / rows - 1, 2 * x / columns - 1
    return np.stack([np.ones_like(x), right, down, right**2, right * down, down**2], axis=-1)


def find_patches(
    distance: NDArray[np.floating], ray_length: FloatArray, bin_m: float
) -> list[Patch]:
    """Find the smooth surfaces in a picture of ranges, the largest first.

    Parameters
    ----------
    distance : (rows, columns) float array
        Range of each pixel's strongest return, m; NaN where there is none.
    ray_length : (rows, columns) float array
        Range over depth of each pixel.
    bin_m : float
        Range of a bin, m.

    Returns
    -------
    list of Patch
    """
    patches = [
        Patch(pixels, _fit_inverse_depth(pixels, ray_length / distance))
        for pixels in _connect_neighbours(distance, NEIGHBOUR_BINS * bin_m)
    ]
    merged = True
    while merged:
        merged = False
        for first, patch in enumerate(patches):
            for second in range(first + 1, len(patches)):
                joint = _merge(patch, patches[second], distance, ray_length, bin_m)
                if joint is not None:
                    patches[first] = joint
                    del patches[second]
                    merged = True
                    break
            if merged:
                break
    return patches


def _connect_neighbours(distance: NDArray[np.floating], tolerance: float) -> list[NDArray[np.intp]]:
    """Connected pixels, eight neighbours each, whose ranges differ by less than a tolerance."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    rows, columns = distance.shape
    number = np.arange(distance.size).reshape(distance.shape)
    links = []
    for down, right in ((0, 1), (1, 0), (1, 1), (1, -1)):
        here = number[: rows - down, max(0, -right) : columns - max(0, right)]
        there = number[down:, max(0, right) : columns + min(0, right)]
        near = np.abs(distance.ravel()[here] - distance.ravel()[there]) < tolerance
        links.append(np.stack([here[near], there[near]]))
    ends = np.concatenate(links, axis=1)
    graph = coo_array((np.ones(ends.shape[1], np.int8), tuple(ends)), shape=(distance.size,) * 2)
    _, label = connected_components(graph, directed=False)
    sizes = np.bincount(label)
    largest = np.argsort(sizes)[::-1]
    return [np.flatnonzero(label == one) for one in largest[sizes[largest] >= MIN_PATCH_PX]]


def _fit_inverse_depth(pixels: NDArray[np.intp], inverse: FloatArray) -> FloatArray:
    """Fit the quadratic, outliers weighted down (Cauchy's weights)."""
    shape = (inverse.shape[0], inverse.shape[1])
    design, values = evaluate_monomials(pixels, shape), inverse.ravel()[pixels]
    weights, coefficients = np.ones(pixels.size), np.zeros(COEFFICIENTS)
    penalty = CURVATURE_PENALTY * pixels.size * np.diag([0.0, 0.0, 0.0, 1.0, 1.0, 1.0])
    for _ in range(FIT_ITERATIONS):
        normal = design.T @ (design * weights[:, np.newaxis]) + penalty * weights.mean()
        coefficients = np.linalg.solve(normal, design.T @ (weights * values))
        error = values - design @ coefficients
        scale = max(1.4826 * float(np.median(np.abs(error))), float(np.finfo(np.float32).eps))
        weights = 1 / (1 + (error / (2 * scale)) ** 2)
    return coefficients


def _merge(
    large: Patch,
    small: Patch,
    distance: NDArray[np.floating],
    ray_length: FloatArray,
    bin_m: float,
) -> Patch | None:
    """Return both as one patch if one surface fits either as well as a surface of its own."""
    shape = (distance.shape[0], distance.shape[1])

    def median_error(patch: Patch, coefficients: FloatArray) -> float:
        inverse = evaluate_monomials(patch.pixels, shape) @ coefficients
        fitted = ray_length.ravel()[patch.pixels] / inverse
        return float(np.median(np.abs(fitted - distance.ravel()[patch.pixels])))

    if median_error(small, large.coefficients) > MERGE_REACH_BINS * bin_m:
        return None
    pixels = np.concatenate([large.pixels, small.pixels])
    joint = Patch(pixels, _fit_inverse_depth(pixels, ray_length / distance))
    errors = (median_error(one, joint.coefficients) for one in (large, small))
    return joint if max(errors) < MERGE_BINS * bin_m else None
