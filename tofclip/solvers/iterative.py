"""Recovery with a prior: the proximal methods."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from dataclasses import dataclass

from tofclip.arrays import namespace, require_numpy
from tofclip.errors import InputError
from tofclip.operators import LinearOperator, estimate_squared_norm
from tofclip.solvers.batches import Batches, make_batches
from tofclip.solvers.data_terms import DataTermMaker, LeastSquares
from tofclip.solvers.fista import Fista
from tofclip.solvers.iteration import (
    IterationHistory,
    Progress,
    Result,
    StoppingRule,
    ignore_progress,
    iterate,
)
from tofclip.solvers.method import Array, Mask, validate_measurements
from tofclip.solvers.proximal import NonnegativeSparsity, NonnegativeTotalVariation, Regulariser
from tofclip.threads import limit_blas_threads

NORM_ITERATIONS = 15
NORM_MARGIN = (
    1.02  # 15 power iterations on a nonnegative matrix are within 1 % of the largest eigenvalue
)


@dataclass(frozen=True)
class ProximalMethod(ABC):
    """FISTA with a prior; what the prior is, subclasses say.

    Parameters
    ----------
    weight : float
        Regularisation relative to the largest value of ``A'f`` over all frames. At 1 the sparsest
        solution, zero, is reached; the scale of the readings does not matter.
    iterations : int
        At most so many for each frame.
    tolerance : float
        Relative change of a block's objective below which it is done; 0: never. What a block is
        depends on the arrays (`tofclip.solvers.batches`), and with it when its frames are done.
    data_term : DataTermMaker
        What a misfit costs.

    Attributes
    ----------
    portable : bool
        Whether arrays of any library are taken, or NumPy's only.
    """

    weight: float
    iterations: int
    tolerance: float = 0.0
    data_term: DataTermMaker = LeastSquares
    portable = False

    @abstractmethod
    def _make_regulariser(self, weight: float) -> Regulariser:
        """Make the prior for one block with an absolute weight."""

    def recover(
        self,
        operator: LinearOperator,
        measurements: Array,
        valid: Mask = None,
        progress: Progress = ignore_progress,
    ) -> Result:
        """Recover one picture per column of `measurements`; see `Method`."""
        if not self.portable:
            require_numpy(f"recovery with the prior {type(self).__name__}", measurements)
        # Blocks share the cores already, and a lone picture's products are too small to share.
        with limit_blas_threads():
            return self._recover_batches(
                operator, validate_measurements(operator, measurements, valid), valid, progress
            )

    def _recover_batches(
        self, operator: LinearOperator, measurements: Array, valid: Mask, progress: Progress
    ) -> Result:
        stopping = StoppingRule(self.iterations, self.tolerance)
        started = time.perf_counter()
        step = 1 / (NORM_MARGIN * estimate_squared_norm(operator, NORM_ITERATIONS))
        batches = make_batches(operator, measurements)
        self._warm_up_loops(operator, step, batches.zero_measurements())
        setup_seconds = time.perf_counter() - started
        weight = self.weight * _largest_back_projection(operator, batches, measurements, valid)
        histories: dict[int, IterationHistory] = {}

        def solve(piece: slice) -> None:
            trusted = None if valid is None else batches.take_block(valid, piece)
            data = self.data_term(batches.take_block(measurements, piece), trusted)
            solver = Fista(
                operator, data, self._make_regulariser(weight), step, data.measurements.shape[1]
            )
            histories[piece.start] = iterate(solver, stopping, progress, piece.stop - piece.start)
            batches.write_block(solver.current, piece)

        batches.for_each_piece(solve)
        return Result.from_blocks(
            batches.frames, [histories[start] for start in sorted(histories)], setup_seconds
        )

    def _warm_up_loops(self, operator: LinearOperator, step: float, dark: Array) -> None:
        """Take one step on a dark block and write it, so that compiled loops are there before the
        first thread comes.

        The operator's matrix is brought to where the readings are, for the same reason.
        """
        solver = Fista(
            operator, LeastSquares(dark), self._make_regulariser(1.0), step, dark.shape[1]
        )
        solver.step()
        make_batches(operator, dark).write_block(solver.current, slice(0, dark.shape[1]))

    def work(self, frames: int) -> int:
        """Return how many frame iterations `recover` reports at most."""
        return frames * self.iterations


@dataclass(frozen=True)
class Sparse(ProximalMethod):
    """Nonnegative pictures with few bright pixels (l1): right for single time bins of a ToF scene."""

    weight: float = 2e-3
    iterations: int = 60
    name = "l1"
    portable = True

    def _make_regulariser(self, weight: float) -> Regulariser:
        return NonnegativeSparsity(weight)


@dataclass(frozen=True)
class TotalVariation(ProximalMethod):
    """Nonnegative pictures with sharp borders between even surfaces (isotropic total variation)."""

    weight: float = 1e-3
    iterations: int = 60
    name = "tv"
    portable = True

    def _make_regulariser(self, weight: float) -> Regulariser:
        return NonnegativeTotalVariation(weight)


@dataclass(frozen=True)
class Wavelets(ProximalMethod):
    """Nonnegative pictures with few details at every scale (Daubechies 4, cycle spinning)."""

    weight: float = 2e-3
    iterations: int = 60
    name = "wavelet"

    def _make_regulariser(self, weight: float) -> Regulariser:
        from tofclip.solvers.wavelets import NonnegativeWavelets

        return NonnegativeWavelets(weight)


def _largest_back_projection(
    operator: LinearOperator, batches: Batches, measurements: Array, valid: Mask
) -> float:
    """The largest value of A'f: the weight at which the sparsest nonnegative solution becomes zero."""
    peaks: list[float] = []

    def look(piece: slice) -> None:
        block = batches.take_block(measurements, piece)
        if valid is not None:
            block = block * namespace(block).astype(batches.take_block(valid, piece), block.dtype)
        back = operator.adjoint(block)
        peaks.append(float(namespace(back).max(back)))

    batches.for_each_piece(look)
    peak = max(peaks)
    if peak <= 0:
        raise InputError("no view sees anything positive; was too high a background subtracted?")
    return peak
