"""A matrix in panels multiplies as a matrix does."""

from __future__ import annotations

import numpy as np
import pytest

from tofclip.operators.panels import BLOCK_VECTORS, PanelMatrix


@pytest.mark.parametrize("frames", [1, 16, 31, 64, 95, 16 * BLOCK_VECTORS + 33])
@pytest.mark.parametrize("shape", [(6, 20), (13, 700), (40, 1)])
def test_products_are_those_of_the_matrix(shape, frames):
    random = np.random.default_rng(frames)
    matrix = random.standard_normal(shape).astype(np.float32)
    operand = random.standard_normal((shape[1] + 5, frames)).astype(np.float32)
    # all rows but one before, one in between where there is one, and some behind
    cut = 1 + shape[1] // 3
    stretches = np.array([[1, cut], [cut + 1, shape[1] + 2]])
    taken = np.concatenate([operand[first:last] for first, last in stretches])
    assert len(taken) == shape[1]
    width = -(-frames // 16) * 16 + 16
    found = PanelMatrix(matrix).multiply(operand, stretches, width)
    assert found.shape == (shape[0], width)
    assert found.ctypes.data % 64 == 0
    expected = matrix.astype(np.float64) @ taken
    size = np.abs(matrix).astype(np.float64) @ np.abs(taken)
    # sums of 320 products in float32, and few of such sums
    assert np.all(np.abs(found[:, :frames] - expected) <= 330 * 6e-8 * size)
    assert not found[:, frames:].any()


def test_a_matrix_without_entries_has_products_without_entries():
    nothing = PanelMatrix(np.zeros((0, 0), np.float32))
    found = nothing.multiply(np.ones((4, 7), np.float32), np.zeros((0, 2), np.int64), 16)
    assert found.shape == (0, 16)
