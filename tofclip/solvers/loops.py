"""The inner loops of the solvers and the blocks of frames that they work on, for the arrays of each
library.

NumPy's arrays are worked on by compiled loops, in blocks of a few frames that stay in cache and are
shared between threads. Arrays of other libraries are worked on with the functions of the array API
standard, as many frames at once as fit into the memory of their device. The last axis of a block is
the frames', side by side. `select_loops` and `make_batches` are the two places where the choice is
made.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from math import prod
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from tofclip.arrays import Array, is_numpy, namespace, zeros
from tofclip.operators import LinearOperator
from tofclip.threads import LANES, run_blocks, split_blocks


class Loops(Protocol):
    """What a solver does to every pixel or measurement of a block of frames.

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

        Parameters
        ----------
        current, previous : (..., columns, frames) array
            The last two solutions.
        momentum : (frames,) array
            Weight of the extrapolation, 0 after a restart.
        gradient : (..., columns, frames) array
            Of the data term at z; may be overwritten.
        step : float
            Step size.
        threshold : float
            Step size times the prior's weight, in the unit of the solution.

        Returns
        -------
        result : (..., columns, frames) array
        total : (frames,) float64 array
        """
        ...

    def gradient_step(
        self, current: Array, previous: Array, momentum: Array, gradient: Array, step: float
    ) -> Array:
        """Return ``z - step * gradient``, z as in `prox_l1`; `gradient` may be overwritten.

        Parameters
        ----------
        current, previous : (..., columns, frames) array
            The last two solutions.
        momentum : (frames,) array
        gradient : (..., columns, frames) array
            Of the data term at z.
        step : float
            Step size.

        Returns
        -------
        (..., columns, frames) array
        """
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

        Parameters
        ----------
        noisy : (rows, columns, frames) array
        dual : (2, rows, columns, frames) array, optional
            Where the sweeps start; None is zero.
        weight : float
            Of the total variation, in the unit of the pictures.
        sweeps : int
            Projected-gradient sweeps.
        result : (rows, columns, frames) array
            Memory for the result.

        Returns
        -------
        result : (rows, columns, frames) array
        total : (frames,) float64 array
            Isotropic total variation.
        dual : (2, rows, columns, frames) array
        """
        ...

    def sum_squares(self, values: Array) -> Array:
        """Return the sum of squares of each frame of (measurements, frames) values, float64."""
        ...

    def restore_frames(self, values: Array, before: Array, rejected: Array) -> Array:
        """Return `values` with the frames that are `rejected`, (frames,) bool, as they were
        `before`.

        `values` may be overwritten.

        Parameters
        ----------
        values : (..., frames) array
        before : (..., frames) array
        rejected : (frames,) bool array

        Returns
        -------
        (..., frames) array
        """
        ...


def select_loops(array: Array) -> Loops:
    """Return the loops that work on arrays like this one."""
    return _compiled_loops() if is_numpy(array) else _portable_loops()


@cache
def _compiled_loops() -> Loops:
    return CompiledLoops()


@cache
def _portable_loops() -> Loops:
    return PortableLoops()


Sums = NDArray[np.float64]


class CompiledLoops:
    """Loops on contiguous NumPy arrays, each in one pass through memory, in place; see `Loops`."""

    def __init__(self) -> None:
        from tofclip.solvers import kernels  # numba takes half a second to import

        self._kernels = kernels

    def prox_l1(
        self,
        current: Array,
        previous: Array,
        momentum: Array,
        gradient: Array,
        step: float,
        threshold: float,
    ) -> tuple[Array, Sums]:
        """Overwrite and return `previous`.

        Parameters
        ----------
        current, previous : (..., columns, frames) array
            The last two solutions; `previous` is overwritten with the result.
        momentum : (frames,) array
        gradient : (..., columns, frames) array
            Of the data term at the extrapolated point.
        step : float
            Step size.
        threshold : float
            Step size times the prior's weight.

        Returns
        -------
        previous : (..., columns, frames) array
        total : (frames,) float64 array
            Sum of each frame's result.
        """
        number, total = current.dtype.type, np.empty(current.shape[-1])
        # Every pixel is on its own: a block of volumes is one of tall pictures.
        now, before, slope = (_flatten_rows(array) for array in (current, previous, gradient))
        self._kernels.shrink_nonnegative(
            now, before, momentum, slope, number(step), number(threshold), total
        )
        return previous, total

    def gradient_step(
        self, current: Array, previous: Array, momentum: Array, gradient: Array, step: float
    ) -> Array:
        """Overwrite and return `gradient`.

        Parameters
        ----------
        current, previous : (..., columns, frames) array
            The last two solutions.
        momentum : (frames,) array
        gradient : (..., columns, frames) array
            Overwritten with the result.
        step : float

        Returns
        -------
        (..., columns, frames) array
            `gradient`.
        """
        now, before, slope = (_flatten_rows(array) for array in (current, previous, gradient))
        self._kernels.take_gradient_step(now, before, momentum, slope, current.dtype.type(step))
        return gradient

    def prox_tv(
        self, noisy: Array, dual: Array | None, weight: float, sweeps: int, result: Array
    ) -> tuple[Array, Sums, Array]:
        """Overwrite and return `result` and `dual`.

        Parameters
        ----------
        noisy : (rows, columns, frames) array
        dual : (2, rows, columns, frames) array, optional
            Overwritten; None starts from zero.
        weight : float
            Of the total variation; 0 only clips at zero.
        sweeps : int
            Projected-gradient sweeps on the dual.
        result : (rows, columns, frames) array
            Overwritten.

        Returns
        -------
        result : (rows, columns, frames) array
        total : (frames,) float64 array
            Isotropic total variation of each frame.
        dual : (2, rows, columns, frames) array
        """
        if dual is None:
            dual = np.zeros((2, *noisy.shape), noisy.dtype)
        weight, total = noisy.dtype.type(weight), np.empty(noisy.shape[-1])
        if weight > 0:
            self._kernels.sweep_total_variation_dual(noisy, dual, weight, sweeps, result)
        self._kernels.compute_total_variation_primal(noisy, dual, weight, result, total)
        return result, total, dual

    def sum_squares(self, values: Array) -> Sums:
        """Multiply and add without a temporary."""
        total: Sums = np.einsum("if,if->f", values, values, dtype=np.float64)
        return total

    def restore_frames(self, values: Array, before: Array, rejected: NDArray[np.bool_]) -> Array:
        """Overwrite and return `values`; most often there is nothing to do.

        Parameters
        ----------
        values : (..., columns, frames) array
            Overwritten in the rejected frames.
        before : (..., columns, frames) array
        rejected : (frames,) bool array

        Returns
        -------
        (..., columns, frames) array
            `values`.
        """
        if rejected.any():
            self._kernels.restore_frames(
                _flatten_rows(values), _flatten_rows(before), rejected.astype(values.dtype)
            )
        return values


def _flatten_rows(array: Array) -> Array:
    """The same memory as (rows, columns, frames)."""
    return array.reshape(-1, *array.shape[-2:])


class PortableLoops:
    """Loops on arrays of any library, each a few passes through memory, for many frames at once;
    see `Loops`.
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
        """Leave all arrays but `gradient` as they are.

        Parameters
        ----------
        current, previous : (..., columns, frames) array
            The last two solutions.
        momentum : (frames,) array
        gradient : (..., columns, frames) array
            Overwritten.
        step : float
        threshold : float
            Step size times the prior's weight.

        Returns
        -------
        result : (..., columns, frames) array
        total : (frames,) float64 array
        """
        xp = namespace(current)
        noisy = self.gradient_step(current, previous, momentum, gradient, step)
        noisy -= threshold
        result = xp.clip(noisy, min=0.0)
        pixels = tuple(range(result.ndim - 1))
        return result, xp.sum(result, axis=pixels, dtype=xp.float64)

    def gradient_step(
        self, current: Array, previous: Array, momentum: Array, gradient: Array, step: float
    ) -> Array:
        """Leave all arrays but `gradient` as they are.

        Parameters
        ----------
        current, previous : (..., columns, frames) array
            The last two solutions.
        momentum : (frames,) array
        gradient : (..., columns, frames) array
            Overwritten with the result.
        step : float

        Returns
        -------
        (..., columns, frames) array
            `gradient`.
        """
        gradient *= -step
        gradient += current
        gradient += momentum * (current - previous)
        return gradient

    def prox_tv(
        self, noisy: Array, dual: Array | None, weight: float, sweeps: int, result: Array
    ) -> tuple[Array, Array, Array]:
        """Leave all arrays as they are.

        Parameters
        ----------
        noisy : (rows, columns, frames) array
        dual : (2, rows, columns, frames) array, optional
        weight : float
        sweeps : int
        result : (rows, columns, frames) array
            Not used: array libraries make their own memory.

        Returns
        -------
        result : (rows, columns, frames) array
        total : (frames,) float64 array
        dual : (2, rows, columns, frames) array
        """
        xp = namespace(noisy)
        if dual is None:
            dual = zeros((2, *noisy.shape), noisy)
        if weight > 0:
            for _ in range(sweeps):
                # step 1 / 8: the squared norm of the gradient is at most 8 (Chambolle 2004)
                dual = _project_to_unit_ball(
                    dual + _forward_differences(_primal_block(noisy, dual, weight)) / (8 * weight)
                )
        result = _primal_block(noisy, dual, weight)
        length = xp.sqrt(xp.sum(_forward_differences(result) ** 2, axis=0))
        return result, xp.sum(length, axis=(0, 1), dtype=xp.float64), dual

    def sum_squares(self, values: Array) -> Array:
        """Square and add."""
        xp = namespace(values)
        return xp.sum(values * values, axis=0, dtype=xp.float64)

    def restore_frames(self, values: Array, before: Array, rejected: Array) -> Array:
        """Choose frame by frame, without asking the device whether there is anything to do.

        Parameters
        ----------
        values : (..., frames) array
        before : (..., frames) array
        rejected : (frames,) bool array

        Returns
        -------
        (..., frames) array
        """
        return namespace(values).where(rejected, before, values)


def _primal_block(noisy: Array, dual: Array, weight: float) -> Array:
    """Return ``max(noisy + weight * div(dual), 0)``.

    The last row of the vertical and the last column of the horizontal dual are always zero (the
    difference across the border is), and take the place of what comes before the first.
    """
    xp = namespace(noisy)
    down, across = dual[0, ...], dual[1, ...]
    divergence = down - xp.roll(down, 1, axis=0)
    divergence += across
    divergence -= xp.roll(across, 1, axis=1)
    divergence *= weight
    divergence += noisy
    return xp.clip(divergence, min=0.0)


def _forward_differences(picture: Array) -> Array:
    """Return the differences to the next row and column, (2, rows, columns, frames); 0 across the
    border.
    """
    xp = namespace(picture)
    below = xp.concat([picture[1:, ...], picture[-1:, ...]], axis=0)
    right = xp.concat([picture[:, 1:, ...], picture[:, -1:, ...]], axis=1)
    return xp.stack([below, right]) - picture


def _project_to_unit_ball(dual: Array) -> Array:
    """Return `dual` projected onto vectors of length at most 1."""
    xp = namespace(dual)
    length = xp.sqrt(xp.sum(dual * dual, axis=0))
    return dual / xp.clip(length, min=1.0)


WORKING_BYTES = 1 << 31
"""What a solver may take for the frames it works on at once, besides measurements and result."""

WORKING_PICTURES = 16
"""Arrays of the frames' size that total variation, which needs most, has at once: solution, dual,
temporaries.
"""


class Batches(Protocol):
    """A batch of measurements, its results, and how they are cut up.

    Attributes
    ----------
    frames : (frames, rows, columns) array
        The results; where nothing was written yet, anything.
    """

    frames: Array

    def zero_measurements(self) -> Array:
        """Return measurements of zero, as few frames as a block may have."""
        ...

    def take_block(self, values: Array, piece: slice) -> Array:
        """Return the columns `piece` of (measurements, frames) values, perhaps with empty ones
        after them.

        Parameters
        ----------
        values : (measurements, frames) array
            Of the whole batch, or the mask that belongs to it.
        piece : slice
            Frames of the block.

        Returns
        -------
        (measurements, frames of the block) array
            May have more columns than the piece, zeros after the last frame.
        """
        ...

    def write_block(self, block: Array, piece: slice) -> None:
        """Put a (rows, columns, frames of the block) block where its frames belong.

        Parameters
        ----------
        block : (rows, columns, frames of the block) array
            Columns beyond the piece are left out.
        piece : slice
            Frames of `frames` that are overwritten.
        """
        ...

    def for_each_piece(self, work: Callable[[slice], None]) -> None:
        """Call `work` on every piece of the batch; the first exception is raised."""
        ...


def make_batches(operator: LinearOperator, measurements: Array) -> Batches:
    """Return how the columns of (measurements, frames) values are cut up for recovery with
    `operator`.

    Parameters
    ----------
    operator : LinearOperator
        Pictures (rows, columns) to measurements (measurements,); gives the shape and dtype of the
        results.
    measurements : (measurements, frames) array
        Their library decides: compiled loops for NumPy, whole batches for others.

    Returns
    -------
    Batches
    """
    return (
        CompiledBatches(operator, measurements)
        if is_numpy(measurements)
        else PortableBatches(operator, measurements)
    )


def frames_per_block(operator: LinearOperator, measurements: Array) -> int:
    """Return how many frames a block has at most.

    Parameters
    ----------
    operator : LinearOperator
        Its ``shape_in`` and dtype give the memory of one frame.
    measurements : (measurements, frames) array
        Only their library counts.

    Returns
    -------
    int
        `LANES` for NumPy arrays; for others as many frames as `WORKING_BYTES` hold, at least one.
    """
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
        """Copy, with zeros after the last frame; a lone frame stays alone.

        Parameters
        ----------
        values : (measurements, frames) array
        piece : slice
            At most `LANES` frames.

        Returns
        -------
        (measurements, LANES) array
            A copy; (measurements, 1) where the batch has a single frame.
        """
        return pad_block(values, piece)

    def write_block(self, block: NDArray[Any], piece: slice) -> None:
        """Copy the block's frames without the zeros that fill it up.

        Parameters
        ----------
        block : (rows, columns, LANES) array
        piece : slice
        """
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
        """Choose the columns.

        Parameters
        ----------
        values : (measurements, frames) array
        piece : slice

        Returns
        -------
        (measurements, frames of the piece) array
            A view.
        """
        return values[:, piece]

    def write_block(self, block: Array, piece: slice) -> None:
        """Copy with the frames as first axis.

        Parameters
        ----------
        block : (rows, columns, frames of the piece) array
        piece : slice
        """
        self.frames[piece, ...] = namespace(block).moveaxis(block, -1, 0)

    def for_each_piece(self, work: Callable[[slice], None]) -> None:
        """Work on one piece after the other."""
        for piece in split_blocks(self.frames.shape[0], self._size):
            work(piece)


def pad_block(values: NDArray[Any], piece: slice) -> NDArray[Any]:
    """Copy the columns `piece` into a block of exactly `LANES` columns, zero beyond them; a lone
    frame stays alone.

    Parameters
    ----------
    values : (measurements, frames) array
    piece : slice
        At most `LANES` frames.

    Returns
    -------
    (measurements, LANES) array
        Of the same dtype; (measurements, 1) where there is a single frame.
    """
    # always the same width: the compiled loops unroll it, and results do not depend on how many
    # frames share a block
    block = np.zeros((values.shape[0], LANES if values.shape[1] > 1 else 1), values.dtype)
    block[:, : piece.stop - piece.start] = values[:, piece]
    return block


def write_frames(block: NDArray[Any], frames: NDArray[Any], piece: slice) -> None:
    """Put a (rows, columns, lanes) block where its frames belong.

    Parameters
    ----------
    block : (rows, columns, lanes) array
        Contiguous.
    frames : (frames, rows, columns) array
        Overwritten in `piece`.
    piece : slice
        Lanes beyond it are left out.
    """
    from tofclip.solvers.kernels import copy_lanes_to_frames

    target = frames[piece].reshape(piece.stop - piece.start, -1)
    copy_lanes_to_frames(block.reshape(-1, block.shape[-1]), target)
