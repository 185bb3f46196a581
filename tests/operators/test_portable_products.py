"""Products with sparse matrices on other libraries' arrays, beyond what the contract of operators
asks.
"""

from __future__ import annotations

import sys

import numpy as np
import pytest
import scipy.sparse

from tofclip.arrays import ComputeDevice, to_numpy
from tofclip.operators import sparse
from tofclip.operators.sparse import make_product

MATRIX = scipy.sparse.random_array((31, 17), density=0.2, rng=np.random.default_rng(1)).tocsr()
BLOCK = np.random.default_rng(2).random((17, 6))
STRICT = ComputeDevice("array_api_strict")


@pytest.mark.parametrize("rows_at_once", [1, 4, 1000])
def test_what_does_not_fit_at_once_is_gathered_in_pieces(rows_at_once, monkeypatch):
    longest = int(np.diff(MATRIX.indptr).max())
    monkeypatch.setattr(sparse, "GATHERED_NUMBERS", rows_at_once * longest * BLOCK.shape[1])
    product = make_product(MATRIX, STRICT)
    np.testing.assert_allclose(to_numpy(product(STRICT.put(BLOCK))), MATRIX @ BLOCK, rtol=1e-13)


def test_a_matrix_without_entries():
    empty = scipy.sparse.csr_array((3, 17), dtype=np.float32)
    result = to_numpy(make_product(empty, STRICT)(STRICT.put(BLOCK.astype(np.float32))))
    np.testing.assert_array_equal(result, np.zeros((3, 6)))


def test_cupys_matrix_is_built_as_scipys_would_be(monkeypatch):
    """Where there is no CuPy, SciPy stands in for its sparse matrices, which have the same
    interface.
    """
    for name in ("cupyx", "cupyx.scipy"):
        monkeypatch.setitem(sys.modules, name, scipy)
    monkeypatch.setitem(sys.modules, "cupyx.scipy.sparse", scipy.sparse)
    monkeypatch.setattr(ComputeDevice, "put", lambda device, values: values)
    product = make_product(MATRIX, ComputeDevice("cupy"))
    np.testing.assert_allclose(product(BLOCK), MATRIX @ BLOCK, rtol=1e-14)
