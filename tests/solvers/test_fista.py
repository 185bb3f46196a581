"""The iterative solver and its priors against problems whose answers are known."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import scipy.optimize
import scipy.sparse

from tofclip.errors import ShapeError
from tofclip.operators import LineProjection, RadonProjection, SparseMatrix, estimate_squared_norm
from tofclip.solvers import (
    Fista,
    Huber,
    LeastSquares,
    NonnegativeSparsity,
    NonnegativeTotalVariation,
    Sparse,
    StoppingRule,
    TotalVariation,
    Wavelets,
    ignore_progress,
    iterate,
)
from tofclip.solvers.methods import (
    GAP_INTERVAL,
    MIN_FURTHER_FALL,
    NOISE_FRACTION,
)
from tofclip.solvers.priors import NonnegativeLightFieldVariation, NonnegativeWavelets
from tofclip.threads import LANES

WEIGHT_RULE = "weights are relative to the largest A'f of all frames"
PICTURE = np.zeros((12, 11))
PICTURE[3:5, 4:8] = [[1, 2, 1, 3], [2, 2, 1, 1]]


def l1_and_tv(*settings):
    methods = Sparse(*settings), TotalVariation(*settings)
    return pytest.mark.parametrize("method", methods, ids=["l1", "tv"])


def identity(shape):
    size = shape[0] * shape[1]
    return SparseMatrix(scipy.sparse.eye_array(size, format="csr"), shape, (size,))


def projection(dtype=np.float64):
    centres, angles, gains = [8.2, 20.0, 31.5], [-0.7, 0.05, 0.6], [1.0, 0.8, 1.1]
    return LineProjection((12, 11), 40, centres, angles, gains, dtype)


def begin(data_term, prior):
    """A block of `LANES` frames of `projection`, at darkness."""
    operator = projection()
    return Fista(operator, data_term, prior, 1 / estimate_squared_norm(operator, 99), LANES)


def solve(measurements, prior, iterations):
    """The same frame in every lane."""
    term = LeastSquares(np.tile(measurements[:, np.newaxis], (1, LANES)))
    solver = begin(term, prior)
    iterate(solver, StoppingRule(iterations), ignore_progress, LANES)
    return solver


def noise(seed, frames=5):
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
    method = TotalVariation(weight=0.05, iterations=400, gap=0.0)
    found = method.recover(identity((7, 10)), pictures.reshape(3, -1).T).frames
    expected = levels + np.sign(levels[:, ::-1] - levels) * weight / columns
    expected = np.repeat(expected, columns, axis=1)[:, np.newaxis].repeat(7, axis=1)
    np.testing.assert_allclose(found, expected, atol=1e-3, err_msg=WEIGHT_RULE)


@l1_and_tv(2e-2, 40)
def test_a_shot_of_any_brightness_gives_the_same_pictures(method):
    dim, bright = (method.recover(projection(), f * noise(5)).frames for f in (1, 1000))
    np.testing.assert_allclose(
        bright, 1000 * dim, rtol=1e-6, atol=1e-6 * bright.max(), err_msg=WEIGHT_RULE
    )


def test_optimality_of_sparse_solutions():
    """At the minimum A'(f - A h) = weight where h > 0 and <= weight elsewhere."""
    operator, weight = projection(), 0.02
    measurements = operator(PICTURE)
    picture = solve(measurements, NonnegativeSparsity(weight), 6000).current[..., 0]
    pull = operator.adjoint(measurements - operator(picture))
    assert np.abs(pull[picture > 1e-3] - weight).max() < 1e-3 * weight
    assert pull.max() <= weight * (1 + 1e-3)


@pytest.mark.parametrize("prior", [NonnegativeSparsity(0.01), NonnegativeTotalVariation(0.05)])
def test_the_objective_never_rises_and_belongs_to_its_picture(prior):
    """Of a refused frame too."""
    measurements, rejected = noise(3, LANES), 0
    solver = begin(LeastSquares(measurements), prior)
    for _ in range(150):
        before = solver.objective
        solver.step()
        assert np.all(solver.objective <= before)
        if solver.rejected.any() and isinstance(prior, NonnegativeSparsity):
            misfit = 0.5 * ((projection()(solver.current) - measurements) ** 2).sum(0)
            expected = misfit + 0.01 * solver.current.sum((0, 1))
            np.testing.assert_allclose(solver.objective, expected, rtol=1e-10)
        rejected += solver.rejected.sum()
    assert rejected > 0  # or the monotone restart was never put to the test


@l1_and_tv(1e-2, 40)
def test_a_frame_does_not_depend_on_its_neighbours(method):
    measurements = noise(5, 50)
    measurements[:, 17] *= 3  # the brightest: it sets the scale of the weight in both runs
    whole = method.recover(projection(), measurements).frames[15:20]
    part = method.recover(projection(), measurements[:, 15:20]).frames
    np.testing.assert_allclose(part, whole, rtol=1e-9, atol=1e-12, err_msg=WEIGHT_RULE)


@l1_and_tv(2e-3, 25)
def test_runs_repeat_to_the_last_bit_and_on_any_number_of_threads(method, monkeypatch):
    measurements, found = noise(6, 100).astype(np.float32), []
    for threads in ("1", "3"):
        monkeypatch.setenv("TOFCLIP_THREADS", threads)
        found.append(method.recover(projection(np.float32), measurements))
    assert found[0].frames.dtype == np.float32
    np.testing.assert_array_equal(found[0].frames, found[1].frames)
    np.testing.assert_array_equal(found[0].objective, found[1].objective)


def test_bad_readings_have_no_influence():
    measurements = np.tile(projection()(PICTURE)[:, np.newaxis], (1, 3))
    valid, corrupted = np.ones(measurements.shape, bool), measurements.copy()
    valid[10:14, 1], corrupted[10:14, 1] = False, 1e6
    found, expected = (
        Sparse(1e-3, 50).recover(projection(), given, valid).frames
        for given in (corrupted, measurements)
    )
    np.testing.assert_array_equal(found, expected)


def test_tolerance_stops_and_says_so():
    limited = Sparse(1e-2, 5).recover(projection(), noise(7))
    assert (limited.iterations, limited.stop_reason) == (5, "iterations done")
    assert limited.objective.size == 6
    done = Sparse(1e-2, 3000, 1e-7).recover(projection(), noise(7))
    assert done.stop_reason == "converged"
    assert 5 < done.iterations < 3000
    assert done.objective[-1] < limited.objective[-1]


def test_steps_grow_as_far_as_they_are_safe_and_save_iterations():
    """Two thirds of the iterations of steps of one size lead to the same objective."""
    measurements = projection()(PICTURE)
    growing = solve(measurements, NonnegativeSparsity(0.02), 40)
    fixed = solve(measurements, _WithoutDistance(0.02), 60)
    assert growing.step_sizes.max() > 1.5 * growing.step_size
    assert np.all(fixed.step_sizes == fixed.step_size)
    assert np.all(growing.objective <= fixed.objective)


class _WithoutDistance(NonnegativeSparsity):
    """Keeps all steps at one size."""

    def proximal_step(self, *given):
        return super().proximal_step(*given)._replace(distance=None)


@pytest.mark.parametrize("data_term", [LeastSquares, partial(Huber, threshold=0.5)])
def test_the_duality_gap_bounds_what_is_left(data_term):
    solver = begin(data_term(noise(8, LANES)), NonnegativeSparsity(0.1))
    gaps, objectives = [], []
    for _ in range(6):
        for _ in range(200):
            solver.step()
        gaps.append(solver.duality_gap())
        objectives.append(solver.objective)
    least = objectives[-1]
    assert np.all(np.array(objectives) - least <= np.array(gaps) + 1e-9)
    assert np.all(gaps[-1] < 1e-3 * least)


def test_the_gap_ends_a_run_and_is_told():
    operator, measurements = projection(), noise(7)
    limited = Sparse(0.1, 10).recover(operator, measurements)
    assert (limited.stop_reason, limited.iterations) == ("iterations done", 10)
    done = Sparse(0.1, 3000).recover(operator, measurements)
    assert done.stop_reason == "converged"
    assert 10 < done.iterations < 3000
    assert done.iterations % GAP_INTERVAL == 0
    assert 0 <= done.duality_gap <= 1e-3 < limited.duality_gap
    least = Sparse(0.1, 3000, gap=1e-8).recover(operator, measurements).objective[-1]
    assert least <= done.objective[-1] <= least * (1 + 1e-3)
    assert np.isnan(TotalVariation(0.1, 10).recover(operator, measurements).duality_gap)


def test_further_iterations_follow_only_while_the_objective_falls():
    operator, measurements, reported = projection(), noise(7), []
    short = Sparse(1e-3, 10, gap=0.0)
    method = replace(short, further=3000)
    done = method.recover(operator, measurements, progress=reported.append)
    assert sum(reported) == method.work(5)
    assert 10 < done.iterations < 3010
    assert done.iterations % GAP_INTERVAL == 0
    limited = short.recover(operator, measurements)
    np.testing.assert_array_equal(done.objective[:11], limited.objective)
    before, last = done.objective[-11], done.objective[-1]
    assert before - last <= MIN_FURTHER_FALL * last
    settled = replace(short, iterations=done.iterations, further=50)
    assert settled.recover(operator, measurements).iterations == done.iterations


def test_noise_is_not_followed_and_light_is():
    operator, random = projection(), np.random.default_rng(7)
    method = Sparse(1e-3, 200, gap=0.0, noise_fall=2e-3)
    dark = method.recover(operator, random.standard_normal((40, 5)))
    fall = -np.diff(dark.objective) / dark.objective[1:]
    assert dark.stop_reason == "converged"
    assert 1 < dark.iterations < 200
    assert fall[-1] < 2e-3 <= fall[-2]
    assert dark.objective[-1] > NOISE_FRACTION * dark.objective[0]
    picture = np.zeros(operator.shape_in)
    picture[2:4, 3:6] = 1
    assert method.recover(operator, operator(picture)[:, np.newaxis]).iterations == 200


@l1_and_tv(0.05, 12)
@pytest.mark.parametrize("data_term", [LeastSquares, partial(Huber, threshold=0.5)])
def test_dark_frames_are_zero_and_cost_nothing(method, data_term):
    """The others are what they are without them, and the objective and the work count them all."""
    operator, measurements, done = projection(), noise(9, 50), []
    dark = np.zeros(50, bool)
    dark[[0, 1, 7, 30, 48, 49]] = True
    measurements[:, dark] *= -1e-3
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


def test_pictures_to_begin_at_save_iterations_at_the_same_objective():
    """Two shots of one scene, which differ in their noise."""
    operator, random = projection(), np.random.default_rng(5)
    seen = operator(np.maximum(random.standard_normal((12, 11, 3)) - 1, 0))
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
    with pytest.raises(ShapeError, match="pictures to begin at"):
        method.recover(operator, second, start=before.frames[:1])


def denoise(prior, noisy, calls):
    """Run the warm-started proximal step on the same point until it has converged."""
    still = np.zeros(noisy.shape[-1], noisy.dtype)
    for _ in range(calls):
        result, penalty, _ = prior.proximal_step(
            noisy, np.zeros_like(noisy), still, np.zeros_like(noisy), np.ones_like(still)
        )
    return result, penalty


def smooth(picture, weight, calls=400, dtype=np.float64):
    """Total variation of one picture, in a block of many."""
    block = np.tile(picture.astype(dtype)[..., np.newaxis], (1, 1, LANES))
    result, penalty = denoise(NonnegativeTotalVariation(weight), block, calls)
    assert np.ptp(result, axis=-1).max() == 0  # every lane the same
    return result[..., 0], float(penalty[0])


def test_it_beats_every_nearby_picture():
    """The step minimises 1/2 |x - v|^2 + w TV(x): no random change in any direction may lower it."""
    rng = np.random.default_rng(2)
    picture, weight = rng.random((9, 8)) + 0.5, 0.15
    best, _ = smooth(picture, weight, calls=4000)

    def objective(x):
        vertical, horizontal = np.zeros_like(x), np.zeros_like(x)
        vertical[:-1], horizontal[:, :-1] = np.diff(x, axis=0), np.diff(x, axis=1)
        return 0.5 * np.sum((x - picture) ** 2) + weight * np.sum(np.hypot(vertical, horizontal))

    lowest = objective(best)
    for size in (1e-1, 1e-2, 1e-3):
        for _ in range(50):
            assert objective(best + size * rng.standard_normal(best.shape)) > lowest
    assert lowest < objective(np.full_like(picture, picture.mean()))
    single, _ = smooth(picture, weight, calls=4000, dtype=np.float32)
    np.testing.assert_allclose(single, best, atol=2e-6)


def test_views_on_their_own_are_ordinary_pictures():
    views = np.random.default_rng(0).random((6, 9, 8, 1))
    found, penalty = denoise(NonnegativeLightFieldVariation(0.2, (2, 3), 0.0), views, 300)
    alone = [denoise(NonnegativeTotalVariation(0.2), picture, 300) for picture in views]
    np.testing.assert_allclose(found, [picture for picture, _ in alone], atol=1e-6)
    assert penalty[0] == pytest.approx(sum(total[0] for _, total in alone), rel=1e-6)


@pytest.mark.parametrize("axis", [0, 1])
def test_a_step_between_views_shrinks_from_both_sides(axis):
    """Two even halves of `n` views along an axis approach by weight * angular / n, as steps between
    columns do.
    """
    halves = np.moveaxis(
        np.repeat([1.0, 3.0], 2)[:, None, None, None] * np.ones((4, 3, 3)), 0, axis
    )
    noisy = halves.reshape(16, 3, 3, 1)
    found, penalty = denoise(NonnegativeLightFieldVariation(0.4, (4, 4), 0.5), noisy, 600)
    known = np.where(noisy == 1, 1 + 0.4 * 0.5 / 2, 3 - 0.4 * 0.5 / 2)
    np.testing.assert_allclose(found, known, atol=1e-5)
    assert penalty[0] == pytest.approx(0.4 * 0.5 * (2 - 0.2) * 4 * 9, rel=1e-4)


def test_wavelets_shrink_noise_and_no_slope():
    result, penalty = denoise(NonnegativeWavelets(5.0), np.full((48, 32, 2), 0.7), 1)
    np.testing.assert_allclose(result, 0.7, atol=1e-9)
    np.testing.assert_allclose(penalty, 0, atol=1e-6)
    y, x = np.mgrid[:64, :64] / 64.0
    slope = (2 + np.sin(3 * x) + np.cos(2 * y))[..., np.newaxis]
    noisy = slope + 0.1 * np.random.default_rng(1).standard_normal(slope.shape)
    result, _ = denoise(NonnegativeWavelets(0.3), noisy, 1)
    inner = (slice(8, -8), slice(8, -8))  # the transform takes the picture for periodic
    assert np.mean((result - slope)[inner] ** 2) < 0.2 * np.mean((noisy - slope)[inner] ** 2)


def test_with_wavelets_the_objective_falls_and_the_data_are_met():
    operator = RadonProjection((32, 32), 32, np.arange(24) * np.pi / 24, np.zeros(24))
    y, x = np.mgrid[:32, :32] - 15.5
    measurements = operator(np.exp(-(x**2 + y**2) / 40).astype(np.float32))
    result = Wavelets(1e-3, 80).recover(operator, measurements[:, np.newaxis])
    assert np.all(np.diff(result.objective) <= 0)
    misfit = np.linalg.norm(operator(result.frames[0]) - measurements)
    assert misfit < 0.02 * np.linalg.norm(measurements)
