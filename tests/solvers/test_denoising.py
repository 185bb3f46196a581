"""Denoisers on pictures whose clean version is known, and plug-and-play: its quadratic step against a dense
solve, its fixed points, its gain over the start.
"""

import sys
from functools import partial

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from tofclip.errors import InputError, MissingDependencyError, ShapeError
from tofclip.metrics import nmse
from tofclip.operators import RadonProjection, estimate_squared_norm
from tofclip.solvers import (
    Huber,
    LeastSquares,
    PlugAndPlay,
    RegularisationByDenoising,
    TotalVariation,
)
from tofclip.solvers.denoising import (
    BlockMatching,
    CollaborativeWiener,
    NonlocalMeans,
    solve_data_step,
)

DEVIATION = 0.1


@pytest.fixture(scope="module")
def clean():
    """Two bars, a ramp and a disc: edges, a slope and a curve."""
    y, x = np.mgrid[:72, :65].astype(np.float32)
    picture = 0.3 * x / 65
    picture[10:50, 12:18] = 1
    picture[10:50, 26:32] = 0.7
    picture[(y - 50) ** 2 + (x - 46) ** 2 < 120] = 0.9
    return picture.astype(np.float32)


@pytest.fixture(scope="module")
def noisy(clean):
    return clean + np.random.default_rng(0).normal(0, DEVIATION, clean.shape).astype(np.float32)


def left_over(found, clean):
    """Share of the noise's energy."""
    assert found.dtype == clean.dtype
    return float(np.mean((found - clean) ** 2)) / DEVIATION**2


@pytest.mark.parametrize("kind", [NonlocalMeans, BlockMatching])
def test_most_of_the_noise_is_removed(clean, noisy, kind):
    if kind is BlockMatching:
        pytest.importorskip("bm3d", reason="the package bm3d is optional")
    assert left_over(kind()(noisy, noisy, DEVIATION), clean) < 0.25


@pytest.mark.nightly
def test_the_collaborative_filter_gets_better_with_its_pilot(clean, noisy):
    """From a blurred pilot onwards, each result the pilot of the next; the truth as pilot is the
    bound.
    """
    denoiser, found = CollaborativeWiener(), [gaussian_filter(noisy, 1)]
    for _ in range(4):
        found.append(denoiser(noisy, found[-1], DEVIATION))
    shares = [left_over(picture, clean) for picture in found[1:]]
    shares.append(left_over(denoiser(noisy, clean, DEVIATION), clean))
    assert np.all(np.diff(shares) < 0)
    assert shares[3] < 0.25


def test_what_is_clean_stays_and_a_turned_picture_is_filtered_alike(clean, noisy):
    even = np.full((20, 31), 0.4, np.float32)
    np.testing.assert_allclose(CollaborativeWiener()(even, even, DEVIATION), 0.4, atol=1e-5)
    np.testing.assert_allclose(CollaborativeWiener()(clean, clean, 1e-4), clean, atol=1e-3)
    # with every patch in the group, ties do not matter
    everyone, part = CollaborativeWiener(group=10_000), noisy[:27, :30]
    turned = everyone(part.T, part.T, DEVIATION)
    np.testing.assert_allclose(turned.T, everyone(part, part, DEVIATION), atol=2e-5)


def test_what_cannot_be_denoised_is_refused(clean, monkeypatch):
    with pytest.raises(ShapeError):
        CollaborativeWiener()(clean, clean[:-1], DEVIATION)
    with pytest.raises(InputError, match="smaller than a patch"):
        CollaborativeWiener()(clean[:4], clean[:4], DEVIATION)
    monkeypatch.setitem(sys.modules, "bm3d", None)
    with pytest.raises(MissingDependencyError, match="non-commercial"):
        BlockMatching()(clean, clean, DEVIATION)
    with pytest.raises(InputError, match="call"):
        PlugAndPlay(TotalVariation(), calls=0)
    with pytest.raises(InputError, match="positive"):
        PlugAndPlay(TotalVariation(), strength=0)


SHAPE = (48, 45)
OPERATOR = RadonProjection(SHAPE, 48, np.arange(14) * np.pi / 14, np.zeros(14), dtype=np.float64)
SMALL = RadonProjection((7, 6), 7, np.arange(5) * np.pi / 5, np.zeros(5), dtype=np.float64)


@pytest.fixture(scope="module")
def truth():
    picture = np.zeros(SHAPE)
    picture[8:40, 8:13] = picture[8:40, 24:29] = 1
    picture[8:13, 8:40] = 0.6
    return picture


def measure(*pictures):
    return np.stack([OPERATOR(picture) for picture in pictures], axis=1)


def recover(method, measurements):
    return method.recover(OPERATOR, measurements).frames


def test_the_quadratic_step_is_the_dense_solution():
    dense = np.stack([SMALL(row.reshape(7, 6)) for row in np.eye(42)], axis=1)
    rng = np.random.default_rng(1)
    measurements, anchor = rng.random(SMALL.shape_out), rng.random((7, 6))
    term = LeastSquares(measurements[:, np.newaxis])
    found = solve_data_step(SMALL, term, anchor, 0.7, iterations=60)
    right = dense.T @ measurements + 0.7 * anchor.ravel()
    known = np.linalg.solve(dense.T @ dense + 0.7 * np.eye(42), right)
    np.testing.assert_allclose(found.ravel(), known, atol=1e-8)


def test_without_a_denoiser_the_data_are_met(truth):
    """A denoiser that changes nothing leaves the iterations of proximal points: they end at the
    least residual.
    """
    measurements, start = measure(truth), TotalVariation(0.05, 20)
    unchanged = PlugAndPlay(start, lambda noisy, pilot, deviation: noisy, calls=40)
    before, after = (
        np.linalg.norm(OPERATOR(recover(method, measurements)[0]) - measurements[:, 0])
        for method in (start, unchanged)
    )
    assert after < 0.1 * before


def test_it_improves_on_its_start(truth):
    measurements = measure(truth)
    noise = np.random.default_rng(0).standard_normal(measurements.shape)
    measurements += 0.04 * measurements.max() * noise
    start = TotalVariation(0.004, 200, 1e-4)  # too small a weight: the start is noisy
    result = PlugAndPlay(start).recover(OPERATOR, measurements)
    started = start.recover(OPERATOR, measurements)
    assert nmse(result.frames[0], truth) < 0.8 * nmse(started.frames[0], truth)
    assert result.iterations == started.iterations  # as asked for; calls are counted beside them
    assert result.frames.min() >= 0
    assert result.stop_reason == "8 calls of the denoiser done"


def blur(noisy, pilot, deviation):
    return gaussian_filter(noisy, 1.0)


def test_regularisation_by_denoising_ends_at_its_equation(truth):
    """``A'(A h - f) + coupling (h - denoise(h)) = 0`` holds at the end; the iteration contracts for
    a blur.
    """
    measurements = measure(gaussian_filter(truth, 2) + 0.5)  # so that nothing is cut at 0
    method = RegularisationByDenoising(TotalVariation(0.02, 20), blur, calls=80)
    picture = recover(method, measurements)[0]
    coupling = method.coupling * estimate_squared_norm(OPERATOR)
    pull = OPERATOR.adjoint(measurements[:, 0] - OPERATOR(picture))
    push = coupling * (picture - gaussian_filter(picture, 1.0))
    assert picture.min() > 0
    # ten steps of conjugate gradients a call leave a hundredth
    assert np.linalg.norm(pull - push) < 0.03 * np.linalg.norm(pull)


def test_many_frames_are_recovered_one_by_one_and_dark_ones_stay_dark(truth):
    measurements = measure(truth, truth[::-1].copy(), np.zeros(SHAPE))
    method = PlugAndPlay(TotalVariation(0.02, 30), calls=2)
    whole, alone = recover(method, measurements), recover(method, measurements[:, :1].copy())
    # a batch sets one weight for all its frames
    np.testing.assert_allclose(whole[0], alone[0], atol=5e-3)
    assert whole[2].max() == 0


def test_huber_s_term_reaches_the_denoiser_s_loop(truth):
    measurements = measure(truth)
    peak, size = measurements.max(), measurements.size
    measurements[np.random.default_rng(3).permutation(size)[: size // 20]] = peak
    term = partial(Huber, threshold=0.02 * peak)
    squares, robust = (
        nmse(recover(PlugAndPlay(start), measurements)[0], truth)
        for start in (TotalVariation(0.02, 200), TotalVariation(0.005, 200, 0.0, term))
    )
    assert robust < 0.5 * squares
