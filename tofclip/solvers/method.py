"""What every way to turn readings into pictures has in common.

A method holds its settings and has one `recover`. It takes NumPy arrays; those that are `portable` take the arrays of
any library that follows the array API standard as well, and answer in kind, on the same device. Memory beyond the
result is bounded: see `tofclip.solvers.batches`.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from tofclip.arrays import Array as Array
from tofclip.arrays import as_type, namespace
from tofclip.errors import InputError, ShapeError
from tofclip.operators import LinearOperator
from tofclip.solvers.batches import frames_at_once
from tofclip.solvers.loop import Progress, Result, silent
from tofclip.threads import blocks

Mask = Array | None


class Method(Protocol):
    """Anything that recovers pictures from readings.

    Attributes
    ----------
    name : str
    portable : bool
        Whether arrays of any library are taken, or NumPy's only.
    """

    name: str
    portable: bool

    def recover(
        self, operator: LinearOperator, readings: Array, good: Mask = None, progress: Progress = silent
    ) -> Result:
        """Recover one picture per column of `readings`.

        Parameters
        ----------
        operator : LinearOperator
            Pictures (rows, columns) to readings (readings,).
        readings : (readings, frames) array
        good : (readings, frames) bool array, optional
            False where a reading must not be trusted.
        progress : callable
            Called with the number of frame iterations just done.
        """
        ...

    def work(self, frames: int) -> int:
        """Return how many frame iterations `recover` reports at most."""
        ...


def relative_residual(operator: LinearOperator, frames: Array, readings: Array, good: Mask = None) -> float:
    """``|A h - f| / |f|`` over all good readings of all frames.

    Parameters
    ----------
    operator : LinearOperator
    frames : (frames, rows, columns) array
    readings : (readings, frames) array
    good : (readings, frames) bool array, optional
    """
    misfit = energy = 0.0
    xp = namespace(frames, readings)
    for piece in blocks(frames.shape[0], frames_at_once(operator, readings)):
        block = xp.moveaxis(frames[piece, ...], 0, -1)
        mask = 1.0 if good is None else xp.astype(good[:, piece], readings.dtype)
        misfit += float(xp.sum(((operator(block) - readings[:, piece]) * mask) ** 2, dtype=xp.float64))
        energy += float(xp.sum((readings[:, piece] * mask) ** 2, dtype=xp.float64))
    if energy == 0:
        raise InputError("every good reading is zero; there is nothing to compare with")
    return float(np.sqrt(misfit / energy))


def checked_readings(operator: LinearOperator, readings: Array, good: Mask) -> Array:
    """Return `readings` contiguous and in the operator's type, refusing wrong shapes, NaN and infinity."""
    xp = namespace(readings) if good is None else namespace(readings, good)
    if readings.ndim != 2 or readings.shape[:1] != operator.shape_out:
        raise ShapeError("readings", f"({operator.shape_out[0]}, frames)", tuple(readings.shape))
    if good is not None and good.shape != readings.shape:
        raise ShapeError("the mask of good readings", tuple(readings.shape), tuple(good.shape))
    if not xp.all(xp.isfinite(readings)):
        raise InputError("readings must not hold NaN or infinity; mark bad ones in `good`")
    return as_type(readings, operator.dtype)
