"""Regularisers with their proximal gradient steps."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from tofclip.arrays import Array as Array
from tofclip.errors import InputError
from tofclip.solvers.loops import select_loops


class Regulariser(Protocol):
    """A penalty R(h) whose proximal map is known, on a block of (rows, columns, lanes) pictures."""

    def proximal_step(
        self, current: Array, previous: Array, momentum: Array, gradient: Array, step: float
    ) -> tuple[Array, Array]:
        """Return ``prox_{step R}(z - step * gradient)``, a proximal gradient step, and R of it for
        each frame, float64.

        ``z = current + momentum * (current - previous)`` is the extrapolated point and `gradient`
        belongs to it. `previous` and `gradient` may be overwritten; the result may lie in their
        memory.
        """
        ...


class NonnegativeSparsity:
    """``weight * sum(h)`` for h >= 0, infinite otherwise: the l1 norm of a nonnegative picture.

    Parameters
    ----------
    weight : float
        In the unit of ``A'f``.
    """

    def __init__(self, weight: float) -> None:
        self.weight = validate_weight(weight)

    def proximal_step(
        self, current: Array, previous: Array, momentum: Array, gradient: Array, step: float
    ) -> tuple[Array, Array]:
        loops = select_loops(current)
        picture, total = loops.prox_l1(
            current, previous, momentum, gradient, step, step * self.weight
        )
        return picture, self.weight * total


class NonnegativeTotalVariation:
    """``weight * TV(h)`` for h >= 0, infinite otherwise; TV is the isotropic total variation of
    each frame.

    The proximal map has no closed form. Its dual is kept from one call to the next (warm start), so
    that even a single sweep a call follows the solver's own convergence. One instance therefore
    belongs to one block.

    Parameters
    ----------
    weight : float
        In the unit of ``A'f``.
    sweeps : int
        Dual sweeps in a call. On the clip scene's shot one sweep ends 1.4 % above the objective of
        ten after 60 iterations and 0.4 % after 200; the time of further sweeps is better spent on
        further iterations.
    """

    def __init__(self, weight: float, sweeps: int = 1) -> None:
        self.weight = validate_weight(weight)
        self.sweeps = sweeps
        self._dual: Array | None = None

    def proximal_step(
        self, current: Array, previous: Array, momentum: Array, gradient: Array, step: float
    ) -> tuple[Array, Array]:
        loops = select_loops(current)
        noisy = loops.gradient_step(current, previous, momentum, gradient, step)
        picture, total, self._dual = loops.prox_tv(
            noisy, self._dual, step * self.weight, self.sweeps, previous
        )
        return picture, self.weight * total


def validate_weight(weight: float) -> float:
    """Return a regularisation weight, refusing what is none."""
    if not (np.isfinite(weight) and weight >= 0):
        raise InputError(f"a regularisation weight must be finite and not negative, got {weight}")
    return float(weight)
