"""What every method that turns measurements into pictures has in common, and FISTA with its priors.

A method holds its settings and has one `recover`. It takes NumPy arrays; those that are `portable`
take the arrays of any library that follows the array API standard as well, and return the same kind,
on the same device. Memory beyond the result is bounded: frames are worked on in `Blocks`.

FISTA minimises ``data(A h) + weight * R(h)`` over h >= 0 for each frame, R being a prior of
`tofclip.solvers.priors`.
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from math import log, prod
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from tofclip.arrays import (
    Array,
    as_type,
    clip_values,
    is_numpy,
    namespace,
    require_numpy,
    to_numpy,
    zeros,
)
from tofclip.errors import InputError, ShapeError
from tofclip.operators import LinearOperator
from tofclip.solvers.data_terms import DataTerm, DataTermMaker, LeastSquares, Mask
from tofclip.solvers.priors import (
    TINY,
    NonnegativeLightFieldVariation,
    NonnegativeSparsity,
    NonnegativeTotalVariation,
    NonnegativeWavelets,
    Regulariser,
)
from tofclip.threads import LANES, limit_blas_threads, run_blocks, split_blocks

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
        for name in ("tolerance", "gap", "noise_fall"):
            value = getattr(self, name)
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
        noisy = last > NOISE_FRACTION * objective[0]
        return bool(noisy & (before - last < self.noise_fall * last))

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

        Returns
        -------
        Result
            Frames (frames, rows, columns) and how they came about.

        Raises
        ------
        ShapeError
            `measurements` or `valid` do not fit the operator.
        InputError
            A measurement is NaN or infinite, or the arrays are not NumPy's and the method is not
            portable.
        """

    def work(self, frames: int) -> int:
        """Return how many frame iterations `recover` reports at most.

        Parameters
        ----------
        frames : int
        """
        return frames


def relative_residual(
    operator: LinearOperator, frames: Array, measurements: Array, valid: Mask = None
) -> float:
    """``|A h - f| / |f|`` over all good measurements of all frames.

    Parameters
    ----------
    operator : LinearOperator
    frames : (frames, rows, columns) array
    measurements : (measurements, frames) array
    valid : (measurements, frames) bool array, optional

    Returns
    -------
    float

    Raises
    ------
    InputError
        Every valid measurement is zero.
    """
    # Block by block: predictions of all frames at once would double the memory.
    misfit = energy = 0.0
    xp = namespace(frames, measurements)
    for piece in split_blocks(frames.shape[0], frames_per_block(operator, measurements)):
        seen = measurements[:, piece]
        mask = 1.0 if valid is None else xp.astype(valid[:, piece], seen.dtype)
        residual = (operator(xp.moveaxis(frames[piece, ...], 0, -1)) - seen) * mask
        misfit += float(xp.sum(residual**2, dtype=xp.float64))
        energy += float(xp.sum((seen * mask) ** 2, dtype=xp.float64))
    if energy == 0:
        raise InputError("every valid measurement is zero; there is nothing to compare with")
    return float(np.sqrt(misfit / energy))


def validate_measurements(operator: LinearOperator, measurements: Array, valid: Mask) -> Array:
    """Return (measurements, frames) values contiguous and in the operator's type, refusing wrong
    shapes, NaN and infinity.
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


WORKING_BYTES = 1 << 31  # what a solver may take for the frames that it works on at once
# Arrays of the frames' size that total variation, which needs most, has at once: solution, dual,
# gradient and their temporaries.
WORKING_PICTURES = 16


def frames_per_block(operator: LinearOperator, measurements: Array) -> int:
    """`LANES` for NumPy's (measurements, frames), or one if it is alone; for others as many as
    `WORKING_BYTES` hold.
    """
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

    def leave_out(self, dark: NDArray[np.bool_]) -> None:
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


STEP_GROWTH = 1.1  # from one iteration to the next a step grows at most by this factor
STEP_MARGIN = 0.97  # of the longest step that the last iteration would have allowed
STEP_RETREAT = 3.0  # factors of `STEP_GROWTH` that a refused step shrinks by
MAX_STEP_LEVEL = 40.0  # such factors: 45 times the safe step, more than was ever of use


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
        xp = namespace(self.current)
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
        candidate = _restore(candidate, self.current, self.rejected)
        seen = _restore(seen, self.seen, self.rejected)
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


def _restore(values: Array, before: Array, rejected: Array) -> Array:
    """The frames that are `rejected` as they were before, without asking a device whether any is."""
    if not is_numpy(values):
        return namespace(values).where(rejected, before, values)
    if rejected.any():
        values[..., rejected] = before[..., rejected]
    return values


NORM_MARGIN = 1.02  # 15 Lanczos iterations may lack so much of the norm; a test checks every camera


@dataclass(frozen=True)
class ProximalMethod(Method, ABC):
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
        depends on the arrays (`Blocks`), and with it when its frames are done.
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
    """

    weight: float
    iterations: int
    tolerance: float = 0.0
    data_term: DataTermMaker = LeastSquares
    gap: float = 1e-3
    further: int = 0
    noise_fall: float = 0.0

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
        """Recover one picture per column of `measurements`; see `Method.recover`.

        Parameters
        ----------
        operator, measurements, valid, progress
            As there.
        start : (frames, rows, columns) array, optional
            Pictures to begin at, such as those of the shot before; dark ones by default.
        """
        expected = (measurements.shape[1], *operator.shape_in)
        if start is not None and start.shape != expected:
            raise ShapeError("pictures to begin at", expected, start.shape)
        if not self.portable:
            require_numpy(f"recovery with the prior {type(self).__name__}", measurements)
        measurements = validate_measurements(operator, measurements, valid)
        # Blocks share the cores already, and a lone picture's products are too small to share.
        with limit_blas_threads():
            return self._recover(operator, measurements, valid, progress, start)

    def _recover(
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
        blocks = Blocks(operator, measurements)
        # A lone picture has the calling thread to itself; after a shot before all is there. Else one
        # step on a dark block loads the compiled loops, and brings the operator's matrix to where the
        # measurements are, before the first thread comes.
        if measurements.shape[1] > 1 and start is None:
            lanes = LANES if is_numpy(measurements) else 1
            nothing = LeastSquares(zeros((measurements.shape[0], lanes), measurements))
            first = Fista(operator, nothing, self._make_regulariser(1.0), step, lanes)
            first.step()
            blocks.write(first.current, slice(0, 1))
        setup_seconds = time.perf_counter() - started
        peaks, pulls, values = self._look_at_zero(operator, blocks, measurements, valid)
        if not peaks.max() > 0:
            raise InputError(
                "no view sees anything positive; was too high a background subtracted?"
            )
        # With max(A'f) as weight the l1 solution is zero: relative weights suit shots of any
        # brightness.
        weight = self.weight * float(peaks.max())
        # most frames of most shots see nothing: they cost no iteration
        dark = pulls <= self._make_regulariser(weight).zero_bound
        blocks.leave_out(dark)
        progress(self.work(int(dark.sum())))
        histories: dict[int, IterationHistory] = {}

        def solve(piece: slice) -> None:
            trusted = None if valid is None else blocks.take(valid, piece)
            data = self.data_term(blocks.take(measurements, piece), trusted)
            frames = data.measurements.shape[1]
            solver = Fista(operator, data, self._make_regulariser(weight), step, frames)
            if start is not None:
                xp = namespace(start)
                pixels = xp.moveaxis(xp.reshape(start, (start.shape[0], -1)), 0, -1)
                begun = blocks.take(pixels, piece)
                solver.start_from(xp.reshape(begun, (*operator.shape_in, frames)))
            histories[piece.start] = iterate(solver, stopping, progress, piece.stop - piece.start)
            blocks.write(solver.current, piece)

        blocks.for_each(solve)
        still = IterationHistory(values[dark].sum(keepdims=True), True, 0.0)
        in_order = [histories[first] for first in sorted(histories)]
        return Result.from_blocks(blocks.frames, [still, *in_order], setup_seconds)

    def _look_at_zero(
        self, operator: LinearOperator, blocks: Blocks, measurements: Array, valid: Mask
    ) -> NDArray[np.float64]:
        """What is known of pictures of nothing, (3, frames): the largest value of A'f, that of the data
        term's negative gradient, and the data term.
        """
        known = np.zeros((3, measurements.shape[1]))

        def look(piece: slice) -> None:
            size = piece.stop - piece.start
            block = blocks.take(measurements, piece)
            trusted = None if valid is None else blocks.take(valid, piece)
            nothing = namespace(block).zeros_like(block)

            def pull(data: DataTerm) -> NDArray[np.float64]:
                back = operator.adjoint(-data.gradient(nothing))
                for _ in operator.shape_in:  # NumPy takes five times as long for all axes at once
                    back = namespace(back).max(back, axis=0)
                return to_numpy(back)[:size]

            data: DataTerm = LeastSquares(block, trusted)
            known[:2, piece] = pull(data)
            if self.data_term is not LeastSquares:
                data = self.data_term(block, trusted)
                known[1, piece] = pull(data)
            known[2, piece] = to_numpy(data.value(nothing))[:size]

        blocks.for_each(look)
        return known

    def work(self, frames: int) -> int:
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
class LightFieldVariation(ProximalMethod):
    """Nonnegative light fields with sharp borders, their views alike (4D total variation;
    supplement Eq. 20).
    """

    weight: float = 1e-2
    iterations: int = 200
    grid: tuple[int, int] = (1, 1)  # views down and across
    # How much a difference between neighbouring views counts beside one between neighbouring pixels.
    # Views differ by their parallax: 0.5 suits disparities of about a pixel, more suits less.
    angular: float = 0.5
    name = "light-field tv"

    def _make_regulariser(self, weight: float) -> Regulariser:
        return NonnegativeLightFieldVariation(weight, self.grid, self.angular)


@dataclass(frozen=True)
class Wavelets(ProximalMethod):
    """Nonnegative pictures with few details at every scale (Daubechies 4, cycle spinning)."""

    weight: float = 2e-3
    iterations: int = 60
    name = "wavelet"

    def _make_regulariser(self, weight: float) -> Regulariser:
        return NonnegativeWavelets(weight)
