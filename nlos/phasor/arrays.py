"""What portable code needs beyond the array API standard: signals of a capture as arrays of any
library, and their phasors.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from nlos.band import Band
from nlos.capture import Capture
from nlos.plane import WallLattice
from tofclip.arrays import AnyArray, Array, ComputeDevice, namespace

# Bytes of the largest array made at a time: on a processor, with its caches, and on a GPU.
CPU_CHUNK_BYTES, GPU_CHUNK_BYTES = 8 << 20, 256 << 20


@dataclass(frozen=True)
class ArrayLibrary:
    """A library at one place, computing in single precision."""

    device: ComputeDevice = field(default_factory=ComputeDevice)

    @cached_property
    def xp(self) -> Any:
        """The functions of the array API standard."""
        return namespace(self.device.put(np.zeros(1, np.float32)))

    @property
    def chunk_bytes(self) -> int:
        """The largest array to be made at a time; some four of its size live together."""
        return CPU_CHUNK_BYTES if "cpu" in str(self.device.device).lower() else GPU_CHUNK_BYTES

    def put(self, values: AnyArray) -> Array:
        """Bring a NumPy array here, real and complex numbers in single precision."""
        single = {"f": np.float32, "c": np.complex64}.get(values.dtype.kind)
        return self.device.put(np.asarray(values, single))

    def zeros(self, shape: tuple[int, ...]) -> Array:
        """Make complex zeros."""
        return self.xp.zeros(shape, dtype=self.xp.complex64, device=self.device.device)

    def exp_cycles(self, cycles: Array) -> Array:
        """Return ``exp(2j * pi * cycles)``, accurate however large the cycles are."""
        angle = 2 * np.pi * (cycles - self.xp.round(cycles))
        return self.xp.exp(1j * self.xp.astype(angle, self.xp.complex64))


class BandTransform:
    """The Fourier transform of `bins` of signals at a band's frequencies, where the signals live."""

    def __init__(self, band: Band, bins: int, library: ArrayLibrary) -> None:
        paths = band.axis.start + band.axis.spacing * np.arange(bins)
        waves = band.weights * np.exp(-1j * np.outer(paths, band.wavenumbers))
        self._xp = library.xp
        self._real, self._imaginary = library.put(waves.real), library.put(waves.imag)

    def of(self, traces: Array) -> Array:
        """Return the phasors (points, frequencies) of signals (points, t)."""
        real, imaginary = (
            self._xp.astype(traces @ part, self._xp.complex64)
            for part in (self._real, self._imaginary)
        )
        return real + 1j * imaginary


def get_traces(capture: Capture, some: slice | AnyArray) -> Array:
    """Return the signals (points, t) of some valid wall points, in the capture's own library."""
    library = ArrayLibrary(capture.device)
    flat = library.xp.reshape(capture.signal, (capture.axis.bins, -1))
    places = np.flatnonzero(capture.valid)[some]
    if not np.array_equal(places, np.arange(flat.shape[1])):
        flat = library.xp.take(flat, library.put(places), axis=1)
    return library.xp.permute_dims(flat, (1, 0))


def arrange_on_lattice(values: Array, wall: WallLattice, library: ArrayLibrary) -> Array:
    """Put values (..., points) into their places (..., rows, columns); the others are 0."""
    xp = library.xp
    if not wall.is_complete:
        padded = xp.concat([values, library.zeros((*values.shape[:-1], 1))], axis=-1)
        values = xp.take(padded, library.put(wall.point_numbers), axis=-1)
    return xp.reshape(values, (*values.shape[:-1], *wall.shape))
