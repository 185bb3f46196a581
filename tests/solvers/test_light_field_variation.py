"""Total variation over a light field, against the two-dimensional one and against pictures with
known answers.
"""

from __future__ import annotations

import numpy as np
import pytest

from tofclip.errors import InputError, ShapeError
from tofclip.solvers import NonnegativeTotalVariation, Regulariser
from tofclip.solvers.priors import NonnegativeLightFieldVariation


def denoised(
    prior: Regulariser, noisy: np.ndarray, calls: int = 300
) -> tuple[np.ndarray, np.ndarray]:
    """Run the warm-started proximal step on the same point until it has converged."""
    still = np.zeros(noisy.shape[-1], noisy.dtype)
    for _ in range(calls):
        result, penalty, _ = prior.proximal_step(
            noisy, np.zeros_like(noisy), still, np.zeros_like(noisy), np.ones_like(still)
        )
    return result, penalty


def test_views_on_their_own_are_ordinary_pictures():
    views = np.random.default_rng(0).random((6, 9, 8, 1))
    found, penalty = denoised(NonnegativeLightFieldVariation(0.2, (2, 3), 0.0), views)
    total = 0.0
    for view, picture in zip(found, views, strict=True):
        alone, its_penalty = denoised(NonnegativeTotalVariation(0.2), picture)
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
    found, penalty = denoised(NonnegativeLightFieldVariation(0.4, (4, 4), 0.5), noisy, 600)
    known = np.where(noisy == 1, 1 + 0.4 * 0.5 / 2, 3 - 0.4 * 0.5 / 2)
    np.testing.assert_allclose(found, known, atol=1e-5)
    assert penalty[0] == pytest.approx(0.4 * 0.5 * (2 - 0.2) * 4 * 9, rel=1e-4)


def test_lanes_do_not_mix():
    views = np.random.default_rng(1).random((4, 7, 6, 2))
    both, _ = denoised(NonnegativeLightFieldVariation(0.1, (2, 2), 0.7), views, 50)
    one, _ = denoised(NonnegativeLightFieldVariation(0.1, (2, 2), 0.7), views[..., :1].copy(), 50)
    np.testing.assert_allclose(both[..., :1], one, atol=1e-12)


def test_negative_values_are_cut_without_any_weight():
    views = np.random.default_rng(2).standard_normal((4, 5, 5, 1)).astype(np.float32)
    found, _ = denoised(NonnegativeLightFieldVariation(0.0, (2, 2), 0.5), views, 1)
    np.testing.assert_array_equal(found, np.maximum(views, 0))


def test_what_does_not_fit_is_refused():
    with pytest.raises(InputError, match="angular"):
        NonnegativeLightFieldVariation(0.1, (2, 2), -1)
    with pytest.raises(ShapeError, match="views"):
        denoised(NonnegativeLightFieldVariation(0.1, (2, 3), 1), np.ones((4, 5, 5, 1)), 1)
