"""The iterative solver against problems whose answers are known."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import scipy.optimize
import scipy.sparse

from tofclip.errors import InputError, ShapeError
from tofclip.operators import LineProjection, SparseMatrix, estimate_squared_norm
from tofclip.solvers import (
    DataTerm,
    Fista,
    Huber,
    LeastSquares,
    NonnegativeSparsity,
    NonnegativeTotalVariation,
    ProximalStep,
    Regulariser,
    Sparse,
    StoppingRule,
    TotalVariation,
    ignore_progress,
    iterate,
)
from tofclip.solvers.methods import (
    GAP_INTERVAL,
    MIN_FURTHER_FALL,
    NOISE_FRACTION,
    IterationHistory,
    Result,
)
from tofclip.threads import LANES

WEIGHT_RULE = "weights are relative to the largest A'f of all frames"


def identity(shape: tuple[int, int], dtype: type = np.float64) -> SparseMatrix:
    size = shape[0] * shape[1]
    return SparseMatrix(scipy.sparse.eye_array(size, dtype=dtype, format="csr"), shape, (size,))


def projection() -> LineProjection:
    return LineProjection(
        (12, 11), 40, [8.2, 20.0, 31.5], [-0.7, 0.05, 0.6], [1.0, 0.8, 1.1], np.float64
    )


def begin(data_term: DataTerm, prior: Regulariser) -> Fista:
    """A block of `LANES` frames of `projection`, at darkness."""
    operator = projection()
    return Fista(operator, data_term, prior, 1 / estimate_squared_norm(operator, 99), LANES)


def noise(seed: int, frames: int = 5) -> np.ndarray:
    return np.abs(np.random.default_rng(seed).standard_normal((40, frames)))


def test_sparsity_on_the_identity_is_soft_thresholding():
    measurements = np.random.default_rng(0).standard_normal((35, 5))
    weight = 0.3 * measurements.max()
    result = Sparse(weight=0.3, iterations=40).recover(identity((5, 7)), measurements)
    expected = np.maximum(measurements - weight, 0).T.reshape(5, 5, 7)
    # The step is 2 % below the exact one, so an error shrinks geometrically and fast.
    np.testing.assert_allclose(result.frames, expected, atol=1e-9, err_msg=WEIGHT_RULE)


def test_total_variation_on_the_identity_moves_two_levels_together():
    """Of two even parts the edge costs its length times its height, so that each part of n columns
    gives way by weight / n; of all frames the brightest sets the weight.
    """
    levels = np.array([[10.0, 4.0], [2.0, 6.0], [3.0, 3.0]])
    columns, weight = np.array([4, 6]), 0.05 * levels.max()
    pictures = np.repeat(levels, columns, axis=1)[:, np.newaxis].repeat(7, axis=1)
    measurements = pictures.reshape(3, -1).T
    method = TotalVariation(weight=0.05, iterations=400, gap=0.0)
    found = method.recover(identity((7, 10)), measurements).frames
    toward = np.sign(levels[:, ::-1] - levels)
    expected = np.repeat(levels + toward * weight / columns, columns, axis=1)[:, np.newaxis]
    np.testing.assert_allclose(
        found, np.broadcast_to(expected, found.shape), atol=1e-3, err_msg=WEIGHT_RULE
    )


@pytest.mark.parametrize("method", [Sparse(2e-2, 40), TotalVariation(2e-2, 40)], ids=["l1", "tv"])
def test_a_shot_of_any_brightness_gives_the_same_pictures(method):
    measurements = noise(5)
    dim, bright = (method.recover(projection(), f * measurements).frames for f in (1, 1000))
    np.testing.assert_allclose(
        bright, 1000 * dim, rtol=1e-6, atol=1e-6 * bright.max(), err_msg=WEIGHT_RULE
    )


def test_without_a_weight_it_solves_nonnegative_least_squares():
    operator = projection()
    truth = np.maximum(np.random.default_rng(1).standard_normal((12, 11)), 0)
    measurements = operator(truth) + 0.1 * np.random.default_rng(2).standard_normal(40)
    _, expected = scipy.optimize.nnls(operator.matrix.toarray(), measurements)
    solver = begin(LeastSquares(_lanes(measurements)), NonnegativeSparsity(0))
    iterate(solver, StoppingRule(4000), ignore_progress, LANES)
    assert np.sqrt(2 * solver.objective[0]) == pytest.approx(expected, rel=1e-6)


def test_optimality_of_sparse_solutions():
    """At the minimum A'(f - A h) = weight where h > 0 and <= weight elsewhere."""
    operator = projection()
    truth = np.zeros((12, 11))
    truth[3:5, 4:8] = [[1, 2, 1, 3], [2, 2, 1, 1]]
    measurements = operator(truth)
    weight = 0.02
    solver = begin(LeastSquares(_lanes(measurements)), NonnegativeSparsity(weight))
    iterate(solver, StoppingRule(6000), ignore_progress, LANES)
    picture = solver.current[..., 0]
    pull = operator.adjoint(measurements - operator(picture))
    assert np.abs(pull[picture > 1e-3] - weight).max() < 1e-3 * weight
    assert pull.max() <= weight * (1 + 1e-3)


def test_the_objective_never_rises():
    measurements = noise(3, LANES)
    for prior in (NonnegativeSparsity(0.01), NonnegativeTotalVariation(0.05)):
        solver = begin(LeastSquares(measurements), prior)
        before = solver.objective
        rejected = 0
        for _ in range(150):
            solver.step()
            assert np.all(solver.objective <= before)
            rejected += int(solver.rejected.sum())
            before = solver.objective
        assert rejected > 0  # or the monotone restart was never put to the test


def test_what_a_refused_frame_reports_belongs_to_its_picture():
    operator = projection()
    measurements = noise(4, LANES)
    solver = begin(LeastSquares(measurements), NonnegativeSparsity(0.01))
    for _ in range(60):
        solver.step()
        if solver.rejected.any():
            break
    assert solver.rejected.any()
    expected = 0.5 * ((operator(solver.current) - measurements) ** 2).sum(
        0
    ) + 0.01 * solver.current.sum((0, 1))
    np.testing.assert_allclose(solver.objective, expected, rtol=1e-12)


@pytest.mark.parametrize("method", [Sparse(1e-2, 40), TotalVariation(1e-2, 40)], ids=["l1", "tv"])
def test_a_frame_does_not_depend_on_its_neighbours(method):
    operator = projection()
    measurements = noise(5, 50)
    measurements[:, 17] *= 3  # the brightest: it sets the scale of the weight in both runs
    whole = method.recover(operator, measurements)
    part = method.recover(operator, measurements[:, 15:20])
    np.testing.assert_allclose(
        part.frames, whole.frames[15:20], rtol=1e-9, atol=1e-12, err_msg=WEIGHT_RULE
    )


@pytest.mark.parametrize("method", [Sparse(2e-3, 25), TotalVariation(2e-3, 25)], ids=["l1", "tv"])
def test_runs_repeat_to_the_last_bit_and_on_any_number_of_threads(method, monkeypatch):
    operator = LineProjection((12, 11), 40, [8.2, 20.0, 31.5], [-0.7, 0.05, 0.6], [1.0, 0.8, 1.1])
    measurements = noise(6, 100).astype(np.float32)
    monkeypatch.setenv("TOFCLIP_THREADS", "1")
    first = method.recover(operator, measurements)
    monkeypatch.setenv("TOFCLIP_THREADS", "3")
    second = method.recover(operator, measurements)
    np.testing.assert_array_equal(first.frames, second.frames)
    np.testing.assert_array_equal(first.objective, second.objective)


def test_bad_readings_have_no_influence():
    operator = projection()
    truth = np.zeros((12, 11))
    truth[4:8, 3:9] = 1
    measurements = np.tile(operator(truth)[:, np.newaxis], (1, 3))
    valid = np.ones(measurements.shape, bool)
    valid[10:14, 1] = False
    corrupted = measurements.copy()
    corrupted[10:14, 1] = 1e6
    method = Sparse(1e-3, 50)
    expected = method.recover(operator, measurements, valid)
    np.testing.assert_array_equal(
        method.recover(operator, corrupted, valid).frames, expected.frames
    )


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_results_have_the_operator_s_type(dtype):
    operator = LineProjection((12, 11), 40, [20.0], [0.3], [1.0], dtype)
    assert Sparse(1e-2, 2).recover(operator, np.ones((40, 2))).frames.dtype == dtype


def test_tolerance_stops_and_says_so():
    operator = projection()
    measurements = noise(7)
    limited = Sparse(1e-2, 5).recover(operator, measurements)
    assert (limited.iterations, limited.stop_reason) == (5, "iteration limit")
    assert limited.objective.size == 6
    done = Sparse(1e-2, 3000, 1e-7).recover(operator, measurements)
    assert done.stop_reason == "converged"
    assert 5 < done.iterations < 3000
    assert done.objective[-1] < limited.objective[-1]


class _Scripted:
    """A solver whose objectives, and whether a step was refused, are given beforehand."""

    def __init__(self, *steps: tuple[float, bool]) -> None:
        self._steps = list(steps)
        self.objective, self.rejected = np.array([10.0]), np.array([False])

    def duality_gap(self) -> None:
        raise AssertionError("nobody asked for the gap")

    def step(self) -> None:
        value, refused = self._steps.pop(0)
        self.objective, self.rejected = np.array([value]), np.array([refused])


def test_a_refused_step_is_not_convergence():
    """The objective stands still because the step was undone, not because it is the least."""
    solver = _Scripted((9.0, False), (9.0, True), (7.0, False), (7.0, False), (1.0, False))
    history = iterate(solver, StoppingRule(5, 1e-3), ignore_progress, 1)
    assert history.converged
    assert history.objective.tolist() == [10, 9, 9, 7, 7]


def _lanes(measurements: np.ndarray) -> np.ndarray:
    return np.tile(measurements[:, np.newaxis], (1, LANES))


def test_after_a_refused_step_the_momentum_starts_anew():
    """The first step from there is a plain one, the second has the second momentum of all runs, and
    both the size that the solver says.
    """
    operator = projection()
    measurements = noise(3, LANES)
    regulariser = NonnegativeSparsity(1e-3)
    solver = begin(LeastSquares(measurements), regulariser)
    checked = 0
    for _ in range(200):
        solver.step()
        fresh = solver.rejected.copy()
        age, size_before = np.ones(LANES), solver.step_sizes
        for number in range(2):
            if not fresh.any():
                break
            size = solver.step_sizes
            # the first step's momentum is 0; the next one's follows the ratio of the steps
            older, age = age, (1 + np.sqrt(1 + 4 * size_before / size * age**2)) / 2
            momentum = (older - 1) / age
            current, previous = solver.current.copy(), solver.previous.copy()
            ahead = current + momentum * (current - previous)
            gradient = operator.adjoint(operator(ahead) - measurements)
            expected = np.maximum(ahead - size * (gradient + 1e-3), 0)
            size_before = size
            solver.step()
            fresh &= ~solver.rejected
            difference = np.abs(solver.current - expected)[..., fresh]
            assert np.all(difference <= 1e-9 * np.abs(expected).max())
            checked += np.count_nonzero(fresh) if number else 0
    assert checked > 0


def test_steps_grow_as_far_as_they_are_safe_and_save_iterations():
    """Two thirds of the iterations of steps of one size lead to the same objective."""
    operator = projection()
    truth = np.zeros((12, 11))
    truth[3:5, 4:8] = [[1, 2, 1, 3], [2, 2, 1, 1]]
    solvers = [
        begin(LeastSquares(_lanes(operator(truth))), regulariser)
        for regulariser in (NonnegativeSparsity(0.02), _WithoutDistance(0.02))
    ]
    for solver, iterations in zip(solvers, (40, 60), strict=True):
        iterate(solver, StoppingRule(iterations), ignore_progress, LANES)
    growing, fixed = solvers
    assert growing.step_sizes.max() > 1.5 * growing.step_size
    assert np.all(fixed.step_sizes == fixed.step_size)
    assert np.all(growing.objective <= fixed.objective)


class _WithoutDistance(NonnegativeSparsity):
    """Keeps all steps at one size."""

    def proximal_step(self, *given: np.ndarray) -> ProximalStep:
        return super().proximal_step(*given)._replace(distance=None)


def test_the_duality_gap_bounds_what_is_left():
    measurements = noise(8, LANES)
    for data_term in (LeastSquares(measurements), Huber(measurements, threshold=0.5)):
        solver = begin(data_term, NonnegativeSparsity(0.1))
        gaps, objectives = [], []
        for _ in range(6):
            for _ in range(200):
                solver.step()
            gaps.append(solver.duality_gap())
            objectives.append(solver.objective)
        least = objectives[-1]
        for gap, objective in zip(gaps, objectives, strict=True):
            assert np.all(objective - least <= gap + 1e-9)
        assert np.all(gaps[-1] < 1e-3 * least)


def test_the_gap_ends_a_run_and_is_told():
    operator = projection()
    measurements = noise(7)
    limited = Sparse(0.1, 10).recover(operator, measurements)
    assert (limited.stop_reason, limited.iterations) == ("iteration limit", 10)
    done = Sparse(0.1, 3000).recover(operator, measurements)
    assert done.stop_reason == "converged"
    assert 10 < done.iterations < 3000
    assert done.iterations % GAP_INTERVAL == 0
    assert 0 <= done.duality_gap <= 1e-3 < limited.duality_gap
    least = Sparse(0.1, 3000, gap=1e-8).recover(operator, measurements).objective[-1]
    assert least <= done.objective[-1] <= least * (1 + 1e-3)
    assert np.isnan(TotalVariation(0.1, 10).recover(operator, measurements).duality_gap)


def test_further_iterations_follow_only_while_the_objective_falls():
    operator, reported = projection(), []
    measurements = noise(7)
    short = Sparse(1e-3, 10, gap=0.0)
    limited = short.recover(operator, measurements)
    method = replace(short, further=3000)
    done = method.recover(operator, measurements, progress=reported.append)
    assert sum(reported) == method.work(5)
    assert 10 < done.iterations < 3010
    assert done.iterations % GAP_INTERVAL == 0
    np.testing.assert_array_equal(done.objective[:11], limited.objective)
    before, last = done.objective[-11], done.objective[-1]
    assert before - last <= MIN_FURTHER_FALL * last
    assert (
        replace(short, iterations=done.iterations, further=50)
        .recover(operator, measurements)
        .iterations
        == done.iterations
    )
    with pytest.raises(InputError, match="further"):
        StoppingRule(3, further=-1)


def test_noise_is_not_followed_and_light_is() -> None:
    operator, noise = projection(), np.random.default_rng(7)
    method = Sparse(1e-3, 200, gap=0.0, noise_fall=2e-3)
    dark = method.recover(operator, noise.standard_normal((40, 5)))
    fall = -np.diff(dark.objective) / dark.objective[1:]
    assert dark.stop_reason == "converged"
    assert 1 < dark.iterations < 200
    assert fall[-1] < 2e-3 <= fall[-2]
    assert dark.objective[-1] > NOISE_FRACTION * dark.objective[0]
    picture = np.zeros(operator.shape_in)
    picture[2:4, 3:6] = 1
    light = operator(picture)[:, np.newaxis]
    assert method.recover(operator, light).iterations == 200
    with pytest.raises(InputError, match="noise_fall"):
        StoppingRule(3, noise_fall=-1e-3)


@pytest.mark.parametrize("method", [Sparse(0.05, 12), TotalVariation(0.05, 12)], ids=["l1", "tv"])
@pytest.mark.parametrize("data_term", [LeastSquares, partial(Huber, threshold=0.5)])
def test_dark_frames_are_zero_and_cost_nothing(method, data_term):
    """The others are what they are without them, and the objective and the work count them all."""
    operator = projection()
    measurements = noise(9, 50)
    dark = np.zeros(50, bool)
    dark[[0, 1, 7, 30, 48, 49]] = True
    measurements[:, dark] *= -1e-3
    done: list[int] = []
    method = replace(method, data_term=data_term, gap=0.0)
    found = method.recover(operator, measurements, progress=done.append)
    alone = method.recover(operator, measurements[:, ~dark])
    assert not found.frames[dark].any()
    assert found.frames[~dark].any(axis=(1, 2)).all()
    np.testing.assert_allclose(found.frames[~dark], alone.frames, rtol=1e-9, atol=1e-12)
    data = data_term(np.ascontiguousarray(measurements[:, dark]))
    of_dark = data.value(np.zeros_like(data.measurements)).sum()
    np.testing.assert_allclose(found.objective, alone.objective + of_dark, rtol=1e-12)
    assert sum(done) == method.work(50)


def test_a_weight_that_leaves_nothing_takes_no_iteration():
    result = Sparse(1.0).recover(projection(), np.ones((40, 3)))
    assert (result.iterations, result.stop_reason, result.duality_gap) == (0, "converged", 0)
    assert not result.frames.any()
    np.testing.assert_allclose(result.objective, [60.0])


def test_blocks_that_stopped_early_count_with_their_last_value():
    histories = [
        IterationHistory(np.array([10.0, 5.0]), True),
        IterationHistory(np.array([8.0, 4.0, 2.0]), True),
    ]
    found = Result.from_blocks(np.zeros((2, 1, 1)), histories)
    assert (found.objective.tolist(), found.iterations) == ([18, 9, 7], 2)


def test_pictures_to_begin_at_save_iterations_at_the_same_objective():
    """Two shots of one scene, which differ in their noise."""
    operator, random = projection(), np.random.default_rng(5)
    truth = np.maximum(random.standard_normal((12, 11, 3)) - 1, 0)
    seen = operator(truth)
    first, second = (seen + 0.01 * seen.max() * random.standard_normal(seen.shape) for _ in "12")
    method = Sparse(weight=1e-2, iterations=60, gap=0.0)
    before = method.recover(operator, first)
    cold = method.recover(operator, second).objective
    warm = method.recover(operator, second, start=before.frames).objective
    assert np.all(np.diff(warm) <= 1e-12 * warm[0])
    # 8 against 33; with a third of the noise none against 33, with twice the noise 21 against 38
    reached = cold[-1] * (1 + 1e-2)
    cold_iterations, warm_iterations = (int(np.argmax(one <= reached)) for one in (cold, warm))
    assert warm_iterations <= cold_iterations / 2


@pytest.mark.parametrize("method", [Sparse(iterations=9), TotalVariation(iterations=9)])
def test_the_objective_at_the_beginning_is_that_of_the_pictures_given(method):
    operator = projection()
    measurements = operator(np.maximum(np.random.default_rng(7).standard_normal((12, 11, 2)), 0))
    before = method.recover(operator, measurements)
    after = replace(method, iterations=1).recover(operator, measurements, start=before.frames)
    assert after.objective[0] == pytest.approx(before.objective[-1], rel=1e-9)
    with pytest.raises(ShapeError, match="pictures to begin at"):
        method.recover(operator, measurements, start=before.frames[:1])


def test_a_lone_picture_costs_its_iterations_products_and_one_more(monkeypatch):
    """The operator's norm is known from the first recovery."""
    operator = projection()
    measurements = operator(np.ones((12, 11)))[:, np.newaxis]
    products = []
    for name in ("_forward", "_adjoint"):
        product = getattr(LineProjection, name)
        monkeypatch.setattr(
            LineProjection,
            name,
            lambda self, block, name=name, product=product: (
                products.append(name) or product(self, block)
            ),
        )
    method = Sparse(1e-2, iterations=7, gap=0.0)
    method.recover(operator, measurements)
    products.clear()
    method.recover(operator, measurements)
    assert (products.count("_forward"), products.count("_adjoint")) == (7, 8)
