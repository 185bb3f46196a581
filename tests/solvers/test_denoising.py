"""Denoisers on pictures whose clean version is known, and plug-and-play: its quadratic step against a dense
solve, its fixed points, its gain over the start.
"""

from __future__ import annotations

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
def clean() -> np.ndarray:
    """Two bars, a ramp and a disc: edges, a slope and a curve."""
    y, x = np.mgrid[:72, :65].astype(np.float32)
    picture = 0.3 * x / 65
    picture[10:50, 12:18] = 1
    picture[10:50, 26:32] = 0.7
    picture[(y - 50) ** 2 + (x - 46) ** 2 < 120] = 0.9
    return picture.astype(np.float32)


def noise(shape: tuple[int, int]) -> np.ndarray:
    return np.random.default_rng(0).normal(0, DEVIATION, shape).astype(np.float32)


def left_over(found: np.ndarray, clean: np.ndarray) -> float:
    """Share of the noise's energy."""
    return float(np.mean((found - clean) ** 2)) / DEVIATION**2


def test_non_local_means_remove_most_of_the_noise(clean):
    noisy = clean + noise(clean.shape)
    found = NonlocalMeans()(noisy, noisy, DEVIATION)
    assert found.dtype == noisy.dtype
    assert left_over(found, clean) < 0.25


def test_the_collaborative_filter_gets_better_with_its_pilot(clean):
    """From a blurred pilot onwards, each result the pilot of the next; the truth as pilot is the
    bound.
    """
    noisy = clean + noise(clean.shape)
    denoiser = CollaborativeWiener()
    found = [gaussian_filter(noisy, 1)]
    for _ in range(4):
        found.append(denoiser(noisy, found[-1], DEVIATION))
    shares = [left_over(picture, clean) for picture in found]
    assert found[-1].dtype == noisy.dtype
    assert (
        shares[1]
        > shares[2]
        > shares[3]
        > shares[4]
        > left_over(denoiser(noisy, clean, DEVIATION), clean)
    )
    assert shares[4] < 0.25


def test_an_even_picture_stays_even():
    even = np.full((20, 31), 0.4, np.float32)
    np.testing.assert_allclose(CollaborativeWiener()(even, even, DEVIATION), 0.4, atol=1e-5)


def test_without_noise_nothing_changes(clean):
    np.testing.assert_allclose(CollaborativeWiener()(clean, clean, 1e-4), clean, atol=1e-3)


def test_the_filter_turns_with_the_picture(clean):
    noisy = (clean + noise(clean.shape))[:27, :30]
    everyone = CollaborativeWiener(
        group=10_000
    )  # with every patch in the group, ties do not matter
    turned = everyone(noisy.T, noisy.T, DEVIATION)
    np.testing.assert_allclose(turned.T, everyone(noisy, noisy, DEVIATION), atol=2e-5)


def test_pictures_that_do_not_fit_are_refused(clean):
    with pytest.raises(ShapeError):
        CollaborativeWiener()(clean, clean[:-1], DEVIATION)
    with pytest.raises(InputError, match="smaller than a patch"):
        CollaborativeWiener()(clean[:4], clean[:4], DEVIATION)


def test_bm3d_says_how_to_get_it(clean, monkeypatch):
    monkeypatch.setitem(sys.modules, "bm3d", None)
    with pytest.raises(MissingDependencyError, match="non-commercial"):
        BlockMatching()(clean, clean, DEVIATION)


def test_bm3d_denoises(clean):
    pytest.importorskip("bm3d", reason="the package bm3d is optional")
    noisy = clean + noise(clean.shape)
    found = BlockMatching()(noisy, noisy, DEVIATION)
    assert left_over(found, clean) < 0.25


SHAPE = (48, 45)


@pytest.fixture(scope="module")
def projections() -> RadonProjection:
    return RadonProjection(SHAPE, 48, np.arange(14) * np.pi / 14, np.zeros(14), dtype=np.float64)


@pytest.fixture(scope="module")
def truth() -> np.ndarray:
    picture = np.zeros(SHAPE)
    picture[8:40, 8:13] = picture[8:40, 24:29] = 1
    picture[8:13, 8:40] = 0.6
    return picture


def unchanged(noisy: np.ndarray, pilot: np.ndarray, deviation: float) -> np.ndarray:
    return noisy


def readings_with_noise(operator: RadonProjection, truth: np.ndarray) -> np.ndarray:
    clean = operator(truth)
    return (clean + 0.04 * clean.max() * np.random.default_rng(0).standard_normal(clean.shape))[
        :, np.newaxis
    ]


def test_the_quadratic_step_is_the_dense_solution():
    operator = RadonProjection((7, 6), 7, np.arange(5) * np.pi / 5, np.zeros(5), dtype=np.float64)
    dense = np.stack([operator(row.reshape(7, 6)) for row in np.eye(42)], axis=1)
    rng = np.random.default_rng(1)
    measurements, anchor = rng.random(operator.shape_out), rng.random((7, 6))
    found = solve_data_step(
        operator, LeastSquares(measurements[:, np.newaxis]), anchor, 0.7, iterations=60
    )
    known = np.linalg.solve(
        dense.T @ dense + 0.7 * np.eye(42), dense.T @ measurements + 0.7 * anchor.ravel()
    )
    np.testing.assert_allclose(found.ravel(), known, atol=1e-8)


def test_bad_readings_hardly_pull_with_huber_s_weights():
    operator = RadonProjection((7, 6), 7, np.arange(5) * np.pi / 5, np.zeros(5), dtype=np.float64)
    anchor = np.random.default_rng(2).random((7, 6))
    corrupted = operator(anchor)[:, np.newaxis]
    corrupted[3] += 1e4
    pulled = solve_data_step(operator, Huber(corrupted, threshold=0.01), anchor, 1.0)
    assert np.abs(pulled - anchor).max() < 0.01  # at most threshold / coupling
    assert (
        np.abs(solve_data_step(operator, LeastSquares(corrupted), anchor, 1.0) - anchor).max() > 100
    )


def test_without_a_denoiser_the_data_are_met(projections, truth):
    """A denoiser that changes nothing leaves the iterations of proximal points: they end at the
    least residual.
    """
    measurements = projections(truth)[:, np.newaxis]
    start = TotalVariation(0.05, 20)
    found = PlugAndPlay(start, unchanged, calls=40).recover(projections, measurements)
    before = np.linalg.norm(
        projections(start.recover(projections, measurements).frames[0]) - measurements[:, 0]
    )
    assert np.linalg.norm(projections(found.frames[0]) - measurements[:, 0]) < 0.1 * before


def test_it_improves_on_its_start(projections, truth):
    measurements = readings_with_noise(projections, truth)
    start = TotalVariation(0.004, 200, 1e-4)  # too small a weight: the start is noisy
    before = nmse(start.recover(projections, measurements).frames[0], truth)
    result = PlugAndPlay(start).recover(projections, measurements)
    assert nmse(result.frames[0], truth) < 0.8 * before
    assert result.frames.min() >= 0
    assert result.stop_reason == "8 calls of the denoiser done"


def blurred(noisy: np.ndarray, pilot: np.ndarray, deviation: float) -> np.ndarray:
    return gaussian_filter(noisy, 1.0)


def test_regularisation_by_denoising_ends_at_its_equation(projections, truth):
    """``A'(A h - f) + coupling (h - denoise(h)) = 0`` holds at the end; the iteration contracts for
    a blur.
    """
    measurements = projections(gaussian_filter(truth, 2) + 0.5)[
        :, np.newaxis
    ]  # so that nothing is cut at 0
    method = RegularisationByDenoising(TotalVariation(0.02, 20), blurred, calls=80)
    picture = method.recover(projections, measurements).frames[0]
    coupling = method.coupling * estimate_squared_norm(projections)
    pull = projections.adjoint(measurements[:, 0] - projections(picture))
    push = coupling * (picture - gaussian_filter(picture, 1.0))
    assert picture.min() > 0
    # ten steps of conjugate gradients a call leave a hundredth
    assert np.linalg.norm(pull - push) < 0.03 * np.linalg.norm(pull)


def test_many_frames_are_recovered_one_by_one(projections, truth):
    measurements = np.concatenate(
        [projections(truth)[:, np.newaxis], projections(truth[::-1].copy())[:, np.newaxis]], 1
    )
    method = PlugAndPlay(TotalVariation(0.02, 30), calls=2)
    both = method.recover(projections, measurements).frames
    alone = method.recover(projections, measurements[:, :1].copy()).frames
    np.testing.assert_allclose(
        both[0], alone[0], atol=5e-3
    )  # a batch sets one weight for all its frames


def test_a_frame_without_light_stays_dark(projections, truth):
    measurements = np.stack([projections(truth), np.zeros(projections.shape_out)], axis=1)
    frames = (
        PlugAndPlay(TotalVariation(0.02, 10), calls=2).recover(projections, measurements).frames
    )
    assert frames[1].max() == 0


def test_huber_s_term_reaches_the_denoiser_s_loop(projections, truth):
    measurements = projections(truth)[:, np.newaxis].copy()
    bad = np.random.default_rng(3).permutation(measurements.size)[: measurements.size // 20]
    clean_peak = measurements.max()
    measurements[bad] = clean_peak
    squares = PlugAndPlay(TotalVariation(0.02, 200)).recover(projections, measurements).frames[0]
    term = partial(Huber, threshold=0.02 * clean_peak)
    robust = (
        PlugAndPlay(TotalVariation(0.005, 200, 0.0, term))
        .recover(projections, measurements)
        .frames[0]
    )
    assert nmse(robust, truth) < 0.5 * nmse(squares, truth)


def test_settings_without_sense_are_refused():
    with pytest.raises(InputError, match="call"):
        PlugAndPlay(TotalVariation(), calls=0)
    with pytest.raises(InputError, match="positive"):
        PlugAndPlay(TotalVariation(), strength=0)
