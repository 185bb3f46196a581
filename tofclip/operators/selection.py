"""Some views of a light field."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import DTypeLike

from tofclip.errors import InputError
from tofclip.operators.base import Array, LinearOperator


class ViewSelection(LinearOperator):
    """Keeps some of a light field's views; the adjoint leaves the others dark.

    Parameters
    ----------
    light_field_shape : (int, int, int)
        Views, rows, columns.
    kept : sequence of int
        Numbers of the views to keep, without repeats.
    dtype : dtype
        float32 or float64.
    """

    def __init__(
        self,
        light_field_shape: tuple[int, int, int],
        kept: Sequence[int],
        dtype: DTypeLike = np.float32,
    ) -> None:
        self.view_indices = np.asarray(kept, np.intp)
        if np.unique(self.view_indices).size != self.view_indices.size or not np.all(
            (self.view_indices >= 0) & (self.view_indices < light_field_shape[0])
        ):
            raise InputError(
                f"views to keep must be different numbers from 0 to {light_field_shape[0] - 1}"
            )
        super().__init__(light_field_shape, (self.view_indices.size, *light_field_shape[1:]), dtype)

    def _forward(self, block: Array) -> Array:
        kept: Array = block[self.view_indices]
        return kept

    def _adjoint(self, block: Array) -> Array:
        views = np.zeros((*self.shape_in, block.shape[-1]), self.dtype)
        views[self.view_indices] = block
        return views
