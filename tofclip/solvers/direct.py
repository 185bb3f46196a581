"""Recovery without iterations: the regularised linear inverse and the adjoint."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofclip.arrays import Array, InEachPlace, Place, is_numpy, namespace, to_numpy
from tofclip.errors import InputError
from tofclip.operators import LinearOperator, SparseMatrix, squared_norm
from tofclip.solvers.batches import PortableBatches, batches_for, write_frames
from tofclip.solvers.loop import Progress, Result, silent
from tofclip.solvers.method import Mask, checked_readings
from tofclip.threads import LANES, blocks, one_blas_thread, run_blocks

DENSE_ROWS = 336  # of the dense matrix, which are read from memory once for all frames
NORM_ITERATIONS = 15  # the damping need not be known better than to a percent


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
    portable = True

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
        prepared = PreparedInverse(operator, inverse)
        # One dark block loads the compiled loops and the BLAS before the first shot needs them.
        prepared.recover(np.zeros((alive.size, LANES), operator.dtype))
        return prepared

    def recover(
        self, operator: LinearOperator, readings: Array, good: Mask = None, progress: Progress = silent
    ) -> Result:
        """Recover one picture per column of `readings`; see `Method`.

        Readings that are bad in every frame are left out; a linear map cannot leave out a reading of one frame only.
        """
        readings = checked_readings(operator, readings, good)
        started = time.perf_counter()
        prepared = self.prepare(operator, None if good is None else to_numpy(namespace(good).any(good, axis=1)))
        setup_seconds = time.perf_counter() - started
        return replace(prepared.recover(readings, progress), setup_seconds=setup_seconds)

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

    @cached_property
    def _inverse(self) -> InEachPlace[Array]:
        return InEachPlace(partial(Place.put, values=self.inverse_gram))

    def recover(self, readings: Array, progress: Progress = silent) -> Result:
        """Recover one picture per column of `readings`, where they are.

        Parameters
        ----------
        readings : (readings, frames) array
        progress : callable
            Called with the number of frames just done.
        """
        readings = checked_readings(self.operator, readings, None)
        if not is_numpy(readings):
            return self._recovered_elsewhere(readings, progress)
        frames = np.empty((readings.shape[1], *self.operator.shape_in), self.operator.dtype)
        weights = self.weights(readings)

        def project(piece: slice) -> None:
            block = weights[piece.start // LANES]
            write_frames(self.operator.adjoint(block if len(frames) > 1 else block[:, :1]), frames, piece)
            progress(piece.stop - piece.start)

        run_blocks(project, readings.shape[1])
        return Result(frames)

    def _recovered_elsewhere(self, readings: Array, progress: Progress) -> Result:
        """Recover as many frames at once as memory allows, where the readings are."""
        batches = PortableBatches(self.operator, readings)

        def project(piece: slice) -> None:
            weights = self._inverse.beside(readings) @ batches.block(readings, piece)
            batches.write(self.operator.adjoint(weights), piece)
            progress(piece.stop - piece.start)

        batches.each(project)
        return Result(batches.frames)

    def weights(self, readings: NDArray[Any]) -> NDArray[Any]:
        """Return ``(A A' + mu I)^-1 f``, (blocks, readings, LANES): the adjoint of each block is `LANES` pictures.

        Frames beyond the last one are zero.

        Parameters
        ----------
        readings : (readings, frames) array, finite
        """
        frames = readings.shape[1]
        weights = np.zeros((-(-frames // LANES), self.inverse_gram.shape[0], LANES), self.operator.dtype)

        def solve(piece: slice) -> None:
            solved = self.inverse_gram[piece] @ readings
            for number, part in enumerate(blocks(frames)):
                weights[number, piece, : part.stop - part.start] = solved[:, part]

        # The blocks already keep every core busy: BLAS threads of its own would wait for, and spin against, ours.
        with one_blas_thread():
            run_blocks(solve, len(self.inverse_gram), DENSE_ROWS)
        return weights


@dataclass(frozen=True)
class Adjoint:
    """The adjoint ``h = A'f`` (supplement Note 13, Eq. 22): the fastest look, with streaks around every object.

    A'f is in no unit of brightness. One factor for the whole shot, the one that leaves the least residual on its
    brightest frames, makes it one.
    """

    name = "adjoint"
    portable = True

    def recover(
        self, operator: LinearOperator, readings: Array, good: Mask = None, progress: Progress = silent
    ) -> Result:
        """Recover one picture per column of `readings`; see `Method`. Bad readings count as zero."""
        readings = checked_readings(operator, readings, good)
        if good is not None:
            readings = readings * namespace(good).astype(good, readings.dtype)
        scale, batches = _best_scale(operator, readings), batches_for(operator, readings)

        def solve(piece: slice) -> None:
            batches.write(operator.adjoint(scale * batches.block(readings, piece)), piece)
            progress(piece.stop - piece.start)

        batches.each(solve)
        return Result(batches.frames)

    def work(self, frames: int) -> int:
        """Return how many frame iterations `recover` reports at most."""
        return frames


def _best_scale(operator: LinearOperator, readings: Array) -> float:
    """The factor c that minimises ``|c A A'f - f|`` over the brightest block of frames."""
    xp = namespace(readings)
    brightest = xp.argsort(xp.sum(readings * readings, axis=0))[-min(LANES, readings.shape[1]) :]
    block = xp.take(readings, brightest, axis=1)
    seen = operator(operator.adjoint(block))
    energy = float(xp.sum(seen * seen, dtype=xp.float64))
    return float(xp.sum(seen * block, dtype=xp.float64)) / energy if energy > 0 else 1.0
