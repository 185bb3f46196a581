"""What every way to turn readings into pictures has in common.

A method holds its settings and has one `recover`. It takes NumPy arrays; those that are `portable`
take the arrays of any library that follows the array API standard as well, and answer in kind, on
the same device. Memory beyond the result is bounded: see `tofclip.solvers.batches`.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from tofclip.arrays import Array as Array
from tofclip.arrays import as_type, namespace
from tofclip.errors import InputError, ShapeError
from tofclip.operators import LinearOperator
from tofclip.solvers.batches import frames_per_block
from tofclip.solvers.iteration import Progress, Result, ignore_progress
from tofclip.threads import split_blocks

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
        self,
        operator: LinearOperator,
        measurements: Array,
        valid: Mask = None,
        progress: Progress = ignore_progress,
    ) -> Result:
        """Recover one picture per column of `measurements`.

        Parameters
        ----------
        operator : LinearOperator
            Pictures (rows, columns) to readings (readings,).
        measurements : (readings, frames) array
        valid : (readings, frames) bool array, optional
            False where a reading must not be trusted.
        progress : callable
            Called with the number of frame iterations just done.
        """
        ...

    def work(self, frames: int) -> int:
        """Return how many frame iterations `recover` reports at most."""
        ...


def relative_residual(
    operator: LinearOperator, frames: Array, measurements: Array, valid: Mask = None
) -> float:
    """``|A h - f| / |f|`` over all good readings of all frames.

    Parameters
    ----------
    operator : LinearOperator
    frames : (frames, rows, columns) array
    measurements : (readings, frames) array
    valid : (readings, frames) bool array, optional
    """
    misfit = energy = 0.0
    xp = namespace(frames, measurements)
    for piece in split_blocks(frames.shape[0], frames_per_block(operator, measurements)):
        block = xp.moveaxis(frames[piece, ...], 0, -1)
        mask = 1.0 if valid is None else xp.astype(valid[:, piece], measurements.dtype)
        misfit += float(
            xp.sum(((operator(block) - measurements[:, piece]) * mask) ** 2, dtype=xp.float64)
        )
        energy += float(xp.sum((measurements[:, piece] * mask) ** 2, dtype=xp.float64))
    if energy == 0:
        raise InputError("every good reading is zero; there is nothing to compare with")
    return float(np.sqrt(misfit / energy))


def validate_measurements(operator: LinearOperator, measurements: Array, valid: Mask) -> Array:
    """Return `measurements` contiguous and in the operator's type, refusing wrong shapes, NaN and
    infinity.
    """
    xp = namespace(measurements) if valid is None else namespace(measurements, valid)
    if measurements.ndim != 2 or measurements.shape[:1] != operator.shape_out:
        raise ShapeError(
            "readings", f"({operator.shape_out[0]}, frames)", tuple(measurements.shape)
        )
    if valid is not None and valid.shape != measurements.shape:
        raise ShapeError("the mask of good readings", tuple(measurements.shape), tuple(valid.shape))
    if not xp.all(xp.isfinite(measurements)):
        raise InputError("readings must not hold NaN or infinity; mark bad ones in `valid`")
    return as_type(measurements, operator.dtype)
