"""Spherical waves between two sets of points, the same in both directions."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from nlos.propagation.compiled import sum_spherical_waves
from tofclip.threads import split_blocks

Array = NDArray[Any]
FloatArray = NDArray[np.float64]

PAIRS_PER_BLOCK = 1 << 20
"""Distances held at a time in double precision: 16 MB of waves."""


def propagate_spherical_waves(
    sources: FloatArray, values: Array, targets: FloatArray, wavenumbers: FloatArray
) -> Array:
    """Return ``sum_s values_k(s) * exp(1j * k * |t - s|) / |t - s|`` at every target t.

    With sources and targets exchanged it is its own transpose. In single precision good to 1e-5 and
    quick; in double precision plain.

    `sources, targets` (n, 3): m; `values` (n, frequencies); `wavenumbers` (frequencies,): evenly
    spaced, rad/m. Returns (m, frequencies): of the type of `values`.
    """
    if values.dtype == np.complex128:
        return _propagate_in_double_precision(sources, values, targets, wavenumbers)
    return sum_spherical_waves(targets, sources, values, wavenumbers)


def _propagate_in_double_precision(
    sources: FloatArray, values: Array, targets: FloatArray, wavenumbers: FloatArray
) -> Array:
    field = np.empty((len(targets), wavenumbers.size), np.complex128)
    for some in split_blocks(len(targets), max(1, PAIRS_PER_BLOCK // len(sources))):
        distance = np.linalg.norm(targets[some, np.newaxis] - sources, axis=-1)
        for i, k in enumerate(wavenumbers):
            field[some, i] = (np.exp(1j * k * distance) / distance) @ values[:, i]
    return field
