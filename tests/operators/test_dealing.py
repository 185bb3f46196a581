"""Dealing angles to views: nobody left out, and neighbours spread over the aperture."""

from __future__ import annotations

import numpy as np
import pytest

from tofclip.errors import InputError
from tofclip.operators.cameras import (
    EvenAngleLineCamera,
    LineCamera,
    assign_evenly,
    assign_randomly,
    count_lines,
)

VIEWS = [(float(v), float(u)) for v in range(-4, 4) for u in range(-4, 4)]


def random_deal(angles: np.ndarray, seed: int):
    return assign_randomly(angles, len(VIEWS), np.random.default_rng(seed))


def even_deal(angles: np.ndarray, seed: int, cycle: int = 4):
    return assign_evenly(angles, VIEWS, cycle, np.random.default_rng(seed))


@pytest.mark.parametrize("deal", [random_deal, even_deal])
@pytest.mark.parametrize("count", [5, 64, 100, 256])
def test_every_angle_is_dealt_once_and_no_view_gets_two_more_than_another(deal, count):
    angles = np.arange(count) * np.pi / count
    used, dealt = deal(angles, 0)
    assert list(used) == sorted(set(used))
    np.testing.assert_array_equal(np.sort(np.concatenate(dealt)), angles)
    own = np.zeros(len(VIEWS), int)
    own[list(used)] = [len(angles) for angles in dealt]
    assert own.max() == -(-count // len(VIEWS))
    if deal is random_deal:
        assert own.max() - own.min() <= 1


def unevenness(used: tuple[int, ...], dealt: list[np.ndarray], window: int) -> float:
    """How far the mean of ``t = u cos + v sin`` over neighbouring angles is from the aperture's,
    rms, in views.
    """
    angles = np.concatenate(dealt)
    v, u = np.repeat(np.array(VIEWS)[list(used)], [len(own) for own in dealt], axis=0).T
    order = np.argsort(angles)
    offset = ((u + 0.5) * np.cos(angles) + (v + 0.5) * np.sin(angles))[order]
    return float(np.sqrt(np.mean(np.convolve(offset, np.ones(window) / window, "valid") ** 2)))


@pytest.mark.parametrize(("count", "cycle"), [(32, 2), (64, 2), (128, 4), (256, 8)])
def test_neighbouring_angles_stand_for_the_whole_aperture(count, cycle):
    """Their mean place is the aperture's middle, many times more nearly than at random; so for
    every seed.
    """
    angles = np.arange(count) * np.pi / count
    even = [unevenness(*even_deal(angles, seed, cycle), cycle) for seed in range(3)]
    at_random = [unevenness(*random_deal(angles, seed), cycle) for seed in range(3)]
    assert max(even) < 0.25 * min(at_random)


def test_the_places_of_a_cycle_are_all_different():
    """With cycle 8 each eighth of the ranked views is taken once in every eight angles."""
    angles = np.arange(64) * np.pi / 64
    used, dealt = even_deal(angles, 0, 8)
    owner = np.empty(64, int)
    owner[np.searchsorted(angles, np.concatenate(dealt))] = np.repeat(
        used, [len(own) for own in dealt]
    )
    v, u = np.array(VIEWS).T[:, :, None]
    rank = np.argsort(
        np.argsort(u * np.cos(angles) + v * np.sin(angles), axis=0, kind="stable"),
        axis=0,
        kind="stable",
    )
    eighth = rank[owner, np.arange(64)] * 8 // 64
    # Each view is taken once only, so that a few must make do with a neighbouring eighth.
    assert np.mean([len(set(eighth[k : k + 8])) for k in range(0, 64, 8)]) > 6.5


def test_the_even_camera_measures_as_much_as_the_random_one():
    for ratio in (0.25, 1.0, 2.0):
        cameras = [kind((32, 32), VIEWS, ratio, 0) for kind in (LineCamera, EvenAngleLineCamera)]
        assert cameras[0].measurements == cameras[1].measurements
        np.testing.assert_array_equal(
            *(np.sort(np.concatenate(camera.angles)) for camera in cameras)
        )


def test_no_lines_at_all_are_refused():
    with pytest.raises(InputError, match="gives no view a projection"):
        count_lines((32, 32), 32, 0.01)
