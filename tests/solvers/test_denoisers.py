"""Denoisers on pictures whose clean version is known."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from tofclip.errors import InputError, MissingDependencyError, ShapeError
from tofclip.solvers.denoising import BlockMatching, CollaborativeWiener, NonlocalMeans

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
