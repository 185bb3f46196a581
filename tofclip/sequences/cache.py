"""What does not change from shot to shot, made once in a process: operators and inverted matrices
of a camera. Sequences, streams and views share them.

Things are known by their content: two shots whose files carry the same camera share its operators.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, fields
from functools import cached_property, lru_cache
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import DTypeLike

from tofclip.arrays import Array, BoolArray, namespace, to_numpy
from tofclip.camera import Camera
from tofclip.operators import LinearOperator, LineProjection
from tofclip.solvers import (
    LinearInverse,
    Method,
    PreparedInverse,
    Progress,
    Result,
    ignore_progress,
)
from tofclip.storage import Record

# Frames at more shears than that make the further operators anew. Twice as many operators, so that
# one whose inverse is kept is kept as well.
MAX_CACHED_INVERSES, MAX_CACHED_OPERATORS = 16, 32

_inverse_lock = Lock()


class _CachedCamera(Camera):
    """A camera that is equal to others of its content, with which it shares operators. Memory: for
    each of the operators 16 bytes for each of ``views * rows * columns * 2`` entries.
    """

    @cached_property
    def _digest(self) -> str:
        return _hash_record(self.to_record())

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _CachedCamera) and self._digest == other._digest

    def __hash__(self) -> int:
        return hash(self._digest)

    def operator(self, shear: float = 0.0, dtype: DTypeLike = np.float32) -> LineProjection:
        """Return F(d), see `Camera.operator`; the same object for the same arguments."""
        return _make_operator(self, float(shear), np.dtype(dtype).str)


@lru_cache(maxsize=MAX_CACHED_OPERATORS)
def _make_operator(camera: _CachedCamera, shear: float, dtype: str) -> LineProjection:
    return Camera.operator(camera, shear, dtype)


def get_cached_camera(camera: Camera) -> Camera:
    """Return the camera with the operators that this process has kept of its content."""
    return _CachedCamera(**{one.name: getattr(camera, one.name) for one in fields(camera)})


def _hash_record(record: Record) -> str:
    """SHA-256 of a record's arrays and numbers, and of those inside it."""
    digest = hashlib.sha256()
    for name, field in sorted(record.fields.items()):
        values = np.ascontiguousarray(field.values)
        digest.update(f"{name} {values.dtype.str} {values.shape} {field.units}".encode())
        digest.update(values.tobytes())
    digest.update(repr(sorted(record.attributes.items())).encode())
    for name, child in sorted(record.children.items()):
        digest.update(f"{name} {_hash_record(child)}".encode())
    return digest.hexdigest()


def prepare_inverse(
    method: LinearInverse, operator: LinearOperator, alive: BoolArray
) -> PreparedInverse:
    """Return what `LinearInverse.prepare` does, the same object for the same arguments; the 16
    inverses used last are kept. `operator`: of a camera that `get_cached_camera` returned; another
    one is not found again.
    """
    with _inverse_lock:  # threads that ask at the same time wait for a single preparation
        return _prepare(method, operator, alive.tobytes())


@lru_cache(maxsize=MAX_CACHED_INVERSES)
def _prepare(method: LinearInverse, operator: Any, alive: bytes) -> PreparedInverse:
    return method.prepare(operator, np.frombuffer(alive, bool))


@dataclass(frozen=True, repr=False)
class CachedInverse(Method):
    """The linear inverse, whose Gram matrices are inverted once for each operator that is kept."""

    method: LinearInverse
    name = "linear"
    portable = True

    def __repr__(self) -> str:
        return repr(self.method)

    def recover(
        self,
        operator: LinearOperator,
        measurements: Array,
        valid: Array | None = None,
        progress: Progress = ignore_progress,
    ) -> Result:
        """Recover one picture per column of `measurements`; see `LinearInverse.recover`. A slit
        column that is dead in every frame drops out of the Gram matrix; one masked in some frames
        stays.
        """
        alive = np.ones(operator.shape_out, bool)
        if valid is not None:
            alive = to_numpy(namespace(valid).any(valid, axis=1))
        return prepare_inverse(self.method, operator, alive).recover(measurements, progress)

    def work(self, frames: int) -> int:
        """Return how many frame iterations `recover` reports at most."""
        return self.method.work(frames)
