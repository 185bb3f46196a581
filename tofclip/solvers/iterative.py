"""Recovery with a prior: the proximal methods."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from dataclasses import dataclass

from tofclip.arrays import namespace, require_numpy
from tofclip.errors import InputError
from tofclip.operators import LinearOperator, squared_norm
from tofclip.solvers.batches import Batches, batches_for
from tofclip.solvers.data_terms import DataTermMaker, LeastSquares
from tofclip.solvers.fista import Fista
from tofclip.solvers.loop import History, Progress, Result, Stopping, iterate, silent
from tofclip.solvers.method import Array, Mask, checked_readings
from tofclip.solvers.proximal import NonnegativeSparsity, NonnegativeTotalVariation, Regulariser
from tofclip.threads import one_blas_thread

NORM_ITERATIONS = 15
NORM_MARGIN = 1.02  # 15 power iterations on a nonnegative matrix are within 1 % of the largest eigenvalue


@dataclass(frozen=True)
class ProximalMethod(ABC):
    """FISTA with a prior; what the prior is, subclasses say.

    Parameters
    ----------
    weight : float
        Regularisation relative to the largest value of ``A'f`` over all frames. At 1 the sparsest solution, zero, is
        reached; the scale of the readings does not matter.
    iterations : int
        At most so many for each frame.
    tolerance : float
        Relative change of a block's objective below which it is done; 0: never. What a block is depends on the arrays
        (`tofclip.solvers.batches`), and with it when its frames are done.
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
    def _regulariser(self, weight: float) -> Regulariser:
        """Make the prior for one block with an absolute weight."""

    def recover(
        self, operator: LinearOperator, readings: Array, good: Mask = None, progress: Progress = silent
    ) -> Result:
        """Recover one picture per column of `readings`; see `Method`."""
        if not self.portable:
            require_numpy(f"recovery with the prior {type(self).__name__}", readings)
        # Blocks share the cores already, and a lone picture's products are too small to share.
        with one_blas_thread():
            return self._recover(operator, checked_readings(operator, readings, good), good, progress)

    def _recover(self, operator: LinearOperator, readings: Array, good: Mask, progress: Progress) -> Result:
        stopping = Stopping(self.iterations, self.tolerance)
        started = time.perf_counter()
        step = 1 / (NORM_MARGIN * squared_norm(operator, NORM_ITERATIONS))
        batches = batches_for(operator, readings)
        self._load_loops(operator, step, batches.dark())
        setup_seconds = time.perf_counter() - started
        weight = self.weight * _largest_back_projection(operator, batches, readings, good)
        histories: dict[int, History] = {}

        def solve(piece: slice) -> None:
            trusted = None if good is None else batches.block(good, piece)
            data = self.data_term(batches.block(readings, piece), trusted)
            solver = Fista(operator, data, self._regulariser(weight), step, data.readings.shape[1])
            histories[piece.start] = iterate(solver, stopping, progress, piece.stop - piece.start)
            batches.write(solver.current, piece)

        batches.each(solve)
        return Result.of_blocks(batches.frames, [histories[start] for start in sorted(histories)], setup_seconds)

    def _load_loops(self, operator: LinearOperator, step: float, dark: Array) -> None:
        """Take one step on a dark block and write it, so that compiled loops are there before the first thread comes.

        The operator's matrix is brought to where the readings are, for the same reason.
        """
        solver = Fista(operator, LeastSquares(dark), self._regulariser(1.0), step, dark.shape[1])
        solver.step()
        batches_for(operator, dark).write(solver.current, slice(0, dark.shape[1]))

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

    def _regulariser(self, weight: float) -> Regulariser:
        return NonnegativeSparsity(weight)


@dataclass(frozen=True)
class TotalVariation(ProximalMethod):
    """Nonnegative pictures with sharp borders between even surfaces (isotropic total variation)."""

    weight: float = 1e-3
    iterations: int = 60
    name = "tv"
    portable = True

    def _regulariser(self, weight: float) -> Regulariser:
        return NonnegativeTotalVariation(weight)


@dataclass(frozen=True)
class Wavelets(ProximalMethod):
    """Nonnegative pictures with few details at every scale (Daubechies 4, cycle spinning)."""

    weight: float = 2e-3
    iterations: int = 60
    name = "wavelet"

    def _regulariser(self, weight: float) -> Regulariser:
        from tofclip.solvers.wavelets import NonnegativeWavelets

        return NonnegativeWavelets(weight)


def _largest_back_projection(operator: LinearOperator, batches: Batches, readings: Array, good: Mask) -> float:
    """The largest value of A'f: the weight at which the sparsest nonnegative solution becomes zero."""
    peaks: list[float] = []

    def look(piece: slice) -> None:
        block = batches.block(readings, piece)
        if good is not None:
            block = block * namespace(block).astype(batches.block(good, piece), block.dtype)
        back = operator.adjoint(block)
        peaks.append(float(namespace(back).max(back)))

    batches.each(look)
    peak = max(peaks)
    if peak <= 0:
        raise InputError("no view sees anything positive; was too high a background subtracted?")
    return peak
