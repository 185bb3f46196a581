"""What every way to turn readings into pictures has in common.

A method holds its settings and has one `recover`. All of them cut the frames into blocks that stay in cache and share
the blocks between threads; memory beyond the result is bounded by a few blocks a thread.
"""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from tofclip.errors import InputError, ShapeError
from tofclip.operators import LinearOperator
from tofclip.recovery.loop import Progress, Result, silent
from tofclip.threads import LANES, blocks

Array = NDArray[Any]
Mask = NDArray[np.bool_] | None


class Method(Protocol):
    """Anything that recovers pictures from readings."""

    name: str

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
    for piece in blocks(frames.shape[0]):
        block = np.moveaxis(frames[piece], 0, -1)
        mask = 1.0 if good is None else good[:, piece]
        misfit += float(np.sum(((operator(block) - readings[:, piece]) * mask) ** 2, dtype=np.float64))
        energy += float(np.sum((readings[:, piece] * mask) ** 2, dtype=np.float64))
    if energy == 0:
        raise InputError("every good reading is zero; there is nothing to compare with")
    return float(np.sqrt(misfit / energy))


def checked_readings(operator: LinearOperator, readings: Array, good: Mask) -> Array:
    """Return `readings` contiguous and in the operator's type, refusing wrong shapes, NaN and infinity."""
    if readings.ndim != 2 or readings.shape[:1] != operator.shape_out:
        raise ShapeError("readings", f"({operator.shape_out[0]}, frames)", readings.shape)
    if good is not None and good.shape != readings.shape:
        raise ShapeError("the mask of good readings", readings.shape, good.shape)
    if not np.all(np.isfinite(readings)):
        raise InputError("readings must not hold NaN or infinity; mark bad ones in `good`")
    return np.ascontiguousarray(readings, dtype=operator.dtype)


def full_block(values: Array, piece: slice) -> Array:
    """Copy the columns `piece` into a block of exactly `LANES` columns, zero beyond them; a lone frame stays alone."""
    block = np.zeros((values.shape[0], LANES if values.shape[1] > 1 else 1), values.dtype)
    block[:, : piece.stop - piece.start] = values[:, piece]
    return block


def write_frames(block: Array, frames: Array, piece: slice) -> None:
    """Put a (rows, columns, lanes) block where its frames belong."""
    from tofclip.recovery.kernels import lanes_to_frames

    target = frames[piece].reshape(piece.stop - piece.start, -1)
    lanes_to_frames(block.reshape(-1, block.shape[-1]), target)
