"""The ways to turn readings into pictures: iterative ones with a prior, and two direct ones.

Each is an object that holds its settings and has one `recover`; all cut the frames into blocks that stay in cache and
share the blocks between threads. Memory beyond the result is bounded by a few blocks a thread.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from tofclip.arrays import LANES, blocks, run_blocks
from tofclip.errors import InputError, ShapeError
from tofclip.operators import LinearOperator, SparseMatrix, squared_norm
from tofclip.recovery.data_terms import LeastSquares
from tofclip.recovery.fista import Fista
from tofclip.recovery.loop import History, Progress, Result, Stopping, iterate, silent
from tofclip.recovery.proximal import NonnegativeSparsity, NonnegativeTotalVariation, Regulariser

Array = NDArray[Any]
Mask = NDArray[np.bool_] | None

NORM_ITERATIONS = 15
NORM_MARGIN = 1.02  # 15 power iterations on a nonnegative matrix are within 1 % of the largest eigenvalue


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


@dataclass(frozen=True)
class _ProximalMethod(ABC):
    """FISTA with a prior; what the prior is, subclasses say.

    Parameters
    ----------
    weight : float
        Regularisation relative to the largest value of ``A'f`` over all frames. At 1 the sparsest solution, zero, is
        reached; the scale of the readings does not matter.
    iterations : int
        At most so many for each frame.
    tolerance : float
        Relative change of a block's objective below which it is done; 0: never.
    """

    weight: float
    iterations: int
    tolerance: float = 0.0

    @abstractmethod
    def _regulariser(self, weight: float) -> Regulariser:
        """Make the prior for one block with an absolute weight."""

    def recover(
        self, operator: LinearOperator, readings: Array, good: Mask = None, progress: Progress = silent
    ) -> Result:
        """Recover one picture per column of `readings`; see `Method`."""
        readings = _checked(operator, readings, good)
        stopping = Stopping(self.iterations, self.tolerance)
        step = 1 / (NORM_MARGIN * squared_norm(operator, NORM_ITERATIONS))
        weight = self.weight * _largest_back_projection(operator, readings, good)
        frames = np.empty((readings.shape[1], *operator.shape_in), operator.dtype)
        histories: dict[int, History] = {}

        def solve(piece: slice) -> None:
            lanes = piece.stop - piece.start
            data = LeastSquares(_full_block(readings, piece), None if good is None else _full_block(good, piece))
            solver = Fista(operator, data, self._regulariser(weight), step, LANES)
            histories[piece.start] = iterate(solver, stopping, progress, lanes)
            _write_frames(solver.current, frames, piece)

        run_blocks(solve, readings.shape[1])
        return Result.of_blocks(frames, [histories[start] for start in sorted(histories)])

    def work(self, frames: int) -> int:
        """Return how many frame iterations `recover` reports at most."""
        return frames * self.iterations


@dataclass(frozen=True)
class Sparse(_ProximalMethod):
    """Nonnegative pictures with few bright pixels (l1): right for single time bins of a ToF scene."""

    weight: float = 2e-3
    iterations: int = 60
    name = "l1"

    def _regulariser(self, weight: float) -> Regulariser:
        return NonnegativeSparsity(weight)


@dataclass(frozen=True)
class TotalVariation(_ProximalMethod):
    """Nonnegative pictures with sharp borders between even surfaces (isotropic total variation)."""

    weight: float = 1e-3
    iterations: int = 60
    name = "tv"

    def _regulariser(self, weight: float) -> Regulariser:
        return NonnegativeTotalVariation(weight)


@dataclass(frozen=True)
class LinearInverse:
    """The regularised linear inverse ``h = A' (A A' + mu I)^-1 f``.

    The small Gram matrix is inverted once (Cholesky, float64); a block then costs one dense product of that size and
    one sparse one. For many shots with one camera, hold on to what `prepare` returns.

    Parameters
    ----------
    damping : float
        mu relative to the largest eigenvalue of A A'.
    """

    damping: float = 1e-2
    name = "linear"

    def prepare(self, operator: LinearOperator, alive: NDArray[np.bool_] | None = None) -> PreparedInverse:
        """Invert the Gram matrix of the living readings.

        Parameters
        ----------
        operator : SparseMatrix
        alive : (readings,) bool array, optional
            False for readings that are never to be trusted.
        """
        import scipy.linalg

        if not isinstance(operator, SparseMatrix):
            raise InputError(f"the linear inverse needs a sparse matrix, not {operator!r}; use l1 or tv")
        if not (np.isfinite(self.damping) and self.damping > 0):
            raise InputError(f"damping must be positive, got {self.damping}")
        if alive is None:
            alive = np.ones(operator.shape_out, bool)
        mu = self.damping * squared_norm(operator, NORM_ITERATIONS)
        seen = operator.matrix[alive].astype(np.float64)
        gram = (seen @ seen.T).toarray()
        gram[np.diag_indices_from(gram)] += mu
        inverse = np.zeros((alive.size, alive.size), operator.dtype)
        factor = scipy.linalg.cho_factor(gram, lower=True, overwrite_a=True)
        inverse[np.ix_(alive, alive)] = scipy.linalg.cho_solve(factor, np.eye(gram.shape[0]))
        return PreparedInverse(operator, inverse)

    def recover(
        self, operator: LinearOperator, readings: Array, good: Mask = None, progress: Progress = silent
    ) -> Result:
        """Recover one picture per column of `readings`; see `Method`.

        Readings that are bad in every frame are left out; a linear map cannot leave out a reading of one frame only.
        """
        alive = None if good is None else np.asarray(good.any(axis=1))
        return self.prepare(operator, alive).recover(readings, progress)

    def work(self, frames: int) -> int:
        """Return how many frame iterations `recover` reports at most."""
        return frames


@dataclass(frozen=True)
class PreparedInverse:
    """A `LinearInverse` whose Gram matrix is inverted already.

    Parameters
    ----------
    operator : LinearOperator
    inverse_gram : (readings, readings) array
        ``(A A' + mu I)^-1``, zero in the rows and columns of dead readings.
    """

    operator: LinearOperator
    inverse_gram: Array

    def recover(self, readings: Array, progress: Progress = silent) -> Result:
        """Recover one picture per column of `readings`, (readings, frames)."""
        from threadpoolctl import threadpool_limits

        readings = _checked(self.operator, readings, None)
        frames = np.empty((readings.shape[1], *self.operator.shape_in), self.operator.dtype)

        def solve(piece: slice) -> None:
            weights = self.inverse_gram @ _full_block(readings, piece)
            _write_frames(self.operator.adjoint(weights), frames, piece)
            progress(piece.stop - piece.start)

        # The blocks already keep every core busy: BLAS threads of its own would wait for, and spin against, ours.
        with threadpool_limits(1, "blas"):
            run_blocks(solve, readings.shape[1])
        return Result(frames)


@dataclass(frozen=True)
class Adjoint:
    """The adjoint ``h = A'f`` (supplement Note 13, Eq. 22): the fastest look, with streaks around every object."""

    name = "adjoint"

    def recover(
        self, operator: LinearOperator, readings: Array, good: Mask = None, progress: Progress = silent
    ) -> Result:
        """Recover one picture per column of `readings`; see `Method`. Bad readings count as zero."""
        readings = _checked(operator, readings, good)
        if good is not None:
            readings = readings * good
        frames = np.empty((readings.shape[1], *operator.shape_in), operator.dtype)

        def solve(piece: slice) -> None:
            _write_frames(operator.adjoint(_full_block(readings, piece)), frames, piece)
            progress(piece.stop - piece.start)

        run_blocks(solve, readings.shape[1])
        return Result(frames)

    def work(self, frames: int) -> int:
        """Return how many frame iterations `recover` reports at most."""
        return frames


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


def _checked(operator: LinearOperator, readings: Array, good: Mask) -> Array:
    if readings.ndim != 2 or readings.shape[:1] != operator.shape_out:
        raise ShapeError("readings", f"({operator.shape_out[0]}, frames)", readings.shape)
    if good is not None and good.shape != readings.shape:
        raise ShapeError("the mask of good readings", readings.shape, good.shape)
    if not np.all(np.isfinite(readings)):
        raise InputError("readings must not hold NaN or infinity; mark bad ones in `good`")
    return np.ascontiguousarray(readings, dtype=operator.dtype)


def _full_block(values: Array, piece: slice) -> Array:
    """Copy the columns `piece` into a block of exactly `LANES` columns, zero beyond them."""
    block = np.zeros((values.shape[0], LANES), values.dtype)
    block[:, : piece.stop - piece.start] = values[:, piece]
    return block


def _write_frames(block: Array, frames: Array, piece: slice) -> None:
    """Put a (rows, columns, LANES) block where its frames belong."""
    from tofclip.recovery.kernels import lanes_to_frames

    target = frames[piece].reshape(piece.stop - piece.start, -1)
    lanes_to_frames(block.reshape(-1, block.shape[-1]), target)


def _largest_back_projection(operator: LinearOperator, readings: Array, good: Mask) -> float:
    """The largest value of A'f: the weight at which the sparsest nonnegative solution becomes zero."""
    peaks: list[float] = []

    def look(piece: slice) -> None:
        block = _full_block(readings if good is None else readings * good, piece)
        peaks.append(float(operator.adjoint(block).max()))

    run_blocks(look, readings.shape[1])
    peak = max(peaks)
    if peak <= 0:
        raise InputError("no view sees anything positive; was too high a background subtracted?")
    return peak
