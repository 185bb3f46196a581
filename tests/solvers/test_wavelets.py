"""The wavelet prior: its proximal step's known limits, and its solver's falling objective."""

from __future__ import annotations

import numpy as np
import pytest

from tofclip.operators import RadonProjection
from tofclip.solvers import Wavelets
from tofclip.solvers.priors import NonnegativeWavelets


def step(picture: np.ndarray, weight: float) -> tuple[np.ndarray, np.ndarray]:
    before, still = np.zeros_like(picture), np.zeros(picture.shape[-1], picture.dtype)
    result, penalty, _ = NonnegativeWavelets(weight).proximal_step(
        picture, before, still, np.zeros_like(picture), np.ones_like(still)
    )
    return result, penalty


@pytest.mark.parametrize("shape", [(32, 32, 1), (37, 45, 3)])
def test_no_weight_only_cuts_negative_values(shape):
    picture = np.random.default_rng(0).standard_normal(shape)
    result, penalty = step(picture, 0.0)
    np.testing.assert_allclose(result, np.maximum(picture, 0), atol=1e-9)
    np.testing.assert_array_equal(penalty, 0)


def test_an_even_picture_costs_nothing_and_stays():
    even = np.full((48, 32, 2), 0.7)
    result, penalty = step(even, 5.0)
    np.testing.assert_allclose(result, 0.7, atol=1e-9)
    np.testing.assert_allclose(penalty, 0, atol=1e-6)


def test_noise_is_shrunk_and_a_slope_is_not():
    y, x = np.mgrid[:64, :64] / 64.0
    slope = (2 + np.sin(3 * x) + np.cos(2 * y))[..., np.newaxis]
    noisy = slope + 0.1 * np.random.default_rng(1).standard_normal(slope.shape)
    result, _ = step(noisy, 0.3)
    inner = (slice(8, -8), slice(8, -8))  # the transform takes the picture for periodic
    assert np.mean((result - slope)[inner] ** 2) < 0.2 * np.mean((noisy - slope)[inner] ** 2)


def test_float32_stays_float32():
    result, penalty = step(np.random.default_rng(2).random((24, 24, 2)).astype(np.float32), 0.1)
    assert result.dtype == np.float32
    assert penalty.dtype == np.float64


def test_the_objective_falls_and_the_data_are_met():
    operator = RadonProjection((32, 32), 32, np.arange(24) * np.pi / 24, np.zeros(24))
    y, x = np.mgrid[:32, :32] - 15.5
    truth = np.exp(-(x**2 + y**2) / 40).astype(np.float32)
    measurements = operator(truth)[:, np.newaxis]
    result = Wavelets(1e-3, 80).recover(operator, measurements)
    assert np.all(np.diff(result.objective) <= 0)
    assert np.linalg.norm(operator(result.frames[0]) - measurements[:, 0]) < 0.02 * np.linalg.norm(
        measurements
    )
