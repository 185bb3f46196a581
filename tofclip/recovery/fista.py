"""The fast iterative shrinkage-thresholding algorithm with monotone restart, one decision per frame."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tofclip.operators import LinearOperator
from tofclip.recovery.data_terms import DataTerm
from tofclip.recovery.proximal import Regulariser


class Fista:
    """Minimise ``data(A h) + R(h)`` for a block of frames at once.

    A. Beck, M. Teboulle, SIAM J. Imaging Sci. 2, 183 (2009); a step that would raise a frame's objective is refused
    and that frame's momentum starts anew (B. O'Donoghue, E. Candes, Found. Comput. Math. 15, 715 (2015)). ``A z`` at
    the extrapolated point is had from the last two ``A h`` by linearity, so a step costs one product each way.

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
    refused : (frames,) bool array
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
        self.current = np.zeros((*operator.shape_in, frames), operator.dtype)
        self.previous = np.zeros_like(self.current)
        self.seen = np.zeros((*operator.shape_out, frames), operator.dtype)
        self._seen_before = np.zeros_like(self.seen)
        self.objective: NDArray[np.float64] = data_term.value(self.seen)
        self.refused = np.zeros(frames, bool)
        self._age = np.ones(frames)

    def step(self) -> None:
        """Advance every frame by one iteration."""
        age = (1 + np.sqrt(1 + 4 * self._age**2)) / 2
        momentum = ((self._age - 1) / age).astype(self.operator.dtype)
        predicted = self.seen + momentum * (self.seen - self._seen_before)
        gradient = self.operator.adjoint(self.data_term.gradient(predicted))
        candidate = self.previous
        penalty = self.regulariser.descend(self.current, candidate, momentum, gradient, self.step_size)
        seen = self.operator(candidate)
        objective = self.data_term.value(seen) + penalty
        self.refused = objective > self.objective
        if self.refused.any():
            self._refuse(candidate, seen, objective, age)
        self.previous, self.current = self.current, candidate
        self._seen_before, self.seen = self.seen, seen
        self.objective, self._age = objective, age

    def _refuse(
        self,
        candidate: NDArray[np.floating],
        seen: NDArray[np.floating],
        objective: NDArray[np.float64],
        age: NDArray[np.float64],
    ) -> None:
        """Put the refused frames back to where they were and let their momentum start anew."""
        from tofclip.recovery.kernels import put_back

        flat = (-1, *candidate.shape[-2:])
        put_back(candidate.reshape(flat), self.current.reshape(flat), self.refused.astype(self.operator.dtype))
        seen[..., self.refused] = self.seen[..., self.refused]
        objective[self.refused] = self.objective[self.refused]
        age[self.refused] = 1
