"""Entries of arrays looked up by arrays of numbers, as the array API standard allows it."""

from __future__ import annotations

from tofclip.arrays import Array, namespace, native_device


def gather_entries(table: Array, numbers: Array) -> Array:
    """Return ``table[numbers]`` for a one-dimensional table and numbers of any shape.

    Parameters
    ----------
    table : (n,) array
    numbers : int array
        Any shape.

    Returns
    -------
    array
        Of the numbers' shape.
    """
    xp = namespace(table, numbers)
    return xp.reshape(xp.take(table, xp.reshape(numbers, (-1,)), axis=0), numbers.shape)


def gather_rows(columns: Array, rows: Array) -> Array:
    """Return ``columns[rows[i, n], n]``; `rows` is (i, n), or (n,) for one entry of each column.

    Parameters
    ----------
    columns : (rows, n) array
    rows : (i, n) or (n,) int array

    Returns
    -------
    array
        Of the shape of `rows`.
    """
    xp = namespace(columns, rows)
    if rows.ndim == 1:
        return xp.take_along_axis(columns, rows[None, :], axis=0)[0, ...]
    return xp.take_along_axis(columns, rows, axis=0)


def build_index_window(first: Array, width: int, last: Array, end: int) -> tuple[Array, Array]:
    """Return the numbers from `first` on, (width, n), none beyond ``end - 1``, and which of them
    are below `last`.

    Parameters
    ----------
    first : (n,) int array
    width : int
    last : (n,) int array
    end : int

    Returns
    -------
    numbers : (width, n) int array
    inside : (width, n) bool array
    """
    xp = namespace(first, last)
    numbers = first + xp.arange(width, dtype=first.dtype, device=native_device(first))[:, None]
    return xp.clip(numbers, max=end - 1), numbers < last
