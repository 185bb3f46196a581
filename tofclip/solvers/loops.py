"""The inner loops of the solvers, for the arrays of each library: compiled ones for NumPy's,
portable ones for others.

The last axis is the frames', side by side. `select_loops` is the one place where the choice is
made.
"""

from __future__ import annotations

from functools import cache
from typing import Protocol

from tofclip.arrays import Array, is_numpy


class Loops(Protocol):
    """What a solver does to every pixel or reading of a block of frames.

    Nothing waits for a device: what is returned may still be on its way.
    """

    def prox_l1(
        self,
        current: Array,
        previous: Array,
        momentum: Array,
        gradient: Array,
        step: float,
        threshold: float,
    ) -> tuple[Array, Array]:
        """Return ``max(z - step * gradient - threshold, 0)`` and its sum for each frame, float64.

        ``z = current + momentum * (current - previous)``. `previous` may be overwritten.
        """
        ...

    def gradient_step(
        self, current: Array, previous: Array, momentum: Array, gradient: Array, step: float
    ) -> Array:
        """Return ``z - step * gradient``, z as in `prox_l1`; `gradient` may be overwritten."""
        ...

    def prox_tv(
        self, noisy: Array, dual: Array | None, weight: float, sweeps: int, result: Array
    ) -> tuple[Array, Array, Array]:
        """Return the picture nearest to `noisy` in total variation, its variation for each frame,
        and its dual.

        Projected-gradient sweeps on the dual of ``1/2 |x - noisy|^2 + weight * TV(x), x >= 0`` (A.
        Chambolle, J. Math. Imaging Vis. 20, 89 (2004)), from `dual` on, (2, rows, columns, frames),
        or from zero. Frames are (rows, columns, frames); `dual` and `result`, which is like them,
        may be overwritten.
        """
        ...

    def sum_squares(self, values: Array) -> Array:
        """Return the sum of squares of each frame of (readings, frames) values, float64."""
        ...

    def restore_frames(self, values: Array, before: Array, rejected: Array) -> Array:
        """Return `values` with the frames that are `rejected`, (frames,) bool, as they were
        `before`.

        `values` may be overwritten.
        """
        ...


def select_loops(array: Array) -> Loops:
    """Return the loops that work on arrays like this one."""
    return _compiled_loops() if is_numpy(array) else _portable_loops()


@cache
def _compiled_loops() -> Loops:
    from tofclip.solvers.compiled import CompiledLoops

    return CompiledLoops()


@cache
def _portable_loops() -> Loops:
    from tofclip.solvers.portable import PortableLoops

    return PortableLoops()
