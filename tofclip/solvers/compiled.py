"""The solvers' inner loops on NumPy arrays: what `tofclip.solvers.kernels` does, as `Loops`."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofclip.solvers import kernels

Array = NDArray[Any]
Sums = NDArray[np.float64]


class CompiledLoops:
    """Loops on contiguous NumPy arrays, each in one pass through memory, in place; see `Loops`."""

    def prox_l1(
        self,
        current: Array,
        previous: Array,
        momentum: Array,
        gradient: Array,
        step: float,
        threshold: float,
    ) -> tuple[Array, Sums]:
        """Overwrite and return `previous`."""
        number, total = current.dtype.type, np.empty(current.shape[-1])
        # Every pixel is on its own: a block of volumes is one of tall pictures.
        now, before, slope = (_flatten_rows(array) for array in (current, previous, gradient))
        kernels.shrink_nonnegative(
            now, before, momentum, slope, number(step), number(threshold), total
        )
        return previous, total

    def gradient_step(
        self, current: Array, previous: Array, momentum: Array, gradient: Array, step: float
    ) -> Array:
        """Overwrite and return `gradient`."""
        now, before, slope = (_flatten_rows(array) for array in (current, previous, gradient))
        kernels.take_gradient_step(now, before, momentum, slope, current.dtype.type(step))
        return gradient

    def prox_tv(
        self, noisy: Array, dual: Array | None, weight: float, sweeps: int, result: Array
    ) -> tuple[Array, Sums, Array]:
        """Overwrite and return `result` and `dual`."""
        if dual is None:
            dual = np.zeros((2, *noisy.shape), noisy.dtype)
        weight, total = noisy.dtype.type(weight), np.empty(noisy.shape[-1])
        if weight > 0:
            kernels.sweep_total_variation_dual(noisy, dual, weight, sweeps, result)
        kernels.compute_total_variation_primal(noisy, dual, weight, result, total)
        return result, total, dual

    def sum_squares(self, values: Array) -> Sums:
        """Multiply and add without a temporary."""
        total: Sums = np.einsum("if,if->f", values, values, dtype=np.float64)
        return total

    def restore_frames(self, values: Array, before: Array, rejected: NDArray[np.bool_]) -> Array:
        """Overwrite and return `values`; most often there is nothing to do."""
        if rejected.any():
            kernels.restore_frames(
                _flatten_rows(values), _flatten_rows(before), rejected.astype(values.dtype)
            )
        return values


def _flatten_rows(array: Array) -> Array:
    """The same memory as (rows, columns, frames)."""
    return array.reshape(-1, *array.shape[-2:])
