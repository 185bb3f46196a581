"""The loop around a solver: how long it runs, what it remembers, and why it stopped."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from tofclip.arrays import Array, namespace, to_numpy
from tofclip.errors import InputError

Progress = Callable[[int], None]
"""Called with the number of frame iterations just done; may raise to interrupt."""


def ignore_progress(_: int) -> None:
    """Report nothing."""


@dataclass(frozen=True)
class StoppingRule:
    """When a block of frames is done.

    Parameters
    ----------
    iterations : int
        At most so many.
    tolerance : float
        Stop as soon as the block's objective changes by less than this fraction in an iteration in
        which no frame's step was refused. 0 runs all iterations.
    """

    iterations: int
    tolerance: float = 0.0

    def __post_init__(self) -> None:
        if self.iterations < 1:
            raise InputError(f"at least one iteration is needed, got {self.iterations}")
        if not (np.isfinite(self.tolerance) and self.tolerance >= 0):
            raise InputError(f"tolerance must be finite and not negative, got {self.tolerance}")


class IterativeSolver(Protocol):
    """What the loop needs to know of a solver."""

    objective: Array
    rejected: Array

    def step(self) -> None:
        """Advance by one iteration."""
        ...


@dataclass(frozen=True)
class IterationHistory:
    """What a run left behind.

    Parameters
    ----------
    objective : (iterations + 1,) array
        Sum over the frames before the first and after every iteration.
    converged : bool
        Whether the tolerance ended it.
    """

    objective: NDArray[np.float64]
    converged: bool

    @property
    def iterations(self) -> int:
        """Iterations done."""
        return self.objective.size - 1


def iterate(
    solver: IterativeSolver, stopping: StoppingRule, progress: Progress, frames: int
) -> IterationHistory:
    """Run `solver` until `stopping` says that it is done.

    A device is waited for once in an iteration if there is a tolerance, and not at all if there is
    none.
    """
    xp = namespace(solver.objective)
    objective = [xp.sum(solver.objective)]
    converged = False
    for done in range(stopping.iterations):
        solver.step()
        objective.append(xp.sum(solver.objective))
        if stopping.tolerance > 0:
            little = objective[-2] - objective[-1] < stopping.tolerance * objective[-1]
            converged = bool(little & ~xp.any(solver.rejected))
        if converged:
            progress(frames * (stopping.iterations - done))
            break
        progress(frames)
    return IterationHistory(to_numpy(xp.stack(objective)), converged)


@dataclass(frozen=True)
class Result:
    """Recovered pictures and how they came about.

    Parameters
    ----------
    frames : (frames, rows, columns) array
        Where the readings were.
    iterations : int
        Of the block that took most; 0 for direct methods.
    objective : (iterations + 1,) array
        Sum over all frames; blocks that stopped early count with their last value. Empty for direct
        methods.
    stop_reason : str
        ``"converged"``, ``"iteration limit"`` or ``"direct method"``.
    setup_seconds : float
        Time spent on what depends on the operator only and on loading compiled loops, not on the
        readings.
    """

    frames: Array
    iterations: int = 0
    objective: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))
    stop_reason: str = "direct method"
    setup_seconds: float = 0.0

    @classmethod
    def from_blocks(
        cls, frames: Array, histories: list[IterationHistory], setup_seconds: float = 0.0
    ) -> Result:
        """Join the histories of all blocks."""
        longest = max(history.iterations for history in histories)
        total = np.zeros(longest + 1)
        for history in histories:
            kept_on = np.full(longest - history.iterations, history.objective[-1])
            total += np.concatenate([history.objective, kept_on])
        converged = all(history.converged for history in histories)
        return cls(
            frames, longest, total, "converged" if converged else "iteration limit", setup_seconds
        )
