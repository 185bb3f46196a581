"""Frames in which a pixel stands out are those that the whole matched filter finds."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse

from tofclip.camera import Camera
from tofclip.errors import InputError
from tofclip.lidar.signal_rows import BrightFrameFinder
from tofclip.operators.sparse import Tiles
from tofclip.solvers import LinearInverse
from tofclip.solvers.direct import GROUP_PIXELS, InverseTraces, order_by_patch
from tofclip.threads import LANES

SHAPE = (21, 37)
# the first two views overlap
CENTRES = np.array([30.0, 52.4, 140.2])


def camera(dead: int | None = None) -> Camera:
    angles = np.radians([-40.0, 5.0, 35.0])
    return Camera(CENTRES, angles, SHAPE, 170, dead_columns=np.arange(170) == dead)


def filter_responses(matrix: np.ndarray, block: np.ndarray) -> np.ndarray:
    """Largest response of the matched filter in each frame."""
    length = np.linalg.norm(matrix, axis=0)
    return (matrix.T @ block / np.where(length > 0, length, 1)[:, np.newaxis]).max(axis=0)


@pytest.mark.parametrize("limit", [2.5, 3.5, 4.5])
@pytest.mark.parametrize("light", [0.0, 12.0])
def test_bright_frames_are_those_of_the_whole_filter(limit, light):
    operator = camera().operator()
    tiles = InverseTraces(LinearInverse().prepare(operator), order_by_patch(SHAPE)).tiles
    random = np.random.default_rng(3)
    block = random.standard_normal((170, 8 * LANES)).astype(np.float32)
    matrix = operator.matrix.toarray()
    for frame in range(0, block.shape[1], 3):
        column = matrix[:, random.integers(matrix.shape[1])]
        block[:, frame] += light * random.random() * column / max(np.linalg.norm(column), 1)
    # more than a word of frames, and not whole ones
    span = slice(LANES, 6 * LANES)
    expected = filter_responses(matrix, block)[span]
    assert np.abs(expected - limit).min() > 1e-5
    bright = BrightFrameFinder(tiles, 170, GROUP_PIXELS).find(block, span, limit)
    np.testing.assert_array_equal(bright, expected >= limit)


def test_dead_measurements_are_left_out_of_the_filter():
    alive = np.arange(170) != 60
    prepared = LinearInverse().prepare(camera(60).operator(), alive)
    tiles = InverseTraces(prepared, order_by_patch(SHAPE)).tiles
    block = np.random.default_rng(0).standard_normal((170, 4 * LANES)).astype(np.float32)
    expected = filter_responses(prepared.operator.matrix.toarray() * alive[:, np.newaxis], block)
    bright = BrightFrameFinder(tiles, 170, GROUP_PIXELS).find(block, slice(0, 4 * LANES), 3.2)
    np.testing.assert_array_equal(bright, expected >= 3.2)


def test_any_nonnegative_matrix_and_any_limit_will_do():
    random = np.random.default_rng(1)
    matrix = scipy.sparse.random_array((50, 90), density=0.1, rng=random).astype(np.float32)
    finder = BrightFrameFinder(Tiles.from_csr(matrix.T.tocsr()), 50, GROUP_PIXELS)
    block = random.standard_normal((50, 2 * LANES)).astype(np.float32)
    span = slice(0, 2 * LANES)
    expected = filter_responses(matrix.toarray(), block)
    np.testing.assert_array_equal(finder.find(block, span, 3.0), expected >= 3.0)
    assert finder.find(block, span, 0.0).all()
    assert not finder.find(block, span, 100.0).any()
    assert not finder.find(-np.abs(block), span, 1e-3).any()


def test_negative_entries_are_refused():
    matrix = scipy.sparse.csr_array(np.array([[1.0, -1.0]], np.float32))
    with pytest.raises(InputError, match="negative entries"):
        BrightFrameFinder(Tiles.from_csr(matrix), 2, GROUP_PIXELS)
