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
        step: Array,
        weight: float,
    ) -> tuple[Array, Array, Array]:
        """Return ``max(z - step * (gradient + weight), 0)``, its sum for each frame, and its squared
        distance from z.

        ``z = current + momentum * (current - previous)``. `previous` may be overwritten.

        `current, previous` (..., columns, frames): the last two solutions; `momentum` (frames,):
        weight of the extrapolation, 0 after a restart; `gradient` (..., columns, frames): of the
        data term at z; may be overwritten; `step` (frames,): step sizes, of the pictures' dtype;
        `weight`: of the prior. Returns `result` (..., columns, frames); `total, distance`
        (frames,).
        """
        ...

    def prox_tv(
        self,
        current: Array,
        previous: Array,
        momentum: Array,
        gradient: Array,
        step: Array,
        weight: float,
        dual: Array | None,
    ) -> tuple[Array, Array, Array]:
        """Return the picture nearest to ``z - step * gradient`` in total variation, its variation
        for each frame, and its dual.

        One projected-gradient sweep on the dual of ``1/2 |x - noisy|^2 + step * weight * TV(x), x >=
        0`` (A. Chambolle, J. Math. Imaging Vis. 20, 89 (2004)), from `dual` on or from zero. z is as
        in `prox_l1`; all arrays may be overwritten but `current`.

        `current, previous` (rows, columns, frames): the last two solutions; `momentum` (frames,);
        `gradient` (rows, columns, frames): of the data term at z; `step` (frames,): step sizes, of
        the pictures' dtype; `weight`: of the total variation; 0 only clips at zero; `dual` (2,
        rows, columns, frames): where the sweep starts; None is zero. Returns `result` (rows,
        columns, frames); `total` (frames,): isotropic total variation; `dual` (2, rows, columns,
        frames).
        """
        ...

    def sum_squares(self, values: Array) -> Array:
        """Return the sum of squares of each frame of (measurements, frames) values, float64."""
        ...

    def restore_frames(self, values: Array, before: Array, rejected: Array) -> Array:
        """Return `values` with the frames that are `rejected`, (frames,) bool, as they were
        `before`.

        `values` may be overwritten.

        `values` (..., frames); `before` (..., frames); `rejected` (frames,). Returns (..., frames).
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
        step: Array,
        weight: float,
    ) -> tuple[Array, Sums, Sums]:
        """Overwrite and return `previous`.

        Arguments and result are those of `Loops.prox_l1`.
        """
        stretch = max(self._kernels.STRETCH_NUMBERS // step.size, 1)
        memory = np.zeros((3, stretch * step.size), current.dtype)
        total, distance = np.zeros((2, memory.shape[1]))
        momentum, step_of_each, scaled = self._repeat(momentum, step, weight, stretch)
        self._kernels.shrink_nonnegative(
            current.reshape(-1),
            previous.reshape(-1),
            momentum,
            gradient.reshape(-1),
            step_of_each,
            scaled,
            memory,
            total,
            distance,
        )
        return previous, _sum_columns(total, step), _sum_columns(distance, step)

    def prox_tv(
        self,
        current: Array,
        previous: Array,
        momentum: Array,
        gradient: Array,
        step: Array,
        weight: float,
        dual: Array | None,
    ) -> tuple[Array, Sums, Array]:
        """Overwrite and return `previous` and `dual`; `gradient` is overwritten too.

        Arguments and result are those of `Loops.prox_tv`.
        """
        if dual is None:
            dual = np.zeros((2, *current.shape), current.dtype)
        now, before, slope = (_join_lanes(array) for array in (current, previous, gradient))
        total = np.zeros(now.shape[1], now.dtype)
        momentum, step_of_each, scaled = self._repeat(momentum, step, weight, current.shape[-2])
        # the squared norm of the gradient is at most 8 (Chambolle 2004)
        sweep = np.divide(1, 8 * scaled, out=np.zeros_like(scaled), where=scaled > 0)
        self._kernels.descend_total_variation(
            step.size,
            now,
            before,
            momentum,
            slope,
            step_of_each,
            scaled,
            dual.reshape(2, *now.shape),
            sweep,
            np.zeros((4, now.shape[1]), now.dtype),
            total,
        )
        return previous, _sum_columns(total, step), dual

    @staticmethod
    def _repeat(
        momentum: Array, step: Array, weight: float, pixels: int
    ) -> tuple[Array, Array, Array]:
        """Momentum, step and threshold that each lane has, for every one of some pixels."""
        # Numbers that a lane has for itself are repeated along the row, so that the loop over it
        # has one index and is vectorised.
        scaled = step * momentum.dtype.type(weight)
        # np.tile takes longer than the loop itself where there is a single picture
        momentum, step, scaled = (
            np.repeat(one[np.newaxis], pixels, axis=0).ravel() for one in (momentum, step, scaled)
        )
        return momentum, step, scaled

    def sum_squares(self, values: Array) -> Sums:
        """Multiply and add without a temporary."""
        total: Sums = np.einsum("if,if->f", values, values, dtype=np.float64)
        return total

    def restore_frames(self, values: Array, before: Array, rejected: NDArray[np.bool_]) -> Array:
        """Overwrite and return `values`; most often there is nothing to do.

        Arguments and result are those of `Loops.restore_frames`.
        """
        if rejected.any():
            self._kernels.restore_frames(
                _flatten_rows(values), _flatten_rows(before), rejected.astype(values.dtype)
            )
        return values


def _flatten_rows(array: Array) -> Array:
    """The same memory as (rows, columns, frames)."""
    return array.reshape(-1, *array.shape[-2:])


def _join_lanes(array: Array) -> Array:
    """The same memory as (rows, columns * frames)."""
    return array.reshape(-1, array.shape[-2] * array.shape[-1])


def _sum_columns(row: Array, step: Array) -> Sums:
    """Add up what belongs to the same lane."""
    total: Sums = row.reshape(-1, step.size).sum(axis=0, dtype=np.float64)
    return total


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
        step: Array,
        weight: float,
    ) -> tuple[Array, Array, Array]:
        """Leave all arrays but `gradient` as they are.

        Arguments and result are those of `Loops.prox_l1`.
        """
        xp = namespace(current)
        # In place as far as possible: on a GPU memory is what limits the size of a block.
        point = current + momentum * (current - previous)
        gradient += weight
        gradient *= -step
        gradient += point
        result = xp.clip(gradient, min=0.0)
        pixels = tuple(range(result.ndim - 1))
        total = xp.sum(result, axis=pixels, dtype=xp.float64)
        return result, total, _sum_squared_difference(result, point)

    def prox_tv(
        self,
        current: Array,
        previous: Array,
        momentum: Array,
        gradient: Array,
        step: Array,
        weight: float,
        dual: Array | None,
    ) -> tuple[Array, Array, Array]:
        """Leave all arrays but `gradient` as they are.

        Arguments and result are those of `Loops.prox_tv`.
        """
        xp = namespace(current)
        gradient *= -step
        gradient += current + momentum * (current - previous)
        if dual is None:
            dual = zeros((2, *current.shape), current)
        scaled = step * weight
        if weight > 0:
            # step 1 / 8: the squared norm of the gradient is at most 8 (Chambolle 2004)
            slope = _forward_differences(_primal_block(gradient, dual, scaled)) / (8 * scaled)
            dual = _project_to_unit_ball(dual + slope)
        result = _primal_block(gradient, dual, scaled)
        length = xp.sqrt(xp.sum(_forward_differences(result) ** 2, axis=0))
        total = xp.sum(length, axis=(0, 1), dtype=xp.float64)
        return result, total, dual

    def sum_squares(self, values: Array) -> Array:
        """Square and add."""
        xp = namespace(values)
        return xp.sum(values * values, axis=0, dtype=xp.float64)

    def restore_frames(self, values: Array, before: Array, rejected: Array) -> Array:
        """Choose frame by frame, without asking the device whether there is anything to do.

        Arguments and result are those of `Loops.restore_frames`.
        """
        return namespace(values).where(rejected, before, values)


def _sum_squared_difference(one: Array, other: Array) -> Array:
    """Of each frame, float64."""
    xp, difference = namespace(one), one - other
    pixels = tuple(range(one.ndim - 1))
    return xp.sum(difference * difference, axis=pixels, dtype=xp.float64)


def _primal_block(noisy: Array, dual: Array, weight: Array) -> Array:
    """Return ``max(noisy + weight * div(dual), 0)``.

    The last row of the vertical and the last column of the horizontal dual are always zero (the
    difference across the border is), and take the place of what comes before the first.
    """
    xp = namespace(noisy)
    down, across = dual[0, ...], dual[1, ...]
    # What roll brings round from the far border is zero there, as the last difference is.
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
    # The border is repeated, so that the difference across it is zero.
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
    """A batch of measurements, its results, and how they are cut up."""

    frames: Array  # (frames, rows, columns), the results; where nothing was written yet, anything

    def zero_measurements(self) -> Array:
        """Return measurements of zero, as few frames as a block may have."""
        ...

    def take_block(self, values: Array, piece: slice) -> Array:
        """Return the columns `piece` of (measurements, frames) values, perhaps with empty ones
        after them.

        `values` (measurements, frames): of the whole batch, or the mask that belongs to it;
        `piece`: frames of the block. Returns (measurements, frames of the block): may have more
        columns than the piece, zeros after the last frame.
        """
        ...

    def write_block(self, block: Array, piece: slice) -> None:
        """Put a (rows, columns, frames of the block) block where its frames belong.

        `block` (rows, columns, frames of the block): columns beyond the piece are left out;
        `piece`: frames of `frames` that are overwritten.
        """
        ...

    def leave_out(self, dark: NDArray[np.bool_]) -> None:
        """Make zero the frames that are dark; pieces count the others only.

        `dark` (frames,).
        """
        ...

    def for_each_piece(self, work: Callable[[slice], None]) -> None:
        """Call `work` on every piece of the batch; the first exception is raised."""
        ...


def make_batches(operator: LinearOperator, measurements: Array) -> Batches:
    """Return how the columns of (measurements, frames) values are cut up for recovery with
    `operator`.

    `operator`: pictures (rows, columns) to measurements (measurements,); gives the shape and dtype
    of the results; `measurements` (measurements, frames): their library decides: compiled loops for
    NumPy, whole batches for others.
    """
    return (
        CompiledBatches(operator, measurements)
        if is_numpy(measurements)
        else PortableBatches(operator, measurements)
    )


def frames_per_block(operator: LinearOperator, measurements: Array) -> int:
    """Return how many frames a block has at most.

    `operator`: its ``shape_in`` and dtype give the memory of one frame; `measurements`
    (measurements, frames): only their library counts. Returns `LANES` for NumPy arrays; for others
    as many frames as `WORKING_BYTES` hold, at least one.
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
        self._order = np.arange(measurements.shape[1])

    def zero_measurements(self) -> NDArray[Any]:
        """Return a block like all others."""
        return self.take_block(self._measurements, slice(0, 0))

    def take_block(self, values: NDArray[Any], piece: slice) -> NDArray[Any]:
        """Copy, with zeros after the last frame; a lone frame stays alone.

        Arguments and result are those of `Batches.take_block`.
        """
        return pad_block(values, self._order[piece])

    def write_block(self, block: NDArray[Any], piece: slice) -> None:
        """Copy the block's frames without the zeros that fill it up.

        Arguments and result are those of `Batches.write_block`.
        """
        chosen = self._order[piece]
        # A run of frames is written in place; scattered ones go by a copy.
        if chosen[-1] - chosen[0] == chosen.size - 1:
            write_frames(block, self.frames, slice(chosen[0], chosen[-1] + 1))
        else:
            together = np.empty((chosen.size, *self.frames.shape[1:]), self.frames.dtype)
            write_frames(block, together, slice(0, chosen.size))
            self.frames[chosen] = together

    def leave_out(self, dark: NDArray[np.bool_]) -> None:
        """Make zero what is dark, and pieces of the other frames only.

        Arguments and result are those of `Batches.leave_out`.
        """
        self.frames[dark] = 0
        self._order = np.flatnonzero(~dark)

    def for_each_piece(self, work: Callable[[slice], None]) -> None:
        """Share the pieces between threads."""
        run_blocks(work, self._order.size)


class PortableBatches:
    """As many frames at once as `WORKING_BYTES` allow, one piece after the other; see `Batches`."""

    def __init__(self, operator: LinearOperator, measurements: Array) -> None:
        self._measurements, self._size = measurements, frames_per_block(operator, measurements)
        self.frames = zeros((measurements.shape[1], *operator.shape_in), measurements)
        self._order = np.arange(measurements.shape[1])

    def zero_measurements(self) -> Array:
        """Return a lone frame."""
        return zeros((self._measurements.shape[0], 1), self._measurements)

    def take_block(self, values: Array, piece: slice) -> Array:
        """Choose the columns.

        Arguments and result are those of `Batches.take_block`.
        """
        runs = [values[:, run] for run in self._runs(piece)]
        return runs[0] if len(runs) == 1 else namespace(values).concat(runs, axis=1)

    def write_block(self, block: Array, piece: slice) -> None:
        """Copy with the frames as first axis.

        Arguments and result are those of `Batches.write_block`.
        """
        pictures, done = namespace(block).moveaxis(block, -1, 0), 0
        for run in self._runs(piece):
            size = run.stop - run.start
            self.frames[run, ...] = pictures[done : done + size, ...]
            done += size

    def leave_out(self, dark: NDArray[np.bool_]) -> None:
        """Make pieces of the other frames only; what is not written is zero.

        Arguments and result are those of `Batches.leave_out`.
        """
        self._order = np.flatnonzero(~dark)

    def for_each_piece(self, work: Callable[[slice], None]) -> None:
        """Work on one piece after the other."""
        for piece in split_blocks(self._order.size, self._size):
            work(piece)

    def _runs(self, piece: slice) -> list[slice]:
        """Neighbouring frames of a piece, which a slice can name on any device."""
        chosen = self._order[piece]
        starts = np.flatnonzero(np.diff(chosen, prepend=-2) > 1)
        ends = np.append(starts[1:], chosen.size)
        return [
            slice(int(chosen[start]), int(chosen[end - 1]) + 1)
            for start, end in zip(starts, ends, strict=True)
        ]


def pad_block(values: NDArray[Any], chosen: NDArray[np.intp]) -> NDArray[Any]:
    """Copy the columns `chosen` into a block of exactly `LANES` columns, zero beyond them; a lone
    frame stays alone.

    `values` (measurements, frames); `chosen` (at most LANES,): numbers of the frames. Returns
    (measurements, LANES): of the same dtype; (measurements, 1) where there is a single frame.
    """
    # always the same width: the compiled loops unroll it, and results do not depend on how many
    # frames share a block
    block = np.zeros((values.shape[0], LANES if values.shape[1] > 1 else 1), values.dtype)
    block[:, : chosen.size] = values[:, chosen]
    return block


def write_frames(block: NDArray[Any], frames: NDArray[Any], piece: slice) -> None:
    """Put a (rows, columns, lanes) block where its frames belong.

    `block` (rows, columns, lanes): contiguous; `frames` (frames, rows, columns): overwritten in
    `piece`; `piece`: lanes beyond it are left out.
    """
    from tofclip.solvers.kernels import copy_lanes_to_frames

    target = frames[piece].reshape(piece.stop - piece.start, -1)
    copy_lanes_to_frames(block.reshape(-1, block.shape[-1]), target)
