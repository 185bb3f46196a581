"""From a plane to the voxels of many depths: the laser's wave on a depth plane as a short sum over
what all frequencies have in common, a periodic lattice, its plane waves, the plan that holds both,
and which depths have to be computed.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np
from numpy.typing import NDArray

from nlos.method import require_memory
from nlos.phasor.transfer import (
    Offsets,
    SphericalWaves,
    TransferFunction,
    Window,
    choose_oversampling,
    find_fast_length,
    find_lateral_limits,
    find_min_periods,
)
from nlos.plane import Plane, StraightPaths, axis_step
from nlos.volume import Grid
from tofclip.arrays import ComplexArray, Float32Array, FloatArray, IntArray
from tofclip.threads import split_blocks

# Chebyshev nodes over the distances on a plane: for a band that turns by 25 periods across.
CHEBYSHEV_NODES = 64
# Samples of a distance function; linear interpolation between them errs by 1e-4 at 6 periods.
TABLE_SAMPLES = 512


@dataclass(frozen=True, eq=False)
class Illumination:
    """``exp(1j * (k - k_0) * (R - middle)) ~ sum_m b_m(k) * f_m(R)``, odd functions f times 1j: two
    thirds of the terms of a Chebyshev expansion, and all real.
    """

    coefficients: Float32Array  # (frequencies, m), b, even functions first
    even: int  # how many functions are even
    table: Float32Array  # (samples, m), f over `span`
    span: FloatArray  # (2,), smallest and largest R, m; `split_illumination` has it about 0


def build_constant_illumination(frequencies: int) -> Illumination:
    """No illumination wave: all frequencies simply add up."""
    ones = np.ones((frequencies, 1), np.float32)
    return Illumination(ones, 1, np.ones((2, 1), np.float32), np.zeros(2))


def split_illumination(
    detuning: FloatArray, strength: FloatArray, half: float, tolerance: float
) -> Illumination:
    """Split the illumination of distances within `half`, m, to a root mean square error; `detuning`
    (frequencies,): ``k - k_0``, rad/m.
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
    """Fewest orthonormal functions (nodes, m), and coefficients (frequencies, m), of `wave`."""
    weighted = wave * strength
    values, vectors = np.linalg.eigh(weighted @ weighted.T)
    # eigh sorts upwards; of both parts, half the squared strength times the nodes is all.
    allowed = tolerance**2 * np.sum(strength**2) * len(wave) / 2
    dropped = int(np.count_nonzero(np.cumsum(np.maximum(values, 0)) < allowed))
    functions = vectors[:, dropped:]
    return functions, wave.T @ functions


@cache
def _build_continuation_matrix(odd: int) -> FloatArray:
    """Matrix that continues a function from its Chebyshev nodes to all samples."""
    angles = np.pi * (np.arange(CHEBYSHEV_NODES // 2) + 0.5) / CHEBYSHEV_NODES
    orders = 2 * np.arange(len(angles)) + odd
    series = (2 / len(angles)) * np.cos(np.outer(orders, angles))
    if not odd:
        series[0] /= 2
    return np.cos(np.outer(np.arccos(np.linspace(-1, 1, TABLE_SAMPLES)), orders)) @ series


# Of the error allowed, what weak plane waves that are left out may hold. Half of it or less is an
# error of voxels: the rest lies on the window's edge, beyond most of them.
WAVES_ERROR_FRACTION = 0.5
# Lateral wavenumbers nearer to each other are one, rad/m.
LATERAL_ROUNDING = 1e-9


@dataclass(frozen=True, eq=False)
class PlaneWaves:
    """The plane waves of a periodic lattice that carry anything, ordered by lateral wavenumber."""

    period: tuple[float, float]  # of the lattice in space along y and x, m
    # (frequencies,), largest lateral wavenumber that counts at each frequency, rad/m; increasing
    lateral_limits: FloatArray

    @property
    def max_indices(self) -> tuple[int, int]:
        """Largest index along y and x."""
        return self.max_indices_within(float(self.lateral_limits[-1]))

    def max_indices_within(self, lateral: float) -> tuple[int, int]:
        """Largest index along y and x up to a lateral wavenumber."""
        y, x = (int((lateral + LATERAL_ROUNDING) * side / (2 * np.pi)) for side in self.period)
        return y, x

    def sort(self, signed: bool) -> tuple[IntArray, IntArray, FloatArray]:
        """Sort the waves, or those without a negative index, by lateral wavenumber, rad/m: indices
        along y and x, and these.
        """
        rows, columns = (np.arange(-n if signed else 0, n + 1) for n in self.max_indices)
        qy, qx = (
            2 * np.pi / side * index
            for side, index in zip(self.period, (rows, columns), strict=True)
        )
        # Rounded, so that waves mirrored in an axis or in the diagonal are equal.
        lateral = np.hypot(qy[:, np.newaxis], qx).ravel()
        lateral = LATERAL_ROUNDING * np.rint(lateral / LATERAL_ROUNDING)
        inside = np.flatnonzero(lateral <= self.lateral_limits[-1])
        order = inside[np.argsort(lateral[inside], kind="stable")]
        return rows[order // columns.size], columns[order % columns.size], lateral[order]


# A complex64 phasor of a plane wave at one frequency.
BYTES_PER_WAVE = 8


@dataclass(frozen=True, eq=False)
class DiffractionPlan:
    """How fields on one plane reach one grid of voxels."""

    plane: Plane
    grid: Grid  # x and y evenly spaced, z as you like
    waves: SphericalWaves
    # (frequencies,), of each frequency in the pulse; decides what may be neglected
    strength: FloatArray
    tolerance: float  # relative error allowed
    # the only ones between plane and voxels that carry anything; by default all do
    paths: StraightPaths | None = None

    @cached_property
    def _offsets(self) -> Offsets:
        offsets = Offsets.between(self.plane, self.grid.y, self.grid.x)
        if self.paths is None:
            return offsets
        return offsets.limit(self.paths.plane_to_voxels, self.paths.rim)

    @cached_property
    def lattice(self) -> tuple[int, int]:
        """Voxels in a period along y and x: no image of a source may meet a voxel inside the window."""
        sides = zip(self._min_periods, (self.grid.y, self.grid.x), strict=True)
        high, wide = (
            find_fast_length(side / axis_step(axis)) if axis.size > 1 else 1 for side, axis in sides
        )
        return high, wide

    @cached_property
    def _min_periods(self) -> tuple[float, float]:
        return find_min_periods(self._offsets, self.tolerance)

    @property
    def _periods(self) -> tuple[float, float]:
        """Of the lattice along y and x, m."""
        axes = zip(self.lattice, (self.grid.y, self.grid.x), self._min_periods, strict=True)
        high, wide = (n * axis_step(axis) if axis.size > 1 else side for n, axis, side in axes)
        return high, wide

    @cached_property
    def _window(self) -> Window:
        return Window.within(self._offsets, self._periods, self.tolerance)

    @cached_property
    def plane_waves(self) -> PlaneWaves:
        """The plane waves that carry the field."""
        # to the nearest voxels waves travel most aside
        error, nearest = WAVES_ERROR_FRACTION * self.tolerance, self._min_distance
        limits = find_lateral_limits(self.waves, self._window, self.strength, nearest, error)
        return PlaneWaves(self._periods, limits)

    @property
    def plane_wave_count(self) -> float:
        """How many plane waves there are, roughly: what a circle of wavenumbers holds."""
        y, x = self.plane_waves.period
        return float(np.pi * self.plane_waves.lateral_limits[-1] ** 2 * y * x / (2 * np.pi) ** 2)

    def require_memory(self) -> None:
        """Refuse a field whose plane waves do not fit into memory."""
        count = self.plane_wave_count
        what = f"{count:.3g} plane waves at {self.waves.count} frequencies"
        size = count * self.waves.count * BYTES_PER_WAVE
        require_memory(size, what, "use a longer wavelength or a smaller grid")

    @cached_property
    def transfer(self) -> TransferFunction:
        """Transfer functions from the plane to any depth."""
        widest, density = self.plane_waves.lateral_limits[-1], choose_oversampling(self.tolerance)
        waves, window = self.waves, self._window
        return TransferFunction(waves, window, float(widest), self._min_distance, density)

    @property
    def _min_distance(self) -> float:
        """Smallest distance along z, but half a point's, m."""
        return max(float(np.abs(self.grid.z - self.plane.z).min()), axis_step(self.plane.x) / 2)


# Along z an image without the laser's carrier is a sum of waves exp(1j * f * z) with f = k *
# cos(theta) + (k - k_0) * cos(alpha): theta the angle at which the field's plane waves travel,
# alpha that of the laser's wave. A band has few f, so that depths finer than half their period are
# redundant: they follow from their neighbours, with an error that theory gives.

# Spacings of computed depths that are tried, relative to that of the wanted ones.
SPACING_RATIOS = (4.0, 3.5, 3.0, 2.75, 2.5, 2.25, 2.0, 1.75, 1.5)
# Computed depths on either side that an interpolated one takes.
NEIGHBOURS = 6
# Wanted depths that are interpolated by one matrix product.
DEPTHS_PER_BLOCK = 16
# Cosines of each angle, and bins of f, that stand for the spectrum along z.
ANGLES, AXIAL_BINS = 24, 128
# Errors that computed depths may have, in the error allowed: interpolation enlarges none.
NOISE_FRACTION = 0.03


@dataclass(frozen=True, eq=False)
class AxialSpectrum:
    """How an image without the laser's carrier varies along z."""

    wavenumbers: FloatArray  # (n,), f, rad/m
    energies: FloatArray  # (n,), of the waves at each f; they add up to 1

    @classmethod
    def of(
        cls,
        wavenumbers: FloatArray,
        strength: FloatArray,
        centre: float,
        cosines: tuple[float, float],
    ) -> AxialSpectrum:
        """Return the spectrum of a field of all forward directions, wavenumbers k and a carrier k_0
        (`centre`), rad/m; `cosines`: range of the laser's wave's with z, 0 without one.
        """
        steps = (np.arange(ANGLES) + 0.5) / ANGLES
        low, high = cosines
        # directions are equally likely per solid angle, that is, per cosine
        k = wavenumbers[:, np.newaxis, np.newaxis]
        axial = k * steps[:, np.newaxis] + (k - centre) * (low + (high - low) * steps)
        weights = np.broadcast_to((strength**2)[:, np.newaxis, np.newaxis], axial.shape)
        energies, edges = np.histogram(axial, AXIAL_BINS, weights=weights)
        return cls((edges[1:] + edges[:-1]) / 2, energies / energies.sum())

    def interpolate(
        self, wanted: FloatArray, known: FloatArray, noise: float
    ) -> tuple[NDArray[np.complex128], FloatArray]:
        """Return the best linear interpolation of depths, weights (wanted, known), and its relative
        errors (wanted,), root mean square; `noise`: that of each known one.
        """
        middle = float(known.mean())
        waves, at_known = (
            np.exp(1j * np.outer(depths - middle, self.wavenumbers)) for depths in (wanted, known)
        )
        # normal equations: correlations of the known depths, and with the wanted ones
        weighted = at_known.conj().T * self.energies[:, np.newaxis]
        correlations = at_known @ weighted + noise**2 * np.eye(known.size)
        weights = np.linalg.solve(correlations.T, (waves @ weighted).T).T
        missing = np.abs(waves - weights @ at_known) ** 2 @ self.energies
        return weights, np.sqrt(missing)


@dataclass(frozen=True, eq=False)
class InterpolatedBlock:
    """Some neighbouring depths as sums of computed ones."""

    depths: slice  # of the wanted depths
    nodes: slice  # of the computed ones
    weights: ComplexArray  # (depths, nodes)


@dataclass(frozen=True, eq=False)
class DepthInterpolation:
    """Which depths are computed, and how all follow."""

    nodes: IntArray  # (n,), indices of the depths that are computed, ascending
    blocks: list[InterpolatedBlock]  # all wanted depths; empty where every one is computed


def choose_depths(z: FloatArray, spectrum: AxialSpectrum, error: float) -> DepthInterpolation:
    """Choose the fewest of depths z (n,), m, from which all follow within an error, relative."""
    everything = DepthInterpolation(np.arange(z.size), [])
    ratio = _find_spacing_ratio(z, spectrum, error)
    if ratio == 1:
        return everything
    count = int(np.ceil((z.size - 1) / ratio)) + 1
    nodes = np.unique(np.rint(np.linspace(0, z.size - 1, count)).astype(np.int64))
    # Ends have neighbours on one side, uneven depths far ones: these are computed.
    while nodes.size < z.size:
        blocks, failed = _interpolate_all(z, nodes, spectrum, error)
        if not failed.size:
            return DepthInterpolation(nodes, blocks)
        # of each run of failures its middle: the rest may follow from that
        runs = np.split(failed, np.flatnonzero(np.diff(failed) > 1) + 1)
        nodes = np.union1d(nodes, [run[run.size // 2] for run in runs])
    return everything


def _find_spacing_ratio(z: FloatArray, spectrum: AxialSpectrum, error: float) -> float:
    """Largest spacing of computed depths, in wanted ones', with the error half-way; else 1."""
    if z.size <= 2 * NEIGHBOURS:
        return 1.0
    step = float(z[-1] - z[0]) / (z.size - 1)
    places = np.arange(2.0 * NEIGHBOURS) - NEIGHBOURS + 0.5
    for ratio in SPACING_RATIOS:
        _, errors = spectrum.interpolate(np.zeros(1), ratio * step * places, NOISE_FRACTION * error)
        if errors[0] <= error:
            return ratio
    return 1.0


def _interpolate_all(
    z: FloatArray, nodes: IntArray, spectrum: AxialSpectrum, error: float
) -> tuple[list[InterpolatedBlock], IntArray]:
    """Interpolate all depths between the nodes; return also which err too much."""
    blocks, failed = [], []
    for some in split_blocks(z.size, DEPTHS_PER_BLOCK):
        first = max(int(np.searchsorted(nodes, some.start)) - NEIGHBOURS, 0)
        last = int(np.searchsorted(nodes, some.stop - 1)) + NEIGHBOURS
        around = slice(first, min(last, nodes.size))
        weights, errors = spectrum.interpolate(z[some], z[nodes[around]], NOISE_FRACTION * error)
        blocks.append(InterpolatedBlock(some, around, weights.astype(np.complex64)))
        failed.append(some.start + np.flatnonzero(errors > error))
    return blocks, np.concatenate(failed)
