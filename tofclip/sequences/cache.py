"""What does not change from shot to shot, made once in a process: operators and inverted matrices
of a camera. Sequences, streams and views share them.

Things are known by their content: two shots whose files carry the same camera share its operators.
"""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from dataclasses import dataclass, fields
from threading import Lock
from weakref import WeakValueDictionary

import numpy as np
from numpy.typing import DTypeLike, NDArray

from tofclip.arrays import Array, namespace, to_numpy
from tofclip.camera import Camera
from tofclip.operators import LinearOperator, LineProjection
from tofclip.solvers import LinearInverse, PreparedInverse, Progress, Result, ignore_progress
from tofclip.storage import Record

# Two, so that sequences of two cameras may alternate; operators of more would fill the memory.
MAX_CACHED_CAMERAS = 2
MAX_CACHED_OPERATORS = 16
"""Of each camera: frames at more shears than that make the further operators anew."""

MAX_CACHED_INVERSES = 16

_InverseKey = tuple[LinearInverse, LinearOperator, bytes]

_camera_cache: dict[str, Camera] = {}
_inverse_cache: OrderedDict[_InverseKey, PreparedInverse] = OrderedDict()
_camera_lock, _inverse_lock = Lock(), Lock()


class CachingCamera(Camera):
    """A camera that keeps the operators it made.

    Memory: for each of at most 16 shears 16 bytes for each of ``views * rows * columns * 2``
    entries.
    """

    def operator(self, shear: float = 0.0, dtype: DTypeLike = np.float32) -> LineProjection:
        """Return F(d), see `Camera.operator`; the same object for the same arguments.

        `shear`: pixels per view step.
        """
        # The dataclass is frozen, so that the cache is put past it into the instance dictionary.
        kept: dict[tuple[float, str], LineProjection] = self.__dict__.setdefault("_kept", {})
        # An operator of which an inverse is still kept is found again as well, or that inverse
        # never would be.
        alive = self.__dict__.setdefault("_alive", WeakValueDictionary())
        key = float(shear), np.dtype(dtype).str
        found: LineProjection | None = alive.get(key)
        if found is None:
            found = alive[key] = super().operator(shear, dtype)
            # The first ones stay: with the last ones, frames that run through more shears than are
            # kept, shot after shot, would find none.
            if len(kept) < MAX_CACHED_OPERATORS:
                kept[key] = found
        return found


def get_cached_camera(camera: Camera) -> Camera:
    """Return the camera of the same content that this process has kept, with its operators."""
    key = hash_record(camera.to_record())
    with _camera_lock:
        if key not in _camera_cache:
            while len(_camera_cache) >= MAX_CACHED_CAMERAS:
                # Dictionaries keep the order of insertion: the first key is the oldest camera.
                _camera_cache.pop(next(iter(_camera_cache)))
            _camera_cache[key] = CachingCamera(
                **{one.name: getattr(camera, one.name) for one in fields(camera)}
            )
        return _camera_cache[key]


def hash_record(record: Record) -> str:
    """SHA-256 of a record's arrays and numbers, and of those inside it."""
    found = hashlib.sha256()
    for name, field in sorted(record.fields.items()):
        found.update(f"{name} {field.values.dtype.str} {field.values.shape} {field.units}".encode())
        found.update(np.ascontiguousarray(field.values).tobytes())
    found.update(repr(sorted(record.attributes.items())).encode())
    for name, child in sorted(record.children.items()):
        found.update(f"{name} {hash_record(child)}".encode())
    return found.hexdigest()


def prepare_inverse(
    method: LinearInverse, operator: LinearOperator, alive: NDArray[np.bool_]
) -> PreparedInverse:
    """Return what `LinearInverse.prepare` does, the same object for the same arguments.

    The 16 inverses used last are kept. Threads that ask for one at the same time wait for a single
    preparation.

    `operator`: of a camera that `get_cached_camera` returned; another one is not found again;
    `alive` (measurements,).
    """
    key = method, operator, alive.tobytes()
    with _inverse_lock:
        if key not in _inverse_cache:
            _inverse_cache[key] = method.prepare(operator, alive)
            if len(_inverse_cache) > MAX_CACHED_INVERSES:
                _inverse_cache.popitem(last=False)
        _inverse_cache.move_to_end(key)
        return _inverse_cache[key]


@dataclass(frozen=True, repr=False)
class CachedInverse:
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
        """Recover one picture per column of `measurements`; see `LinearInverse.recover`.

        `operator`: pictures (rows, columns) to measurements (measurements,); `measurements`
        (measurements, frames); `valid` (measurements, frames): measurements that are False in every
        frame are left out; `progress`: called with the number of frames just recovered.
        """
        alive = (
            # A slit column that is dead in every frame drops out of the Gram matrix; one masked in
            # some frames stays.
            np.ones(operator.shape_out, bool)
            if valid is None
            else to_numpy(namespace(valid).any(valid, axis=1))
        )
        return prepare_inverse(self.method, operator, alive).recover(measurements, progress)

    def work(self, frames: int) -> int:
        """Return how many frame iterations `recover` reports at most."""
        return self.method.work(frames)
