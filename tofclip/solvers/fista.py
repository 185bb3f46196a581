"""What every method that turns measurements into pictures has in common: its interface, its result, and
the loop around an iterative solver.

A method holds its settings and has one `recover`. It takes NumPy arrays; those that are `portable`
take the arrays of any library that follows the array API standard as well, and return the same kind,
on the same device. Memory beyond the result is bounded: see `tofclip.solvers.loops`.

Recovery with a prior by FISTA: the priors with their proximal maps, the algorithm, and the methods
that apply it to a batch of frames.

Minimises ``1/2 |A h - f|^2 + weight * R(h)`` over h >= 0 for each frame, R the l1 norm or the total
variation.
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from math import log
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from tofclip.arrays import Array, as_type, clip_values, namespace, require_numpy, to_numpy, zeros
from tofclip.errors import InputError, ShapeError
from tofclip.operators import LinearOperator
from tofclip.solvers.data_terms import DataTerm, DataTermMaker, LeastSquares
from tofclip.solvers.loops import Batches, frames_per_block, make_batches, select_loops
from tofclip.threads import limit_blas_threads, split_blocks

Mask = Array | None

Progress = Callable[[int], None]
"""Called with the number of frame iterations just done; may raise to interrupt."""


def ignore_progress(_: int) -> None:
    """Report nothing."""


GAP_INTERVAL = 10
"""Iterations between two looks at the duality gap, each of which costs half an iteration."""


NOISE_FRACTION = 0.1
"""Of a block's energy: what is left of it beyond is noise, since no model of a camera misses as much.
"""

MIN_FURTHER_FALL = 6e-3
"""Of the objective. Between iterations 30 and 40 it falls by 0.9 to 3.6 % in shots whose thin bars
have a rim of false points by then, and by 0.1 to 0.2 % in dark ones, in which more iterations only
follow the noise."""


@dataclass(frozen=True)
class StoppingRule:
    """When a block of frames is done.

    Parameters
    ----------
    iterations : int
        Maximum number.
    tolerance : float
        Stop as soon as the block's objective changes by less than this fraction in an iteration in
        which no frame's step was refused. 0 runs all iterations.
    gap : float
        Stop, too, as soon as every frame's duality gap is at most this fraction of its objective,
        for solvers that know one. It is looked at every `GAP_INTERVAL` iterations.
    further : int
        Iterations that may follow, in steps of `GAP_INTERVAL`, as long as the last step took more
        than `MIN_FURTHER_FALL` off the block's objective.
    noise_fall : float
        Stop, too, where more than `NOISE_FRACTION` of the objective at zero is left and an iteration
        takes less than this fraction off: what it fits is noise. 0: never.
    """

    iterations: int
    tolerance: float = 0.0
    gap: float = 0.0
    further: int = 0
    noise_fall: float = 0.0

    def __post_init__(self) -> None:
        if self.iterations < 1:
            raise InputError(f"at least one iteration is needed, got {self.iterations}")
        for name, value in (
            ("tolerance", self.tolerance),
            ("gap", self.gap),
            ("noise_fall", self.noise_fall),
        ):
            if not (np.isfinite(value) and value >= 0):
                raise InputError(f"{name} must be finite and not negative, got {value}")
        if self.further < 0:
            raise InputError(f"further iterations must not be negative, got {self.further}")

    def follows_noise(self, objective: Sequence[Array]) -> bool:
        """Say whether a block of little more than noise has come as near to it as it should.

        Parameters
        ----------
        objective : sequence of scalars
            Of the block before the first and after every iteration.
        """
        before, last = objective[-2], objective[-1]
        return bool(
            (last > NOISE_FRACTION * objective[0]) & (before - last < self.noise_fall * last)
        )

    def continues(self, objective: Sequence[Array]) -> bool:
        """Say whether a block goes on after its iterations.

        Parameters
        ----------
        objective : sequence of scalars
            Of the block before the first and after every iteration.
        """
        done = len(objective) - 1
        if not (done >= GAP_INTERVAL and self.iterations <= done < self.iterations + self.further):
            return False
        fall = objective[-1 - GAP_INTERVAL] - objective[-1]
        return bool(fall > MIN_FURTHER_FALL * objective[-1])


class IterativeSolver(Protocol):
    """What the loop needs to know of a solver."""

    objective: Array
    rejected: Array

    def step(self) -> None:
        """Advance by one iteration."""
        ...

    def duality_gap(self) -> Array | None:
        """Return how far each frame's objective is above the least one at most, where that is
        known.
        """
        ...


@dataclass(frozen=True)
class IterationHistory:
    """What a run left behind.

    Parameters
    ----------
    objective : (iterations + 1,) array
        Sum over the frames before the first and after every iteration.
    converged : bool
        Whether the tolerance, the gap or the noise ended it.
    gap : float
        How far the last objective is above the least one at most; NaN where that is not known.
    """

    objective: NDArray[np.float64]
    converged: bool
    gap: float = float("nan")

    @property
    def iterations(self) -> int:
        """Iterations done."""
        return self.objective.size - 1


def iterate(
    solver: IterativeSolver, stopping: StoppingRule, progress: Progress, frames: int
) -> IterationHistory:
    """Run `solver` until `stopping` says that it is done.

    A device is waited for once in an iteration if there is a tolerance or `noise_fall`, and not at all
    if there is neither.

    Parameters
    ----------
    solver : IterativeSolver
        Advanced in place.
    stopping : StoppingRule
        Maximum number of iterations, what may follow them, and the tolerance.
    progress : callable
        Called with the number of frame iterations just done; those that are saved are reported too.
    frames : int
        Number of frames that an iteration counts for.

    Returns
    -------
    IterationHistory
        Objective of the whole block before the first iteration and after each.
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
        if stopping.tolerance > 0:
            # a refused step changes nothing, which does not mean that the block has converged
            little = objective[-2] - objective[-1] < stopping.tolerance * objective[-1]
            converged = bool(little & ~xp.any(solver.rejected))
        if stopping.noise_fall > 0:
            converged |= stopping.follows_noise(objective)
        if stopping.gap > 0 and (converged or done == limit or done % GAP_INTERVAL == 0):
            gap = solver.duality_gap()
            if gap is not None:
                converged |= bool(xp.all(gap <= stopping.gap * solver.objective))
        if converged:
            # The iterations that were saved count as done, so that a progress bar ends at its end.
            progress(frames * (most - done + 1))
            break
        progress(frames)
        if done == limit:
            if stopping.continues(objective):
                limit = min(done + GAP_INTERVAL, most)
            elif done < most:
                progress(frames * (most - done))
    excess = float("nan") if gap is None else float(xp.sum(gap))
    return IterationHistory(to_numpy(xp.stack(objective)), converged, excess)


@dataclass(frozen=True)
class Result:
    """Recovered pictures and how they came about.

    Parameters
    ----------
    frames : (frames, rows, columns) array
        Where the measurements were.
    iterations : int
        Of the block that took most; 0 for direct methods.
    objective : (iterations + 1,) array
        Sum over all frames; blocks that stopped early count with their last value. Empty for direct
        methods.
    stop_reason : str
        ``"converged"``, ``"iteration limit"`` or ``"direct method"``.
    setup_seconds : float
        Time spent on what depends on the operator only and on loading compiled loops, not on the
        measurements.
    duality_gap : float
        The last objective is above the least one by at most this fraction of it; NaN where that is
        not known.
    """

    frames: Array
    iterations: int = 0
    objective: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))
    stop_reason: str = "direct method"
    setup_seconds: float = 0.0
    duality_gap: float = float("nan")

    @classmethod
    def from_blocks(
        cls, frames: Array, histories: list[IterationHistory], setup_seconds: float = 0.0
    ) -> Result:
        """Join the histories of all blocks.

        Parameters
        ----------
        frames : (frames, rows, columns) array
            Results of all blocks.
        histories : list of IterationHistory
            One for each block.
        setup_seconds : float
            Time before the first iteration.

        Returns
        -------
        Result
            Objectives are added up; a block that ended early counts with its last one.
        """
        longest = max(history.iterations for history in histories)
        total = np.zeros(longest + 1)
        for history in histories:
            # a block that ended early keeps its last objective
            kept_on = np.full(longest - history.iterations, history.objective[-1])
            total += np.concatenate([history.objective, kept_on])
        converged = all(history.converged for history in histories)
        gap = sum(history.gap for history in histories)
        return cls(
            frames,
            longest,
            total,
            "converged" if converged else "iteration limit",
            setup_seconds,
            gap / total[-1] if total[-1] > 0 else gap,
        )


class Method(Protocol):
    """Anything that recovers pictures from measurements.

    Attributes
    ----------
    name : str
    portable : bool
        Whether arrays of any library are taken, or NumPy's only.
    """

    name: str
    portable: bool

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
            False where a measurement must not be trusted.
        progress : callable
            Called with the number of frame iterations just done.

        Returns
        -------
        Result
            Frames (frames, rows, columns) and how they came about.
        """
        ...

    def work(self, frames: int) -> int:
        """Return how many frame iterations `recover` reports at most."""
        ...


def relative_residual(
    operator: LinearOperator, frames: Array, measurements: Array, valid: Mask = None
) -> float:
    """``|A h - f| / |f|`` over all good measurements of all frames.

    Returns
    -------
    float

    Raises
    ------
    InputError
        Every valid measurement is zero.

    Parameters
    ----------
    operator : LinearOperator
    frames : (frames, rows, columns) array
    measurements : (measurements, frames) array
    valid : (measurements, frames) bool array, optional
    """
    # Block by block: predictions of all frames at once would double the memory.
    misfit = energy = 0.0
    xp = namespace(frames, measurements)
    for piece in split_blocks(frames.shape[0], frames_per_block(operator, measurements)):
        block = xp.moveaxis(frames[piece, ...], 0, -1)
        # Invalid measurements count neither as misfit nor as energy.
        mask = 1.0 if valid is None else xp.astype(valid[:, piece], measurements.dtype)
        misfit += float(
            xp.sum(((operator(block) - measurements[:, piece]) * mask) ** 2, dtype=xp.float64)
        )
        energy += float(xp.sum((measurements[:, piece] * mask) ** 2, dtype=xp.float64))
    if energy == 0:
        raise InputError("every valid measurement is zero; there is nothing to compare with")
    return float(np.sqrt(misfit / energy))


def validate_measurements(operator: LinearOperator, measurements: Array, valid: Mask) -> Array:
    """Return `measurements` contiguous and in the operator's type, refusing wrong shapes, NaN and
    infinity.

    `operator`: pictures (rows, columns) to measurements (measurements,); `measurements`
    (measurements, frames); `valid` (measurements, frames). Returns (measurements, frames):
    contiguous, of the operator's dtype.
    """
    xp = namespace(measurements) if valid is None else namespace(measurements, valid)
    if measurements.ndim != 2 or measurements.shape[:1] != operator.shape_out:
        raise ShapeError(
            "measurements", f"({operator.shape_out[0]}, frames)", tuple(measurements.shape)
        )
    if valid is not None and valid.shape != measurements.shape:
        raise ShapeError(
            "the mask of valid measurements", tuple(measurements.shape), tuple(valid.shape)
        )
    if not xp.all(xp.isfinite(measurements)):
        raise InputError("measurements must not hold NaN or infinity; mark bad ones in `valid`")
    return as_type(measurements, operator.dtype)


class ProximalStep(NamedTuple):
    """A proximal gradient step and what is known about it, frame by frame.

    Parameters
    ----------
    picture : (rows, columns, lanes) array
    penalty : (lanes,) float64 array
        R of the picture.
    distance : (lanes,) float64 array, optional
        Squared distance of the picture from the point that the step began at. Without it, steps keep
        their size.
    """

    picture: Array
    penalty: Array
    distance: Array | None = None


class Regulariser(Protocol):
    """A penalty R(h) whose proximal map is known, on a block of (rows, columns, lanes) pictures; 0
    where h is.

    Attributes
    ----------
    zero_bound : float
        A frame is zero where A'f (the data term's negative gradient at zero) nowhere exceeds this.
    """

    zero_bound: float

    def proximal_step(
        self, current: Array, previous: Array, momentum: Array, gradient: Array, step: Array
    ) -> ProximalStep:
        """Return ``prox_{step R}(z - step * gradient)``, a proximal gradient step.

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
        step : (lanes,) array
            Step sizes, of the pictures' dtype.

        Returns
        -------
        ProximalStep
        """
        ...

    def scale_dual(self, pull: Array) -> Array | None:
        """Return by how much each frame's dual point must shrink to be feasible, (lanes,) float64,
        or None where that is not known.

        Parameters
        ----------
        pull : (rows, columns, lanes) array
            Negative gradient of the data term.
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
        self.weight = self.zero_bound = validate_weight(weight)

    def proximal_step(
        self, current: Array, previous: Array, momentum: Array, gradient: Array, step: Array
    ) -> ProximalStep:
        """Shift by ``step * weight`` and clip at zero; see `Regulariser`.

        Arguments and result are those of `Regulariser.proximal_step`.
        """
        loops = select_loops(current)
        picture, total, distance = loops.prox_l1(
            current, previous, momentum, gradient, step, self.weight
        )
        return ProximalStep(picture, self.weight * total, distance)

    def scale_dual(self, pull: Array) -> Array:
        """Return what makes ``A' dual`` nowhere greater than the weight."""
        xp = namespace(pull)
        steepest = xp.max(pull, axis=tuple(range(pull.ndim - 1)))
        steepest = clip_values(xp.astype(steepest, xp.float64), TINY)
        return clip_values(self.weight / steepest, highest=1.0)


class NonnegativeTotalVariation:
    """``weight * TV(h)`` for h >= 0, infinite otherwise; TV is the isotropic total variation of
    each frame.

    The proximal map has no closed form. Its dual is kept from one call to the next (warm start), so
    that a single sweep a call follows the solver's own convergence: on the clip scene's shot one
    sweep ends 1.4 % above the objective of ten after 60 iterations and 0.4 % after 200, and the time
    of further sweeps is better spent on further iterations. One instance therefore belongs to one
    block. Steps keep their size: an inexact proximal map after a longer step is refused, or not, by
    the rounding of the last digits, and pictures of two devices would differ by a percent.

    Parameters
    ----------
    weight : float
        In the unit of ``A'f``.
    """

    zero_bound = 0.0

    def __init__(self, weight: float) -> None:
        self.weight = validate_weight(weight)
        self._dual: Array | None = None

    def proximal_step(
        self, current: Array, previous: Array, momentum: Array, gradient: Array, step: Array
    ) -> ProximalStep:
        """Sweep the dual once and return the picture that belongs to it; see `Regulariser`.

        Arguments and result are those of `Regulariser.proximal_step`.
        """
        loops = select_loops(current)
        picture, total, self._dual = loops.prox_tv(
            current, previous, momentum, gradient, step, self.weight, self._dual
        )
        return ProximalStep(picture, self.weight * total)

    def scale_dual(self, pull: Array) -> None:
        """Not known: a dual point is feasible for a field of differences, not for a number."""


def validate_weight(weight: float) -> float:
    """Return a regularisation weight, refusing what is none."""
    if not (np.isfinite(weight) and weight >= 0):
        raise InputError(f"a regularisation weight must be finite and not negative, got {weight}")
    return float(weight)


STEP_GROWTH = 1.1
"""From one iteration to the next a step grows at most by this factor."""

STEP_MARGIN = 0.97
"""What steps keep to of the longest one that the last iteration would have allowed."""

STEP_RETREAT = 3.0
"""Factors of `STEP_GROWTH` that a refused step shrinks by."""

MAX_STEP_LEVEL = 40.0
"""Of the same factors: a step of 45 times the safe one, more than was ever of use."""

TINY = 1e-300


class Fista:
    """Minimise ``data(A h) + R(h)`` for a block of frames at once.

    A. Beck, M. Teboulle, SIAM J. Imaging Sci. 2, 183 (2009); a step that would raise a frame's
    objective is refused and that frame's momentum starts anew (B. O'Donoghue, E. Candes, Found.
    Comput. Math. 15, 715 (2015)). ``A z`` at the extrapolated point is had from the last two ``A
    h`` by linearity, so a step costs one product each way. Everything stays where the data term's
    measurements are, and no step waits for a device.

    Each frame has a step size of its own. A step t from z to h is as safe as the shortest one as
    long as ``t |A (h - z)|^2 <= |h - z|^2``, and differences of a few pixels are shrunk by A much
    more than a uniform picture is: steps grow while that holds, to 3 to 6 times the safe one, and
    the momentum follows their ratio (L. Calatroni, A. Chambolle, SIAM J. Optim. 29, 1772 (2019)).
    Two thirds of the iterations lead as far.

    Parameters
    ----------
    operator : LinearOperator
        A.
    data_term : DataTerm
    regulariser : Regulariser
    step_size : float
        The safe one, at most 1 over the largest eigenvalue of A'A.
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
        self._level = namespace(self.objective).zeros_like(self.objective)
        self._level_before = self._level
        self.rejected = self._age < 1

    def start_from(self, pictures: Array) -> None:
        """Begin at these pictures instead of at darkness.

        Parameters
        ----------
        pictures : (rows, columns, frames) array
            Not negative.
        """
        xp = namespace(pictures)
        self.seen = self.operator(pictures)
        self._seen_before = self.seen * 1
        # a step of length zero leaves them as they are and says what the prior thinks of them
        still = xp.astype(xp.zeros_like(self.objective), pictures.dtype)
        step = self.regulariser.proximal_step(
            pictures, pictures * 1, still, xp.zeros_like(pictures), still
        )
        self.current, self.previous = pictures, step.picture
        self.objective = self.data_term.value(self.seen) + step.penalty

    @property
    def step_sizes(self) -> Array:
        """Of the next step, (frames,) float64."""
        return self.step_size * namespace(self._level).exp(self._level * log(STEP_GROWTH))

    def step(self) -> None:
        """Advance every frame by one iteration."""
        xp, loops = namespace(self.current), select_loops(self.current)
        sizes = self.step_sizes
        shrunk = xp.exp((self._level_before - self._level) * log(STEP_GROWTH))
        # Beck and Teboulle, Eq. 4.2, with the ratio of the last two steps; the momentum is that of
        # Eq. 4.3
        age = (1 + xp.sqrt(1 + 4 * shrunk * self._age**2)) / 2
        momentum = xp.astype((self._age - 1) / age, self.current.dtype)
        # A z by linearity, from products that are known already
        predicted = self.seen + momentum * (self.seen - self._seen_before)
        gradient = self.operator.adjoint(self.data_term.gradient(predicted))
        candidate, penalty, distance = self.regulariser.proximal_step(
            self.current,
            self.previous,
            momentum,
            gradient,
            xp.astype(sizes, self.current.dtype),
        )
        seen = self.operator(candidate)
        objective = self.data_term.value(seen) + penalty
        # Monotone variant: momentum may overshoot, and a frame that got worse keeps what it had.
        self.rejected = objective > self.objective
        if distance is not None:
            moved = self.data_term.squared_length(seen - predicted)
            level = self._choose_level(sizes * moved, distance)
            self._level_before = xp.where(self.rejected, level, self._level)
            self._level = level
        # Refused frames go back to where they were, and their momentum starts anew.
        candidate = loops.restore_frames(candidate, self.current, self.rejected)
        seen = loops.restore_frames(seen, self.seen, self.rejected)
        self.objective = xp.where(self.rejected, self.objective, objective)
        self._age = xp.where(self.rejected, 1.0, age)
        self.previous, self.current = self.current, candidate
        self._seen_before, self.seen = self.seen, seen

    def _choose_level(self, curvature: Array, distance: Array) -> Array:
        """Logarithm of the next step over the safe one, to the base of `STEP_GROWTH`, from the last
        one's ``t |A (h - z)|^2`` and ``|h - z|^2``.
        """
        xp = namespace(distance)
        # t |A (h - z)|^2 / |h - z|^2 is at most 1 for a step that is surely safe; what is left
        # below STEP_MARGIN may be used by a longer one.
        used = clip_values(curvature, TINY) / clip_values(distance, TINY)
        room = clip_values((log(STEP_MARGIN) - xp.log(used)) / log(STEP_GROWTH), highest=1.0)
        # a frame that stands still says nothing about its step
        room = xp.where(distance > 0, room, xp.zeros_like(room))
        level = self._level + xp.where(self.rejected, -STEP_RETREAT * xp.ones_like(room), room)
        return clip_values(level, 0.0, MAX_STEP_LEVEL)

    def duality_gap(self) -> Array | None:
        """Return how far each frame's objective is above the least one at most, (frames,) float64.

        From the dual point that belongs to the residual (E. Ndiaye, O. Fercoq, A. Gramfort, J.
        Salmon, J. Mach. Learn. Res. 18, 1 (2017)), for one product with the adjoint. None for priors
        and data terms whose dual is not known.
        """
        slope = self.data_term.gradient(self.seen)
        scale = self.regulariser.scale_dual(-self.operator.adjoint(slope))
        bound = None if scale is None else self.data_term.dual_value(slope, scale)
        return None if bound is None else self.objective - bound


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
    gap : float
        A block is done as soon as every frame's objective is above the least one by at most this
        fraction of it, as the duality gap says, for priors that have one; 0: never.
    further : int
        Iterations that may follow for blocks whose objective still falls, see `StoppingRule`.
    noise_fall : float
        Fall of the objective in an iteration, relative, below which a block of little more than noise
        is done, see `StoppingRule`.

    Attributes
    ----------
    name : str
    portable : bool
        Whether arrays of any library are taken, or NumPy's only.
    """

    weight: float
    iterations: int
    tolerance: float = 0.0
    data_term: DataTermMaker = LeastSquares
    gap: float = 1e-3
    further: int = 0
    noise_fall: float = 0.0
    name = ""
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
        start: Array | None = None,
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
        start : (frames, rows, columns) array, optional
            Pictures to begin at, such as those of the shot before; dark ones by default.

        Returns
        -------
        Result
            Frames (frames, rows, columns) and the history of the objective.

        Raises
        ------
        ShapeError
            `measurements`, `valid` or `start` do not fit the operator.
        InputError
            A measurement is NaN or infinite, or the arrays are not NumPy's and the prior is not
            portable.
        """
        if start is not None and start.shape != (measurements.shape[1], *operator.shape_in):
            raise ShapeError(
                "pictures to begin at", (measurements.shape[1], *operator.shape_in), start.shape
            )
        if not self.portable:
            require_numpy(f"recovery with the prior {type(self).__name__}", measurements)
        # Blocks share the cores already, and a lone picture's products are too small to share.
        with limit_blas_threads():
            return self._recover_batches(
                operator,
                validate_measurements(operator, measurements, valid),
                valid,
                progress,
                start,
            )

    def _recover_batches(
        self,
        operator: LinearOperator,
        measurements: Array,
        valid: Mask,
        progress: Progress,
        start: Array | None,
    ) -> Result:
        stopping = StoppingRule(
            self.iterations, self.tolerance, self.gap, self.further, self.noise_fall
        )
        started = time.perf_counter()
        step = 1 / (NORM_MARGIN * operator.squared_norm)
        batches = make_batches(operator, measurements)
        # a lone picture has the calling thread to itself; after a shot before all is there
        if measurements.shape[1] > 1 and start is None:
            self._warm_up_loops(operator, step, batches.zero_measurements())
        setup_seconds = time.perf_counter() - started
        zero = self._look_at_zero(operator, batches, measurements, valid)
        # with max(A'f) as weight the l1 solution is zero: relative weights suit shots of any
        # brightness
        weight = self.weight * zero.peak
        # most frames of most shots see nothing: they cost no iteration
        dark = zero.pulls <= self._make_regulariser(weight).zero_bound
        batches.leave_out(dark)
        progress(self.work(int(dark.sum())))
        histories: dict[int, IterationHistory] = {}

        def solve(piece: slice) -> None:
            trusted = None if valid is None else batches.take_block(valid, piece)
            data = self.data_term(batches.take_block(measurements, piece), trusted)
            solver = Fista(
                operator, data, self._make_regulariser(weight), step, data.measurements.shape[1]
            )
            if start is not None:
                begun = batches.take_block(_list_pixels(start), piece)
                solver.start_from(
                    namespace(begun).reshape(begun, (*operator.shape_in, begun.shape[-1]))
                )
            histories[piece.start] = iterate(solver, stopping, progress, piece.stop - piece.start)
            batches.write_block(solver.current, piece)

        batches.for_each_piece(solve)
        in_order = [histories[start] for start in sorted(histories)]
        still = IterationHistory(zero.values[dark].sum(keepdims=True), True, 0.0)
        return Result.from_blocks(batches.frames, [still, *in_order], setup_seconds)

    def _look_at_zero(
        self, operator: LinearOperator, batches: Batches, measurements: Array, valid: Mask
    ) -> _ZeroPictures:
        """Find what the data term makes of pictures of nothing."""
        zero = _ZeroPictures(batches.frames.shape[0])

        def look(piece: slice) -> None:
            size = piece.stop - piece.start
            block = batches.take_block(measurements, piece)
            trusted = None if valid is None else batches.take_block(valid, piece)
            least_squares = LeastSquares(block, trusted)
            nothing = namespace(block).zeros_like(block)
            back = operator.adjoint(-least_squares.gradient(nothing))
            highest = _max_of_frames(back)[:size]
            zero.peaks[piece] = highest
            if self.data_term is LeastSquares:
                zero.pulls[piece] = highest
                zero.values[piece] = to_numpy(least_squares.value(nothing))[:size]
            else:
                data = self.data_term(block, trusted)
                zero.pulls[piece] = _max_of_frames(operator.adjoint(-data.gradient(nothing)))[:size]
                zero.values[piece] = to_numpy(data.value(nothing))[:size]

        batches.for_each_piece(look)
        return zero

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
        return frames * (self.iterations + self.further)


@dataclass(frozen=True)
class Sparse(ProximalMethod):
    """Nonnegative pictures with few bright pixels (l1): right for single time bins of a ToF scene."""

    weight: float = 2e-3
    iterations: int = 40
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
        from tofclip.solvers.priors import NonnegativeWavelets

        return NonnegativeWavelets(weight)


class _ZeroPictures:
    """What is known about pictures of nothing, frame by frame.

    `peaks` (frames,): largest value of A'f; `pulls` (frames,): largest value of the data term's
    negative gradient; `values` (frames,): the data term.
    """

    def __init__(self, frames: int) -> None:
        self.peaks, self.pulls, self.values = np.zeros((3, frames))

    @property
    def peak(self) -> float:
        """Largest value of A'f: the weight at which the sparsest nonnegative solution is zero."""
        peak = float(self.peaks.max())
        if peak <= 0:
            raise InputError(
                "no view sees anything positive; was too high a background subtracted?"
            )
        return peak


def _list_pixels(pictures: Array) -> Array:
    """Return pictures (frames, ...) as (pixels, frames), the way of measurements."""
    xp = namespace(pictures)
    return xp.moveaxis(xp.reshape(pictures, (pictures.shape[0], -1)), 0, -1)


def _max_of_frames(pictures: Array) -> NDArray[np.float64]:
    xp = namespace(pictures)
    for _ in range(
        pictures.ndim - 1
    ):  # one after the other: NumPy takes five times as long at once
        pictures = xp.max(pictures, axis=0)
    return to_numpy(pictures).astype(np.float64)
