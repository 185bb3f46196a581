"""The virtual pulse of phasor-field imaging, and the few frequencies of a capture that it lets
pass.

Liu et al., "Non-line-of-sight imaging using phasor-field virtual wave optics", Nature 572, 620-623
(2019).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nlos.capture import TimeAxis
from tofclip.arrays import AnyArray, BoolArray, FloatArray, IntArray
from tofclip.errors import InputError, require_positive, require_type
from tofclip.threads import limit_blas_threads, run_blocks, split_blocks

# The pulse's cycles fill its envelope from -3 to +3 standard deviations.
ENVELOPE_SIGMAS = 3.0
# Where the pulse's spectrum ends, in detunings times the envelope's standard deviation.
BAND_EDGE = 3.15
# Room for the pulse before and after the record, in standard deviations of its envelope: an edge of
# the record leaves 1e-4 of itself beyond.
TAIL_SIGMAS = 4.5
# Of Kaiser's spectrum: near to the Gaussian, and its echoes weak enough for tolerances of 1e-3.
KAISER = 9.46
# Bins that are reduced to the few shapes of waves in the band before the Fourier transform.
BLOCK_BINS = 64
# Wall points that a thread filters at once.
POINTS_PER_BLOCK = 1024
# Samples below this fraction of the strongest count as 0: products with them would leave float32's
# normal numbers, which takes processors ten times as long (tails of simulated pulses are like
# that).
NEGLIGIBLE_FRACTION = 1e-20
# Samples of a signal per carrier wavelength: linear interpolation errs by 1e-3 rms for 3 cycles.
SAMPLES_PER_WAVELENGTH = 64


@dataclass(frozen=True)
class VirtualPulse:
    """A carrier of a given wavelength under an envelope that is Gaussian within 2 %.

    The envelope over path length L is about ``exp(-L^2 / (2 * sigma^2))`` with ``6 * sigma = cycles
    * wavelength``: 99.7 % of it lie within the cycles. Its spectrum is Kaiser's: a Gaussian that is
    cut off as early rings ten times as strongly, which shows as echoes of a record's end.

    Parameters
    ----------
    wavelength : float
        Carrier wavelength in path length, m. About twice the size of the finest detail that is
        resolved; at least twice the spacing of the wall points.
    cycles : float
        Length of the pulse in wavelengths. With fewer than 3 the spectrum reaches down to frequency
        0, where it has to be cut, and the pulse rings.
    """

    wavelength: float
    cycles: float = 3.0

    def __post_init__(self) -> None:
        for name in ("wavelength", "cycles"):
            value = getattr(self, name)
            require_type(value, (int, float, np.number), f"{name} of the virtual pulse is a number")
            require_positive(f"{name} of the virtual pulse", value)

    @property
    def wavenumber(self) -> float:
        """Wavenumber of the carrier, rad/m."""
        return 2 * np.pi / self.wavelength

    @property
    def sigma(self) -> float:
        """Standard deviation of the envelope, m of path."""
        return self.cycles * self.wavelength / (2 * ENVELOPE_SIGMAS)

    @property
    def half_band(self) -> float:
        """Wavenumbers on either side of the carrier's that the pulse holds, rad/m."""
        return BAND_EDGE / self.sigma

    def spectrum(self, wavenumbers: Any) -> FloatArray:
        """Strength of the pulse at ``wavenumbers``, rad/m, 1 at the carrier, 0 beyond the band.

        J. F. Kaiser, R. W. Schafer, IEEE Trans. Acoust. Speech Signal Process. 28, 105 (1980).
        """
        from scipy.special import i0

        inside, root = self._find_in_band(wavenumbers)
        return np.where(inside, (i0(KAISER * root) - 1) / (i0(KAISER) - 1), 0.0)

    def slope(self, wavenumbers: Any) -> FloatArray:
        """Slope, m, of the logarithm of `spectrum` at ``wavenumbers``, rad/m, of the band."""
        from scipy.special import i0, i1

        _, root = self._find_in_band(wavenumbers)
        argument = KAISER * np.maximum(root, 1e-3)
        detuning = np.asarray(wavenumbers, dtype=np.float64) - self.wavenumber
        change: FloatArray = i1(argument) / (argument * (i0(argument) - 1))
        return -((KAISER / self.half_band) ** 2) * detuning * change

    def _find_in_band(self, wavenumbers: Any) -> tuple[BoolArray, FloatArray]:
        """Which wavenumbers are in the band, and ``sqrt(1 - u^2)`` of their places -1 < u < 1."""
        place = (np.asarray(wavenumbers, dtype=np.float64) - self.wavenumber) / self.half_band
        return np.abs(place) <= 1, np.sqrt(np.maximum(1 - place**2, 0))


@dataclass(frozen=True, eq=False)
class Waveforms:
    """Band-limited complex signals, finely sampled over path length."""

    # (points, samples), 0 at the first and the last two: holding them means silence outside
    values: AnyArray
    start: float  # path length of sample 0, m
    spacing: float  # path between samples, m


@dataclass(frozen=True, eq=False)
class Band:
    """The frequencies at which a virtual pulse sees captures of a time axis: harmonics of a period
    that holds the record and the pulse before and after it, so that no signal wraps around.
    """

    pulse: VirtualPulse
    axis: TimeAxis

    def __post_init__(self) -> None:
        shortest = 2 * self.axis.spacing
        if self.pulse.wavelength <= shortest or self.harmonics.size == 0:
            raise InputError(
                f"empty band: time bins of {self.axis.spacing:.4g} m of path cannot carry a wavelength of "
                f"{self.pulse.wavelength:.4g} m; use more than {shortest:.4g} m"
            )

    @cached_property
    def tail_bins(self) -> int:
        """Bins of silence before and after the record, which the pulse spreads into."""
        return int(np.ceil(TAIL_SIGMAS * self.pulse.sigma / self.axis.spacing)) + 1

    @cached_property
    def period_bins(self) -> int:
        """Length of the Fourier transform, bins."""
        from scipy.fft import next_fast_len

        return int(next_fast_len(self.axis.bins + 2 * self.tail_bins, real=True))

    @cached_property
    def harmonics(self) -> IntArray:
        """Which frequencies of the transform; not 0 nor Nyquist's, which have no phase."""
        indices = np.arange(1, (self.period_bins + 1) // 2)
        return indices[self.pulse.spectrum(indices * self._fundamental_wavenumber) > 0]

    @property
    def _fundamental_wavenumber(self) -> float:
        return 2 * np.pi / (self.period_bins * self.axis.spacing)

    @property
    def wavenumbers(self) -> FloatArray:
        """The band's wavenumbers k, rad/m, evenly spaced, shape (frequencies,)."""
        return self._fundamental_wavenumber * self.harmonics.astype(np.float64)

    @property
    def weights(self) -> FloatArray:
        """The pulse's weights G_k; phasors of ``cos(k * L)`` add up to ``exp(1j * k * L)``."""
        # 2 / n: positive frequencies stand for both signs of a real signal
        return self.pulse.spectrum(self.wavenumbers) * (2 / self.period_bins)

    @property
    def strength(self) -> FloatArray:
        """The pulse's weights relative to the largest, shape (frequencies,)."""
        return self.weights / self.weights.max()

    def compute_phasors(self, traces: AnyArray) -> AnyArray:
        """Return the phasors P_k (points, frequencies) of signals (points, t), as precise as these."""
        real, bins = traces.dtype.type, traces.shape[1]
        # A library's own threads would go on waiting, busily, where ours want to work.
        with limit_blas_threads():
            shapes, coefficients = self._get_fourier_matrices(bins, real)
            parts = np.empty((len(traces), coefficients.shape[1]), real)

            def filter_block(some: slice) -> None:
                in_time = traces[some].T
                floor = NEGLIGIBLE_FRACTION * max(in_time.max(), -in_time.min())
                short = np.empty((len(coefficients), in_time.shape[1]), real)
                for block, own in zip(
                    split_blocks(bins, BLOCK_BINS),
                    np.split(short, -(-bins // BLOCK_BINS)),
                    strict=True,
                ):
                    samples = np.abs(in_time[block])
                    np.multiply(in_time[block], samples > floor, out=samples)
                    np.matmul(shapes[: block.stop - block.start].T, samples, out=own)
                np.matmul(short.T, coefficients, out=parts[some])

            run_blocks(filter_block, len(traces), POINTS_PER_BLOCK)
        return parts.view(np.result_type(real, np.complex64))

    def _get_fourier_matrices(self, bins: int, real: type[Any]) -> tuple[AnyArray, AnyArray]:
        """Matrices of two steps of a Fourier transform at the band's frequencies: few shapes (bins,
        n) make up a narrow band's waves in a block of bins, whatever their phases; (blocks * n, 2 *
        frequencies) turn their strengths into phasors, real and imaginary parts interleaved.
        """
        if (bins, real) in self._matrices:
            return self._matrices[bins, real]
        phases = np.outer(self.axis.spacing * np.arange(BLOCK_BINS), self.wavenumbers)
        waves = np.exp(-1j * phases)
        shapes, strengths, _ = np.linalg.svd(
            np.concatenate([waves.real, waves.imag], axis=1), full_matrices=False
        )
        shapes = shapes[:, strengths > 8 * np.finfo(real).eps * strengths[0]]
        starts = self.axis.start + self.axis.spacing * np.arange(0, bins, BLOCK_BINS)
        carriers = self.weights * np.exp(-1j * np.outer(starts, self.wavenumbers))
        coefficients = carriers[:, np.newaxis] * (shapes.T @ waves)
        parts = coefficients.reshape(-1, self.wavenumbers.size).view(np.float64)
        self._matrices[bins, real] = shapes.astype(real), parts.astype(real)
        return self._matrices[bins, real]

    @cached_property
    def _matrices(self) -> dict[tuple[int, type[Any]], tuple[AnyArray, AnyArray]]:
        return {}

    def waveforms(self, phasors: AnyArray) -> Waveforms:
        """Return ``sum_k P_k * exp(1j * k * L)``, sampled for linear interpolation."""
        # So few frequencies are summed faster by a matrix product than by a padded transform.
        carriers, start, spacing = self.carriers
        return Waveforms(phasors @ carriers.astype(phasors.dtype), start, spacing)

    @property
    def sample_count(self) -> int:
        """Length of the waveforms."""
        return int(self.carriers[0].shape[1])

    @cached_property
    def carriers(self) -> tuple[NDArray[np.complex128], float, float]:
        """``exp(1j * k * L)`` (frequencies, samples) over the record and the pulse's tails, path of
        sample 0 and between samples, m; 0 at the first and the last two, where paths outside are
        clamped.
        """
        fineness = SAMPLES_PER_WAVELENGTH * self.axis.spacing / self.pulse.wavelength
        spacing = self.axis.spacing / max(1, int(np.ceil(fineness)))
        tail = self.tail_bins * self.axis.spacing
        count = round((self.axis.bins * self.axis.spacing + 2 * tail) / spacing)
        paths = self.axis.start - tail + spacing * np.arange(count, dtype=np.float64)
        carriers: NDArray[np.complex128] = np.exp(1j * np.outer(self.wavenumbers, paths))
        carriers[:, [0, -2, -1]] = 0
        return carriers, float(paths[0]), spacing
