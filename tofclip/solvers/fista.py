"""The fast iterative shrinkage-thresholding algorithm with monotone restart, one decision per
frame.
"""

from __future__ import annotations

from tofclip.arrays import Array, namespace, zeros
from tofclip.operators import LinearOperator
from tofclip.solvers.data_terms import DataTerm
from tofclip.solvers.loops import select_loops
from tofclip.solvers.proximal import Regulariser


class Fista:
    """Minimise ``data(A h) + R(h)`` for a block of frames at once.

    A. Beck, M. Teboulle, SIAM J. Imaging Sci. 2, 183 (2009); a step that would raise a frame's
    objective is refused and that frame's momentum starts anew (B. O'Donoghue, E. Candes, Found.
    Comput. Math. 15, 715 (2015)). ``A z`` at the extrapolated point is had from the last two ``A
    h`` by linearity, so a step costs one product each way. Everything stays where the data term's
    readings are, and no step waits for a device.

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
        age = (1 + xp.sqrt(1 + 4 * self._age**2)) / 2
        momentum = xp.astype((self._age - 1) / age, self.current.dtype)
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
