"""f-k migration: confocal imaging as a wave that runs back into the scene."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nlos.capture import Capture
from nlos.confocal.kernels import migrate_row
from nlos.confocal.scan import (
    ConfocalPlan,
    ConfocalScan,
    find_padded_length,
    resample_to_grid,
)
from nlos.geometry import Grid
from nlos.method import Method
from nlos.plane import axis_step
from tofclip.errors import InputError
from tofclip.threads import run_blocks, thread_count


@dataclass(frozen=True)
class FKMigration(Method):
    """Confocal imaging by f-k (Stolt) migration.

    The signals are taken for a wave that all hidden points sent out at once and that travelled to
    the wall at half the speed of light. A resampling of its spectrum, from frequency to depth
    wavenumber, gives the wave at that one instant. Needs a confocal scan of a lattice on a plane z
    = const; copes with glossy and retroreflective things.

    The spectrum is interpolated about the middle of the record, where linear interpolation dims
    late signals least.

    Memory: for P wall points and T bins, two half spectra of the box padded to twice its size along
    all three axes, some 100 * P * T bytes (0.2 GB for 64 x 64 x 512); time: two transforms of that
    box.

    Lindell, Wetzstein, O'Toole, "Wave-based non-line-of-sight imaging using fast f-k migration",
    ACM Trans. Graph. 38, 116 (2019), Eq. 7-9.

    Parameters
    ----------
    falloff : float
        Power of the distance with which brightness falls: 4 for diffuse things, 2 for
        retroreflective ones.
    """

    falloff: float = 4.0

    def __post_init__(self) -> None:
        if not (np.isfinite(self.falloff) and self.falloff >= 0):
            raise InputError(f"falloff must be a power of 0 or more, got {self.falloff}")

    def plan(self, capture: Capture, grid: Grid) -> ConfocalPlan:
        """Make the method ready for captures like `capture` on `grid`.

        Parameters
        ----------
        capture : Capture
            A confocal scan of a lattice on a plane z = const, without the light that the wall
            returns at once; see `nlos.preparation.remove_first_bounce`.
        grid : Grid
            Up to half a wall beyond the wall's edges; read by linear interpolation.

        Returns
        -------
        ConfocalPlan

        Raises
        ------
        InputError
            The method cannot image such a capture on the grid, or not within memory.
        """
        settings = {"method": "fk", "falloff": self.falloff}
        return ConfocalPlan(capture, grid, self._compute, settings)

    def _compute(self, scan: ConfocalScan, grid: Grid) -> NDArray[np.float32]:
        """Return the image (z, y, x) of a scan on a grid."""
        energy = _compute_energy(
            _migrate_spectrum(self._compute_spectrum(scan), scan), scan.signal.shape[2]
        )
        return resample_to_grid(energy, scan, grid, (grid.z - scan.plane.z) / scan.spacing)

    def _compute_spectrum(self, scan: ConfocalScan) -> NDArray[np.complex64]:
        """Spectrum (ky, kx, frequency >= 0) of the wave's amplitude; its middle in time stands at
        time 0.
        """
        from scipy.fft import fft2, rfft

        rows, columns, bins = scan.signal.shape
        brightness = scan.correct_falloff(self.falloff)
        # brightness is the square of a wave's amplitude; noise keeps its sign
        wave = np.copysign(np.sqrt(np.abs(brightness)), brightness)
        period, workers = find_padded_length(bins), thread_count()
        spectrum = rfft(wave, period, workers=workers)
        # the record's middle becomes time zero, about which a spectrum varies slowest from
        # frequency to frequency
        spectrum *= np.exp(2j * np.pi * (bins // 2) / period * np.arange(spectrum.shape[2])).astype(
            np.complex64
        )
        lateral: NDArray[np.complex64] = fft2(
            spectrum,
            (find_padded_length(rows), find_padded_length(columns)),
            axes=(0, 1),
            workers=workers,
        )
        return lateral


def _migrate_spectrum(spectrum: NDArray[np.complex64], scan: ConfocalScan) -> NDArray[np.complex64]:
    """Resample the spectrum from frequency to depth wavenumber, in place."""
    bins = scan.signal.shape[2]
    period = find_padded_length(bins)
    ky, kx = (
        np.fft.fftfreq(n, axis_step(axis)) * period * scan.spacing
        for n, axis in zip(spectrum.shape[:2], (scan.plane.y, scan.plane.x), strict=True)
    )
    delay = 2 * np.pi * (bins // 2) / period

    def process_block(rows: slice) -> None:
        for r in range(rows.start, rows.stop):
            migrate_row(spectrum[r], ky[r], kx, delay)

    run_blocks(process_block, spectrum.shape[0], 8)
    return spectrum


def _compute_energy(spectrum: NDArray[np.complex64], bins: int) -> NDArray[np.float32]:
    """Return the wave's energy (y, x, depth), from its spectrum without negative depth wavenumbers."""
    from scipy.fft import ifft, ifft2

    workers = thread_count()
    wave = ifft2(spectrum, axes=(0, 1), workers=workers, overwrite_x=True)
    energy = np.empty((*wave.shape[:2], bins), np.float32)

    def process_block(rows: slice) -> None:
        field = ifft(wave[rows], find_padded_length(bins))[..., :bins]
        energy[rows] = field.real**2 + field.imag**2

    run_blocks(process_block, wave.shape[0], 8)
    return energy
