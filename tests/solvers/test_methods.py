"""The direct methods, and what all methods refuse."""

from __future__ import annotations

import numpy as np
import pytest

from tofclip.camera import Camera
from tofclip.errors import InputError, ShapeError
from tofclip.operators import Diagonal, Identity, LineProjection
from tofclip.solvers import (
    Backprojection,
    LinearInverse,
    PreparedInverse,
    Sparse,
    StoppingRule,
    TotalVariation,
    relative_residual,
)
from tofclip.solvers.direct import PATCH_COLUMNS, PATCH_ROWS, InverseTraces, order_by_patch
from tofclip.threads import LANES

METHODS = [Sparse(2e-3, 10), TotalVariation(2e-3, 10), LinearInverse(), Backprojection()]
every_method = pytest.mark.parametrize("method", METHODS, ids=lambda method: method.name)


@pytest.fixture
def operator() -> LineProjection:
    return LineProjection(
        (12, 11), 40, [8.2, 20.0, 31.5], [-0.7, 0.05, 0.6], [1.0, 0.8, 1.1], np.float64
    )


def test_linear_inverse_is_the_damped_normal_equations(operator):
    measurements = np.random.default_rng(0).random((40, 5))
    dense = operator.matrix.toarray()
    mu = 0.05 * np.linalg.norm(dense, 2) ** 2
    expected = np.linalg.solve(dense.T @ dense + mu * np.eye(132), dense.T @ measurements)
    result = LinearInverse(0.05).recover(operator, measurements)
    # The largest eigenvalue comes from 15 power iterations, within 1 %.
    scale = np.abs(expected).max()
    np.testing.assert_allclose(result.frames, expected.T.reshape(5, 12, 11), atol=0.01 * scale)
    assert result.stop_reason == "direct method"


def test_linear_inverse_leaves_dead_readings_out(operator):
    measurements = np.random.default_rng(1).random((40, 4))
    alive = np.ones((40, 4), bool)
    alive[[3, 17]] = False
    corrupted = measurements.copy()
    corrupted[[3, 17]] = 1e5
    method = LinearInverse()
    np.testing.assert_allclose(
        method.recover(operator, corrupted, alive).frames,
        method.recover(operator, measurements, alive).frames,
        rtol=1e-10,
    )


def test_a_prepared_inverse_serves_many_shots(operator):
    measurements = np.random.default_rng(2).random((40, 40))
    prepared = LinearInverse().prepare(operator)
    np.testing.assert_array_equal(
        prepared.recover(measurements).frames,
        LinearInverse().recover(operator, measurements).frames,
    )


def test_setting_up_is_told_apart_from_recovering(operator):
    result = LinearInverse().recover(operator, np.ones((40, 2)))
    assert result.setup_seconds > 0


def test_adjoint_is_the_adjoint_up_to_one_factor(operator):
    measurements = np.random.default_rng(3).random((40, 37))
    expected = np.moveaxis(operator.adjoint(measurements), -1, 0)
    frames = Backprojection().recover(operator, measurements).frames
    np.testing.assert_allclose(frames * expected.max() / frames.max(), expected, rtol=1e-12)


def test_adjoint_has_the_scale_that_fits_best(operator):
    measurements = np.random.default_rng(5).random((40, 9))
    frames = Backprojection().recover(operator, measurements).frames
    best = relative_residual(operator, frames, measurements)
    assert best < 1
    for factor in (0.99, 1.01):
        assert relative_residual(operator, factor * frames, measurements) > best


@every_method
def test_frames_come_in_the_order_of_the_readings(operator, method):
    measurements = np.zeros((40, 70))
    bright = [0, 33, 69]
    for frame in bright:
        measurements[:, frame] = operator(np.ones((12, 11)))
    result = method.recover(operator, measurements)
    assert result.frames.shape == (70, 12, 11)
    energy = result.frames.sum(axis=(1, 2))
    assert set(np.nonzero(energy > 1e-6 * energy.max())[0]) == set(bright)


@every_method
def test_progress_adds_up(operator, method):
    done: list[int] = []
    method.recover(operator, np.ones((40, 70)), progress=done.append)
    assert sum(done) == method.work(70)


@every_method
def test_an_interruption_gets_through(operator, method):
    def interrupt(_: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        method.recover(operator, np.ones((40, 70)), progress=interrupt)


@every_method
def test_unusable_readings_are_refused(operator, method):
    with pytest.raises(ShapeError, match="measurements"):
        method.recover(operator, np.ones((39, 2)))
    with pytest.raises(InputError, match="NaN"):
        method.recover(operator, np.full((40, 2), np.nan))


@pytest.mark.parametrize("method", METHODS[:2], ids=lambda method: method.name)
def test_darkness_is_refused(operator, method):
    with pytest.raises(InputError, match=r"nothing|positive"):
        method.recover(operator, -np.ones((40, 2)))
    with pytest.raises(ShapeError, match="mask"):
        method.recover(operator, np.ones((40, 2)), np.ones((40, 3), bool))


def test_linear_inverse_needs_a_matrix(operator):
    with pytest.raises(InputError, match="sparse matrix"):
        LinearInverse().recover(Diagonal(np.ones(40), np.float64) @ operator, np.ones((40, 2)))
    with pytest.raises(InputError, match="damping"):
        LinearInverse(0.0).recover(operator, np.ones((40, 2)))


@pytest.mark.parametrize("settings", [(0,), (5, -1.0), (5, np.nan)])
def test_nonsensical_stopping_is_refused(settings):
    with pytest.raises(InputError):
        StoppingRule(*settings)


def test_relative_residual_by_hand(operator):
    frames = np.random.default_rng(4).random((35, 12, 11))
    measurements = operator(np.moveaxis(frames, 0, -1))
    assert relative_residual(operator, frames, measurements) < 1e-14
    assert relative_residual(operator, 0 * frames, measurements) == 1
    valid = np.ones(measurements.shape, bool)
    valid[5] = False
    measurements[5] = 1e9
    assert relative_residual(operator, frames, measurements, valid) < 1e-14
    with pytest.raises(InputError, match="zero"):
        relative_residual(operator, frames, 0 * measurements)


@pytest.mark.parametrize("method", [Sparse(), TotalVariation()], ids=lambda method: method.name)
def test_a_lone_picture_is_recovered_as_in_a_block(method):
    """One picture takes loops of one lane, many take blocks; float32 rounding is all that may
    differ.
    """
    random = np.random.default_rng(4)
    operator = LineProjection((15, 17), 90, [14.0, 44.0, 74.0], [0.5, 0.0, -0.5], [1.0, 1.0, 1.0])
    picture = (random.random((15, 17)) > 0.8).astype(np.float32)
    measurements = operator(picture)[:, np.newaxis]
    alone = method.recover(operator, measurements).frames[0]
    many = method.recover(operator, np.tile(measurements, 3)).frames
    np.testing.assert_allclose(alone, many[1], atol=1e-3 * alone.max())


def test_a_measurement_that_is_invalid_in_one_frame_only_is_used_by_the_linear_inverse():
    operator = LineProjection((6, 6), 20, [10.0], [0.3], [1.0], np.float64)
    measurements = np.random.default_rng(0).random((20, 3))
    valid = np.ones((20, 3), bool)
    valid[9, 1] = False
    method = LinearInverse()
    expected = method.recover(operator, measurements).frames
    np.testing.assert_array_equal(method.recover(operator, measurements, valid).frames, expected)
    valid[9] = False
    assert not np.allclose(method.recover(operator, measurements, valid).frames, expected)


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
