"""The total-variation step against pictures whose answer can be written down."""

from __future__ import annotations

import numpy as np
import pytest

from tofclip.solvers import NonnegativeTotalVariation
from tofclip.threads import LANES


def denoise(
    picture: np.ndarray, weight: float, calls: int = 400, dtype: type = np.float64
) -> tuple[np.ndarray, float]:
    """Run the warm-started proximal step on the same point until it has converged."""
    block = np.tile(picture.astype(dtype)[..., np.newaxis], (1, 1, LANES))
    prior = NonnegativeTotalVariation(weight)
    still = np.zeros(LANES, dtype)
    for _ in range(calls):
        result, penalty, _ = prior.proximal_step(
            block, np.zeros_like(block), still, np.zeros_like(block), np.ones(LANES, dtype)
        )
    assert np.ptp(result, axis=-1).max() == 0  # every lane the same
    return result[..., 0], float(penalty[0])


def test_two_plateaus_approach_each_other():
    """A step between halves of `n` columns moves each by weight / n (Strong and Chan 2003), until
    they meet.
    """
    picture = np.ones((6, 8))
    picture[:, 4:] = 3
    result, penalty = denoise(picture, 0.4)
    np.testing.assert_allclose(result[:, :4], 1 + 0.4 / 4, atol=1e-6)
    np.testing.assert_allclose(result[:, 4:], 3 - 0.4 / 4, atol=1e-6)
    assert penalty == pytest.approx(0.4 * 6 * (2 - 0.2), rel=1e-6)


def test_a_large_weight_leaves_the_mean():
    picture = np.random.default_rng(0).random((7, 5))
    result, _ = denoise(picture, 50.0, calls=3000)
    np.testing.assert_allclose(result, picture.mean(), atol=1e-4)


def test_negative_values_are_cut():
    picture = np.full((5, 5), -1.0)
    result, penalty = denoise(picture, 0.1)
    assert result.max() == 0
    assert penalty == 0


def test_no_weight_only_cuts_negative_values():
    picture = np.random.default_rng(1).standard_normal((6, 5))
    result, _ = denoise(picture, 0.0, calls=1)
    np.testing.assert_array_equal(result, np.maximum(picture, 0))


def test_it_beats_every_nearby_picture():
    """The step minimises 1/2 |x - v|^2 + w TV(x): no random change in any direction may lower it."""
    rng = np.random.default_rng(2)
    picture, weight = rng.random((9, 8)) + 0.5, 0.15
    best, _ = denoise(picture, weight, calls=4000)

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
    single, _ = denoise(picture, 0.2, dtype=np.float32)
    double, _ = denoise(picture, 0.2)
    np.testing.assert_allclose(single, double, atol=2e-6)


@pytest.mark.parametrize("weight", [-1.0, np.nan, np.inf])
def test_a_nonsensical_weight_is_refused(weight):
    from tofclip.errors import InputError

    with pytest.raises(InputError, match="weight"):
        NonnegativeTotalVariation(weight)
