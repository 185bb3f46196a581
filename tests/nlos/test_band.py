import numpy as np
import pytest
from numpy.linalg import norm

from nlos.band import Band, VirtualPulse
from nlos.capture import TimeAxis

AXIS = TimeAxis(bins=300, bin_width=16e-12, start=0.7)
PULSE = VirtualPulse(0.125, 3)


def waveform_of(signal, band):
    waveforms = band.waveforms(band.compute_phasors(signal[None]))
    paths = waveforms.start + waveforms.spacing * np.arange(waveforms.values.shape[1])
    return paths, waveforms.values[0]


@pytest.mark.parametrize("cycles", [3, 5, 8])
@pytest.mark.parametrize("place", [0, 120, 299])
def test_an_impulse_becomes_the_virtual_pulse(place, cycles):
    """At the ends of the record as well: nothing wraps around."""
    pulse = VirtualPulse(0.125, cycles)
    signal = np.zeros(AXIS.bins)
    signal[place] = 1.0
    paths, found = waveform_of(signal, Band(pulse, AXIS))
    distance = paths - AXIS.paths[place]
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


def test_phasors_are_the_weighted_fourier_sum_of_their_definition():
    band = Band(PULSE, AXIS)
    signal = np.random.default_rng(3).normal(size=(2, AXIS.bins))
    kernel = np.exp(-1j * np.outer(AXIS.paths, band.wavenumbers))
    expected = band.weights * (signal @ kernel)
    assert band.compute_phasors(signal) == pytest.approx(expected, rel=1e-10, abs=1e-14)
    single = band.compute_phasors(signal.astype(np.float32))
    assert single.dtype == np.complex64
    # float32 sums of 300 terms.
    assert norm(single - expected) < 1e-5 * norm(expected)
