"""A matrix in tiles multiplies as a matrix does, where the processor has registers for them."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

from tofclip.operators.panels import PanelMatrix, tiles
from tofclip.operators.panels.tiles import TileMatrix, arrange_matrix, request_tile_registers

with_registers = pytest.mark.skipif(
    not request_tile_registers(), reason="needs a processor with matrix registers, and Linux"
)


@with_registers
@pytest.mark.parametrize("frames", [1, 16, 31, 64, 95, 289])
@pytest.mark.parametrize("shape", [(6, 20), (33, 703), (40, 1), (64, 64)])
def test_products_are_those_of_the_matrix_to_single_precision(shape, frames):
    random = np.random.default_rng(frames)
    # twelve orders of magnitude, of either sign
    matrix = (random.standard_normal(shape) * 10 ** random.uniform(-6, 6, shape)).astype(np.float32)
    operand = random.standard_normal((shape[1] + 5, frames)).astype(np.float32)
    # all rows but one before, one in between where there is one, and some behind
    cut = 1 + shape[1] // 3
    stretches = np.array([[1, cut], [cut + 1, shape[1] + 2]])
    taken = np.concatenate([operand[first:last] for first, last in stretches])
    assert len(taken) == shape[1]
    width = -(-frames // 16) * 16 + 16
    found = TileMatrix(matrix).multiply(operand, stretches, width)
    assert found.shape == (shape[0], width)
    assert found.ctypes.data % 64 == 0
    expected = matrix.astype(np.float64) @ taken
    size = np.abs(matrix).astype(np.float64) @ np.abs(taken)
    # a few units in the last place: what float32 itself is granted is a hundred times as much
    assert np.all(np.abs(found[:, :frames] - expected) <= 40 * 6e-8 * size)
    assert not found[:, frames:].any()


@with_registers
def test_lone_products_keep_all_digits_of_single_precision():
    random = np.random.default_rng(2)
    diagonal, operand = random.uniform(1, 2, (2, 96)).astype(np.float32)
    found = TileMatrix(np.diag(diagonal)).multiply(operand[:, None], np.array([[0, 96]]), 16)
    exact = diagonal.astype(np.float64) * operand
    np.testing.assert_allclose(found[:, 0], exact, rtol=1.2e-7)


@with_registers
def test_a_matrix_without_entries_has_products_without_entries():
    nothing = TileMatrix(np.zeros((0, 0), np.float32))
    found = nothing.multiply(np.ones((4, 7), np.float32), np.zeros((0, 2), np.int64), 16)
    assert found.shape == (0, 16)


@with_registers
def test_a_matrix_is_arranged_for_the_computer_at_which_it_arrives(monkeypatch):
    random = np.random.default_rng(3)
    matrix = random.standard_normal((20, 30)).astype(np.float32)
    operand, stretches = random.standard_normal((30, 5)).astype(np.float32), np.array([[0, 30]])
    here = TileMatrix(matrix)
    sent = pickle.dumps(here)
    assert isinstance(pickle.loads(sent), TileMatrix)
    monkeypatch.setattr(tiles, "request_tile_registers", lambda: False)
    there = pickle.loads(sent)
    assert isinstance(there, PanelMatrix)
    np.testing.assert_allclose(
        there.multiply(operand, stretches, 16), here.multiply(operand, stretches, 16), atol=1e-5
    )


def test_no_registers_are_asked_for_where_the_compiler_knows_of_none(monkeypatch):
    from tofclip.operators.panels import kernels

    monkeypatch.setattr(kernels, "CPU_FEATURES", "+avx512f,-amx-tile,-amx-bf16")
    assert request_tile_registers.__wrapped__() is False


def test_without_registers_a_matrix_is_multiplied_in_panels(monkeypatch):
    monkeypatch.setattr(tiles, "request_tile_registers", lambda: False)
    assert isinstance(arrange_matrix(np.ones((3, 4), np.float32)), PanelMatrix)


def test_without_registers_no_matrix_is_put_into_tiles(monkeypatch):
    monkeypatch.setattr(tiles, "request_tile_registers", lambda: False)
    with pytest.raises(RuntimeError, match="registers"):
        TileMatrix(np.ones((3, 4), np.float32))
