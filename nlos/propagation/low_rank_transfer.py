"""How waves depend on the depth of the wall point that they come from, as short sums of products."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from nlos.propagation.kernels import VECTOR_FLOATS
from nlos.rsd.transfer import NODE_OVERSAMPLING, TransferFunction
from tofclip.threads import run_blocks, split_blocks

FloatArray = NDArray[np.float64]

FREQUENCIES_PER_GROUP = 6
"""Neighbouring frequencies that share their functions of depth."""

INTERPOLATION_ERROR_FRACTION, TERMS_ERROR_FRACTION = 0.2, 0.6
"""Of the error allowed, what interpolation between depths and leaving out terms may take; they are
independent, and their squares add up.
"""

MIN_DEPTH_RANGE_M = 1e-5
"""Depths closer than this are one, m."""

CARRIER_FRACTION = 0.4
"""Wavenumber along z, relative to the band's highest, about which the waves vary least with depth."""

EIGENVALUE_CUTOFF = 1e-10
"""Combinations of depths that hold less than this fraction of the wall points are none."""


@dataclass(frozen=True, eq=False)
class LowRankTerms:
    """``K_k(q, d_p) ~ sum_m over_waves[k, q, m] * over_points[m, p]`` at some frequencies."""

    # (frequencies, nodes, n), at the nodes of the transfer functions: all real, then all imaginary
    # parts, then 0
    wave_factors: NDArray[np.float32]
    point_factors: NDArray[np.complex64]  # (m, points)


@dataclass(frozen=True, eq=False)
class LowRankTransfer:
    """The transfer functions from wall points at many distances to one plane.

    They are known at Chebyshev nodes of the distance. The fewest products that make them up at the
    distances that occur, weighted as they occur, come from an eigenvalue problem per group of
    frequencies: about one for each half turn that the waves differ by over the relief, and one for
    each piece of a wall of flat pieces.
    """

    transfer: TransferFunction
    distances: FloatArray  # (points,), along z, m
    # (frequencies,), largest lateral wavenumber that counts at each frequency, rad/m
    lateral_limits: FloatArray
    # (frequencies,), how strong the field is at each frequency; decides what may be neglected
    strength: FloatArray
    tolerance: float  # relative error allowed

    @cached_property
    def groups(self) -> list[slice]:
        """Frequencies that are treated together."""
        return list(split_blocks(self.lateral_limits.size, FREQUENCIES_PER_GROUP))

    @cached_property
    def _distance_span(self) -> tuple[float, float]:
        """Middle and half the extent of the distances, m."""
        low, high = float(self.distances.min()), float(self.distances.max())
        return (low + high) / 2, (high - low) / 2

    @cached_property
    def nodes(self) -> FloatArray:
        """Distances at which the transfer functions are sampled, m."""
        middle, half = self._distance_span
        if half < MIN_DEPTH_RANGE_M:
            return np.array([middle])
        count = count_nodes(
            self.transfer.waves.wavenumbers,
            self.strength,
            middle,
            half,
            INTERPOLATION_ERROR_FRACTION * self.tolerance,
        )
        # Chebyshev nodes: interpolation between them is close to the best polynomial's
        return middle + half * np.cos(np.pi * (np.arange(count) + 0.5) / count)

    @property
    def _carrier_wavenumber(self) -> float:
        """Wavenumber along z that is taken out of all waves, rad/m; they have 0 to their own."""
        return CARRIER_FRACTION * self.transfer.waves.max_wavenumber

    @cached_property
    def _distance_basis(self) -> tuple[NDArray[np.complex64], NDArray[np.complex64]]:
        """Functions of distance, orthonormal over the wall's points: from nodes (nodes, n), and at
        points (n, points).

        A wall of few depths has few.
        """
        middle, half = self._distance_span
        count = self.nodes.size
        places = (self.distances - middle) / max(half, MIN_DEPTH_RANGE_M)
        at_nodes = np.cos(np.outer(np.arange(count), np.pi * (np.arange(count) + 0.5) / count)) * (
            2 / count
        )
        at_nodes[0] /= 2
        # Lagrange polynomials of the nodes, at the points' distances
        weights = np.polynomial.chebyshev.chebvander(places, count - 1) @ at_nodes
        # orthogonal combinations: distances where no point lies get no term of their own
        values, vectors = np.linalg.eigh(weights.T @ weights / len(weights))
        kept = values > EIGENVALUE_CUTOFF * values[-1]
        root = np.sqrt(values[kept])
        # a carrier wave is taken off, so that less phase is left to interpolate
        from_nodes = (
            vectors[:, kept]
            * root
            * np.exp(-1j * self._carrier_wavenumber * self.nodes)[:, np.newaxis]
        )
        at_points = np.ascontiguousarray((weights @ (vectors[:, kept] / root)).T, np.float32)
        carrier = np.exp(1j * self._carrier_wavenumber * self.distances).astype(np.complex64)
        return from_nodes.astype(np.complex64), at_points * carrier

    @cached_property
    def _transfer_table(self) -> NDArray[np.complex64]:
        """Transfer functions as combinations of `_distance_basis`, shape (n, nodes, frequencies)."""
        samples = np.empty(
            (self.nodes.size, self.transfer.nodes.size, self.lateral_limits.size), np.complex64
        )
        # computed once here, before threads ask for it
        _ = self.transfer.bessel_matrix

        def sample(some: slice) -> None:
            for i in range(some.start, some.stop):
                parts = self.transfer.evaluate(float(self.nodes[i]), np.zeros(2))
                samples[i].real, samples[i].imag = parts[:, 0], parts[:, 1]

        run_blocks(sample, len(samples), size=1)
        flat = self._distance_basis[0].T @ samples.reshape(len(samples), -1)
        table: NDArray[np.complex64] = flat.reshape(-1, *samples.shape[1:])
        return table

    def _compute_energies(self, group: slice) -> tuple[FloatArray, NDArray[np.complex64]]:
        """Energies, increasing, and combinations of `_distance_basis` (n, n) that carry them."""
        # The nodes are closer than energies need.
        lateral = np.maximum(self.transfer.nodes[:: int(NODE_OVERSAMPLING)], 0)[:, np.newaxis]
        # a ring of lateral wavenumbers holds waves in proportion to its radius
        weights = np.sqrt(lateral * (lateral <= self.lateral_limits[group])) * self.strength[group]
        weighted = self._transfer_table[:, :: int(NODE_OVERSAMPLING), group] * weights.astype(
            np.float32
        )
        flat = weighted.reshape(len(weighted), -1)
        values, vectors = np.linalg.eigh(flat.conj() @ flat.T)
        return np.maximum(values, 0).astype(np.float64), vectors

    @cached_property
    def _leading_combinations(self) -> list[NDArray[np.complex64]]:
        """Combinations (n, m) of every group that have to be kept."""
        energies = [(np.empty(0), np.empty((0, 0), np.complex64))] * len(self.groups)
        _ = self._transfer_table

        def decompose(some: slice) -> None:
            for i in range(some.start, some.stop):
                energies[i] = self._compute_energies(self.groups[i])

        run_blocks(decompose, len(self.groups), size=1)
        every = np.sort(np.concatenate([values for values, _ in energies]))
        allowed = (TERMS_ERROR_FRACTION * self.tolerance) ** 2 * every.sum()
        # the weakest term kept: all below it hold the allowed energy, over all groups together
        weakest = every[np.searchsorted(np.cumsum(every), allowed)]
        return [vectors[:, values >= min(weakest, values[-1])] for values, vectors in energies]

    @property
    def term_counts(self) -> list[int]:
        """Number of terms of every group."""
        return [vectors.shape[1] for vectors in self._leading_combinations]

    def terms(self, number: int) -> LowRankTerms:
        """Return the terms of one group."""
        kept, table = (
            self._leading_combinations[number],
            self._transfer_table[..., self.groups[number]],
        )
        terms = kept.shape[1]
        wave_factors = (kept.T @ table.reshape(len(table), -1)).reshape(terms, *table.shape[1:]).T
        # Padded to whole vectors.
        parts = np.zeros(
            (*wave_factors.shape[:-1], -(-2 * terms // VECTOR_FLOATS) * VECTOR_FLOATS), np.float32
        )
        parts[..., :terms], parts[..., terms : 2 * terms] = wave_factors.real, wave_factors.imag
        return LowRankTerms(parts, kept.conj().T @ self._distance_basis[1])


def count_nodes(
    wavenumbers: FloatArray, strength: FloatArray, middle: float, half: float, error: float
) -> int:
    """Return how many Chebyshev nodes of the distance interpolate waves to a relative error.

    Enough for the phase, which runs through ``k * half`` about its middle (Jacobi-Anger expansion),
    and for the fall with distance, which is singular at distance 0.

    `wavenumbers` (frequencies,): rad/m, ascending; `strength` (frequencies,): relative amplitude of
    each frequency; `middle, half`: middle and half width of the range of distances, m; `error`:
    relative.
    """
    from scipy.special import jv

    # Strong frequencies decide, and neighbours hardly differ.
    some = slice(None, None, max(1, wavenumbers.size // 16))
    carrier = CARRIER_FRACTION * wavenumbers[-1]
    phases = half * np.maximum(carrier, wavenumbers[some] - carrier)
    orders = np.arange(4, 24 + int(1.5 * phases.max()))
    rest = 2 * np.abs(jv(orders, phases[:, np.newaxis])) * strength[some, np.newaxis]
    # five beyond the last coefficient that counts: the expansion falls faster than exponentially
    # from there
    phase = int(np.flatnonzero(rest.max(axis=0) > error).max(initial=-1)) + 5
    # 1 / R is singular at R = 0: Chebyshev coefficients fall like exp(-n arccosh(middle / half))
    # (Bernstein ellipse)
    fall = np.arccosh(middle / half)
    return max(phase, int(np.ceil(np.log(1 / error) / fall)) + 1)
