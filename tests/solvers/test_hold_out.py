"""The choice of a weight by cross-validation, on problems whose best weight is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tofclip.errors import InputError
from tofclip.metrics import nmse
from tofclip.operators import RadonProjection
from tofclip.solvers import TotalVariation
from tofclip.solvers.cross_validation import (
    FOLD_COUNT,
    INITIAL_WEIGHT,
    MAX_WEIGHT_WORK,
    SINGLE_FOLD_RUNS,
    WEIGHT_RATIO,
    _search_downhill,
    assign_folds,
    choose_weight,
)


@given(count=st.integers(2, 3000), run=st.integers(1, 200), seed=st.integers(0, 9))
def test_every_reading_is_left_out_once(count, run, seed):
    out = assign_folds(count, run, seed)
    assert out.shape[0] == count
    assert out.any(axis=0).all()
    if out.shape[1] > 1:
        np.testing.assert_array_equal(out.sum(axis=1), 1)
    else:
        assert 0.05 < out.mean() < 0.25  # one of eight folds, of many runs


def test_neighbours_are_left_out_together():
    out = assign_folds(16 * 20, 20, 3).reshape(16, 20, FOLD_COUNT)
    np.testing.assert_array_equal(out.all(axis=1), out.any(axis=1))


def test_many_runs_need_one_fold_only():
    assert assign_folds(SINGLE_FOLD_RUNS, 1, 0).shape[1] == 1
    assert assign_folds(SINGLE_FOLD_RUNS - 1, 1, 0).shape[1] == FOLD_COUNT


def test_one_reading_alone_is_refused():
    with pytest.raises(InputError, match="as a number"):
        assign_folds(1, 1, 0)


@pytest.mark.parametrize("lowest", [-3.4, -0.7, 0.0, 0.4, 4.2])
def test_the_search_finds_the_lowest_point_of_a_parabola(lowest):
    choice = _search_downhill(
        lambda weight: 3 + (np.log(weight / INITIAL_WEIGHT) / np.log(WEIGHT_RATIO) - lowest) ** 2
    )
    assert choice.weight == pytest.approx(INITIAL_WEIGHT * WEIGHT_RATIO**lowest, rel=1e-6)
    assert np.all(np.diff(choice.trial_weights) > 0)


def test_an_error_that_only_falls_ends_the_search():
    choice = _search_downhill(lambda weight: weight)
    assert choice.trial_weights.size == 10
    assert choice.weight == choice.trial_weights[0]


@pytest.mark.parametrize("noise", [0.02, 0.1])
def test_the_picture_is_nearly_as_good_as_with_the_best_weight(noise):
    operator = RadonProjection((40, 40), 40, np.arange(20) * np.pi / 20, np.zeros(20))
    truth = np.zeros((40, 40), np.float32)
    truth[8:30, 10:18], truth[12:20, 10:34] = 1, 0.5
    clean = operator(truth)
    random = np.random.default_rng(0)
    measurements = (clean + noise * clean.max() * random.standard_normal(clean.shape)).astype(
        np.float32
    )
    method = TotalVariation(1.0, 200, 1e-4)

    def error(weight: float) -> float:
        return nmse(
            replace(method, weight=weight).recover(operator, measurements[:, np.newaxis]).frames[0],
            truth,
        )

    best = min(error(weight) for weight in 10.0 ** np.arange(-3, -0.5, 0.25))
    # 20 % is the project's acceptance for a weight chosen without the truth
    done: list[int] = []
    found = choose_weight(method, operator, measurements, 40, progress=done.append)
    assert error(found.weight) < 1.2 * best
    assert sum(done) == MAX_WEIGHT_WORK  # a bar ends at its end
    assert len(done) == 1 + found.errors.size * FOLD_COUNT  # and moves with every recovery
