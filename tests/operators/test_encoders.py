"""Radon projections, codes and the weighting of means against what they must be."""

from __future__ import annotations

import numpy as np
import pytest

from tofclip.operators import (
    HadamardCodes,
    LinearShear,
    MeanWeighting,
    RadonProjection,
)


def blob(shape: tuple[int, int], x: float, y: float) -> np.ndarray:
    rows, columns = np.indices(shape)
    return np.exp(-((columns - shape[1] // 2 - x) ** 2 + (rows - shape[0] // 2 - y) ** 2) / 18)


def test_at_right_angles_a_projection_sums_columns_and_rows():
    picture = np.random.default_rng(0).random((8, 8))
    measurements = RadonProjection((8, 8), 8, [0.0, np.pi / 2], [0.0, 0.0], np.float64)(picture)
    np.testing.assert_allclose(measurements[:8], picture.sum(axis=0), rtol=1e-12)
    np.testing.assert_allclose(measurements[8:], picture.sum(axis=1), rtol=1e-12)


def test_offsetting_the_detector_shears_the_picture():
    """A_k B_k by offset is A_k after the shear; linear interpolation twice or once on a blob of 3
    px differs by 1 %.
    """
    shear, view = -0.6, (-3, 2)
    angles = np.deg2rad([0, 23, 77, 140])
    picture = blob((61, 67), 4, -3)
    offsets = shear * (view[1] * np.cos(angles) + view[0] * np.sin(angles))
    offset = RadonProjection((61, 67), 67, angles, offsets, np.float64)(picture)
    plain = RadonProjection((61, 67), 67, angles, np.zeros(4), np.float64)
    sheared = plain(LinearShear((61, 67), shear, view, dtype=np.float64)(picture))
    assert np.linalg.norm(offset - sheared) < 0.01 * np.linalg.norm(sheared)
    assert np.linalg.norm(plain(picture) - sheared) > 0.1 * np.linalg.norm(sheared)


@pytest.mark.parametrize("count", [1, 2, 5])
def test_a_lone_picture_is_projected_as_by_the_matrix(count):
    """Without a matrix and with it; detectors so short and so far off that light is lost on both
    sides.
    """
    random = np.random.default_rng(count)
    offsets = random.uniform(-9, 9, count)
    operator = RadonProjection((12, 17), 9, random.uniform(0, np.pi, count), offsets, np.float64)
    picture, measurements = random.random((12, 17)), random.random(9 * count)
    np.testing.assert_allclose(operator(picture), operator.matrix @ picture.ravel(), atol=1e-13)
    np.testing.assert_allclose(
        operator.adjoint(measurements).ravel(), operator.matrix.T @ measurements, atol=1e-13
    )
    assert operator(picture).sum() < count * picture.sum()


def test_hadamard_codes_are_rows_of_a_hadamard_matrix_with_signs():
    """All codes of a picture, made -1 and 1, are orthogonal to each other."""
    codes = 2 * HadamardCodes((4, 8), 32, 7, np.float64)(np.eye(32).reshape(4, 8, 32)) - 1
    assert set(np.unique(codes)) == {-1.0, 1.0}
    np.testing.assert_allclose(codes @ codes.T, 32 * np.eye(32), atol=1e-12)


def test_codes_are_zeros_and_ones_half_of_them_open():
    codes = HadamardCodes((13, 16), 60, 3, np.float64)(np.eye(208).reshape(13, 16, 208))
    assert set(np.unique(codes)) == {0.0, 1.0}
    # 60 x 208 fair draws: the mean's standard deviation is 0.0045.
    assert codes.mean() == pytest.approx(0.5, abs=0.02)
    assert len(np.unique(codes, axis=0)) == 60


def test_the_seed_decides_the_codes():
    picture = np.random.default_rng(1).random((8, 8))
    np.testing.assert_array_equal(
        HadamardCodes((8, 8), 9, 5)(picture), HadamardCodes((8, 8), 9, 5)(picture)
    )
    assert not np.allclose(
        HadamardCodes((8, 8), 9, 5)(picture), HadamardCodes((8, 8), 9, 6)(picture)
    )


def test_every_view_keeps_its_own_share_of_its_mean():
    measurements = np.array([1.0, 3.0, 10.0, 20.0, 60.0])
    weighted = MeanWeighting([2, 3], 0.1, np.float64)(measurements)
    np.testing.assert_allclose(
        weighted, measurements - 0.9 * np.array([2, 2, 30, 30, 30]), rtol=1e-14
    )
