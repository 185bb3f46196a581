"""Patches in returns, the bodies of which these may consist, and the shapes of surfaces."""

from __future__ import annotations

import numpy as np
import pytest
from surface_scene import BIN_M

from tofclip.recovery.surfaces.growing import bend_patches, find_bodies, find_halves
from tofclip.recovery.surfaces.patches import Patch, find_plain_patches
from tofclip.recovery.surfaces.shapes import (
    QuadricBasis,
    SmoothBasis,
    evaluate_monomials,
    guess_quadric,
)


def find_patches_in(distance: np.ndarray, ray_length: np.ndarray):
    pixels = np.flatnonzero(np.isfinite(distance))
    sure = np.full(pixels.size, BIN_M / 10)
    plain = find_plain_patches(pixels, distance.ravel()[pixels], sure, ray_length, BIN_M)
    return bend_patches(plain, BIN_M)


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


def test_what_no_quadratic_follows_gets_splines():
    y, x = np.indices((64, 64))
    ray_length = np.sqrt(1 + ((x - 32) / 300) ** 2 + ((y - 32) / 300) ** 2)
    waves = 1.5 + 0.01 * np.sin(x / 8) * np.cos(y / 9)
    distance = waves + 3e-4 * np.random.default_rng(0).standard_normal(waves.shape)
    (patch,) = find_patches_in(distance, ray_length)
    # noise of a tenth of a bin; waves of three
    assert np.median(np.abs(patch.compute_ranges(patch.pixels) - waves.ravel())) < 0.15 * BIN_M


def meet(middle, radius, axes):
    """Ranges of a ball or a rod, (64, 64), m, NaN beside it; how far inside its limb a ray is; range over
    depth.
    """
    y, x = np.indices((64, 64))
    rays = np.stack([(x - 32) / 300, (y - 32) / 300, np.ones(x.shape)], axis=-1)
    middle, across = np.array(middle), np.array(axes)
    a, b = np.sum(across * rays**2, axis=-1), rays @ (across * middle)
    inside = b**2 - a * (np.sum(across * middle**2) - radius**2)
    ray_length = np.linalg.norm(rays, axis=-1)
    with np.errstate(invalid="ignore"):
        return ray_length * (b - np.sqrt(inside)) / a, inside, ray_length


def test_a_ball_and_the_cable_beside_it_are_parted():
    """Neighbours' ranges nowhere differ by more than a bin or two: they are one patch of returns, which
    one surface followed to 1.2 bins.
    """
    things = (meet((0.02, 0.0, 1.5), 0.09, (1, 1, 1)), meet((-0.07, 0.0, 1.48), 0.03, (1, 0, 1)))
    seen = [np.where(inside > 0.12 * inside.max(), ranges, np.nan) for ranges, inside, _ in things]
    truth = np.fmin(*seen)
    noise = 3e-4 * np.random.default_rng(0).standard_normal(truth.shape)
    for patch in find_patches_in(truth + noise, things[0][2]):
        error = patch.compute_ranges(patch.pixels) - truth.ravel()[patch.pixels]
        assert np.median(np.abs(error)) < 0.15 * BIN_M


def test_bodies_that_touch_grow_apart():
    """Six that touch, whose ranges a surface of second order follows to a bin and more, and no valley parts."""
    bodies = [
        ((0.0, -0.118, 1.5), (1 / 0.03, 1 / 0.04, 1 / 0.035)),  # each with half its sides
        ((0.0, 0.0, 1.5), (1 / 0.055, 1 / 0.085, 1 / 0.04)),
        *(((side * 0.07, 0.0, 1.5), (1 / 0.02, 1 / 0.08, 1 / 0.02)) for side in (-1, 1)),
        *(((side * 0.03, 0.11, 1.5), (1 / 0.025, 1 / 0.05, 1 / 0.025)) for side in (-1, 1)),
    ]
    seen = [meet(middle, 1, np.square(axes)) for middle, axes in bodies]
    ranges = np.array([np.where(inside > 0, distance, np.inf) for distance, inside, _ in seen])
    nearest, truth = ranges.argmin(axis=0).ravel(), ranges.min(axis=0)
    pixels, bin_m = np.flatnonzero(np.isfinite(truth)), BIN_M / 4
    noise = 0.3 * bin_m * np.random.default_rng(0).standard_normal(truth.shape)
    distance = (truth + noise).ravel()[pixels]
    patch = Patch.fit(pixels, distance, np.full(pixels.size, bin_m), seen[0][2])
    assert patch.compute_error() > bin_m
    parts = find_bodies([patch], bin_m)
    owners = [np.bincount(nearest[part.pixels], minlength=6) for part in parts]
    assert {int(owner.argmax()) for owner in owners} == set(range(6))
    assert sum(owner.max() for owner in owners) > 0.95 * pixels.size
    # what one surface follows as nearly is not taken apart
    for part in parts:
        assert find_bodies([part], bin_m) == []
    assert find_bodies(parts, bin_m) == []


def test_the_top_of_a_cup_is_parted_from_its_side():
    """Of 13 x 6 and 13 x 9 px."""
    truth, _, ray_length = meet((0.0, 0.0, 1.5), 0.03, (1, 0, 1))
    y, x = np.indices(truth.shape)
    top, side = (y >= 26) & (y < 32), (y >= 32) & (y < 41)
    truth = np.where(top, 1.47 + 0.012 * (32 - y), truth)
    within = (np.abs(x - 32) <= 6) & (top | side)
    pixels, bin_m = np.flatnonzero(within), BIN_M / 4
    noise = 0.5 * bin_m * np.random.default_rng(0).standard_normal(pixels.size)
    distance = truth.ravel()[pixels] + noise
    patch = Patch.fit(pixels, distance, np.full(pixels.size, bin_m), ray_length)
    owners = [np.mean(top.ravel()[part.pixels]) for part in find_halves(patch, bin_m)]
    assert sorted(owners) == pytest.approx([0, 1], abs=0.1)


def test_what_is_one_body_has_no_halves():
    truth, inside, ray_length = meet((0.03, -0.02, 1.5), 0.04, (1, 1, 1))
    pixels, bin_m = np.flatnonzero(inside > 0.1 * inside.max()), BIN_M / 4
    noise = 0.5 * bin_m * np.random.default_rng(0).standard_normal(pixels.size)
    distance = truth.ravel()[pixels] + noise
    patch = Patch.fit(pixels, distance, np.full(pixels.size, bin_m), ray_length)
    assert find_halves(patch, bin_m) == []


def test_what_is_a_row_high_is_halved_along_it():
    pixels, ray_length, bin_m = np.arange(640, 704), np.ones((64, 64)), BIN_M / 4
    distance = 1.5 + np.where(pixels < 670, 0.0, 12 * bin_m)
    patch = Patch.fit(pixels, distance, np.full(pixels.size, bin_m), ray_length)
    first, second = sorted(find_halves(patch, bin_m), key=lambda part: int(part.pixels[0]))
    assert first.pixels.max() < 670 <= second.pixels.min()


@pytest.mark.parametrize("axes", [(1, 1, 1), (1, 0, 1)])
def test_the_nearest_round_surface_does_not_follow_what_is_off(axes):
    truth, inside, ray_length = meet((0.03, -0.02, 1.5), 0.12, axes)
    pixels = np.flatnonzero(inside > 0.1 * inside.max())
    distance = truth.ravel()[pixels]

    def measure_error(distance):
        basis, found = guess_quadric(pixels, ray_length.ravel()[pixels] / distance, truth.shape)
        fitted = ray_length.ravel()[pixels] / basis.compute_inverse(basis.evaluate(pixels), found)
        return np.median(np.abs(fitted - truth.ravel()[pixels]))

    assert measure_error(distance) < 0.01 * BIN_M
    distance[::10] += 5 * BIN_M  # 0.5 bins on average
    assert measure_error(distance) < 0.25 * BIN_M


@pytest.mark.parametrize("axes", [(1, 1, 1), (1, 0, 1)])
def test_a_ball_and_a_rod_are_followed_up_to_their_limbs(axes):
    """Frames' returns at a limb are far too near, all of them, and no polynomial is as steep."""
    truth, inside, ray_length = meet((0.03, -0.02, 1.5), 0.12, axes)
    limb = inside / inside.max() < 0.15
    random = np.random.default_rng(0)
    distance = truth + 3e-4 * random.standard_normal(truth.shape)
    distance[limb] -= random.uniform(0, 0.01, truth.shape)[limb]
    patch = max(find_patches_in(distance, ray_length), key=lambda one: one.pixels.size)
    # what a pixel at the limb sees is a mean of what is there
    seen = np.flatnonzero(inside > 0.05 * inside.max())
    error = patch.compute_ranges(seen) - truth.ravel()[seen]
    assert np.median(np.abs(error)) < 0.1 * BIN_M
    assert np.quantile(np.abs(error), 0.95) < BIN_M  # splines: 5 bins at the limb


def test_derivatives_of_a_round_surface_are_those_of_differences():
    basis = QuadricBasis((40, 50), (5, 8, 35, 42), unit=0.02)
    coefficients = np.array([0.3, 0.01, 0.02, 0.1, 0.01, 0.005, -0.1, 0.008, -0.12])
    functions = basis.evaluate(np.arange(40 * 50))  # within, at the limb, and beyond
    found = basis.differentiate(functions, coefficients)
    for number, step in enumerate(1e-6 * np.eye(coefficients.size)):
        ahead, behind = (
            basis.compute_inverse(functions, coefficients + sign * step) for sign in (1, -1)
        )
        np.testing.assert_allclose(found[:, number], (ahead - behind) / 2e-6, rtol=1e-4, atol=1e-6)


def test_a_round_surface_moves_as_its_derivatives_say():
    """l and q make up for each other nearly: what hardly changes a ball is a long way in both."""
    basis = QuadricBasis((40, 50), (5, 8, 35, 42), unit=0.02)
    coefficients = np.array([0.3, 0.0, 0.0, 0.1, 0.0, 0.0, -0.1, 0.0, -0.1])
    functions = basis.evaluate(np.arange(40 * 50))
    light = (functions @ coefficients[3:] > 0.01).astype(np.float32)
    derivatives = basis.differentiate(functions, coefficients)[light > 0]
    way = np.linalg.svd(derivatives / np.linalg.norm(derivatives, axis=0))[2][-1]
    way /= np.linalg.norm(derivatives, axis=0)
    change = 0.02 * way / abs(way[0])  # of l, where the ball rises by 0.06
    ends = coefficients + change, basis.take_step(functions, coefficients, change, light)
    aim = basis.compute_inverse(functions, coefficients)[light > 0] + derivatives @ change
    plain, taken = (
        np.abs(basis.compute_inverse(functions, end)[light > 0] - aim).mean() for end in ends
    )
    assert taken < 0.2 * plain


def test_splines_are_a_quadratic_and_what_bends():
    """Cubic splines hold every quadratic, so that taking it apart and together changes nothing."""
    shape = (40, 50)
    basis = SmoothBasis(shape, (-3, 5, 30, 45), (3, 4))
    coefficients, quadratic = basis.quadratic_parts
    np.testing.assert_allclose(quadratic @ coefficients, np.eye(6), atol=1e-8)
    pixels = np.ravel_multi_index(np.mgrid[2:28, 8:40].reshape(2, -1), shape)
    monomials = evaluate_monomials(pixels, shape)
    np.testing.assert_allclose(basis.evaluate(pixels) @ coefficients, monomials, atol=1e-8)
    # no pixel at all ended the recovery of a shot
    assert basis.evaluate(pixels[:0]).shape == (0, len(coefficients))
