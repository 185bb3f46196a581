"""What does not change from shot to shot, made once in a process: operators and inverted matrices
of a camera. Sequences, streams and views share them.

Operators are known by what they project: two shots whose files carry the same camera share its own.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property, lru_cache
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import DTypeLike

from tofclip.arrays import BoolArray
from tofclip.camera import Camera
from tofclip.operators import LinearOperator, LineProjection
from tofclip.solvers import LinearInverse, PreparedInverse

# Frames at more shears than that make the further operators anew. Twice as many operators, so that
# one whose inverse is kept is kept as well.
MAX_CACHED_INVERSES, MAX_CACHED_OPERATORS = 16, 32

_inverse_lock = Lock()


class _CachedCamera(Camera):
    """A camera that is equal to others that project alike, with which it shares operators. Memory:
    for each of the operators 16 bytes for each of ``views * rows * columns * 2`` entries.
    """

    @cached_property
    def _projection(self) -> tuple[Any, ...]:
        lines = self.centres_px, self.angles, self.gains, self.view_positions
        return self.image_shape, self.slit_width_px, *(one.tobytes() for one in lines)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _CachedCamera) and self._projection == other._projection

    def __hash__(self) -> int:
        return hash(self._projection)

    def operator(self, shear: float = 0.0, dtype: DTypeLike = np.float32) -> LineProjection:
        """Return F(d), see `Camera.operator`; the same object for the same arguments."""
        return _make_operator(self, float(shear), np.dtype(dtype).str)


@lru_cache(maxsize=MAX_CACHED_OPERATORS)
def _make_operator(camera: _CachedCamera, shear: float, dtype: str) -> LineProjection:
    return Camera.operator(camera, shear, dtype)


def get_cached_camera(camera: Camera) -> Camera:
    """Return the camera with the operators that this process has kept of its content."""
    return _CachedCamera(**{one.name: getattr(camera, one.name) for one in fields(camera)})


@dataclass(frozen=True, repr=False)
class CachedInverse(LinearInverse):
    """The linear inverse, whose Gram matrices are inverted once for each operator of a camera that
    `get_cached_camera` returned; another one is not found again. The 16 used last are kept.
    """

    def __repr__(self) -> str:
        return repr(LinearInverse(self.damping))  # results say what was done, not what was kept

    def prepare(self, operator: LinearOperator, alive: BoolArray | None = None) -> PreparedInverse:
        """Do as `LinearInverse.prepare`; the same object for the same arguments."""
        known = np.ones(operator.shape_out, bool) if alive is None else alive
        with _inverse_lock:  # threads that ask at the same time wait for a single preparation
            return _prepare(self.damping, operator, known.tobytes())


@lru_cache(maxsize=MAX_CACHED_INVERSES)
def _prepare(damping: float, operator: Any, alive: bytes) -> PreparedInverse:
    return LinearInverse(damping).prepare(operator, np.frombuffer(alive, bool))
