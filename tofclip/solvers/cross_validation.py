"""The weight of a prior, chosen by how well measurements are predicted that the recovery has not
seen.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from tofclip.arrays import Array, require_numpy
from tofclip.errors import InputError
from tofclip.operators import LinearOperator
from tofclip.solvers.fista import ProximalMethod
from tofclip.solvers.methods import Progress, ignore_progress
from tofclip.threads import map_parallel

INITIAL_WEIGHT = 10**-1.75  # relative weight that is tried first
WEIGHT_RATIO = 10**0.375  # between one trial and the next
MAX_TRIALS = 10  # from the first weight this reaches three decades up or down
FOLD_COUNT = 8  # parts of the measurements; each is predicted from the other seven
# Runs of measurements of which one fold alone is a fair sample: the others are not tried.
SINGLE_FOLD_RUNS = 4096
# Recoveries that a choice of a weight takes at most, and that it reports when it is done.
MAX_WEIGHT_WORK = MAX_TRIALS * FOLD_COUNT


@dataclass(frozen=True)
class WeightChoice:
    """The weights tried and what their recoveries failed to predict."""

    weight: float  # the best, between those tried
    trial_weights: NDArray[np.float64]  # (trials,), ascending
    # (trials,), value of the data term on the measurements held out, all folds together
    errors: NDArray[np.float64]


def choose_weight(
    method: ProximalMethod,
    operator: LinearOperator,
    measurements: Array,
    run: int,
    seed: int = 0,
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
    held = assign_folds(measurements.size, run, seed)[:, :max_folds]
    parts = np.split(held, held.shape[1], axis=1)
    column = measurements[:, np.newaxis]

    def unpredicted(trial: ProximalMethod, out: NDArray[np.bool_]) -> float:
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


def assign_folds(count: int, run: int, seed: int) -> NDArray[np.bool_]:
    """Assign runs of consecutive measurements to folds at random: (count, folds), True where a
    measurement is left out of a fold that is tried.
    """
    # Too few runs for the folds: shorter ones, although neighbours then know more of each other.
    if -(-count // run) < FOLD_COUNT:
        run = max(1, count // FOLD_COUNT)
    runs = -(-count // run)
    if runs < 2:
        raise InputError(
            "one measurement alone cannot choose its own prior's weight; give the weight as a number"
        )
    dealt = np.random.default_rng(seed).permutation(runs) % min(FOLD_COUNT, runs)
    # This many runs in one fold already give the error to a few percent.
    used = 1 if runs >= SINGLE_FOLD_RUNS else min(FOLD_COUNT, runs)
    out: NDArray[np.bool_] = np.repeat(dealt, run)[:count, np.newaxis] == np.arange(used)
    return out


def _search_downhill(
    error: Callable[[float], float], first: float = INITIAL_WEIGHT
) -> WeightChoice:
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
    weights = first * WEIGHT_RATIO**steps
    return WeightChoice(float(first * WEIGHT_RATIO**lowest), weights, values)
