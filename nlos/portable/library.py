"""The few things that portable code needs beyond the array API standard."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofclip.arrays import Array, ComputeDevice, namespace

CPU_CHUNK_BYTES, GPU_CHUNK_BYTES = 8 << 20, 256 << 20
"""Bytes of the largest array that is made at a time: on a processor, with its caches, and on a GPU,
with its thousands of lanes.
"""

SINGLE_PRECISION_DTYPES = {"f": np.float32, "c": np.complex64}


@dataclass(frozen=True)
class ArrayLibrary:
    """A library at one place, computing in single precision."""

    device: ComputeDevice

    @classmethod
    def of(cls, array: Array) -> ArrayLibrary:
        """Return the library of `array`, where that lives."""
        return cls(ComputeDevice.of(array))

    @cached_property
    def xp(self) -> Any:
        """The functions of the array API standard."""
        return namespace(self.device.put(np.zeros(1, np.float32)))

    @property
    def chunk_bytes(self) -> int:
        """The largest array that should be made at a time; some four of its size are alive
        together.
        """
        return CPU_CHUNK_BYTES if "cpu" in str(self.device.device).lower() else GPU_CHUNK_BYTES

    def put(self, values: NDArray[Any]) -> Array:
        """Bring a NumPy array here, in single precision if it holds real or complex numbers."""
        return self.device.put(np.asarray(values, SINGLE_PRECISION_DTYPES.get(values.dtype.kind)))

    def zeros(self, shape: tuple[int, ...]) -> Array:
        """Make complex64 zeros."""
        return self.xp.zeros(shape, dtype=self.xp.complex64, device=self.device.device)

    def exp_turns(self, turns: Array) -> Array:
        """Return ``exp(2j * pi * turns)``, accurate however large the turns are."""
        angle = 2 * np.pi * (turns - self.xp.round(turns))
        return self.xp.exp(1j * self.xp.astype(angle, self.xp.complex64))

    def make_complex(self, real: Array, imaginary: Array) -> Array:
        """Make complex numbers of real and imaginary parts.

        `real, imaginary`: of one shape.
        """
        xp = self.xp
        return xp.astype(real, xp.complex64) + 1j * xp.astype(imaginary, xp.complex64)


def remove_whole_turns(turns: Any) -> NDArray[np.float64]:
    """Leave out whole turns while there are digits for it: what is left goes well into single
    precision.
    """
    values = np.asarray(turns, np.float64)
    return np.asarray(values - np.round(values))
