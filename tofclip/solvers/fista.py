"""Recovery with a prior by FISTA: the algorithm, the methods that apply it to a batch of frames, and the
weight of a prior, chosen by how well measurements are predicted that the recovery has not seen.

Minimises ``data(A h) + weight * R(h)`` over h >= 0 for each frame, R being a prior of
`tofclip.solvers.priors`.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from math import log
from typing import ClassVar, Self

import numpy as np

from tofclip.arrays import (
    Array,
    BoolArray,
    FloatArray,
    clip_values,
    is_numpy,
    namespace,
    require_numpy,
    to_numpy,
    zeros,
)
from tofclip.errors import require, require_shape
from tofclip.operators import LinearOperator
from tofclip.solvers.data_terms import DataTerm, DataTermMaker, LeastSquares, Mask
from tofclip.solvers.methods import (
    Blocks,
    IterationHistory,
    Method,
    Progress,
    Result,
    StoppingRule,
    ignore_progress,
    iterate,
    validate_measurements,
)
from tofclip.solvers.priors import (
    TINY,
    NonnegativeLightFieldVariation,
    NonnegativeSparsity,
    NonnegativeTotalVariation,
    NonnegativeWavelets,
    Regulariser,
)
from tofclip.threads import LANES, limit_blas_threads, map_parallel

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

    `operator` is A, `step_size` the safe one, at most 1 over the largest eigenvalue of A'A, `frames` the
    number of frames of the block. `current` (rows, columns, frames), with a light field's model (views,
    rows, columns, frames), is the solution so far; `objective` and `rejected` (frames,) say how good it is
    and which frames' last step was refused.
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
        self.objective = data_term.value(self.seen)
        self._age = namespace(self.objective).ones_like(self.objective)
        self._level = namespace(self.objective).zeros_like(self.objective)
        self._level_before = self._level
        self.rejected = self._age < 1

    def start_from(self, pictures: Array) -> None:
        """Begin at these `pictures`, (rows, columns, frames), not negative, not at darkness."""
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
        step = xp.astype(sizes, self.current.dtype)
        candidate, penalty, distance = self.regulariser.proximal_step(
            self.current, self.previous, momentum, gradient, step
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
class ProximalMethod(Method):
    """FISTA with a prior; what the prior is, subclasses say.

    Its `weight` is relative to the largest value of ``A'f`` over all frames: at 1 the sparsest solution,
    zero, is reached; the scale of the measurements does not matter. `iterations`, `tolerance`, `gap`,
    `further` and `noise_fall` say when a block of frames is done, see `StoppingRule`; what a block is
    depends on the arrays (`Blocks`), and with it when its frames are done. `data_term` is what a misfit
    costs.
    """

    weight: float
    iterations: int
    tolerance: float = 0.0
    data_term: DataTermMaker = LeastSquares
    gap: float = 1e-3
    further: int = 0
    noise_fall: float = 0.0

    prior: ClassVar[Callable[..., Regulariser]]

    def _make_regulariser(self, weight: float) -> Regulariser:
        """Make the prior for one block with an absolute weight."""
        return type(self).prior(weight)

    @property
    def has_prior(self) -> bool:
        return True

    def with_data_term(self, data_term: DataTermMaker) -> Self:
        """Return this method with another misfit, if it has least squares."""
        return replace(self, data_term=data_term) if self.data_term is LeastSquares else self

    def scale_weight(self, factor: float) -> Self:
        return replace(self, weight=self.weight * factor)

    # Blocks share the cores already, and a lone picture's products are too small to share.
    @limit_blas_threads()
    def recover(
        self,
        operator: LinearOperator,
        measurements: Array,
        valid: Mask = None,
        progress: Progress = ignore_progress,
        start: Array | None = None,
    ) -> Result:
        """Recover one picture per column of `measurements`, see `Method.recover`; `start` are
        pictures to begin at, (frames, rows, columns), such as those of the shot before: dark ones
        by default.
        """
        if start is not None:
            pictures = measurements.shape[1], *operator.shape_in
            require_shape("pictures to begin at", pictures, start.shape)
        if not self.portable:
            require_numpy(f"recovery with the prior {type(self).__name__}", measurements)
        measurements = validate_measurements(operator, measurements, valid)
        settings = self.iterations, self.tolerance, self.gap, self.further, self.noise_fall
        stopping = StoppingRule(*settings)
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
        require(
            peaks.max() > 0, "no view sees anything positive; was too high a background subtracted?"
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
    ) -> FloatArray:
        """What is known of pictures of nothing, (3, frames): the largest value of A'f, that of the data
        term's negative gradient, and the data term.
        """
        known = np.zeros((3, measurements.shape[1]))

        def look(piece: slice) -> None:
            size = piece.stop - piece.start
            block = blocks.take(measurements, piece)
            trusted = None if valid is None else blocks.take(valid, piece)
            nothing = namespace(block).zeros_like(block)

            def pull(data: DataTerm) -> FloatArray:
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
    prior = NonnegativeSparsity


@dataclass(frozen=True)
class TotalVariation(ProximalMethod):
    """Nonnegative pictures with sharp borders between even surfaces (isotropic total variation)."""

    weight: float = 1e-3
    iterations: int = 60
    name = "tv"
    portable = True
    prior = NonnegativeTotalVariation


@dataclass(frozen=True)
class LightFieldVariation(ProximalMethod):
    """Nonnegative light fields with sharp borders, views alike (4D total variation; Eq. 20)."""

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
    prior = NonnegativeWavelets


INITIAL_WEIGHT = 10**-1.75  # relative weight that is tried first
WEIGHT_RATIO = 10**0.375  # between one trial and the next
MAX_TRIALS = 10  # from the first weight this reaches three decades up or down
FOLD_COUNT, FOLD_SEED = 8, 0  # parts of the measurements; each is predicted from the other seven
# Runs of measurements of which one fold alone is a fair sample: the others are not tried.
SINGLE_FOLD_RUNS = 4096
# Recoveries that a choice of a weight takes at most, and that it reports when it is done.
MAX_WEIGHT_WORK = MAX_TRIALS * FOLD_COUNT


@dataclass(frozen=True)
class WeightChoice:
    """The weights tried and what their recoveries failed to predict."""

    weight: float  # the best, between those tried
    # (trials,), value of the data term on the measurements held out, all folds together, by the
    # weights that were tried, ascending
    errors: FloatArray


def choose_weight(
    method: ProximalMethod,
    operator: LinearOperator,
    measurements: Array,
    run: int,
    progress: Progress = ignore_progress,
    first: float = INITIAL_WEIGHT,
    max_folds: int = FOLD_COUNT,
) -> WeightChoice:
    """Choose the weight at which measurements left out of the recovery are predicted best
    (eight-fold cross-validation).

    No noise level and no true picture are needed, which is why this is taken instead of the
    discrepancy principle or SURE: what F(d) cannot explain (surfaces out of focus) is not noise of
    a known strength, and generalised cross-validation takes it for signal. Trials go downhill from
    the first weight until the minimum is bracketed; a parabola in the weight's logarithm refines
    it.

    `measurements` (measurements,) are of one picture; `run` consecutive ones are left out together:
    neighbours on a detector hardly differ, so that single ones would be predicted by their neighbours'
    errors. The method's own weight does not matter. `progress` is called with the number of recoveries
    just done, of `MAX_WEIGHT_WORK`; those that are not needed count as done at the end. With fewer than
    eight folds it takes less time and knows the error less well.
    """
    require_numpy("the choice of a prior's weight", measurements)
    held = assign_folds(measurements.size, run, FOLD_SEED)[:, :max_folds]
    parts = np.split(held, held.shape[1], axis=1)
    column = measurements[:, np.newaxis]

    def unpredicted(trial: ProximalMethod, out: BoolArray) -> float:
        # Recovered without the measurements of this fold, judged by them alone.
        picture = trial.recover(operator, column, ~out).frames[0]
        progress(FOLD_COUNT // len(parts))
        return float(trial.data_term(column, out).value(operator(picture)[:, np.newaxis])[0])

    def error(weight: float) -> float:
        # the compiled loops of one picture keep one core busy and release the interpreter
        return sum(map_parallel(partial(unpredicted, replace(method, weight=weight)), parts))

    choice = _search_downhill(error, first)
    done = choice.errors.size * (FOLD_COUNT // len(parts)) * len(parts)
    progress(MAX_WEIGHT_WORK - done)
    return choice


def assign_folds(count: int, run: int, seed: int) -> BoolArray:
    """Assign runs of consecutive measurements to folds at random: (count, folds), True where a
    measurement is left out of a fold that is tried.
    """
    # Too few runs for the folds: shorter ones, although neighbours then know more of each other.
    if -(-count // run) < FOLD_COUNT:
        run = max(1, count // FOLD_COUNT)
    runs = -(-count // run)
    require(
        runs >= 2,
        "one measurement alone cannot choose its own prior's weight; give the weight as a number",
    )
    dealt = np.random.default_rng(seed).permutation(runs) % min(FOLD_COUNT, runs)
    # This many runs in one fold already give the error to a few percent.
    used = 1 if runs >= SINGLE_FOLD_RUNS else min(FOLD_COUNT, runs)
    return np.repeat(dealt, run)[:count, np.newaxis] == np.arange(used)


def _search_downhill(error: Callable[[float], float], first: float) -> WeightChoice:
    """Try weights up or down from `first`, whichever lowers the error, until it rises again."""
    # On a logarithmic axis the error has one valley: two trials say which way it goes down.
    errors = {step: error(first * WEIGHT_RATIO**step) for step in (0, 1)}
    direction = 1 if errors[1] < errors[0] else -1
    while len(errors) < MAX_TRIALS:
        best = min(errors, key=errors.__getitem__)
        if best + direction in errors:
            break
        errors[best + direction] = error(first * WEIGHT_RATIO ** (best + direction))
    steps = np.array(sorted(errors), float)
    values = np.array([errors[step] for step in sorted(errors)])
    number = int(np.argmin(values))
    lowest = steps[number]
    if 0 < number < steps.size - 1:
        # The minimum of the parabola through three trials lies between the tried weights.
        left, middle, right = values[number - 1 : number + 2]
        lowest += 0.5 * (left - right) / (left - 2 * middle + right)
    return WeightChoice(float(first * WEIGHT_RATIO**lowest), values)
