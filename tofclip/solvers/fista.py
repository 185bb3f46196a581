"""Recovery with a prior by FISTA: the priors with their proximal maps, the algorithm, and the methods
that apply it to a batch of frames.

Minimises ``1/2 |A h - f|^2 + weight * R(h)`` over h >= 0 for each frame, R the l1 norm or the total
variation.
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from tofclip.arrays import Array, namespace, require_numpy, zeros
from tofclip.errors import InputError
from tofclip.operators import LinearOperator, estimate_squared_norm
from tofclip.solvers.data_terms import DataTerm, DataTermMaker, LeastSquares
from tofclip.solvers.loops import Batches, make_batches, select_loops
from tofclip.solvers.method import (
    IterationHistory,
    Mask,
    Progress,
    Result,
    StoppingRule,
    ignore_progress,
    iterate,
    validate_measurements,
)
from tofclip.threads import limit_blas_threads


class Regulariser(Protocol):
    """A penalty R(h) whose proximal map is known, on a block of (rows, columns, lanes) pictures."""

    def proximal_step(
        self, current: Array, previous: Array, momentum: Array, gradient: Array, step: float
    ) -> tuple[Array, Array]:
        """Return ``prox_{step R}(z - step * gradient)``, a proximal gradient step, and R of it for
        each frame, float64.

        ``z = current + momentum * (current - previous)`` is the extrapolated point and `gradient`
        belongs to it. `previous` and `gradient` may be overwritten; the result may lie in their
        memory.

        Parameters
        ----------
        current, previous : (rows, columns, lanes) array
            The last two solutions.
        momentum : (lanes,) array
        gradient : (rows, columns, lanes) array
            Of the data term at z.
        step : float
            Step size.

        Returns
        -------
        picture : (rows, columns, lanes) array
        penalty : (lanes,) float64 array
            R of the picture.
        """
        ...


class NonnegativeSparsity:
    """``weight * sum(h)`` for h >= 0, infinite otherwise: the l1 norm of a nonnegative picture.

    Parameters
    ----------
    weight : float
        In the unit of ``A'f``.
    """

    def __init__(self, weight: float) -> None:
        self.weight = validate_weight(weight)

    def proximal_step(
        self, current: Array, previous: Array, momentum: Array, gradient: Array, step: float
    ) -> tuple[Array, Array]:
        """Shift by ``step * weight`` and clip at zero; see `Regulariser`.

        Parameters
        ----------
        current, previous : (rows, columns, lanes) array
            The last two solutions; `previous` may be overwritten.
        momentum : (lanes,) array
        gradient : (rows, columns, lanes) array
            May be overwritten.
        step : float
            Step size.

        Returns
        -------
        picture : (rows, columns, lanes) array
        penalty : (lanes,) float64 array
            Weight times the picture's sum.
        """
        loops = select_loops(current)
        picture, total = loops.prox_l1(
            current, previous, momentum, gradient, step, step * self.weight
        )
        return picture, self.weight * total


class NonnegativeTotalVariation:
    """``weight * TV(h)`` for h >= 0, infinite otherwise; TV is the isotropic total variation of
    each frame.

    The proximal map has no closed form. Its dual is kept from one call to the next (warm start), so
    that even a single sweep a call follows the solver's own convergence. One instance therefore
    belongs to one block.

    Parameters
    ----------
    weight : float
        In the unit of ``A'f``.
    sweeps : int
        Dual sweeps in a call. On the clip scene's shot one sweep ends 1.4 % above the objective of
        ten after 60 iterations and 0.4 % after 200; the time of further sweeps is better spent on
        further iterations.
    """

    def __init__(self, weight: float, sweeps: int = 1) -> None:
        self.weight = validate_weight(weight)
        self.sweeps = sweeps
        self._dual: Array | None = None

    def proximal_step(
        self, current: Array, previous: Array, momentum: Array, gradient: Array, step: float
    ) -> tuple[Array, Array]:
        """Sweep the dual `sweeps` times and return the picture that belongs to it; see
        `Regulariser`.

        Parameters
        ----------
        current, previous : (rows, columns, lanes) array
            The last two solutions; `previous` may be overwritten.
        momentum : (lanes,) array
        gradient : (rows, columns, lanes) array
            May be overwritten.
        step : float
            Step size.

        Returns
        -------
        picture : (rows, columns, lanes) array
        penalty : (lanes,) float64 array
            Weight times total variation.
        """
        loops = select_loops(current)
        noisy = loops.gradient_step(current, previous, momentum, gradient, step)
        picture, total, self._dual = loops.prox_tv(
            noisy, self._dual, step * self.weight, self.sweeps, previous
        )
        return picture, self.weight * total


def validate_weight(weight: float) -> float:
    """Return a regularisation weight, refusing what is none."""
    if not (np.isfinite(weight) and weight >= 0):
        raise InputError(f"a regularisation weight must be finite and not negative, got {weight}")
    return float(weight)


class Fista:
    """Minimise ``data(A h) + R(h)`` for a block of frames at once.

    A. Beck, M. Teboulle, SIAM J. Imaging Sci. 2, 183 (2009); a step that would raise a frame's
    objective is refused and that frame's momentum starts anew (B. O'Donoghue, E. Candes, Found.
    Comput. Math. 15, 715 (2015)). ``A z`` at the extrapolated point is had from the last two ``A
    h`` by linearity, so a step costs one product each way. Everything stays where the data term's
    measurements are, and no step waits for a device.

    Parameters
    ----------
    operator : LinearOperator
        A.
    data_term : DataTerm
    regulariser : Regulariser
    step_size : float
        At most 1 over the largest eigenvalue of A'A.
    frames : int
        Number of frames of the block.

    Attributes
    ----------
    current : (rows, columns, frames) array
        With a light field's model (views, rows, columns, frames).
        The solution so far.
    objective : (frames,) array
    rejected : (frames,) bool array
        Frames whose last step was refused.
    """

    def __init__(
        self,
        operator: LinearOperator,
        data_term: DataTerm,
        regulariser: Regulariser,
        step_size: float,
        frames: int,
    ) -> None:
        self.operator, self.data_term, self.regulariser = operator, data_term, regulariser
        self.step_size = step_size
        self.current, self.previous = (
            zeros((*operator.shape_in, frames), data_term.measurements) for _ in range(2)
        )
        self.seen, self._seen_before = (
            zeros((*operator.shape_out, frames), data_term.measurements) for _ in range(2)
        )
        self.objective: Array = data_term.value(self.seen)
        self._age = namespace(self.objective).ones_like(self.objective)
        self.rejected = self._age < 1

    def step(self) -> None:
        """Advance every frame by one iteration."""
        xp, loops = namespace(self.current), select_loops(self.current)
        # Beck and Teboulle, Eq. 4.2; the momentum is that of Eq. 4.3
        age = (1 + xp.sqrt(1 + 4 * self._age**2)) / 2
        momentum = xp.astype((self._age - 1) / age, self.current.dtype)
        # A z by linearity, from products that are known already
        predicted = self.seen + momentum * (self.seen - self._seen_before)
        gradient = self.operator.adjoint(self.data_term.gradient(predicted))
        candidate, penalty = self.regulariser.proximal_step(
            self.current, self.previous, momentum, gradient, self.step_size
        )
        seen = self.operator(candidate)
        objective = self.data_term.value(seen) + penalty
        self.rejected = objective > self.objective
        # Refused frames go back to where they were, and their momentum starts anew.
        candidate = loops.restore_frames(candidate, self.current, self.rejected)
        seen = loops.restore_frames(seen, self.seen, self.rejected)
        self.objective = xp.where(self.rejected, self.objective, objective)
        self._age = xp.where(self.rejected, 1.0, age)
        self.previous, self.current = self.current, candidate
        self._seen_before, self.seen = self.seen, seen


NORM_ITERATIONS = 15
NORM_MARGIN = 1.02
"""What 15 Lanczos iterations may lack of the largest eigenvalue; a test checks every camera."""


@dataclass(frozen=True)
class ProximalMethod(ABC):
    """FISTA with a prior; what the prior is, subclasses say.

    Parameters
    ----------
    weight : float
        Regularisation relative to the largest value of ``A'f`` over all frames. At 1 the sparsest
        solution, zero, is reached; the scale of the measurements does not matter.
    iterations : int
        Maximum number for each frame.
    tolerance : float
        Relative change of a block's objective below which it is done; 0: never. What a block is
        depends on the arrays (`tofclip.solvers.loops`), and with it when its frames are done.
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
        """Recover one picture per column of `measurements`; see `Method`.

        Parameters
        ----------
        operator : LinearOperator
            Pictures (rows, columns) to measurements (measurements,).
        measurements : (measurements, frames) array
        valid : (measurements, frames) bool array, optional
            Measurements that are False are left out.
        progress : callable
            Called with the number of frame iterations just done.

        Returns
        -------
        Result
            Frames (frames, rows, columns) and the history of the objective.

        Raises
        ------
        ShapeError
            `measurements` or `valid` do not fit the operator.
        InputError
            A measurement is NaN or infinite, or the arrays are not NumPy's and the prior is not
            portable.
        """
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
        # with max(A'f) as weight the l1 solution is zero: relative weights suit shots of any
        # brightness
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

        The operator's matrix is brought to where the measurements are, for the same reason.
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
