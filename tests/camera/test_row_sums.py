"""Sums of rectified rows, made in one look at the raw picture, are those of the rectified picture."""

from __future__ import annotations

import numpy as np
import pytest

from tofclip.camera import Camera, ProjectiveSweep, Rectifier, SkewSweep, estimate_dark_level
from tofclip.camera.rectifier import RowSums
from tofclip.errors import InputError
from tofclip.threads import LANES

ROWS, WIDTH, LENGTH = 200, 75, 5
SKEW = SkewSweep(np.array([20.0, 55.0]), np.array([-6.0, 9.5]), np.array([0.01, -0.02]))
TURNED = ProjectiveSweep(np.array([[1.01, 0.02, -0.7], [-0.03, 0.98, 1.3], [1e-5, -2e-5, 1.0]]))


def camera(sweep=SKEW, dead: int = 20) -> Camera:
    return Camera([37.0], [0.0], (8, 8), WIDTH, sweep=sweep, dead_columns=np.arange(WIDTH) == dead)


def streak(seed: int = 0) -> np.ndarray:
    counts = np.random.default_rng(seed).poisson(90, (ROWS, WIDTH)).astype(np.float32)
    counts[60:130] += 300
    return counts


@pytest.mark.parametrize("sweep", [SKEW, TURNED, None])
def test_sums_are_those_of_rectified_rows(sweep):
    rectifier, counts = Rectifier(camera(sweep), ROWS), streak()
    # more than the threads' blocks; the last ones begin anew, as of instants that fill a vector up
    starts = np.append(np.arange(0, ROWS - LENGTH, 2), np.zeros(LANES, int))[: 4 * LANES]
    starts = np.pad(starts, (0, 4 * LANES - starts.size))
    sums = np.full((WIDTH, starts.size + 3), -1, np.float32)
    dark = RowSums(rectifier, starts, LENGTH).add_up(counts, sums)
    assert dark == estimate_dark_level(counts)
    rectified = rectifier.rectify(counts)
    expected = rectified[:, starts[:, np.newaxis] + np.arange(LENGTH)].sum(axis=2)
    # sums of 500 counts before the dark level is taken off
    np.testing.assert_allclose(sums[:, :-3], expected, atol=1e-3)
    assert np.all(sums[:, -3:] == -1)
    assert not sums[20, :-3].any()
    outside = ~rectifier.inside.T[:, starts[:, np.newaxis] + np.arange(LENGTH)].any(axis=2)
    assert outside.any() or sweep is None
    assert not sums[:, :-3][outside].any()


@pytest.mark.parametrize("sweep", [SKEW, TURNED])
def test_some_rows_are_rectified_as_all_are(sweep):
    rectifier, counts = Rectifier(camera(sweep), ROWS), streak(1)
    numbers = np.array([0, 3, 4, 100, ROWS - 1])
    found = rectifier.rectify_rows(counts, 90.0, numbers)
    np.testing.assert_array_equal(found, rectifier.rectify(counts, dark=90.0)[:, numbers])


def test_a_dark_shot_and_one_of_another_size_are_refused():
    rectifier = Rectifier(camera(), ROWS)
    adder = RowSums(rectifier, np.arange(LANES), LENGTH)
    sums = np.empty((WIDTH, LANES), np.float32)
    with pytest.raises(InputError, match="dark level"):
        adder.add_up(np.full((ROWS, WIDTH), 7, np.float32), sums)
    with pytest.raises(InputError, match="streak image of this camera"):
        adder.add_up(streak()[:-1], sums)
