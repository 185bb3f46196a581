"""Single pixels over time, against whole pictures of one instant."""

from __future__ import annotations

import numpy as np
import pytest

from tofclip.camera import Camera
from tofclip.errors import InputError
from tofclip.operators import Identity
from tofclip.solvers import LinearInverse, PreparedInverse
from tofclip.solvers.direct import PATCH_COLUMNS, PATCH_ROWS, InverseTraces, order_by_patch
from tofclip.threads import LANES


def camera() -> Camera:
    return Camera(np.array([30.0, 85.0, 140.0]), np.radians([-40.0, 5.0, 35.0]), (21, 37), 170)


@pytest.mark.parametrize("frames", [1, 31, 64, 150, 300])
def test_traces_are_the_pictures_seen_pixel_by_pixel(frames):
    measurements = np.random.default_rng(frames).random((170, frames)).astype(np.float32)
    prepared = LinearInverse().prepare(camera().operator())
    pixels = order_by_patch((21, 37))
    traces = InverseTraces(prepared, pixels)
    weights = prepared.weights(measurements)
    found = np.full((pixels.size, frames + 2), -1.0, np.float32)
    for piece in (slice(0, 100), slice(100, 101), slice(101, pixels.size)):
        traces.fill(weights, piece, found[piece], slice(1, frames + 1))
    expected = prepared.recover(measurements).frames.reshape(frames, -1)[:, pixels].T
    # the same sums in the same order: only a lone frame goes another way
    np.testing.assert_allclose(found[:, 1:-1], expected, atol=1e-5 * np.abs(expected).max())
    assert np.all(found[:, [0, -1]] == -1)


@pytest.mark.parametrize("frames", [1, LANES, 150])
def test_weights_are_the_inverse_gram_matrix_times_the_measurements(frames):
    prepared = LinearInverse().prepare(camera().operator())
    measurements = np.random.default_rng(frames).random((170, frames)).astype(np.float32)
    weights = prepared.weights(measurements)
    matrix = prepared.operator.matrix.toarray().astype(np.float64)
    mu = LinearInverse().damping * prepared.operator.squared_norm
    expected = np.linalg.solve(matrix @ matrix.T + mu * np.eye(170), measurements)
    # what no pixel falls on has no part in the pictures
    unseen = matrix.sum(axis=1) == 0
    assert 0 < unseen.sum() < 170
    expected[unseen] = 0
    # float32 sums of 170 products
    np.testing.assert_allclose(
        weights[:, :frames], expected, atol=170 * 6e-8 * np.abs(expected).max()
    )
    assert not weights[:, frames:].any()
    assert weights.shape[1] >= -(-frames // LANES) * LANES  # whole vectors
    assert weights.ctypes.data % 64 == weights.strides[0] % 64 == 0


def test_patches_hold_every_pixel_once_and_neighbours_together():
    order = order_by_patch((21, 37))
    np.testing.assert_array_equal(np.sort(order), np.arange(21 * 37))
    row, column = np.divmod(order[: PATCH_ROWS * PATCH_COLUMNS], 37)
    assert (row.max(), column.max()) == (PATCH_ROWS - 1, PATCH_COLUMNS - 1)


def test_operators_without_a_matrix_are_refused():
    inverse = PreparedInverse(Identity((4, 4)), np.eye(16, dtype=np.float32))
    with pytest.raises(InputError, match="sparse matrix"):
        InverseTraces(inverse, order_by_patch((4, 4)))
