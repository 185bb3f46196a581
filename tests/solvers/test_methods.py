"""Data terms against their definitions, the direct methods, what all methods refuse, and the choice of
a weight by cross-validation.
"""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tofclip.errors import InputError
from tofclip.metrics import nmse
from tofclip.operators import Identity, LineProjection, RadonProjection
from tofclip.solvers import (
    Backprojection,
    ClippedSquares,
    Huber,
    LeastSquares,
    LinearInverse,
    Poisson,
    PreparedInverse,
    Sparse,
    StoppingRule,
    TotalVariation,
    relative_residual,
)
from tofclip.solvers.data_terms import estimate_robust_deviation
from tofclip.solvers.direct import InverseTraces
from tofclip.solvers.fista import (
    FOLD_COUNT,
    MAX_WEIGHT_WORK,
    assign_folds,
    choose_weight,
)

COUNTS = np.array([0.0, 1, 3, 20, 400, 1e4])
DEVIATION = np.sqrt(COUNTS + 1)
SCALED = (COUNTS / DEVIATION)[:, np.newaxis]
every_term = pytest.mark.parametrize(
    "make",
    [
        LeastSquares,
        partial(Huber, threshold=0.7),
        partial(Poisson, deviation=DEVIATION),
        partial(ClippedSquares, limit=50.0),
    ],
    ids=["squares", "huber", "poisson", "clipped"],
)
METHODS = [Sparse(2e-3, 10), TotalVariation(2e-3, 10), LinearInverse(), Backprojection()]
every_method = pytest.mark.parametrize("method", METHODS, ids=lambda method: method.name)


@every_term
@given(shift=st.floats(-30, 30), seed=st.integers(0, 99))
def test_the_gradient_is_the_derivative_of_the_value(make, shift, seed):
    term, step = make(SCALED), 1e-5
    at = SCALED + shift * np.random.default_rng(seed).random(SCALED.shape)
    for reading, aside in enumerate(step * np.eye(COUNTS.size)[..., np.newaxis]):
        slope = (term.value(at + aside)[0] - term.value(at - aside)[0]) / (2 * step)
        # central differences in float64: rounding 1e-16 * value / step, curvature changes within
        # the step
        assert slope == pytest.approx(term.gradient(at)[reading, 0], rel=1e-4, abs=1e-4)


@every_term
@given(one=st.floats(-50, 50), other=st.floats(-50, 50))
def test_the_gradient_is_lipschitz_with_constant_one(make, one, other):
    term = make(SCALED)
    change = term.gradient(SCALED + one) - term.gradient(SCALED + other)
    assert np.all(np.abs(change) <= abs(one - other) * (1 + 1e-9) + 1e-12)


@every_term
def test_the_readings_themselves_fit_best_and_bad_ones_do_not_count(make):
    assert make(SCALED).value(SCALED)[0] == pytest.approx(0, abs=1e-9)
    for shift in (-0.3, 0.3):
        assert make(SCALED).value(np.maximum(SCALED + shift, 0) + 1e-3)[0] > 0
    valid, far = np.ones(SCALED.shape, bool), SCALED.copy()
    valid[2], far[2] = False, SCALED[2] + 9
    term = make(SCALED, valid)
    assert term.value(far)[0] == pytest.approx(0, abs=1e-9)
    assert term.gradient(far)[2, 0] == 0


def test_what_is_cut_off_may_be_brighter_but_not_darker():
    term, predicted = (
        ClippedSquares(np.full((3, 1), 10.0), limit=10.0),
        np.array([[8.0], [10], [90]]),
    )
    np.testing.assert_array_equal(term.gradient(predicted)[:, 0], [-2, 0, 0])
    assert term.value(predicted)[0] == 2


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
    found = term.value((expected / DEVIATION)[:, np.newaxis])[0]
    assert found == pytest.approx(likelihood / Poisson.CURVATURE)


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


def test_the_robust_deviation_is_that_of_gaussian_errors():
    errors = np.random.default_rng(0).normal(0, 3, 20001)
    errors[:1000] = 1e6
    # 5 % of outliers raise the median size by 6 %
    assert estimate_robust_deviation(errors) == pytest.approx(3, rel=0.1)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Huber(SCALED, threshold=0), "threshold"),
        (lambda: Poisson(-SCALED, deviation=DEVIATION), "negative"),
        (lambda: ClippedSquares(SCALED, limit=0.0), "must be a positive number"),
        (lambda: LeastSquares(SCALED, np.ones((2, 1), bool)), "must have shape"),
        (lambda: estimate_robust_deviation(np.zeros(5)), "met exactly"),
        (lambda: StoppingRule(0), "iteration"),
        (lambda: StoppingRule(5, -1.0), "tolerance"),
        (lambda: StoppingRule(5, np.nan), "tolerance"),
        (lambda: StoppingRule(3, further=-1), "further"),
        (lambda: StoppingRule(3, noise_fall=-1e-3), "noise_fall"),
        (lambda: assign_folds(1, 1, 0), "as a number"),
        (
            lambda: LinearInverse(0.0).prepare(LineProjection((3, 3), 9, [4.0], [0.0], [1.0])),
            "damping",
        ),
        (lambda: LinearInverse().recover(Identity((4,)), np.ones((4, 2))), "sparse matrix"),
        (
            lambda: InverseTraces(PreparedInverse(Identity((4, 4)), np.eye(16)), np.arange(4)),
            "matrix",
        ),
    ],
)
def test_what_cannot_be_is_refused(make, message):
    with pytest.raises(InputError, match=message):
        make()


@pytest.fixture
def operator():
    centres, angles, gains = [8.2, 20.0, 31.5], [-0.7, 0.05, 0.6], [1.0, 0.8, 1.1]
    return LineProjection((12, 11), 40, centres, angles, gains, np.float64)


def readings(frames, seed=0, pixels=40):
    return np.random.default_rng(seed).random((pixels, frames))


def test_linear_inverse_is_the_damped_normal_equations(operator):
    measurements, dense = readings(5), operator.matrix.toarray()
    mu = 0.05 * np.linalg.norm(dense, 2) ** 2
    expected = np.linalg.solve(dense.T @ dense + mu * np.eye(132), dense.T @ measurements)
    result = LinearInverse(0.05).recover(operator, measurements)
    # The largest eigenvalue comes from 15 power iterations, within 1 %.
    scale = np.abs(expected).max()
    np.testing.assert_allclose(result.frames, expected.T.reshape(5, 12, 11), atol=0.01 * scale)
    assert result.stop_reason == "direct method"
    assert result.setup_seconds > 0


def test_linear_inverse_leaves_out_what_is_dead_in_every_frame_only(operator):
    measurements, valid = readings(4), np.ones((40, 4), bool)
    valid[9, 1] = False
    whole = LinearInverse().recover(operator, measurements).frames
    used = LinearInverse().recover(operator, measurements, valid).frames
    np.testing.assert_array_equal(used, whole)
    valid[[9, 17]] = False
    corrupted = measurements.copy()
    corrupted[[9, 17]] = 1e5
    found, without = (
        LinearInverse().recover(operator, given, valid).frames
        for given in (corrupted, measurements)
    )
    np.testing.assert_allclose(found, without, rtol=1e-10)
    assert not np.allclose(found, whole)


def test_adjoint_is_the_adjoint_at_the_scale_that_fits_best(operator):
    measurements = readings(37)
    expected = np.moveaxis(operator.adjoint(measurements), -1, 0)
    frames = Backprojection().recover(operator, measurements).frames
    np.testing.assert_allclose(frames * expected.max() / frames.max(), expected, rtol=1e-12)
    measurements = readings(9, 5)
    frames = Backprojection().recover(operator, measurements).frames
    best, smaller, larger = (
        relative_residual(operator, factor * frames, measurements) for factor in (1, 0.99, 1.01)
    )
    assert best < min(smaller, larger, 1)


@every_method
def test_frames_come_in_the_order_of_the_readings_and_progress_adds_up(operator, method):
    measurements, bright, done = np.zeros((40, 70)), [0, 33, 69], []
    measurements[:, bright] = operator(np.ones((12, 11)))[:, np.newaxis]
    result = method.recover(operator, measurements, progress=done.append)
    assert result.frames.shape == (70, 12, 11)
    energy = result.frames.sum(axis=(1, 2))
    assert set(np.nonzero(energy > 1e-6 * energy.max())[0]) == set(bright)
    assert sum(done) == method.work(70)


@every_method
def test_an_interruption_gets_through(operator, method):
    def interrupt(_):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        method.recover(operator, np.ones((40, 70)), progress=interrupt)


def test_relative_residual_by_hand(operator):
    frames = np.random.default_rng(4).random((35, 12, 11))
    measurements = operator(np.moveaxis(frames, 0, -1))
    assert relative_residual(operator, frames, measurements) < 1e-14
    assert relative_residual(operator, 0 * frames, measurements) == 1
    valid = np.ones(measurements.shape, bool)
    valid[5], measurements[5] = False, 1e9
    assert relative_residual(operator, frames, measurements, valid) < 1e-14
    with pytest.raises(InputError, match="zero"):
        relative_residual(operator, frames, 0 * measurements)


@pytest.mark.parametrize("method", [Sparse(), TotalVariation()], ids=lambda method: method.name)
def test_a_lone_picture_is_recovered_as_in_a_block(method):
    """One picture takes loops of one lane, many take blocks; float32 rounding is all that may
    differ.
    """
    operator = LineProjection((15, 17), 90, [14.0, 44.0, 74.0], [0.5, 0.0, -0.5], [1.0, 1.0, 1.0])
    picture = (np.random.default_rng(4).random((15, 17)) > 0.8).astype(np.float32)
    measurements = operator(picture)[:, np.newaxis]
    alone = method.recover(operator, measurements).frames[0]
    many = method.recover(operator, np.tile(measurements, 3)).frames
    np.testing.assert_allclose(alone, many[1], atol=1e-3 * alone.max())


@given(count=st.integers(2, 3000), run=st.integers(1, 200), seed=st.integers(0, 9))
def test_every_reading_is_left_out_once(count, run, seed):
    out = assign_folds(count, run, seed)
    assert out.shape[0] == count
    assert out.any(axis=0).all()
    if out.shape[1] > 1:
        np.testing.assert_array_equal(out.sum(axis=1), 1)
    else:
        assert 0.05 < out.mean() < 0.25  # one of eight folds, of many runs


@pytest.mark.parametrize("noise", [0.02, 0.1])
def test_the_picture_is_nearly_as_good_as_with_the_best_weight(noise):
    operator = RadonProjection((40, 40), 40, np.arange(20) * np.pi / 20, np.zeros(20))
    truth = np.zeros((40, 40), np.float32)
    truth[8:30, 10:18], truth[12:20, 10:34] = 1, 0.5
    clean = operator(truth)
    error = noise * clean.max() * np.random.default_rng(0).standard_normal(clean.shape)
    measurements = (clean + error).astype(np.float32)
    method = TotalVariation(1.0, 200, 1e-4)

    def compute_error(weight):
        found = replace(method, weight=weight).recover(operator, measurements[:, np.newaxis])
        return nmse(found.frames[0], truth)

    best = min(compute_error(weight) for weight in 10.0 ** np.arange(-3, -0.5, 0.25))
    # 20 % is the project's acceptance for a weight chosen without the truth
    done = []
    found = choose_weight(method, operator, measurements, 40, progress=done.append)
    assert compute_error(found.weight) < 1.2 * best
    assert sum(done) == MAX_WEIGHT_WORK  # a bar ends at its end
    assert len(done) == 1 + found.errors.size * FOLD_COUNT  # and moves with every recovery
