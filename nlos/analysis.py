"""What a capture says about itself before it is imaged: whether a picture can come of it, which
light is the wall's own, which waves its points and its noise leave to see.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.linalg import norm
from numpy.typing import NDArray

from nlos.band import VirtualPulse
from nlos.capture import Capture, measure_extent, select_lasers
from nlos.illumination import is_confocal
from tofclip.arrays import BoolArray, FloatArray, to_numpy
from tofclip.errors import InputError, require

# Steps of the mean signal's profile per width of the wall.
PROFILE_STEPS_PER_WALL = 50
# The wall's own light arrives within this fraction of the wall's width of its own path: earlier,
# there is noise only, and later, hidden things.
FIRST_BOUNCE_WALL_FRACTION = 0.1
# The wall's own light falls at least by this factor before anything else arrives.
MIN_BOUNCE_RATIO = 3.0
# The wall's own light has faded when it is this fraction of the brightest light that follows.
FADED_FRACTION = 0.1
# Of the samples, before any light can have come, that tell the noise.
MIN_EARLY_FRACTION = 0.02
# Of the record, over which its window rises, and falls.
WINDOW_EDGE_FRACTION = 0.05
# Of all frequencies, the highest are taken for noise.
NOISE_BAND_FRACTION = 0.25
# Wall points whose signals are looked at.
MAX_ANALYSED_POINTS = 4096
# Of the strongest wave's energy, the least that is noise and not the tail of a pulse.
MIN_FLOOR_RATIO = 1e-5
# What white noise's energy may change from the lower to the upper half of the highest frequencies;
# beyond, and up to the second, it is coloured noise: of recovered frames, or rounded.
MAX_FLOOR_SLOPE, MAX_COLOURED_SLOPE = 0.1, 1.0
# Of the brightest light, what the last bins hold if light still comes.
LIT_END_FRACTION = 0.01
# Signal over noise of all wall points together that a wavelength needs: with it a letter of some
# hundred resolved voxels stands out. Measured on recorded letters and a mannequin.
MIN_COHERENT_SIGNAL = 600.0
# Energy that a wavelength has in the record, relative to before any light can have come.
MIN_BAND_OVER_EARLY = 3.0
# Of a pulse's signal, what may be of waves finer than the wall samples.
MAX_ALIASED_FRACTION = 0.2
# From one wavelength that is tried to the next.
WAVELENGTH_STEP_RATIO = 1.02
# A default wavelength is rounded up by less than one part in this number.
ROUNDED_PARTS = 30
# A laser spot farther from the wall than this number of its widths is a mistake.
MAX_LASER_WALL_WIDTHS = 5.0
# A laser spot may stand so far before the foremost or behind the hindmost wall point, and farther
# by this part of how far aside it is, where the wall is not known.
MAX_LASER_OFF_WALL_M, LASER_OFF_WALL_SLOPE = 0.05, 0.5
# A record that begins after a longer path, m, still holds the ways to the devices.
MAX_START_M = 1e3
# Of the samples, what may have the largest value: light comes during a part of the record.
MAX_SATURATED_FRACTION = 0.5
# Larger samples overflow once they are squared.
MAX_SIGNAL = 1e30


@dataclass(frozen=True)
class FirstBounce:
    """Light that came straight from the laser spot, by way of no hidden thing."""

    end: float  # m of path after its arrival by which it has faded
    ratio: float  # its peak, relative to the brightest light that follows


def find_first_bounce(capture: Capture) -> FirstBounce | None:
    """Recognise the light that the wall returns at once, after the path from the laser spot, and
    how long it lasts: it falls until hidden things' light rises. None where the record has none.

    A record that begins after its arrival may begin with its tail, which falls from the first bin on.
    """
    late, level = _compute_profile(capture)
    reach = FIRST_BOUNCE_WALL_FRACTION * measure_extent(capture)
    own, recorded = np.abs(late) <= reach, late[:1].min(initial=np.inf) <= reach
    if late.size < 4 or own.all() or (recorded and not own.any()):
        return None
    peak = int(np.argmax(np.where(own, level, -np.inf))) if recorded else 0
    # From the peak on, the lowest level before the highest that rises from it again.
    fall = np.minimum.accumulate(level[peak:])
    rise = level[peak:] - fall
    top = peak + int(np.argmax(rise))
    valley = peak + int(np.argmin(level[peak : top + 1])) if rise.max() > 0 else level.size - 1
    lowest = float(level[valley])
    follows = float(level[valley:].max()) - lowest
    if level[peak] < MIN_BOUNCE_RATIO * max(lowest, 0.0) or level[peak] <= 0:
        return None
    if follows <= 0 and not recorded:
        return None  # it may be hidden things' own
    if follows <= 0:
        follows = float(level[peak]) * FADED_FRACTION
    faded = np.flatnonzero(level[peak : valley + 1] - lowest <= FADED_FRACTION * follows)
    if faded.size and faded[0] == 0:
        return None  # a few counts of the background before anything else
    end = float(late[peak + int(faded[0])]) if faded.size else float(late[valley])
    return FirstBounce(max(end, 0.0), (float(level[peak]) - lowest) / follows)


@dataclass(frozen=True, eq=False)
class SignalSpectrum:
    """How much of each wave a capture's signals hold, and how much is noise: photons' is white, as
    the highest frequencies tell; other noise is known from before light can have come.
    """

    power: FloatArray  # (frequencies,), mean over the wall points
    floor: float  # of the noise
    wavenumbers: FloatArray  # (frequencies,), rad/m of path
    spectrum: NDArray[np.complex128]  # (n, frequencies), of some wall points
    # (n, t), samples before any light can have come; none where there are too few
    early: BoolArray
    points: int  # all wall points

    @classmethod
    def of(cls, capture: Capture, margin: float) -> SignalSpectrum:
        """Analyse a gated capture; a wave reaches `margin` m ahead of its light."""
        traces, direct = _select_traces(capture)
        # Waves would see an edge where the record ends while light still comes. Between the ends
        # the window is flat: light counts alike wherever in the record it comes.
        inward = np.minimum(places := np.arange(traces.shape[1]), places[::-1])
        rising = np.minimum(inward / (WINDOW_EDGE_FRACTION * traces.shape[1]), 1)
        spectrum = np.fft.rfft(traces * (1 - np.cos(np.pi * rising)) / 2, axis=1)
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
        """Whether white noise is seen: flat where a pulse's tail would fall."""
        return self._floor_slope < MAX_FLOOR_SLOPE

    @property
    def is_coloured(self) -> bool:
        """Whether noise is seen that is not white, so that the spectrum does not tell its level."""
        return MAX_FLOOR_SLOPE <= self._floor_slope < MAX_COLOURED_SLOPE

    @property
    def _floor_slope(self) -> float:
        """Change of the energy at the highest frequencies; infinite where no floor is seen."""
        if not self.floor > MIN_FLOOR_RATIO * float(self.power.max(initial=0.0)):
            return np.inf
        count = max(1, int(NOISE_BAND_FRACTION * self.power.size) // 2)
        below, above = self.power[-2 * count : -count].mean(), self.power[-count:].mean()
        return abs(float(below / above) - 1)

    def coherent_signal(self, pulse: VirtualPulse) -> float:
        """Signal over noise of all wall points together in a pulse's band."""
        if not self.is_noisy:
            return np.inf
        weight = pulse.spectrum(self.wavenumbers) ** 2
        return self.points * float(np.sum(weight * self.power) / np.sum(weight) / self.floor - 1)

    def fraction_shorter(self, pulse: VirtualPulse, wavelength: float) -> float:
        """Fraction of a pulse's signal, without noise, in waves shorter than `wavelength`, m."""
        signal = pulse.spectrum(self.wavenumbers) ** 2 * np.maximum(self.power - self.floor, 0)
        shorter = self.wavenumbers > 2 * np.pi / wavelength
        total = float(signal.sum())
        return float(signal[shorter].sum()) / total if total > 0 else 0.0

    def band_over_early(self, pulse: VirtualPulse) -> float:
        """Energy in a pulse's band over that before light can have come; infinite if unknown."""
        if not self.early.any():
            return np.inf
        # The waves of negative frequencies are left out, so that the magnitude is the envelope.
        padded = np.zeros(self.early.shape, np.complex128)
        padded[:, : self.spectrum.shape[1]] = self.spectrum * pulse.spectrum(self.wavenumbers)
        energy = np.abs(np.fft.ifft(padded, axis=1)) ** 2
        before = float(energy[self.early].mean())
        return float(energy[~self.early].mean()) / before if before > 0 else np.inf


def find_lit_end(capture: Capture) -> bool:
    """Whether light still comes when the record ends, so that its end shows as an edge."""
    traces, _ = _select_traces(capture)
    level = np.abs(traces.mean(axis=0))
    last = level[-max(1, level.size // 50) :].mean()
    return bool(last > LIT_END_FRACTION * level.max())


def require_plausible(capture: Capture) -> None:
    """Refuse what no picture can come of, before any work is done."""
    low, high = capture.points.min(axis=0), capture.points.max(axis=0)
    extent = measure_extent(capture)
    if len(capture.points) > 1 and extent == 0 and capture.laser.ndim == 1:
        raise InputError("all wall points stand in one place: a capture needs several places")
    beyond = np.maximum(np.maximum(low - capture.lasers, capture.lasers - high), 0)
    away = float(norm(beyond, axis=1).max())
    if extent > 0 and away > MAX_LASER_WALL_WIDTHS * extent:
        raise InputError(
            f"the laser spot lies {away:.3g} m from the wall, which is {extent:.3g} m wide: give the spot on the wall"
        )
    outside = norm(beyond[:, :2], axis=1)
    off = beyond[:, 2] - MAX_LASER_OFF_WALL_M - LASER_OFF_WALL_SLOPE * outside
    if extent > 0 and off.max() > 0:
        worst = int(np.argmax(off))
        side = "behind" if capture.lasers[worst, 2] < low[2] else "in front of"
        raise InputError(
            f"the laser spot lies {beyond[worst, 2]:.3g} m {side} the wall: give the spot on the wall"
        )
    if capture.start > MAX_START_M:
        raise InputError(
            f"the record begins at a path of {capture.start:.4g} m: take the ways to and from the devices off"
        )
    largest = float(abs(capture.signal).max())
    if not largest < MAX_SIGNAL:
        raise InputError(f"signals of {largest:.3g} overflow in single precision; scale them down")
    require(largest != 0, "every signal is 0: there is nothing to image")
    brightest = float(capture.signal.max())
    if brightest == float(capture.signal.min()):
        raise InputError(f"every signal is {largest:.4g}, constant or saturated: nothing to image")
    saturated = float((capture.signal == brightest).sum()) / math.prod(capture.signal.shape)
    if brightest > 0 and saturated > MAX_SATURATED_FRACTION:
        raise InputError(
            f"{100 * saturated:.0f} % of the samples are {brightest:.4g}, saturated: record less light"
        )


def require_usable_wavelength(capture: Capture, wavelength: float, cycles: float) -> None:
    """Refuse a given wavelength that shows nothing."""
    record = float(np.ptp(capture.axis.paths))
    extent = measure_extent(capture)
    longest = min(limit for limit in (extent, record / cycles) if limit > 0)
    if wavelength > longest * (1 + 1e-6):
        raise InputError(
            f"a wavelength of {wavelength:.3g} m shows nothing of this capture, with a wall {extent:.3g} m "
            f"wide and a record of {record:.3g} m: use at most {longest / 2:.2g} m"
        )


def require_usable_cycles(capture: Capture, cycles: float) -> None:
    """Refuse a virtual pulse that is longer than the record at every wavelength that bins carry."""
    record, shortest = float(np.ptp(capture.axis.paths)), 2 * capture.axis.spacing
    if cycles * shortest > record:
        raise InputError(
            f"a pulse of {cycles:.4g} cycles is longer than the record of {record:.3g} m: use at most "
            f"{record / shortest:.2g} cycles; about 3 are usual"
        )


def choose_wavelength(capture: Capture, cycles: float) -> tuple[float, str] | None:
    """Choose the carrier for a gated capture, m, and say why: the shortest that wall points and
    time bins carry. Only waves that stand out of noise make false images: these the wall has to
    sample, at the steepest angle. None where the spectrum does not tell, as in the photons' noise.
    """
    sampled = find_shortest_wavelength(capture, cycles)
    reason = "the shortest that wall points and time bins carry"
    longest = max(sampled * WAVELENGTH_STEP_RATIO, find_longest_wavelength(capture))
    spectrum = SignalSpectrum.of(capture, sampled)
    if spectrum.is_coloured:
        return None
    wavelength, aliased = sampled, 0.0
    if spectrum.is_noisy:
        aliased = _sampling_limit(capture, _steepest_angle(capture))
        wavelength = find_finest_wavelength(capture, cycles)
        reason = "the shortest above the noise that the wall points carry"
    while wavelength < longest:
        pulse = VirtualPulse(wavelength, cycles)
        if spectrum.coherent_signal(pulse) < MIN_COHERENT_SIGNAL:
            return None  # what all wall points see of a place together may still stand out
        if spectrum.fraction_shorter(pulse, aliased or np.inf) > MAX_ALIASED_FRACTION and aliased:
            reason = "shorter waves are finer than the wall points sample"
        elif spectrum.band_over_early(pulse) < MIN_BAND_OVER_EARLY:
            reason = "shorter waves are as strong before any light can have come"
        else:
            break
        wavelength *= WAVELENGTH_STEP_RATIO
    else:
        return None
    return round_wavelength_up(wavelength), reason


def find_finest_wavelength(capture: Capture, cycles: float) -> float:
    """Shortest carrier that the wall samples at the steepest angle of arriving waves, m."""
    aliased = _sampling_limit(capture, _steepest_angle(capture))
    sampled = find_shortest_wavelength(capture, cycles)
    return max(min(aliased, sampled), 4 * capture.axis.spacing)


def round_wavelength_up(wavelength: float) -> float:
    """Round a wavelength in m up to a power of ten that is at most a thirtieth of it."""
    scale = 10.0 ** -math.floor(math.log10(wavelength / ROUNDED_PARTS))
    # A value that is round already stays, whatever its last bit.
    return math.ceil(wavelength * scale - 1e-9) / scale


def find_shortest_wavelength(capture: Capture, cycles: float) -> float:
    """Carrier of the shortest pulse, of so many cycles, whose whole band a capture carries, m:
    sampled twice along the record and the wall, there four times if both legs grow.
    """
    pulse = VirtualPulse(1.0, cycles)
    reach = 1 + pulse.half_band / pulse.wavenumber  # of the band, in wavenumbers of the carrier
    return reach * max(_sampling_limit(capture), 2 * capture.axis.spacing)


def find_longest_wavelength(capture: Capture) -> float:
    """Carrier above which a point's image at a wall's width is wider than half the wall, m."""
    return float(np.ptp(capture.points[:, :2], axis=0).max()) / 2


def find_sampling_step(capture: Capture) -> float:
    """Distance of neighbouring wall points, or of spots that one point sees, m; else 0."""
    if math.isfinite(capture.spacing):
        return capture.spacing
    if capture.laser.ndim == 1:
        return 0.0
    # Light runs either way: the spots sample the scene as wall points would.
    swapped = replace(capture, wall=capture.laser, laser=capture.wall).spacing
    return swapped if math.isfinite(swapped) else 0.0


def _sampling_limit(capture: Capture, sine: float = 1.0) -> float:
    """Shortest wave that the wall samples twice where it arrives under an angle of that sine, m."""
    return sine * find_sampling_step(capture) * (4 if is_confocal(capture) else 2)


def _steepest_angle(capture: Capture) -> float:
    """Sine of the angle at which what is brightest is seen from the far end of the wall."""
    extent = 2 * find_longest_wavelength(capture)
    late, level = _compute_profile(capture)
    depth = max(float(late[np.argmax(level)]) / 2, 0.0)
    return extent / math.hypot(extent, depth) if extent > 0 else 1.0


def _compute_profile(capture: Capture) -> tuple[FloatArray, FloatArray]:
    """Mean signal by path beyond that of the wall's own light: paths, m, and levels."""
    traces, direct = _select_traces(capture)
    step = max(capture.axis.spacing, measure_extent(capture) / PROFILE_STEPS_PER_WALL)
    number = np.floor((capture.axis.paths - direct[:, np.newaxis]) / step).astype(np.intp)
    first = int(number.min())
    count = np.bincount((number - first).ravel())
    total = np.bincount((number - first).ravel(), traces.ravel())
    # Steps that few wall points reach tell little of the wall.
    kept = count > count.max() / 10
    paths = step * (first + np.arange(count.size) + 0.5)
    return paths[kept], total[kept] / count[kept]


def _select_traces(capture: Capture) -> tuple[FloatArray, FloatArray]:
    """Signals (n, t) of some wall points, and their paths from the laser, m, in any order alike."""
    some = np.lexsort((capture.points + capture.lasers).T)
    some = some[:: len(some) // MAX_ANALYSED_POINTS + 1]
    flat = to_numpy(capture.signal).reshape(capture.axis.bins, -1)
    traces = flat[:, np.flatnonzero(capture.valid)[some]].T.astype(np.float64)
    lasers = select_lasers(capture, some)
    direct: FloatArray = norm(capture.points[some] - lasers, axis=1)
    return traces, direct
