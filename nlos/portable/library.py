"""The few things that portable code needs beyond the array API standard."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofclip.arrays import Array, Place, namespace

CACHED_CHUNK, LARGE_CHUNK = 8 << 20, 256 << 20
"""Bytes of the largest array that is made at a time: on a processor, with its caches, and on a graphics processor, with
its thousands of lanes."""

SINGLE = {"f": np.float32, "c": np.complex64}


@dataclass(frozen=True)
class Library:
    """A library at one place, computing in single precision.

    Parameters
    ----------
    place : Place
    """

    place: Place

    @classmethod
    def of(cls, array: Array) -> Library:
        """Return the library of `array`, where that lives."""
        return cls(Place.of(array))

    @cached_property
    def xp(self) -> Any:
        """The functions of the array API standard."""
        return namespace(self.place.put(np.zeros(1, np.float32)))

    @property
    def chunk_bytes(self) -> int:
        """The largest array that should be made at a time; some four of its size are alive together."""
        return CACHED_CHUNK if "cpu" in str(self.place.device).lower() else LARGE_CHUNK

    def put(self, values: NDArray[Any]) -> Array:
        """Bring a NumPy array here, in single precision if it holds real or complex numbers."""
        return self.place.put(np.asarray(values, SINGLE.get(values.dtype.kind)))

    def zeros(self, shape: tuple[int, ...]) -> Array:
        """Make complex64 zeros."""
        return self.xp.zeros(shape, dtype=self.xp.complex64, device=self.place.device)

    def turned(self, turns: Array) -> Array:
        """Return ``exp(2j * pi * turns)``, accurate however large the turns are."""
        angle = 2 * np.pi * (turns - self.xp.round(turns))
        return self.xp.exp(1j * self.xp.astype(angle, self.xp.complex64))

    def joined(self, real: Array, imaginary: Array) -> Array:
        """Make complex numbers of real and imaginary parts."""
        xp = self.xp
        return xp.astype(real, xp.complex64) + 1j * xp.astype(imaginary, xp.complex64)


def whole_turns_off(turns: Any) -> NDArray[np.float64]:
    """Leave out whole turns while there are digits for it: what is left goes well into single precision."""
    values = np.asarray(turns, np.float64)
    return np.asarray(values - np.round(values))
