"""Spherical waves between two sets of points, the same in both directions."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from nlos.propagation.kernels import LANES, STEPS, add_spherical_waves
from tofclip.threads import blocks, run_blocks

Array = NDArray[Any]
FloatArray = NDArray[np.float64]

LANES_AT_A_TIME = 4
"""Groups of targets per piece of work in single precision."""

PAIRS_AT_A_TIME = 1 << 20
"""Distances held at a time in double precision: 16 MB of waves."""


def spherical_sum(sources: FloatArray, values: Array, targets: FloatArray, wavenumbers: FloatArray) -> Array:
    """Return ``sum_s values_k(s) * exp(1j * k * |t - s|) / |t - s|`` at every target t.

    With sources and targets exchanged it is its own transpose. In single precision good to 1e-5 and quick; in double
    precision plain.

    Parameters
    ----------
    sources, targets : (n, 3), (m, 3) array
        m.
    values : (n, frequencies) complex array
    wavenumbers : (frequencies,) array
        Evenly spaced, rad/m.

    Returns
    -------
    (m, frequencies) complex array
        Of the type of `values`.
    """
    if values.dtype == np.complex128:
        return _in_double_precision(sources, values, targets, wavenumbers)
    # Distances are what counts: near the middle of both, float32 coordinates have most digits.
    middle = (sources.mean(axis=0) + targets.mean(axis=0)) / 2
    return _in_single_precision(sources - middle, values, targets - middle, wavenumbers)


def _in_single_precision(sources: FloatArray, values: Array, targets: FloatArray, wavenumbers: FloatArray) -> Array:
    count = wavenumbers.size
    padded = -(-count // STEPS) * STEPS
    parts = np.zeros((len(sources), 2 * padded), np.float32)
    parts[:, : 2 * count] = np.ascontiguousarray(values, np.complex64).view(np.float32)
    groups = -(-len(targets) // LANES)
    lanes = np.resize(targets.astype(np.float32), (groups * LANES, 3)).reshape(groups, LANES, 3)
    emitters = sources.astype(np.float32)
    step = wavenumbers[1] - wavenumbers[0] if count > 1 else 0.0
    turns, turns_on = np.float32(wavenumbers[0] / (2 * np.pi)), np.float32(step / (2 * np.pi))
    field = np.empty((groups, LANES, count), np.complex64)

    def work(some: slice) -> None:
        for group in range(some.start, some.stop):
            sums = np.zeros(padded * 2 * LANES, np.float32)
            add_spherical_waves(emitters, parts, np.ascontiguousarray(lanes[group].T).ravel(), turns, turns_on, sums)
            real, imaginary = np.moveaxis(sums.reshape(padded, 2, LANES)[:count], 1, 0)
            field[group].real, field[group].imag = real.T, imaginary.T

    run_blocks(work, groups, size=LANES_AT_A_TIME)
    return field.reshape(-1, count)[: len(targets)]


def _in_double_precision(sources: FloatArray, values: Array, targets: FloatArray, wavenumbers: FloatArray) -> Array:
    field = np.empty((len(targets), wavenumbers.size), np.complex128)
    for some in blocks(len(targets), max(1, PAIRS_AT_A_TIME // len(sources))):
        distance = np.linalg.norm(targets[some, np.newaxis] - sources, axis=-1)
        for i, k in enumerate(wavenumbers):
            field[some, i] = (np.exp(1j * k * distance) / distance) @ values[:, i]
    return field
