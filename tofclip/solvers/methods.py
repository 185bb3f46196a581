"""What every method that turns measurements into pictures has in common: its interface, its result, the
loop around an iterative solver, and the blocks of frames that it works on.

A method holds its settings and has one `recover`. It takes NumPy arrays; those that are `portable`
take the arrays of any library that follows the array API standard as well, and return the same kind,
on the same device. Memory beyond the result is bounded: frames are worked on in `Blocks`.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field
from math import prod
from typing import Protocol, Self

import numpy as np

from tofclip.arrays import (
    Array,
    BoolArray,
    FloatArray,
    as_type,
    is_numpy,
    namespace,
    to_numpy,
    zeros,
)
from tofclip.errors import ShapeError, require, require_shape
from tofclip.operators import LinearOperator
from tofclip.solvers.data_terms import DataTermMaker, Mask
from tofclip.threads import LANES, run_blocks, split_blocks

Progress = Callable[[int], None]
"""Called with the number of frame iterations just done; may raise to interrupt."""


def ignore_progress(_: int) -> None:
    """Report nothing."""


GAP_INTERVAL = 10  # iterations between looks at the duality gap: each costs half an iteration
# Of a block's energy: what is left of it beyond is noise, since no model of a camera misses as much.
NOISE_FRACTION = 0.1
# Of the objective. Between iterations 30 and 40 it falls by 0.9 to 3.6 % in shots whose thin bars have
# a rim of false points by then, and by 0.1 to 0.2 % in dark ones, in which more iterations only follow
# the noise.
MIN_FURTHER_FALL = 6e-3


@dataclass(frozen=True)
class StoppingRule:
    """When a block of frames is done: after so many `iterations`, or as soon as one of these holds.

    * the block's objective changes by less than the fraction `tolerance` in an iteration in which no
      frame's step was refused; 0 runs all iterations;
    * every frame's duality gap is at most the fraction `gap` of its objective, for solvers that know
      one; it is looked at every `GAP_INTERVAL` iterations;
    * more than `NOISE_FRACTION` of the objective at zero is left and an iteration takes less than the
      fraction `noise_fall` off: what it fits is noise; 0: never.

    So many `further` iterations may follow, in steps of `GAP_INTERVAL`, as long as the last step took more
    than `MIN_FURTHER_FALL` off the block's objective.
    """

    iterations: int
    tolerance: float = 0.0
    gap: float = 0.0
    further: int = 0
    noise_fall: float = 0.0

    def __post_init__(self) -> None:
        require(self.iterations >= 1, f"at least one iteration is needed, got {self.iterations}")
        for name in ("tolerance", "gap", "noise_fall"):
            value = getattr(self, name)
            require(
                np.isfinite(value) and value >= 0,
                f"{name} must be finite and not negative, got {value}",
            )
        require(self.further >= 0, f"further iterations must not be negative, got {self.further}")


class IterativeSolver(Protocol):
    """What the loop needs to know of a solver."""

    objective: Array
    rejected: Array

    def step(self) -> None:
        """Advance by one iteration."""
        ...

    def duality_gap(self) -> Array | None:
        """Return how far each frame is above the least objective at most, where that is known."""
        ...


@dataclass(frozen=True)
class IterationHistory:
    """What a run left behind: `objective` (iterations + 1,), the sum over the frames before the
    first and after every iteration; `converged`, whether the tolerance, the gap or the noise
    ended it; `gap`, how far the last objective is above the least one at most, NaN where that
    is not known.
    """

    objective: FloatArray
    converged: bool
    gap: float = float("nan")

    @property
    def iterations(self) -> int:
        """Iterations done."""
        return self.objective.size - 1


def iterate(
    solver: IterativeSolver, stopping: StoppingRule, progress: Progress, frames: int
) -> IterationHistory:
    """Run `solver` until `stopping` says that it is done; it is advanced in place. `progress` is
    called with the number of frame iterations just done, each of them so many `frames`; those that
    are saved are reported too.

    A device is waited for once in an iteration if there is a tolerance or `noise_fall`, and not at
    all if there is neither.
    """
    xp = namespace(solver.objective)
    # Sums stay where the arrays are: reading one back from a GPU would make every iteration wait.
    objective = [xp.sum(solver.objective)]
    converged, gap = False, None
    done, limit, most = 0, stopping.iterations, stopping.iterations + stopping.further
    while done < limit:
        done += 1
        solver.step()
        objective.append(xp.sum(solver.objective))
        last = objective[-1]
        fall = objective[-2] - last
        if stopping.tolerance > 0:
            # a refused step changes nothing, which does not mean that the block has converged
            little = fall < stopping.tolerance * last
            converged = bool(little & ~xp.any(solver.rejected))
        if stopping.noise_fall > 0:
            noisy = last > NOISE_FRACTION * objective[0]
            converged |= bool(noisy & (fall < stopping.noise_fall * last))
        if stopping.gap > 0 and (converged or done == limit or done % GAP_INTERVAL == 0):
            gap = solver.duality_gap()
            if gap is not None:
                converged |= bool(xp.all(gap <= stopping.gap * solver.objective))
        if converged:
            # The iterations that were saved count as done, so that a progress bar ends at its end.
            progress(frames * (most - done + 1))
            break
        progress(frames)
        if done == limit < most:
            before = objective[-1 - GAP_INTERVAL] if done >= GAP_INTERVAL else last
            if before - last > MIN_FURTHER_FALL * last:
                limit = min(done + GAP_INTERVAL, most)
            else:
                progress(frames * (most - done))
    excess = float("nan") if gap is None else float(xp.sum(gap))
    return IterationHistory(to_numpy(xp.stack(objective)), converged, excess)


@dataclass(frozen=True)
class Result:
    """Recovered pictures, `frames` (frames, rows, columns), where the measurements were, and how they
    came about.

    `iterations` are those of the block that took most, 0 for direct methods; `objective` (iterations
    + 1,) is the sum over all frames, in which blocks that stopped early count with their last value,
    empty for direct methods; `stop_reason` is ``"converged"``, ``"iterations done"`` or ``"direct
    method"``; `setup_seconds` were spent on what depends on the operator only and on loading compiled
    loops. The last objective is above the least one by at most the fraction `duality_gap` of it; NaN
    where that is not known.
    """

    frames: Array
    iterations: int = 0
    objective: FloatArray = field(default_factory=lambda: np.empty(0))
    stop_reason: str = "direct method"
    setup_seconds: float = 0.0
    duality_gap: float = float("nan")

    @classmethod
    def from_blocks(
        cls, frames: Array, histories: list[IterationHistory], setup_seconds: float = 0.0
    ) -> Result:
        """Join the histories of all blocks of the `frames`, recovered after `setup_seconds`: a block
        that ended early keeps its last objective.
        """
        longest = max(history.iterations for history in histories)
        padded = [np.pad(one.objective, (0, longest - one.iterations), "edge") for one in histories]
        total = np.sum(padded, axis=0)
        converged = all(history.converged for history in histories)
        why = "converged" if converged else "iterations done"
        gap = sum(history.gap for history in histories) / (total[-1] if total[-1] > 0 else 1)
        return cls(frames, longest, total, why, setup_seconds, gap)


class Method(Protocol):
    """Anything that recovers pictures from measurements.

    Attributes
    ----------
    name : str
    portable : bool
        Whether arrays of any library are taken, or NumPy's only.
    """

    name: str
    portable: bool = False

    @abstractmethod
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
            Pictures (rows, columns) to measurements (measurements,).
        measurements : (measurements, frames) array
        valid : (measurements, frames) bool array, optional
            False where a measurement must not be trusted: it is left out.
        progress : callable
            Called with the number of frame iterations just done.

        Raises
        ------
        ShapeError
            `measurements` or `valid` do not fit the operator.
        InputError
            A measurement is NaN or infinite, or the arrays are not NumPy's and the method is not
            portable.
        """

    def work(self, frames: int) -> int:
        """Return how many frame iterations `recover` reports at most for so many `frames`."""
        return frames

    @property
    def has_prior(self) -> bool:
        """Whether there is a prior, so that measurements are fitted as well as noise allows."""
        return False

    def with_data_term(self, data_term: DataTermMaker) -> Self:
        """Return this method with another misfit in the place of least squares, where it has these."""
        return self

    def scale_weight(self, factor: float) -> Self:
        """Return this method with its prior weighing by so much more, where it has one."""
        return self


def relative_residual(
    operator: LinearOperator, frames: Array, measurements: Array, valid: Mask = None
) -> float:
    """``|A h - f| / |f|`` over all good `measurements` (measurements, frames), those that are
    `valid`, of all `frames` (frames, rows, columns), by their `operator`. `InputError` where
    every valid measurement is zero.
    """
    misfit, energy = sum_residual(operator, frames, measurements, valid)
    require(energy != 0, "every valid measurement is zero; there is nothing to compare with")
    return float(np.sqrt(misfit / energy))


def sum_residual(
    operator: LinearOperator, frames: Array, measurements: Array, valid: Mask
) -> tuple[float, float]:
    """Squares of what is left of the valid measurements, and of these, block by block: predictions of
    all frames at once would double the memory.
    """
    misfit = energy = 0.0
    xp = namespace(frames, measurements)
    for piece in split_blocks(frames.shape[0], frames_per_block(operator, measurements)):
        seen = measurements[:, piece]
        mask = 1.0 if valid is None else xp.astype(valid[:, piece], seen.dtype)
        residual = (operator(xp.moveaxis(frames[piece, ...], 0, -1)) - seen) * mask
        misfit += float(xp.sum(residual**2, dtype=xp.float64))
        energy += float(xp.sum((seen * mask) ** 2, dtype=xp.float64))
    return misfit, energy


def validate_measurements(operator: LinearOperator, measurements: Array, valid: Mask) -> Array:
    """Return (measurements, frames), contiguous, in the operator's type; refuse NaN."""
    xp = namespace(measurements) if valid is None else namespace(measurements, valid)
    if measurements.ndim != 2 or measurements.shape[:1] != operator.shape_out:
        expected = f"({operator.shape_out[0]}, frames)"
        raise ShapeError("measurements", expected, tuple(measurements.shape))
    if valid is not None:
        require_shape("the mask of valid measurements", measurements.shape, valid.shape)
    require(
        xp.all(xp.isfinite(measurements)),
        "measurements must not hold NaN or infinity; mark bad ones in `valid`",
    )
    return as_type(measurements, operator.dtype)


WORKING_BYTES = 1 << 31  # what a solver may take for the frames that it works on at once
# Arrays of the frames' size that total variation, which needs most, has at once: solution, dual,
# gradient and their temporaries.
WORKING_PICTURES = 16


def frames_per_block(operator: LinearOperator, measurements: Array) -> int:
    """`LANES` for NumPy's, or 1 of a lone frame; of others as many as `WORKING_BYTES` hold."""
    if is_numpy(measurements):
        return LANES if measurements.shape[1] > 1 else 1
    picture = prod(operator.shape_in) * operator.dtype.itemsize
    return max(1, WORKING_BYTES // (WORKING_PICTURES * picture))


class Blocks:
    """The frames of (measurements, frames) values, cut into blocks that are worked on together, and
    their pictures, `frames`.

    NumPy's blocks stay in cache, and threads share them. All have one width, because compiled loops
    unroll it, and so no frame's result depends on its neighbours; zeros fill the last one. Other
    libraries' blocks fill the memory of their device, one after the other.
    """

    def __init__(self, operator: LinearOperator, measurements: Array) -> None:
        self._compiled = is_numpy(measurements)
        self.size = frames_per_block(operator, measurements)
        number = measurements.shape[1]
        shape = number, *operator.shape_in
        # not zeros: NumPy asks for large pages of memory for empty arrays only
        self.frames = (
            np.empty(shape, operator.dtype) if self._compiled else zeros(shape, measurements)
        )
        self._order = np.arange(number)

    def leave_out(self, dark: BoolArray) -> None:
        """Make the frames that are dark zero; pieces count the others only."""
        if self._compiled:
            self.frames[dark] = 0
        self._order = np.flatnonzero(~dark)

    def for_each(self, work: Callable[[slice], None]) -> None:
        """Call `work` on every piece; the first exception is raised."""
        if self._compiled:
            run_blocks(work, self._order.size, self.size)
        else:
            for piece in split_blocks(self._order.size, self.size):
                work(piece)

    def take(self, values: Array, piece: slice) -> Array:
        """Copy a piece's columns of (n, frames) values."""
        if not self._compiled:
            return namespace(values).concat([values[:, run] for run in self._runs(piece)], axis=1)
        chosen = self._order[piece]
        block = np.zeros((values.shape[0], self.size), values.dtype)
        block[:, : chosen.size] = values[:, chosen]
        return block

    def write(self, block: Array, piece: slice) -> None:
        """Put a piece's (..., frames) pictures where they belong."""
        done = 0
        for run in self._runs(piece):
            lanes = slice(done, done + run.stop - run.start)
            done = lanes.stop
            if self._compiled:
                from tofclip.solvers.kernels import copy_lanes_to_frames

                size = run.stop - run.start
                flat = block.reshape(-1, block.shape[-1])
                copy_lanes_to_frames(flat, lanes.start, self.frames[run].reshape(size, -1))
            else:
                self.frames[run, ...] = namespace(block).moveaxis(block[..., lanes], -1, 0)

    def _runs(self, piece: slice) -> list[slice]:
        """Neighbouring frames of a piece, which a slice can name on any device."""
        chosen = self._order[piece]
        runs = np.split(chosen, np.flatnonzero(np.diff(chosen) > 1) + 1)
        return [slice(int(run[0]), int(run[-1]) + 1) for run in runs]
