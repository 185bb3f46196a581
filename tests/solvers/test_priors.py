"""The priors' proximal steps against pictures whose answer can be written down."""

from __future__ import annotations

import numpy as np
import pytest

from tofclip.errors import InputError, ShapeError
from tofclip.operators import RadonProjection
from tofclip.solvers import NonnegativeTotalVariation, Regulariser, Wavelets
from tofclip.solvers.priors import NonnegativeLightFieldVariation, NonnegativeWavelets
from tofclip.threads import LANES


def denoise(
    prior: Regulariser, noisy: np.ndarray, calls: int = 300
) -> tuple[np.ndarray, np.ndarray]:
    """Run the warm-started proximal step on the same point until it has converged."""
    still = np.zeros(noisy.shape[-1], noisy.dtype)
    for _ in range(calls):
        result, penalty, _ = prior.proximal_step(
            noisy, np.zeros_like(noisy), still, np.zeros_like(noisy), np.ones_like(still)
        )
    return result, penalty


def smooth(
    picture: np.ndarray, weight: float, calls: int = 400, dtype: type = np.float64
) -> tuple[np.ndarray, float]:
    """Total variation of one picture, in a block of many."""
    block = np.tile(picture.astype(dtype)[..., np.newaxis], (1, 1, LANES))
    result, penalty = denoise(NonnegativeTotalVariation(weight), block, calls)
    assert np.ptp(result, axis=-1).max() == 0  # every lane the same
    return result[..., 0], float(penalty[0])


def test_two_plateaus_approach_each_other():
    """A step between halves of `n` columns moves each by weight / n (Strong and Chan 2003), until
    they meet.
    """
    picture = np.ones((6, 8))
    picture[:, 4:] = 3
    result, penalty = smooth(picture, 0.4)
    np.testing.assert_allclose(result[:, :4], 1 + 0.4 / 4, atol=1e-6)
    np.testing.assert_allclose(result[:, 4:], 3 - 0.4 / 4, atol=1e-6)
    assert penalty == pytest.approx(0.4 * 6 * (2 - 0.2), rel=1e-6)


def test_a_large_weight_leaves_the_mean():
    picture = np.random.default_rng(0).random((7, 5))
    result, _ = smooth(picture, 50.0, calls=3000)
    np.testing.assert_allclose(result, picture.mean(), atol=1e-4)


def test_negative_values_are_cut():
    picture = np.full((5, 5), -1.0)
    result, penalty = smooth(picture, 0.1)
    assert result.max() == 0
    assert penalty == 0


def test_no_weight_only_cuts_negative_values():
    picture = np.random.default_rng(1).standard_normal((6, 5))
    result, _ = smooth(picture, 0.0, calls=1)
    np.testing.assert_array_equal(result, np.maximum(picture, 0))


def test_it_beats_every_nearby_picture():
    """The step minimises 1/2 |x - v|^2 + w TV(x): no random change in any direction may lower it."""
    rng = np.random.default_rng(2)
    picture, weight = rng.random((9, 8)) + 0.5, 0.15
    best, _ = smooth(picture, weight, calls=4000)

    def objective(x: np.ndarray) -> float:
        vertical, horizontal = np.zeros_like(x), np.zeros_like(x)
        vertical[:-1], horizontal[:, :-1] = np.diff(x, axis=0), np.diff(x, axis=1)
        return 0.5 * np.sum((x - picture) ** 2) + weight * np.sum(np.hypot(vertical, horizontal))

    lowest = objective(best)
    for size in (1e-1, 1e-2, 1e-3):
        for _ in range(50):
            assert objective(best + size * rng.standard_normal(best.shape)) > lowest
    assert lowest < objective(np.full_like(picture, picture.mean()))
    assert lowest < objective(picture)


def test_float32_agrees_with_float64():
    picture = np.random.default_rng(3).random((9, 8))
    single, _ = smooth(picture, 0.2, dtype=np.float32)
    double, _ = smooth(picture, 0.2)
    np.testing.assert_allclose(single, double, atol=2e-6)


@pytest.mark.parametrize("weight", [-1.0, np.nan, np.inf])
def test_a_nonsensical_weight_is_refused(weight):
    with pytest.raises(InputError, match="weight"):
        NonnegativeTotalVariation(weight)


def test_views_on_their_own_are_ordinary_pictures():
    views = np.random.default_rng(0).random((6, 9, 8, 1))
    found, penalty = denoise(NonnegativeLightFieldVariation(0.2, (2, 3), 0.0), views)
    total = 0.0
    for view, picture in zip(found, views, strict=True):
        alone, its_penalty = denoise(NonnegativeTotalVariation(0.2), picture)
        np.testing.assert_allclose(view, alone, atol=1e-6)
        total += its_penalty[0]
    assert penalty[0] == pytest.approx(total, rel=1e-6)


@pytest.mark.parametrize(("grid", "axis"), [((2, 3), 0), ((3, 2), 1)])
def test_a_step_between_views_shrinks_from_both_sides(grid, axis):
    """Two even halves of `n` views along an axis approach by weight * angular / n, as steps between
    columns do.
    """
    halves = np.ones((4, 4, 3, 3))
    index = [slice(None)] * 4
    index[axis] = slice(2, None)
    halves[tuple(index)] = 3
    noisy = halves.reshape(16, 3, 3, 1)
    found, penalty = denoise(NonnegativeLightFieldVariation(0.4, (4, 4), 0.5), noisy, 600)
    known = np.where(noisy == 1, 1 + 0.4 * 0.5 / 2, 3 - 0.4 * 0.5 / 2)
    np.testing.assert_allclose(found, known, atol=1e-5)
    assert penalty[0] == pytest.approx(0.4 * 0.5 * (2 - 0.2) * 4 * 9, rel=1e-4)


def test_lanes_do_not_mix():
    views = np.random.default_rng(1).random((4, 7, 6, 2))
    both, _ = denoise(NonnegativeLightFieldVariation(0.1, (2, 2), 0.7), views, 50)
    one, _ = denoise(NonnegativeLightFieldVariation(0.1, (2, 2), 0.7), views[..., :1].copy(), 50)
    np.testing.assert_allclose(both[..., :1], one, atol=1e-12)


def test_negative_values_are_cut_without_any_weight():
    views = np.random.default_rng(2).standard_normal((4, 5, 5, 1)).astype(np.float32)
    found, _ = denoise(NonnegativeLightFieldVariation(0.0, (2, 2), 0.5), views, 1)
    np.testing.assert_array_equal(found, np.maximum(views, 0))


def test_what_does_not_fit_is_refused():
    with pytest.raises(InputError, match="angular"):
        NonnegativeLightFieldVariation(0.1, (2, 2), -1)
    with pytest.raises(ShapeError, match="views"):
        denoise(NonnegativeLightFieldVariation(0.1, (2, 3), 1), np.ones((4, 5, 5, 1)), 1)


def shrink(picture: np.ndarray, weight: float) -> tuple[np.ndarray, np.ndarray]:
    return denoise(NonnegativeWavelets(weight), picture, calls=1)


@pytest.mark.parametrize("shape", [(32, 32, 1), (37, 45, 3)])
def test_wavelets_without_a_weight_only_cut_negative_values(shape):
    picture = np.random.default_rng(0).standard_normal(shape)
    result, penalty = shrink(picture, 0.0)
    np.testing.assert_allclose(result, np.maximum(picture, 0), atol=1e-9)
    np.testing.assert_array_equal(penalty, 0)


def test_wavelets_leave_an_even_picture():
    even = np.full((48, 32, 2), 0.7)
    result, penalty = shrink(even, 5.0)
    np.testing.assert_allclose(result, 0.7, atol=1e-9)
    np.testing.assert_allclose(penalty, 0, atol=1e-6)


def test_wavelets_shrink_noise_and_no_slope():
    y, x = np.mgrid[:64, :64] / 64.0
    slope = (2 + np.sin(3 * x) + np.cos(2 * y))[..., np.newaxis]
    noisy = slope + 0.1 * np.random.default_rng(1).standard_normal(slope.shape)
    result, _ = shrink(noisy, 0.3)
    inner = (slice(8, -8), slice(8, -8))  # the transform takes the picture for periodic
    assert np.mean((result - slope)[inner] ** 2) < 0.2 * np.mean((noisy - slope)[inner] ** 2)


def test_wavelets_keep_float32():
    result, penalty = shrink(np.random.default_rng(2).random((24, 24, 2)).astype(np.float32), 0.1)
    assert result.dtype == np.float32
    assert penalty.dtype == np.float64


def test_with_wavelets_the_objective_falls_and_the_data_are_met():
    operator = RadonProjection((32, 32), 32, np.arange(24) * np.pi / 24, np.zeros(24))
    y, x = np.mgrid[:32, :32] - 15.5
    truth = np.exp(-(x**2 + y**2) / 40).astype(np.float32)
    measurements = operator(truth)[:, np.newaxis]
    result = Wavelets(1e-3, 80).recover(operator, measurements)
    assert np.all(np.diff(result.objective) <= 0)
    assert np.linalg.norm(operator(result.frames[0]) - measurements[:, 0]) < 0.02 * np.linalg.norm(
        measurements
    )
