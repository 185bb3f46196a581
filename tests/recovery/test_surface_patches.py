"""Smooth surfaces in the returns of frames."""

from __future__ import annotations

import numpy as np
from surface_scene import BIN_M

from tofclip.recovery.surfaces.patches import SmoothBasis, evaluate_monomials, find_patches


def find_patches_in(distance: np.ndarray, ray_length: np.ndarray):
    pixels = np.flatnonzero(np.isfinite(distance))
    return find_patches(pixels, distance.ravel()[pixels], ray_length, BIN_M)


def test_patches_are_planes_to_rounding_and_halves_of_one_are_joined():
    y, x = np.indices((40, 40))
    ray_length = np.sqrt(1 + ((x - 20) / 150) ** 2 + ((y - 20) / 150) ** 2)
    plane = ray_length / (0.5 + 1e-3 * x - 5e-4 * y)
    distance = plane.copy()
    distance[:, 18:21] = np.nan  # cut in two
    distance[5:12, 25:33] = 1.2 * ray_length[5:12, 25:33]
    distance[30, 30] = 1.0  # alone
    patches = find_patches_in(distance, ray_length)
    assert [patch.pixels.size for patch in patches] == [40 * 37 - 56 - 1, 56]
    everywhere = patches[0].basis.evaluate(np.arange(1600))
    fitted = ray_length.ravel() / (everywhere @ patches[0].coefficients)
    np.testing.assert_allclose(fitted, plane.ravel(), atol=1e-4)


def test_a_ball_that_no_quadratic_follows_gets_splines():
    y, x = np.indices((64, 64))
    ray_length = np.sqrt(1 + ((x - 32) / 300) ** 2 + ((y - 32) / 300) ** 2)
    square = 1 - ((x - 32) ** 2 + (y - 32) ** 2) / 27.0**2
    ball = np.where(square > 0.1, 1.5 - 0.12 * np.sqrt(np.maximum(square, 0)), np.nan)
    distance = ball + 3e-4 * np.random.default_rng(0).standard_normal(ball.shape)
    (patch,) = find_patches_in(distance, ray_length)
    assert not patch.basis.is_quadratic
    fitted = ray_length.ravel()[patch.pixels] / (
        patch.basis.evaluate(patch.pixels) @ patch.coefficients
    )
    # noise of a tenth of a bin; the quadratic leaves 0.38 bins
    assert np.median(np.abs(fitted - ball.ravel()[patch.pixels])) < 0.15 * BIN_M


def test_splines_are_a_quadratic_and_what_bends():
    """Cubic splines hold every quadratic, so that taking it apart and together changes nothing."""
    shape = (40, 50)
    basis = SmoothBasis(shape, (-3, 5, 30, 45), (3, 4))
    coefficients, quadratic = basis.split_quadratic()
    np.testing.assert_allclose(quadratic @ coefficients, np.eye(6), atol=1e-8)
    pixels = np.ravel_multi_index(np.mgrid[2:28, 8:40].reshape(2, -1), shape)
    monomials = evaluate_monomials(pixels, shape)
    np.testing.assert_allclose(basis.evaluate(pixels) @ coefficients, monomials, atol=1e-8)
