"""Vectors in compiled loops do what NumPy does with sixteen numbers."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numba import njit

from tofclip import vectors
from tofclip.vectors import (
    choose,
    copy_transposed,
    count_set_lanes,
    fill_vector,
    find_first_bit,
    find_highest_lane,
    list_set_lanes,
    load_vector,
    number_lanes,
    raise_vector,
    store_vector,
    sum_vector,
)

# whole numbers, of which float32 sums are exact in any order
floats = arrays(np.float32, vectors.LENGTH, elements=st.integers(-1000, 1000).map(np.float32))


@njit
def _combine(one, other, results):
    a, b = load_vector(one, np.uintp(0)), load_vector(other, np.uintp(0))
    store_vector(results[0], np.uintp(0), a + b)
    store_vector(results[1], np.uintp(0), a - b)
    store_vector(results[2], np.uintp(0), a * b)
    store_vector(results[3], np.uintp(0), choose((a > b) & (b >= fill_vector(one[3])), a, b))
    store_vector(results[4], np.uintp(0), raise_vector(a, b))
    return sum_vector(a), find_highest_lane(b), list_set_lanes(a >= b), count_set_lanes(a >= b)


@settings(deadline=None)
@given(floats, floats)
def test_arithmetic_and_choice(one, other):
    results = np.empty((5, vectors.LENGTH), np.float32)
    total, highest, bits, number = _combine(one, other, results)
    expected = [
        one + other,
        one - other,
        one * other,
        np.where((one > other) & (other >= one[3]), one, other),
        np.maximum(one, other),
    ]
    np.testing.assert_array_equal(results, expected)
    assert (total, highest, number) == (one.sum(), other.max(), (one >= other).sum())
    assert int(bits) == sum(1 << k for k in np.flatnonzero(one >= other).tolist())


@njit
def _find_bit(word):
    return find_first_bit(word)


@given(st.integers(1, 2**64 - 1))
def test_bits(word):
    first = _find_bit(np.uint64(word))
    assert word % (2 << int(first)) == 1 << int(first)


@njit
def _find_highest_number(numbers):
    return find_highest_lane(load_vector(numbers, np.uintp(0)))


@settings(deadline=None)
@given(arrays(np.int32, vectors.LENGTH))
def test_the_highest_whole_number(numbers):
    assert _find_highest_number(numbers) == numbers.max()


@njit
def _copy_shifted(values, start, numbers):
    store_vector(numbers, np.uintp(0), number_lanes())
    store_vector(values, np.uintp(0), load_vector(values, np.uintp(start)))


def test_vectors_begin_anywhere():
    values, numbers = np.arange(40, dtype=np.float32), np.empty(16, np.int32)
    _copy_shifted(values, 21, numbers)
    np.testing.assert_array_equal(values, [*range(21, 37), *range(16, 40)])
    np.testing.assert_array_equal(numbers, np.arange(16))


@njit
def _transpose(source, stride, target, step):
    copy_transposed(source, np.uintp(3), stride, target, np.uintp(5), step)


def test_sixteen_vectors_become_sixteen_others():
    source = np.arange(3 + 16 * 20, dtype=np.float32)
    target = np.full(5 + 16 * 19, -1, np.float32)
    _transpose(source, np.uintp(20), target, np.uintp(19))
    rows = source[3:].reshape(16, 20)[:, :16]
    written = target[5:].reshape(16, 19)
    np.testing.assert_array_equal(written[:, :16], rows.T)
    assert np.all(target[:5] == -1)
    assert np.all(written[:, 16:] == -1)
