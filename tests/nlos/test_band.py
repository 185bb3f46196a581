from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nlos.band import Band, VirtualPulse
from nlos.capture import TimeAxis
from tofclip.errors import InputError

AXIS = TimeAxis(bins=300, bin_width=16e-12, start=0.7)
PULSE = VirtualPulse(0.125, 3)


def waveform_of(signal: np.ndarray, band: Band) -> tuple[np.ndarray, np.ndarray]:
    waveforms = band.waveforms(band.compute_phasors(signal[None]))
    paths = waveforms.start + waveforms.spacing * np.arange(waveforms.values.shape[1])
    return paths, waveforms.values[0]


@pytest.mark.parametrize("cycles", [3, 5, 8])
def test_an_impulse_becomes_the_virtual_pulse(cycles: float) -> None:
    pulse = VirtualPulse(0.125, cycles)
    signal = np.zeros(AXIS.bins)
    signal[120] = 1.0
    paths, found = waveform_of(signal, Band(pulse, AXIS))
    distance = paths - AXIS.paths[120]
    # The inverse Fourier transform of G(k) over all positive and negative k, for samples `spacing`
    # apart.
    height = 2 * AXIS.spacing / (pulse.sigma * np.sqrt(2 * np.pi))
    expected = (
        height
        * np.exp(-(distance**2) / (2 * pulse.sigma**2))
        * np.exp(2j * np.pi * distance / pulse.wavelength)
    )
    assert np.max(np.abs(found - expected)) < 0.02 * height
    # What is left far from the pulse, where a Gaussian cut off at the band's edge has 14e-4.
    assert np.max(np.abs(found[np.abs(distance) > 4.5 * pulse.sigma])) < 3e-4 * height


def test_phasors_are_the_weighted_fourier_sum_of_their_definition() -> None:
    band = Band(PULSE, AXIS)
    signal = np.random.default_rng(3).normal(size=(2, AXIS.bins))
    kernel = np.exp(-1j * np.outer(AXIS.paths, band.wavenumbers))
    expected = band.weights * (signal @ kernel)
    assert band.compute_phasors(signal) == pytest.approx(expected, rel=1e-10, abs=1e-14)
    single = band.compute_phasors(signal.astype(np.float32))
    assert single.dtype == np.complex64
    # float32 sums of 300 terms.
    assert np.linalg.norm(single - expected) < 1e-5 * np.linalg.norm(expected)


@settings(max_examples=25, deadline=None)
@given(
    position=st.integers(0, 199),
    wavelength=st.floats(0.02, 0.3),
    cycles=st.floats(3, 8),
    start=st.floats(-2, 2),
)
def test_nothing_wraps_around_the_end_of_the_record(
    position: int, wavelength: float, cycles: float, start: float
) -> None:
    axis = TimeAxis(200, 16e-12, start)
    signal = np.zeros(axis.bins)
    signal[position] = 1.0
    pulse = VirtualPulse(wavelength, cycles)
    paths, found = waveform_of(signal, Band(pulse, axis))
    assert paths[0] <= axis.start - 4 * pulse.sigma
    assert paths[-1] >= axis.paths[-1] + 4 * pulse.sigma - 1e-9
    assert np.all(found[[0, -2, -1]] == 0)
    far = np.abs(paths - axis.paths[position]) > 6 * pulse.sigma
    # Ringing of the band cut at 1 % of its peak, with two such edges, decays like 1 / distance.
    assert np.all(np.abs(found[far]) < 0.01 * np.abs(found).max())
    assert np.abs(paths[np.argmax(np.abs(found))] - axis.paths[position]) <= axis.spacing


def test_the_samples_are_fine_enough_for_linear_interpolation() -> None:
    band = Band(VirtualPulse(0.048, 3), TimeAxis(1016, 4.6e-12, 0.138))
    spacing = band.waveforms(band.compute_phasors(np.zeros((1, 1016), np.float32))).spacing
    assert spacing <= 0.048 / 64
    # Whole bins are still hit: no interpolation error where the record itself has a sample.
    assert (band.axis.spacing / spacing) % 1 == pytest.approx(0, abs=1e-9)


@pytest.mark.parametrize(
    ("wavelength", "cycles", "message"),
    [
        *((wave, 3, "empty band") for wave in (1e-4, 2 * AXIS.spacing)),
        *((wave, 3, "virtual pulse must be a positive") for wave in (0, -1, np.nan)),
        *((0.1, cycles, "virtual pulse must be a positive") for cycles in (0, np.inf)),
    ],
)
def test_what_is_no_band_is_refused(wavelength: float, cycles: float, message: str) -> None:
    with pytest.raises(InputError, match=message):
        Band(VirtualPulse(wavelength, cycles), AXIS)


def test_tails_too_small_for_normal_numbers_change_nothing() -> None:
    """Simulated pulses fade to 1e-38 and below, which a processor multiplies ten times as slowly."""
    random, band = np.random.default_rng(0), Band(VirtualPulse(0.125, 3), AXIS)
    signal = random.normal(size=(6, AXIS.bins)).astype(np.float32)
    tails = np.where(random.random(signal.shape) < 0.5, np.float32(1e-38) * signal, signal)
    clean = np.where(np.abs(tails) < 1e-30, np.float32(0), tails)
    assert np.array_equal(band.compute_phasors(tails), band.compute_phasors(clean))
    # faint signals are no tails
    faint = band.compute_phasors(np.float32(1e-25) * signal)
    expected = 1e-25 * band.compute_phasors(signal).astype(np.complex128)
    assert np.linalg.norm(faint - expected) < 1e-5 * np.linalg.norm(expected)
