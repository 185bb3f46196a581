"""The laser's wave on a depth plane, as a short sum over what all frequencies have in common."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

CHEBYSHEV_NODES = 64
"""Chebyshev nodes over the distances on a plane; enough for a band that turns by 25 periods across
them.
"""

TABLE_SAMPLES = 512
"""Samples of a distance function; linear interpolation between them errs by 1e-4 at 6 periods."""


@dataclass(frozen=True, eq=False)
class Illumination:
    """``exp(1j * (k - k_0) * (R - middle)) ~ sum_m b_m(k) * f_m(R)``, the odd functions f times 1j.

    The even and the odd part in R are each split by their own eigenvectors, which keeps everything
    real and takes some two thirds of the terms of a Chebyshev expansion.
    """

    coefficients: NDArray[np.float32]  # (frequencies, m), b, even functions first
    even: int  # how many functions are even
    table: NDArray[np.float32]  # (samples, m), f over `span`
    span: FloatArray  # (2,), smallest and largest R, m; `split_illumination` has it about 0


def build_constant_illumination(frequencies: int) -> Illumination:
    """No illumination wave: all frequencies simply add up."""
    return Illumination(
        np.ones((frequencies, 1), np.float32), 1, np.ones((2, 1), np.float32), np.zeros(2)
    )


def split_illumination(
    detuning: FloatArray, strength: FloatArray, half: float, tolerance: float
) -> Illumination:
    """Split the illumination of distances from ``-half`` to ``half`` about a middle one.

    `detuning` (frequencies,): ``k - k_0``, rad/m; `strength` (frequencies,): how much each
    frequency counts; `half`: m; `tolerance`: root mean square error allowed, relative.
    """
    # Even and odd functions are known by their values at the positive half of the nodes.
    angles = np.pi * (np.arange(CHEBYSHEV_NODES // 2) + 0.5) / CHEBYSHEV_NODES
    phase = np.outer(np.cos(angles), half * detuning)
    kept = [_find_leading_functions(wave(phase), strength, tolerance) for wave in (np.cos, np.sin)]
    table = np.concatenate(
        [_build_continuation_matrix(odd) @ values for odd, (values, _) in enumerate(kept)], axis=1
    )
    coefficients = np.concatenate([b for _, b in kept], axis=1)
    span = np.array([-half, half])
    return Illumination(
        coefficients.astype(np.float32), kept[0][1].shape[1], table.astype(np.float32), span
    )


def _find_leading_functions(
    wave: FloatArray, strength: FloatArray, tolerance: float
) -> tuple[FloatArray, FloatArray]:
    """Fewest orthonormal functions (nodes, m), and their coefficients (frequencies, m), that make
    up `wave`.
    """
    weighted = wave * strength
    values, vectors = np.linalg.eigh(weighted @ weighted.T)
    # eigh sorts upwards; of both parts together, half the squared strength times the nodes is the
    # whole.
    allowed = tolerance**2 * np.sum(strength**2) * len(wave) / 2
    dropped = int(np.count_nonzero(np.cumsum(np.maximum(values, 0)) < allowed))
    functions = vectors[:, dropped:]
    return functions, wave.T @ functions


@cache
def _build_continuation_matrix(odd: int) -> FloatArray:
    """Matrix that continues a function from its Chebyshev nodes to all samples by its Chebyshev
    series.
    """
    angles = np.pi * (np.arange(CHEBYSHEV_NODES // 2) + 0.5) / CHEBYSHEV_NODES
    orders = 2 * np.arange(len(angles)) + odd
    series = (2 / len(angles)) * np.cos(np.outer(orders, angles))
    if not odd:
        series[0] /= 2
    continued: FloatArray = (
        np.cos(np.outer(np.arccos(np.linspace(-1, 1, TABLE_SAMPLES)), orders)) @ series
    )
    return continued
