"""Recovery without iterations: the regularised linear inverse and the adjoint.

The linear inverse pixel by pixel: a few pixels at all instants, instead of all pixels at a few
instants.

Code that looks at one pixel's brightness over time, as the search for returns does, never needs the
transient cube: the dense part of the inverse, which is small, is worked out for the whole shot, and
the sparse part for a few pixels at a time, whose traces stay in cache.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofclip.arrays import (
    Array,
    ComputeDevice,
    PerDevice,
    empty_aligned,
    is_numpy,
    namespace,
    to_numpy,
)
from tofclip.errors import InputError
from tofclip.operators import LinearOperator, SparseMatrix
from tofclip.operators.panels import PanelMatrix
from tofclip.operators.panels.tiles import TileMatrix, arrange_matrix
from tofclip.operators.sparse import Tiles
from tofclip.solvers.fista import Mask, Progress, Result, ignore_progress, validate_measurements
from tofclip.solvers.loops import PortableBatches, make_batches, write_frames
from tofclip.threads import LANES, count_block_threads, limit_blas_threads, run_blocks

ROW_GAP = 16
"""Numbers between rows of weights: at a distance of a power of two they would share few places of
the cache."""


@dataclass(frozen=True)
class LinearInverse:
    """The regularised linear inverse ``h = A' (A A' + mu I)^-1 f``.

    The small Gram matrix is inverted once (Cholesky, float64); a block then costs one dense product
    of that size and one sparse one. For many shots with one camera, hold on to what `prepare`
    returns.

    Parameters
    ----------
    damping : float
        mu relative to the largest eigenvalue of A A'.
    """

    damping: float = 1e-2
    name = "linear"
    portable = True

    def prepare(
        self, operator: LinearOperator, alive: NDArray[np.bool_] | None = None
    ) -> PreparedInverse:
        """Invert the Gram matrix of the living measurements.

        Parameters
        ----------
        operator : SparseMatrix
        alive : (measurements,) bool array, optional
            False for measurements that are never to be trusted.

        Returns
        -------
        PreparedInverse

        Raises
        ------
        InputError
            The operator is not a sparse matrix, or the damping is not positive.
        """
        import scipy.linalg

        if not isinstance(operator, SparseMatrix):
            raise InputError(
                f"the linear inverse needs a sparse matrix, not {operator!r}; use l1 or tv"
            )
        if not (np.isfinite(self.damping) and self.damping > 0):
            raise InputError(f"damping must be positive, got {self.damping}")
        if alive is None:
            alive = np.ones(operator.shape_out, bool)
        mu = self.damping * operator.squared_norm
        # What sees no pixel has nothing but its diagonal, and no part in the pictures.
        used = np.flatnonzero(alive & (np.diff(operator.matrix.indptr) > 0))
        # in float64: a Cholesky factor loses digits with the condition number
        seen = operator.matrix[used].astype(np.float64)
        gram = (seen @ seen.T).toarray()
        gram[np.diag_indices_from(gram)] += mu
        factor = scipy.linalg.cho_factor(gram, lower=True, overwrite_a=True)
        inverse = scipy.linalg.cho_solve(factor, np.eye(used.size)).astype(operator.dtype)
        prepared = PreparedInverse(operator, inverse, used)
        # One dark block loads the compiled loops and the BLAS before the first shot needs them.
        prepared.recover(np.zeros((alive.size, LANES), operator.dtype))
        return prepared

    def recover(
        self,
        operator: LinearOperator,
        measurements: Array,
        valid: Mask = None,
        progress: Progress = ignore_progress,
    ) -> Result:
        """Recover one picture per column of `measurements`; see `Method`.

        Measurements that are bad in every frame are left out; a linear map cannot leave out a
        measurement of one frame only.

        Parameters
        ----------
        operator : LinearOperator
            Pictures (rows, columns) to measurements (measurements,).
        measurements : (measurements, frames) array
        valid : (measurements, frames) bool array, optional
            False where a measurement must not be used.
        progress : callable
            Called with the number of frames just recovered.

        Returns
        -------
        Result
            Frames (frames, rows, columns), without iterations.

        Raises
        ------
        ShapeError
            `measurements` or `valid` do not fit the operator.
        InputError
            A measurement is NaN or infinite.
        """
        measurements = validate_measurements(operator, measurements, valid)
        started = time.perf_counter()
        prepared = self.prepare(
            operator, None if valid is None else to_numpy(namespace(valid).any(valid, axis=1))
        )
        setup_seconds = time.perf_counter() - started
        return replace(prepared.recover(measurements, progress), setup_seconds=setup_seconds)

    def work(self, frames: int) -> int:
        """Return how many frame iterations `recover` reports at most."""
        return frames


@dataclass(frozen=True)
class PreparedInverse:
    """A `LinearInverse` whose Gram matrix is inverted already.

    Parameters
    ----------
    operator : LinearOperator
    inverse_gram : (n, n) array
        ``(A A' + mu I)^-1`` of the measurements that are used.
    used : (n,) int array
        Their numbers, increasing: those that are alive and see a pixel.

    Notes
    -----
    Memory: in single precision the matrix is held twice, or two and a half times on a processor with
    matrix registers; see `tofclip.operators.panels.tiles`.
    """

    operator: LinearOperator
    inverse_gram: NDArray[Any]
    used: NDArray[np.int64]

    @cached_property
    def _inverse(self) -> PerDevice[Array]:
        """Of all measurements, with zeros for those that are not used."""
        every = np.zeros((math.prod(self.operator.shape_out),) * 2, self.inverse_gram.dtype)
        every[np.ix_(self.used, self.used)] = self.inverse_gram
        return PerDevice(partial(ComputeDevice.put, values=every))

    @cached_property
    def _panels(self) -> PanelMatrix | TileMatrix | None:
        """The inverse as compiled products take it, which are for single precision."""
        return arrange_matrix(self.inverse_gram) if self.operator.dtype == np.float32 else None

    @cached_property
    def _stretches(self) -> NDArray[np.int64]:
        """First, and the one after the last, of neighbouring measurements that are used."""
        cuts = np.flatnonzero(np.diff(self.used, prepend=-2) != 1)
        last = self.used[np.append(cuts[1:], self.used.size)[: cuts.size] - 1]
        return np.stack([self.used[cuts], last + 1], axis=1)

    def recover(self, measurements: Array, progress: Progress = ignore_progress) -> Result:
        """Recover one picture per column of `measurements`, where they are.

        Parameters
        ----------
        measurements : (measurements, frames) array
        progress : callable
            Called with the number of frames just done.

        Returns
        -------
        Result
            Frames (frames, rows, columns).
        """
        measurements = validate_measurements(self.operator, measurements, None)
        if not is_numpy(measurements):
            return self._recover_on_device(measurements, progress)
        frames = np.empty((measurements.shape[1], *self.operator.shape_in), self.operator.dtype)
        weights = self.weights(measurements)

        def project(piece: slice) -> None:
            lanes = slice(piece.start, piece.start + (LANES if len(frames) > 1 else 1))
            block = np.zeros((measurements.shape[0], lanes.stop - lanes.start), weights.dtype)
            block[self.used] = weights[:, lanes]
            write_frames(self.operator.adjoint(block), frames, piece)
            progress(piece.stop - piece.start)

        run_blocks(project, measurements.shape[1])
        return Result(frames)

    def _recover_on_device(self, measurements: Array, progress: Progress) -> Result:
        """Recover as many frames at once as memory allows, where the measurements are."""
        batches = PortableBatches(self.operator, measurements)

        def project(piece: slice) -> None:
            weights = self._inverse.get(measurements) @ batches.take_block(measurements, piece)
            batches.write_block(self.operator.adjoint(weights), piece)
            progress(piece.stop - piece.start)

        batches.for_each_piece(project)
        return Result(batches.frames)

    def weights(self, measurements: NDArray[Any]) -> NDArray[Any]:
        """Return ``(A A' + mu I)^-1 f``, (used, frames and some): its adjoint is the pictures.

        Beyond the last frame rows are zero to a multiple of `LANES` frames and `ROW_GAP` more.

        Parameters
        ----------
        measurements : (measurements, frames) array, finite
        """
        frames = measurements.shape[1]
        held = -(-frames // LANES) * LANES + ROW_GAP
        if self._panels is not None:
            return self._panels.multiply(measurements, self._stretches, held)
        weights = empty_aligned((self.used.size, held), self.operator.dtype)
        weights[:, frames:] = 0
        inverse, solved, seen = self.inverse_gram, weights[:, :frames], measurements[self.used]

        def solve(piece: slice) -> None:
            np.matmul(inverse[piece], seen, out=solved[piece])

        # The blocks already keep every core busy: BLAS threads of its own would wait for, and spin
        # against, ours.
        with limit_blas_threads():
            run_blocks(solve, len(solved), max(1, -(-len(solved) // count_block_threads())))
        return weights


@dataclass(frozen=True)
class Backprojection:
    """The adjoint ``h = A'f`` (supplement Note 13, Eq. 22): the fastest look, with streaks around
    every object.

    A'f is in no unit of brightness. One factor for the whole shot, the one that leaves the least
    residual on its brightest frames, makes it one.
    """

    name = "adjoint"
    portable = True

    def recover(
        self,
        operator: LinearOperator,
        measurements: Array,
        valid: Mask = None,
        progress: Progress = ignore_progress,
    ) -> Result:
        """Recover one picture per column of `measurements`; see `Method`. Bad measurements count as
        zero.

        Parameters
        ----------
        operator : LinearOperator
            Pictures (rows, columns) to measurements (measurements,).
        measurements : (measurements, frames) array
        valid : (measurements, frames) bool array, optional
            Measurements that are False count as zero.
        progress : callable
            Called with the number of frames just recovered.

        Returns
        -------
        Result
            Frames (frames, rows, columns), without iterations.

        Raises
        ------
        ShapeError
            `measurements` or `valid` do not fit the operator.
        InputError
            A measurement is NaN or infinite.
        """
        measurements = validate_measurements(operator, measurements, valid)
        if valid is not None:
            measurements = measurements * namespace(valid).astype(valid, measurements.dtype)
        scale, batches = _fit_scale(operator, measurements), make_batches(operator, measurements)

        def solve(piece: slice) -> None:
            batches.write_block(
                operator.adjoint(scale * batches.take_block(measurements, piece)), piece
            )
            progress(piece.stop - piece.start)

        batches.for_each_piece(solve)
        return Result(batches.frames)

    def work(self, frames: int) -> int:
        """Return how many frame iterations `recover` reports at most."""
        return frames


def _fit_scale(operator: LinearOperator, measurements: Array) -> float:
    """The factor c that minimises ``|c A A'f - f|`` over the brightest block of frames."""
    xp = namespace(measurements)
    # the brightest frames, in which signal outweighs noise
    brightest = xp.argsort(xp.sum(measurements * measurements, axis=0))[
        -min(LANES, measurements.shape[1]) :
    ]
    block = xp.take(measurements, brightest, axis=1)
    seen = operator(operator.adjoint(block))
    energy = float(xp.sum(seen * seen, dtype=xp.float64))
    return float(xp.sum(seen * block, dtype=xp.float64)) / energy if energy > 0 else 1.0


PATCH_ROWS, PATCH_COLUMNS = 8, 8
"""The measurements that such a patch looks at stay in the first-level cache."""

GROUP_PIXELS = 4
"""Neighbours in a row of a patch: of each view they look at nearly the same measurements."""


def order_by_patch(image_shape: tuple[int, int]) -> NDArray[np.int64]:
    """Return the numbers of all pixels of a picture, counted in raster order, patch by patch."""
    row, column = np.divmod(np.arange(image_shape[0] * image_shape[1]), image_shape[1])
    return np.lexsort((column, row, column // PATCH_COLUMNS, row // PATCH_ROWS))


class InverseTraces:
    """A prepared inverse whose sparse part is applied to pixels in an order of their own.

    `inverse`: of a sparse matrix in float32; `pixels` (n,): numbers of the pixels, counted in
    raster order; see `order_by_patch`.
    """

    def __init__(self, inverse: PreparedInverse, pixels: NDArray[np.int64]) -> None:
        if not isinstance(inverse.operator, SparseMatrix):
            raise InputError(
                f"traces of single pixels need a sparse matrix, not {inverse.operator!r}"
            )
        self.inverse = inverse
        # The transpose has one row per pixel, in the order in which they are wanted.
        self._tiles = Tiles.from_csr(inverse.operator.matrix[inverse.used].T.tocsr()[pixels])

    @property
    def tiles(self) -> Tiles:
        """The operator's transpose, a row for each pixel, a column for each measurement; without
        what is not used.
        """
        used = self.inverse.used.astype(np.uint32)
        return self._tiles._replace(columns=used[self._tiles.columns])

    def fill(self, weights: Array, piece: slice, traces: Array, frames: slice) -> None:
        """Write what the inverse makes of a shot at the pixels ``pixels[piece]``.

        `weights` (used measurements, time and some): `PreparedInverse.weights` of the shot's
        measurements; `traces` (pixels of the piece, time): its columns `frames` are overwritten;
        `frames`: time bins; as many as the measurements have.
        """
        from tofclip.solvers.kernels import compute_traces

        compute_traces(
            *self._tiles,
            (piece.start, piece.start + len(traces)),
            weights,
            traces,
            (frames.start, frames.stop),
        )
