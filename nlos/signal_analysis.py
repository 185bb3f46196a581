"""What a capture's signals say about themselves: the wall's own light, and signal against noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nlos.band import VirtualPulse
from nlos.capture import Capture
from tofclip.arrays import to_numpy

FloatArray = NDArray[np.float64]

PROFILE_STEPS_PER_WALL = 50
"""Steps of the mean signal's profile per width of the wall."""

FIRST_BOUNCE_WALL_FRACTION = 0.1
"""The wall's own light arrives within this fraction of the wall's width of its own path."""

MIN_BOUNCE_RATIO = 3.0
"""The wall's own light falls at least by this factor before anything else arrives."""

FADED_FRACTION = 0.1
"""The wall's own light has faded when it is this fraction of the brightest light that follows."""


MIN_EARLY_FRACTION = 0.02
"""Of the samples, before any light can have come, that tell the noise."""

NOISE_BAND_FRACTION = 0.25
"""Of all frequencies, the highest are taken for noise."""

MAX_ANALYSED_POINTS = 1024
"""Wall points whose signals are looked at."""

MIN_FLOOR_RATIO = 1e-5
"""Of the strongest wave's energy, the least that is noise and not the tail of a pulse."""

MAX_FLOOR_SLOPE = 0.15
"""What noise's energy may change from the lower to the upper half of the highest frequencies."""

LIT_END_FRACTION = 0.01
"""Of the brightest light, what the last bins hold if light still comes."""


@dataclass(frozen=True)
class FirstBounce:
    """Light that came straight from the laser spot, by way of no hidden thing.

    Parameters
    ----------
    end : float
        m of path after its arrival by which it has faded.
    ratio : float
        Its peak, relative to the brightest light that follows.
    """

    end: float
    ratio: float


def find_first_bounce(capture: Capture) -> FirstBounce | None:
    """Recognise the light that the wall returns at once, and how long it lasts.

    It arrives at every wall point after the path from the laser spot, and falls from there on until
    hidden things' light rises.

    Parameters
    ----------
    capture : Capture

    Returns
    -------
    FirstBounce or None
        None where no such light is in the record.
    """
    late, level = _compute_profile(capture)
    extent = float(np.ptp(capture.points, axis=0).max())
    if late.size < 4:
        return None
    early = late <= FIRST_BOUNCE_WALL_FRACTION * extent
    if not early.any() or early.all():
        return None
    peak = int(np.argmax(np.where(early, level, -np.inf)))
    # From the peak on, the lowest level before the highest that rises from it again.
    fall = np.minimum.accumulate(level[peak:])
    rise = level[peak:] - fall
    top = peak + int(np.argmax(rise))
    valley = peak + int(np.argmin(level[peak : top + 1])) if rise.max() > 0 else level.size - 1
    lowest = float(level[valley])
    follows = float(level[valley:].max()) - lowest
    if level[peak] < MIN_BOUNCE_RATIO * max(lowest, 0.0) or level[peak] <= 0:
        return None
    if follows <= 0:
        follows = float(level[peak]) * FADED_FRACTION
    faded = np.flatnonzero(level[peak : valley + 1] - lowest <= FADED_FRACTION * follows)
    if faded.size and faded[0] == 0:
        return None  # a few counts of the background before anything else
    end = float(late[peak + int(faded[0])]) if faded.size else float(late[valley])
    return FirstBounce(max(end, 0.0), (float(level[peak]) - lowest) / follows)


@dataclass(frozen=True, eq=False)
class SignalSpectrum:
    """How much of each wave a capture's signals hold, and how much of it is noise.

    Photons' noise is white: what the highest frequencies hold, all frequencies hold. Other noise is
    known where the record begins before light can have come.

    Parameters
    ----------
    power : (frequencies,) array
        Mean over the wall points.
    floor : float
        Of the noise.
    wavenumbers : (frequencies,) array
        rad/m of path.
    spectrum : (n, frequencies) complex array
        Of some wall points.
    early : (n, t) bool array
        Samples before any light can have come; none where there are too few.
    points : int
        All wall points.
    """

    power: FloatArray
    floor: float
    wavenumbers: FloatArray
    spectrum: NDArray[np.complex128]
    early: NDArray[np.bool_]
    points: int

    @classmethod
    def of(cls, capture: Capture, margin: float) -> SignalSpectrum:
        """Analyse a capture without the wall's own light.

        Parameters
        ----------
        capture : Capture
        margin : float
            m of path before light may come that a wave reaches ahead.

        Returns
        -------
        SignalSpectrum
        """
        traces, direct = _select_traces(capture)
        # Waves would see an edge where the record ends while light still comes.
        spectrum = np.fft.rfft(traces * np.hanning(traces.shape[1]), axis=1)
        power = np.mean(np.abs(spectrum) ** 2, axis=0)
        floor = float(np.mean(power[-max(1, int(NOISE_BAND_FRACTION * power.size)) :]))
        early = capture.axis.paths < (direct - margin)[:, np.newaxis]
        if early.mean() < MIN_EARLY_FRACTION or not traces[early].any():
            early = np.zeros_like(early)
        frequencies = np.fft.rfftfreq(traces.shape[1], capture.axis.spacing)
        wavenumbers = np.asarray(2 * np.pi * frequencies, np.float64)
        unwindowed = np.fft.rfft(traces, axis=1)
        return cls(power, floor, wavenumbers, unwindowed, early, len(capture.points))

    @property
    def is_noisy(self) -> bool:
        """Whether white noise is seen in the spectrum, as in all that was recorded.

        It is flat at the highest frequencies, where the tail of a pulse falls.
        """
        count = max(1, int(NOISE_BAND_FRACTION * self.power.size) // 2)
        below = float(np.mean(self.power[-2 * count : -count]))
        above = float(np.mean(self.power[-count:]))
        seen = self.floor > MIN_FLOOR_RATIO * float(self.power.max(initial=0.0))
        return seen and abs(below / above - 1) < MAX_FLOOR_SLOPE

    def coherent_signal(self, pulse: VirtualPulse) -> float:
        """Signal over noise of all wall points together in a pulse's band."""
        if not self.is_noisy:
            return np.inf
        weight = pulse.spectrum(self.wavenumbers) ** 2
        return self.points * float(np.sum(weight * self.power) / np.sum(weight) / self.floor - 1)

    def fraction_shorter(self, pulse: VirtualPulse, wavelength: float) -> float:
        """Fraction of a pulse's signal, noise taken off, in waves shorter than `wavelength` m.

        Parameters
        ----------
        pulse : VirtualPulse
        wavelength : float
            Metres.

        Returns
        -------
        float
            0 to 1.
        """
        signal = pulse.spectrum(self.wavenumbers) ** 2 * np.maximum(self.power - self.floor, 0)
        shorter = self.wavenumbers > 2 * np.pi / wavelength
        total = float(signal.sum())
        return float(signal[shorter].sum()) / total if total > 0 else 0.0

    def band_over_early(self, pulse: VirtualPulse) -> float:
        """Energy in a pulse's band where light may have come, over that before; infinite where the
        record does not begin so early.
        """
        if not self.early.any():
            return np.inf
        # The waves of negative frequencies are left out, so that the magnitude is the envelope.
        padded = np.zeros(self.early.shape, np.complex128)
        padded[:, : self.spectrum.shape[1]] = self.spectrum * pulse.spectrum(self.wavenumbers)
        energy = np.abs(np.fft.ifft(padded, axis=1)) ** 2
        before = float(energy[self.early].mean())
        return float(energy[~self.early].mean()) / before if before > 0 else np.inf


def find_brightest_path(capture: Capture) -> float:
    """Path, beyond that of the wall's own light, at which most light arrives, m."""
    late, level = _compute_profile(capture)
    return float(late[np.argmax(level)])


def find_lit_end(capture: Capture) -> bool:
    """Whether light still comes when the record ends, so that its end shows as an edge."""
    traces, _ = _select_traces(capture)
    level = np.abs(traces.mean(axis=0))
    last = level[-max(1, level.size // 50) :].mean()
    return bool(last > LIT_END_FRACTION * level.max())


def _compute_profile(capture: Capture) -> tuple[FloatArray, FloatArray]:
    """Mean signal by path beyond that of the wall's own light: paths, m, and levels."""
    traces, direct = _select_traces(capture)
    extent = float(np.ptp(capture.points, axis=0).max())
    step = max(capture.axis.spacing, extent / PROFILE_STEPS_PER_WALL)
    number = np.floor((capture.axis.paths - direct[:, np.newaxis]) / step).astype(np.intp)
    first = int(number.min())
    count = np.bincount((number - first).ravel())
    total = np.bincount((number - first).ravel(), traces.ravel())
    # Steps that few wall points reach tell little of the wall.
    kept = count > count.max() / 10
    paths = step * (first + np.arange(count.size) + 0.5)
    return paths[kept], total[kept] / count[kept]


def _select_traces(capture: Capture) -> tuple[FloatArray, FloatArray]:
    """Signals (n, t) of some wall points, evenly picked, and the path to each from its laser, m."""
    some = np.arange(len(capture.points))[:: len(capture.points) // MAX_ANALYSED_POINTS + 1]
    flat = to_numpy(capture.signal).reshape(capture.axis.bins, -1)
    traces = flat[:, np.flatnonzero(capture.valid)[some]].T.astype(np.float64)
    lasers = capture.lasers if len(capture.lasers) == 1 else capture.lasers[some]
    direct: FloatArray = np.linalg.norm(capture.points[some] - lasers, axis=1)
    return traces, direct
