"""Data terms against their definitions: gradients by differences, curvature at most 1, bad measurements
left out.
"""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tofclip.errors import InputError, ShapeError
from tofclip.solvers import ClippedSquares, Huber, LeastSquares, Poisson
from tofclip.solvers.data_terms import DataTermMaker, estimate_robust_deviation

COUNTS = np.array([0.0, 1, 3, 20, 400, 1e4])
DEVIATION = np.sqrt(COUNTS + 1)
SCALED = (COUNTS / DEVIATION)[:, np.newaxis]


def makers() -> list[DataTermMaker]:
    return [
        LeastSquares,
        partial(Huber, threshold=0.7),
        partial(Poisson, deviation=DEVIATION),
        partial(ClippedSquares, limit=50.0),
    ]


@pytest.mark.parametrize("make", makers(), ids=["squares", "huber", "poisson", "clipped"])
@given(shift=st.floats(-30, 30), seed=st.integers(0, 99))
def test_the_gradient_is_the_derivative_of_the_value(make, shift, seed):
    term = make(SCALED)
    at = SCALED + shift * np.random.default_rng(seed).random(SCALED.shape)
    step = 1e-5
    for reading in range(COUNTS.size):
        aside = np.zeros_like(at)
        aside[reading] = step
        slope = (term.value(at + aside)[0] - term.value(at - aside)[0]) / (2 * step)
        # central differences in float64: rounding 1e-16 * value / step, curvature changes within
        # the step
        assert slope == pytest.approx(term.gradient(at)[reading, 0], rel=1e-4, abs=1e-4)


@pytest.mark.parametrize("make", makers(), ids=["squares", "huber", "poisson", "clipped"])
@given(one=st.floats(-50, 50), other=st.floats(-50, 50))
def test_the_gradient_is_lipschitz_with_constant_one(make, one, other):
    term = make(SCALED)
    change = term.gradient(SCALED + one) - term.gradient(SCALED + other)
    assert np.all(np.abs(change) <= abs(one - other) * (1 + 1e-9) + 1e-12)


@pytest.mark.parametrize("make", makers(), ids=["squares", "huber", "poisson", "clipped"])
def test_the_readings_themselves_fit_best(make):
    term = make(SCALED)
    assert term.value(SCALED)[0] == pytest.approx(0, abs=1e-9)
    for shift in (-0.3, 0.3):
        assert term.value(np.maximum(SCALED + shift, 0) + 1e-3)[0] > 0


@pytest.mark.parametrize("make", makers(), ids=["squares", "huber", "poisson", "clipped"])
def test_readings_that_are_not_good_do_not_count(make):
    valid = np.ones(SCALED.shape, bool)
    valid[2] = False
    far = SCALED.copy()
    far[2] += 9
    assert make(SCALED, valid).value(far)[0] == pytest.approx(0, abs=1e-9)
    assert make(SCALED, valid).gradient(far)[2, 0] == 0


def test_what_is_cut_off_may_be_brighter_but_not_darker():
    term = ClippedSquares(np.full((3, 1), 10.0), limit=10.0)
    np.testing.assert_array_equal(term.gradient(np.array([[8.0], [10], [90]]))[:, 0], [-2, 0, 0])
    assert term.value(np.array([[8.0], [10], [90]]))[0] == 2
    with pytest.raises(InputError, match="must be positive"):
        ClippedSquares(SCALED, limit=0.0)


def test_huber_is_squares_within_and_straight_beyond_its_threshold():
    term = Huber(np.zeros((3, 1)), threshold=2.0)
    np.testing.assert_allclose(term.gradient(np.array([[1.0], [2.0], [50.0]]))[:, 0], [1, 2, 2])
    assert term.value(np.array([[0.0], [0.0], [50.0]]))[0] == pytest.approx(2 * (50 - 1))


def test_poisson_is_the_likelihood_up_to_its_scale():
    """Above half a count and a half the term is counts - n log(counts), less its least value, over
    the curvature.
    """
    expected = np.array([1.0, 2, 5, 30, 300, 12000])
    term = Poisson(SCALED, deviation=DEVIATION)
    # n log(n) is 0 where n is
    log_counts = np.log(np.maximum(COUNTS, 1))
    likelihood = np.sum(expected - COUNTS * np.log(expected) - (COUNTS - COUNTS * log_counts))
    assert term.value((expected / DEVIATION)[:, np.newaxis])[0] == pytest.approx(
        likelihood / Poisson.CURVATURE
    )


def test_the_robust_deviation_is_that_of_gaussian_errors():
    errors = np.random.default_rng(0).normal(0, 3, 20001)
    errors[:1000] = 1e6
    assert estimate_robust_deviation(errors) == pytest.approx(
        3, rel=0.1
    )  # 5 % of outliers raise the median size by 6 %


def test_what_cannot_be_is_refused():
    with pytest.raises(InputError, match="threshold"):
        Huber(SCALED, threshold=0)
    with pytest.raises(InputError, match="negative"):
        Poisson(-SCALED, deviation=DEVIATION)
    with pytest.raises(ShapeError):
        LeastSquares(SCALED, np.ones((2, 1), bool))
    with pytest.raises(InputError, match="met exactly"):
        estimate_robust_deviation(np.zeros(5))


@pytest.mark.parametrize("make", [LeastSquares, partial(Huber, threshold=4.0)])
@pytest.mark.parametrize("scale", [0.3, 1.0])
def test_the_dual_value_is_minus_the_conjugate(make, scale):
    """Of f at u: the largest of <u, z> - f(z), which is where the gradient at z is u."""
    slope = np.random.default_rng(3).standard_normal(SCALED.shape)
    term, pull = make(SCALED), scale * slope
    reached = SCALED + pull
    np.testing.assert_allclose(term.gradient(reached), pull)
    expected = term.value(reached) - np.sum(pull * reached, axis=0)
    np.testing.assert_allclose(term.dual_value(slope, np.array([scale])), expected, rtol=1e-9)
