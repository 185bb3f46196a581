"""Recovery with a prior: the proximal methods."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np

from tofclip.errors import InputError
from tofclip.operators import LinearOperator, squared_norm
from tofclip.recovery.data_terms import DataTermMaker, LeastSquares
from tofclip.recovery.fista import Fista
from tofclip.recovery.loop import History, Progress, Result, Stopping, iterate, silent
from tofclip.recovery.method import Array, Mask, checked_readings, full_block, write_frames
from tofclip.recovery.proximal import NonnegativeSparsity, NonnegativeTotalVariation, Regulariser
from tofclip.threads import run_blocks

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
        Relative change of a block's objective below which it is done; 0: never.
    data_term : DataTermMaker
        What a misfit costs.
    """

    weight: float
    iterations: int
    tolerance: float = 0.0
    data_term: DataTermMaker = LeastSquares

    @abstractmethod
    def _regulariser(self, weight: float) -> Regulariser:
        """Make the prior for one block with an absolute weight."""

    def recover(
        self, operator: LinearOperator, readings: Array, good: Mask = None, progress: Progress = silent
    ) -> Result:
        """Recover one picture per column of `readings`; see `Method`."""
        from threadpoolctl import threadpool_limits

        # Blocks share the cores already, and a lone picture's products are too small to share.
        with threadpool_limits(1, "blas"):
            return self._recover(operator, checked_readings(operator, readings, good), good, progress)

    def _recover(self, operator: LinearOperator, readings: Array, good: Mask, progress: Progress) -> Result:
        stopping = Stopping(self.iterations, self.tolerance)
        started = time.perf_counter()
        step = 1 / (NORM_MARGIN * squared_norm(operator, NORM_ITERATIONS))
        self._load_loops(operator, step, full_block(readings, slice(0, 0)))
        setup_seconds = time.perf_counter() - started
        weight = self.weight * _largest_back_projection(operator, readings, good)
        frames = np.empty((readings.shape[1], *operator.shape_in), operator.dtype)
        histories: dict[int, History] = {}

        def solve(piece: slice) -> None:
            data = self.data_term(full_block(readings, piece), None if good is None else full_block(good, piece))
            solver = Fista(operator, data, self._regulariser(weight), step, data.readings.shape[1])
            histories[piece.start] = iterate(solver, stopping, progress, piece.stop - piece.start)
            write_frames(solver.current, frames, piece)

        run_blocks(solve, readings.shape[1])
        return Result.of_blocks(frames, [histories[start] for start in sorted(histories)], setup_seconds)

    def _load_loops(self, operator: LinearOperator, step: float, dark: Array) -> None:
        """Take one step on a dark block, so that compiled loops are loaded before the first thread needs them."""
        lanes = dark.shape[1]
        solver = Fista(operator, LeastSquares(dark), self._regulariser(1.0), step, lanes)
        solver.step()
        write_frames(solver.current, np.empty((lanes, *operator.shape_in), operator.dtype), slice(0, lanes))

    def work(self, frames: int) -> int:
        """Return how many frame iterations `recover` reports at most."""
        return frames * self.iterations


@dataclass(frozen=True)
class Sparse(ProximalMethod):
    """Nonnegative pictures with few bright pixels (l1): right for single time bins of a ToF scene."""

    weight: float = 2e-3
    iterations: int = 60
    name = "l1"

    def _regulariser(self, weight: float) -> Regulariser:
        return NonnegativeSparsity(weight)


@dataclass(frozen=True)
class TotalVariation(ProximalMethod):
    """Nonnegative pictures with sharp borders between even surfaces (isotropic total variation)."""

    weight: float = 1e-3
    iterations: int = 60
    name = "tv"

    def _regulariser(self, weight: float) -> Regulariser:
        return NonnegativeTotalVariation(weight)


@dataclass(frozen=True)
class Wavelets(ProximalMethod):
    """Nonnegative pictures with few details at every scale (Daubechies 4, cycle spinning)."""

    weight: float = 2e-3
    iterations: int = 60
    name = "wavelet"

    def _regulariser(self, weight: float) -> Regulariser:
        from tofclip.recovery.wavelets import NonnegativeWavelets

        return NonnegativeWavelets(weight)


def _largest_back_projection(operator: LinearOperator, readings: Array, good: Mask) -> float:
    """The largest value of A'f: the weight at which the sparsest nonnegative solution becomes zero."""
    peaks: list[float] = []

    def look(piece: slice) -> None:
        block = full_block(readings, piece)
        if good is not None:
            block *= full_block(good, piece)
        peaks.append(float(operator.adjoint(block).max()))

    run_blocks(look, readings.shape[1])
    peak = max(peaks)
    if peak <= 0:
        raise InputError("no view sees anything positive; was too high a background subtracted?")
    return peak
