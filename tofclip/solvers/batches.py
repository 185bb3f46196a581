"""How the frames of a batch are cut up and put together again, for the arrays of each library.

On this processor blocks of a few frames stay in cache and are shared between threads. A graphics
processor is kept busy by as many frames at once as fit into its memory. `make_batches` is the one
place where the choice is made.
"""

from __future__ import annotations

from collections.abc import Callable
from math import prod
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from tofclip.arrays import Array, is_numpy, namespace, zeros
from tofclip.operators import LinearOperator
from tofclip.threads import LANES, run_blocks, split_blocks

WORKING_BYTES = 1 << 31
"""What a solver may take for the frames it works on at once, besides readings and result."""

WORKING_PICTURES = 16
"""Arrays of the frames' size that total variation, which needs most, has at once: solution, dual,
temporaries.
"""


class Batches(Protocol):
    """A batch of readings, its results, and how they are cut up.

    Attributes
    ----------
    frames : (frames, rows, columns) array
        The results; where nothing was written yet, anything.
    """

    frames: Array

    def zero_measurements(self) -> Array:
        """Return readings of zero, as few frames as a block may have."""
        ...

    def take_block(self, values: Array, piece: slice) -> Array:
        """Return the columns `piece` of (readings, frames) values, perhaps with empty ones after
        them.
        """
        ...

    def write_block(self, block: Array, piece: slice) -> None:
        """Put a (rows, columns, frames of the block) block where its frames belong."""
        ...

    def for_each_piece(self, work: Callable[[slice], None]) -> None:
        """Call `work` on every piece of the batch; the first exception is raised."""
        ...


def make_batches(operator: LinearOperator, measurements: Array) -> Batches:
    """Return how (readings, frames) readings are cut up for recovery with `operator`."""
    return (
        CompiledBatches(operator, measurements)
        if is_numpy(measurements)
        else PortableBatches(operator, measurements)
    )


def frames_per_block(operator: LinearOperator, measurements: Array) -> int:
    """Return how many frames a block has at most."""
    if is_numpy(measurements):
        return LANES
    return max(
        1, WORKING_BYTES // (WORKING_PICTURES * prod(operator.shape_in) * operator.dtype.itemsize)
    )


class CompiledBatches:
    """Blocks of exactly `LANES` frames for compiled loops, on `tofclip.threads.thread_count`
    threads; see `Batches`.

    Memory beyond the result is bounded by a few blocks a thread.
    """

    def __init__(self, operator: LinearOperator, measurements: NDArray[Any]) -> None:
        self._measurements = measurements
        self.frames = np.empty((measurements.shape[1], *operator.shape_in), operator.dtype)

    def zero_measurements(self) -> NDArray[Any]:
        """Return a block like all others."""
        return self.take_block(self._measurements, slice(0, 0))

    def take_block(self, values: NDArray[Any], piece: slice) -> NDArray[Any]:
        """Copy, with zeros after the last frame; a lone frame stays alone."""
        return pad_block(values, piece)

    def write_block(self, block: NDArray[Any], piece: slice) -> None:
        """Copy what is no filling."""
        write_frames(block, self.frames, piece)

    def for_each_piece(self, work: Callable[[slice], None]) -> None:
        """Share the pieces between threads."""
        run_blocks(work, len(self.frames))


class PortableBatches:
    """As many frames at once as `WORKING_BYTES` allow, one piece after the other; see `Batches`."""

    def __init__(self, operator: LinearOperator, measurements: Array) -> None:
        self._measurements, self._size = measurements, frames_per_block(operator, measurements)
        self.frames = zeros((measurements.shape[1], *operator.shape_in), measurements)

    def zero_measurements(self) -> Array:
        """Return a lone frame."""
        return zeros((self._measurements.shape[0], 1), self._measurements)

    def take_block(self, values: Array, piece: slice) -> Array:
        """Choose the columns."""
        return values[:, piece]

    def write_block(self, block: Array, piece: slice) -> None:
        """Copy with the frames as first axis."""
        self.frames[piece, ...] = namespace(block).moveaxis(block, -1, 0)

    def for_each_piece(self, work: Callable[[slice], None]) -> None:
        """Work on one piece after the other."""
        for piece in split_blocks(self.frames.shape[0], self._size):
            work(piece)


def pad_block(values: NDArray[Any], piece: slice) -> NDArray[Any]:
    """Copy the columns `piece` into a block of exactly `LANES` columns, zero beyond them; a lone
    frame stays alone.
    """
    block = np.zeros((values.shape[0], LANES if values.shape[1] > 1 else 1), values.dtype)
    block[:, : piece.stop - piece.start] = values[:, piece]
    return block


def write_frames(block: NDArray[Any], frames: NDArray[Any], piece: slice) -> None:
    """Put a (rows, columns, lanes) block where its frames belong."""
    from tofclip.solvers.kernels import copy_lanes_to_frames

    target = frames[piece].reshape(piece.stop - piece.start, -1)
    copy_lanes_to_frames(block.reshape(-1, block.shape[-1]), target)
