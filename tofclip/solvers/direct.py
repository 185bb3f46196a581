"""Recovery without iterations: the regularised linear inverse and the adjoint.

The inverse goes pixel by pixel as well: code that looks at one pixel's brightness over time, as the
search for returns does, never needs the transient cube. The dense part of the inverse, which is
small, is worked out for the whole shot, and the sparse part for a few pixels at a time, whose traces
stay in cache.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np

from tofclip.arrays import (
    AnyArray,
    Array,
    BoolArray,
    ComputeDevice,
    IntArray,
    PerDevice,
    empty_aligned,
    is_numpy,
    namespace,
    to_numpy,
)
from tofclip.errors import InputError, require_positive
from tofclip.operators import LinearOperator, SparseMatrix
from tofclip.operators.sparse import Tiles
from tofclip.solvers.data_terms import Mask
from tofclip.solvers.methods import (
    Blocks,
    Method,
    Progress,
    Result,
    ignore_progress,
    validate_measurements,
)
from tofclip.threads import LANES, limit_blas_threads, run_blocks

# Numbers between rows of weights: at a distance of a power of two they would share few places of the
# cache.
ROW_GAP = 16
# Of a product, whatever the number of threads is: sums are rounded as their block's size has it.
ROWS_AT_ONCE = 192


@dataclass(frozen=True)
class LinearInverse(Method):
    """The regularised linear inverse ``h = A' (A A' + mu I)^-1 f``, mu being `damping` times the largest
    eigenvalue of A A'.

    The small Gram matrix is inverted once (Cholesky, float64); a block then costs one dense product
    of that size and one sparse one. For many shots with one camera, hold on to what `prepare`
    returns. Measurements that are bad in every frame are left out: a linear map cannot leave out a
    measurement of one frame only.
    """

    damping: float = 1e-2
    name = "linear"
    portable = True

    def prepare(self, operator: LinearOperator, alive: BoolArray | None = None) -> PreparedInverse:
        """Invert the Gram matrix of the living measurements of an `operator`; `alive` (measurements,)
        is False for those that are never to be trusted. `InputError` where the operator is not a
        `SparseMatrix`, or the damping is not positive.
        """
        import scipy.linalg

        if not isinstance(operator, SparseMatrix):
            raise InputError(
                f"the linear inverse needs a sparse matrix, not {operator!r}; use l1 or tv"
            )
        require_positive("damping", self.damping)
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
        inverse = np.zeros((alive.size, alive.size), operator.dtype)
        inverse[np.ix_(used, used)] = scipy.linalg.cho_solve(factor, np.eye(used.size))
        prepared = PreparedInverse(operator, inverse)
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
        measurements = validate_measurements(operator, measurements, valid)
        started = time.perf_counter()
        alive = None if valid is None else to_numpy(namespace(valid).any(valid, axis=1))
        prepared = self.prepare(operator, alive)
        setup_seconds = time.perf_counter() - started
        return replace(prepared.recover(measurements, progress), setup_seconds=setup_seconds)


@dataclass(frozen=True)
class PreparedInverse:
    """A `LinearInverse` of an `operator` A whose Gram matrix is inverted already: `inverse_gram`
    (measurements, measurements) is ``(A A' + mu I)^-1`` of the measurements that are alive and
    see a pixel; 0 for the others.
    """

    operator: LinearOperator
    inverse_gram: AnyArray

    @cached_property
    def _inverse(self) -> PerDevice[Array]:
        return PerDevice(partial(ComputeDevice.put, values=self.inverse_gram))

    def recover(self, measurements: Array, progress: Progress = ignore_progress) -> Result:
        """Recover a picture per column of `measurements`, with `progress`; see `Method.recover`."""
        measurements = validate_measurements(self.operator, measurements, None)
        blocks = Blocks(self.operator, measurements)
        weights = self.weights(measurements) if is_numpy(measurements) else None

        def project(piece: slice) -> None:
            if weights is None:
                block = self._inverse.get(measurements) @ blocks.take(measurements, piece)
            else:
                block = weights[:, piece.start : piece.start + blocks.size]
            blocks.write(self.operator.adjoint(block), piece)
            progress(piece.stop - piece.start)

        blocks.for_each(project)
        return Result(blocks.frames)

    def weights(self, measurements: AnyArray) -> AnyArray:
        """Return ``(A A' + mu I)^-1 f``, (measurements, frames and some): its adjoint is the pictures.

        Beyond the last frame rows are zero to a multiple of `LANES` frames and `ROW_GAP` more.
        Measurements are (measurements, frames), finite.
        """
        number, frames = measurements.shape
        width = -(-frames // LANES) * LANES + ROW_GAP
        weights = empty_aligned((number, width), self.operator.dtype)
        weights[:, frames:] = 0

        def solve(piece: slice) -> None:
            np.matmul(self.inverse_gram[piece], measurements, out=weights[piece, :frames])

        with limit_blas_threads():
            run_blocks(solve, number, ROWS_AT_ONCE)
        return weights


@dataclass(frozen=True)
class Backprojection(Method):
    """The adjoint ``h = A'f`` (supplement Note 13, Eq. 22): the fastest look, with streaks around
    every object.

    A'f is in no unit of brightness. One factor for the whole shot, the one that leaves the least
    residual on its brightest frames, makes it one. Bad measurements count as zero.
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
        measurements = validate_measurements(operator, measurements, valid)
        if valid is not None:
            measurements = measurements * namespace(valid).astype(valid, measurements.dtype)
        scale, blocks = _fit_scale(operator, measurements), Blocks(operator, measurements)

        def solve(piece: slice) -> None:
            blocks.write(operator.adjoint(scale * blocks.take(measurements, piece)), piece)
            progress(piece.stop - piece.start)

        blocks.for_each(solve)
        return Result(blocks.frames)


def _fit_scale(operator: LinearOperator, measurements: Array) -> float:
    """The c that minimises ``|c A A'f - f|`` over the brightest frames: signal, not noise."""
    xp = namespace(measurements)
    order = xp.argsort(xp.sum(measurements * measurements, axis=0))
    block = xp.take(measurements, order[-min(LANES, measurements.shape[1]) :], axis=1)
    seen = operator(operator.adjoint(block))
    energy = float(xp.sum(seen * seen, dtype=xp.float64))
    return float(xp.sum(seen * block, dtype=xp.float64)) / energy if energy > 0 else 1.0


PATCH_ROWS, PATCH_COLUMNS = 8, 8  # what such a patch looks at stays in the first-level cache
GROUP_PIXELS = 4  # neighbours in a row of a patch, which look at nearly the same measurements


def order_by_patch(image_shape: tuple[int, int]) -> IntArray:
    """Return the numbers of all pixels of a picture, counted in raster order, patch by patch."""
    row, column = np.divmod(np.arange(image_shape[0] * image_shape[1]), image_shape[1])
    return np.lexsort((column, row, column // PATCH_COLUMNS, row // PATCH_ROWS))


class InverseTraces:
    """A prepared inverse of a sparse matrix in float32, whose sparse part is applied to `pixels`
    (n,), numbers in raster order, in an order of their own; see `order_by_patch`. `tiles` is the
    operator's transpose, a row for each pixel, without measurements that are not used.
    """

    def __init__(self, inverse: PreparedInverse, pixels: IntArray) -> None:
        if not isinstance(inverse.operator, SparseMatrix):
            raise InputError(
                f"traces of single pixels need a sparse matrix, not {inverse.operator!r}"
            )
        self.inverse = inverse
        matrix = inverse.operator.matrix.copy()
        unused = np.diagonal(inverse.inverse_gram) == 0
        matrix.data[np.repeat(unused, np.diff(matrix.indptr))] = 0
        matrix.eliminate_zeros()
        self.tiles = Tiles.from_csr(matrix.T.tocsr()[pixels])

    def fill(self, weights: Array, piece: slice, traces: Array, frames: slice) -> None:
        """Write what the inverse makes of a shot at ``pixels[piece]`` into the columns `frames` of
        `traces` (pixels, time); `weights` are `PreparedInverse.weights` of its measurements.
        """
        from tofclip.solvers.kernels import compute_traces

        rows = piece.start, piece.start + len(traces)
        compute_traces(*self.tiles, rows, weights, traces, (frames.start, frames.stop))
