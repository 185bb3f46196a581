"""Which candidates count as returns: by fractions of what is brightest (`Detection`), or judged by the
evidence of the shot that shows them (`EvidenceJudge`).

A recovered frame shows light where there is none: photons' noise, and what the recovery spreads from
few views. Of each candidate the probability is stated that it is false, of which both kinds are part:
a return is true if it is neither noise nor spread.

* **Noise.** A return of brightness h puts ``h a_m`` on measurement m of variance ``floor^2 + gain *
  (F h)_m``. With all other pixels known its brightness would be known to ``1 / sqrt(sum a_m^2 /
  variance_m)``. Surfaces go on in the pixels around, at the same range, and noise does not: what counts
  is the sum of significances of a candidate with its neighbours, and how many these are.
* **Spread.** What is spread around a bright object is weaker than it at the same instant, weak in its
  scene, and in its pixel weaker than the surface that is there; and the shot contradicts it: the
  measurements that should see it hold less light than the frames explain, because only some views have
  light there and the others are dark. Without the candidate and those around it they would be
  explained better.

Ripples on light that is spread over time are one candidate before that (`join_candidates`).
Both are logistic functions of these numbers, whose few weights (`NOISE`, `SPREAD`) were found on scenes
of known returns by a forward model of their own (docs/recovery_algorithm.md has the table).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import scipy
from numpy.typing import NDArray

from tofclip.arrays import BoolArray, FloatArray, IntArray, to_numpy
from tofclip.camera.noise import MeasurementNoise
from tofclip.errors import InputError
from tofclip.lidar.pulse import Pulse
from tofclip.shots import Frames
from tofclip.units import SPEED_OF_LIGHT

SLOTS_PER_WIDTH = 4
TINY = float(np.finfo(np.float64).tiny)
# of the scene's brightness: that of its brightest pixels, but not of a single glint
SCENE_BRIGHTNESS_QUANTILE = 0.999


@dataclass(frozen=True)
class Detection:
    """What counts as a return.

    Parameters
    ----------
    signal_to_noise : float
        Least response of the matched filter, in standard deviations of the pixel's background.
    min_scene_fraction : float
        Least intensity relative to the brightest returns of the scene.
    min_time_bin_fraction : float
        Least intensity relative to the brightest return of any pixel at the same instant, within a
        pulse width: leaves out the streaks that recovery from few views draws across a frame around
        its bright objects.
    min_pixel_fraction : float
        Least intensity relative to the pixel's strongest return: leaves out echoes inside the
        instrument.
    max_returns : int
        Maximum number of returns in a pixel, the strongest.

    Raises
    ------
    InputError
        A share outside 0..1, a negative signal-to-noise, or no return allowed.
    """

    signal_to_noise: float = 5.0
    min_scene_fraction: float = 0.05
    min_time_bin_fraction: float = 0.12
    min_pixel_fraction: float = 0.2
    max_returns: int = 4

    def __post_init__(self) -> None:
        if not self.signal_to_noise >= 0:
            raise InputError(
                f"the signal-to-noise limit must not be negative, got {self.signal_to_noise}"
            )
        for share in (self.min_scene_fraction, self.min_time_bin_fraction, self.min_pixel_fraction):
            if not 0 <= share <= 1:
                raise InputError(f"a share must lie between 0 and 1, got {share}")
        if not 1 <= self.max_returns <= 255:
            raise InputError(f"a pixel can have 1 to 255 returns, got {self.max_returns}")

    def find_significant(
        self, pixel: IntArray, time: FloatArray, intensity: FloatArray, pulse_width: float
    ) -> BoolArray:
        """Say which candidates are strong enough, (n,). `pixel, time, intensity` (n,): number of each
        one's pixel, instant, s, and brightness with the fall-off with range undone; instants that differ
        by less than `pulse_width`, s, are the same.
        """
        if pixel.size == 0:
            return np.zeros(0, bool)
        in_pixel = self.min_pixel_fraction * find_strongest(pixel, intensity)[pixel]
        least = self.compute_least_intensity(pixel, time, intensity, pulse_width, time)
        return (intensity >= in_pixel) & (intensity >= least)

    def compute_least_intensity(
        self,
        pixel: IntArray,
        time: FloatArray,
        intensity: FloatArray,
        pulse_width: float,
        at: FloatArray,
    ) -> FloatArray:
        """Return what the scene and its other returns at the same instant ask of a return at instants
        `at` (m,), s: brightness with the fall-off with range undone. The rest, of at least one
        candidate, is as for `find_significant`.
        """
        start, end = min(time.min(), at.min()), max(time.max(), at.max())

        def find_slot(instants: FloatArray) -> IntArray:
            slots = (instants - start) * (SLOTS_PER_WIDTH / pulse_width) + 0.5
            return np.asarray(slots, dtype=np.int64)

        brightest = np.zeros(int(find_slot(end)) + 1)
        np.maximum.at(brightest, find_slot(time), intensity)
        around = scipy.ndimage.maximum_filter1d(brightest, 2 * SLOTS_PER_WIDTH + 1)
        strongest = find_strongest(pixel, intensity)
        scene = find_quantile_value(strongest[strongest > 0], SCENE_BRIGHTNESS_QUANTILE)
        needed = np.maximum(self.min_scene_fraction * scene, self.min_time_bin_fraction * around)
        return needed[find_slot(at)]


def find_strongest(pixel: IntArray, intensity: FloatArray) -> FloatArray:
    """Return the largest intensity of each pixel, 0 where there is no candidate."""
    strongest = np.zeros(int(pixel.max()) + 1)
    np.maximum.at(strongest, pixel, intensity)
    return strongest


def find_quantile_value(values: NDArray[np.floating], fraction: float) -> float:
    """As `numpy.quantile`, in a tenth of its time: that one looks for two numbers at once."""
    place = fraction * (values.size - 1)
    before = int(place)
    ordered = np.partition(values, before)
    value = float(ordered[before])
    above = float(ordered[before + 1 :].min(initial=np.inf))
    return value + (place - before) * (above - value) if place > before else value


DEFAULT_FALSE_ALARM = 0.1  # probability of being false above which a candidate is dropped

CANDIDATES = Detection(3.0, 0.0, 0.0, min_pixel_fraction=0.02, max_returns=6)
"""What is looked at: nearly everything that a trace shows."""

AT_INSTANT = Detection(min_scene_fraction=0, min_time_bin_fraction=1, min_pixel_fraction=0)
POOL_RADIUS_PX = 2.9
GATE_PULSES_PER_PX = 0.45  # the pool then reaches 1.3 pulse lengths in range
EXCESS_LIMITS = -0.8, 0.3  # of light, beyond which it says no more
# Of the light at an instant or in the scene, the part that is brighter than what others are compared with:
# a retroreflector is bright, but has little of the light.
BRIGHTER_PART = 0.5
# Misfit at which half of the scene's brightness counts: of its light the instrument spreads some.
HALF_MISFIT = 0.02
# pooled significance of the brightest at an instant, at which half of what it spreads is seen beside noise
HALF_SEEN = 30.0

# Weights, and last what is added to the sum.
# of the log of the pooled significance, and of how many candidates it is pooled over
NOISE = np.array([0.93, 0.41, -3.118])
# of the logs of the brightness, over that of the light at its instant, over that of the scene's light, and
# over the most in the pixel, and of the relative excess of light
SPREAD = np.array([0.567, 1.3, 0.981, 3.915, 3.582])
SPREAD_ERROR = 0.5  # of the middle of light that is spread over time, in its deviations
FRAMES_PER_BLOCK = 32
CLIPPED_KEY = "clipped_readings"  # of the figures of frames, see `tofclip.recovery.defects`


@dataclass(frozen=True)
class EvidenceJudge:
    """Says how probable it is that each candidate of a transient cube is false."""

    frames: Frames  # recovered, with the measurements that they explain
    noise: MeasurementNoise
    pulse: Pulse
    max_false_alarm: float = DEFAULT_FALSE_ALARM

    def judge(self, pixel: IntArray, time: FloatArray, signal: FloatArray) -> FloatArray:
        """Return the probability that each candidate is false. `pixel` (n,) does not decrease; `signal`
        (n,): counts, summed over the bins.
        """
        if pixel.size == 0:
            return np.empty(0)
        # the compiler takes as long to import as all else
        from tofclip.lidar.peak_kernels import pool_neighbours

        width, distance = self.pulse.fwhm, SPEED_OF_LIGHT / 2 * time
        shape = self.frames.camera.image_shape
        starts = np.searchsorted(pixel, np.arange(math.prod(shape) + 1))
        # what ranges may differ by for each pixel of the radius: it reaches less far in range the
        # further a neighbour is, like a ball
        ball = POOL_RADIUS_PX, GATE_PULSES_PER_PX * SPEED_OF_LIGHT / 2 * width

        # what the model does not explain is known by its brightness
        noise = replace(self.noise, misfit=0.0, dazzle=np.inf)
        own, missing, light = weigh_candidates(self.frames, noise, self.pulse, pixel, time, signal)
        intensity = signal * distance**2
        each = np.stack([own, np.ones(own.size), light, missing, intensity], axis=1)
        sums = each.copy()  # over each candidate and those around it at the same range
        pool_neighbours(pixel, distance, each, starts, shape, ball, sums)
        pooled, neighbours, explained, unexplained, around = np.ascontiguousarray(sums.T)
        most = AT_INSTANT.compute_least_intensity(pixel, time, pooled, width, time)
        # float32's least: a quotient by float64's may overflow
        excess = unexplained / np.maximum(explained, np.finfo(np.float32).tiny)
        # of what is hardly seen, noise makes as much
        excess = np.clip(excess, *EXCESS_LIMITS) * pooled**2 / (pooled**2 + 4 * neighbours)
        ratios = [
            around / find_brightness_at_instant(time, around, width),
            intensity / find_brightness(intensity),
            intensity / find_strongest(pixel, intensity)[pixel],
        ]
        brightness = np.log(np.clip(ratios, TINY, 1))
        # what is cut off does not fit either, but is not spread
        misfit = 0.0 if self.frames.figures.get(CLIPPED_KEY) else self.noise.misfit
        brightness[1] *= misfit / (misfit + HALF_MISFIT)
        # what has no significance does not gain any by being many
        against_noise = [np.log(np.maximum(pooled, TINY)), np.minimum(neighbours, 3 * pooled)]
        no_noise = scipy.special.expit(NOISE[:-1] @ against_noise + NOISE[-1])
        spread = scipy.special.expit(-SPREAD[:-1] @ [*brightness, excess] - SPREAD[-1])
        seen = most**2 / (most**2 + HALF_SEEN**2)
        return 1 - no_noise * (1 - seen * spread)


def find_brightness(values: FloatArray) -> float:
    """Return the brightness above which there is half of the light."""
    downwards = np.sort(values)[::-1]
    light = np.cumsum(downwards)
    return float(downwards[min(np.searchsorted(light, BRIGHTER_PART * light[-1]), light.size - 1)])


def find_brightness_at_instant(time: FloatArray, values: FloatArray, width: float) -> FloatArray:
    """Return the brightness above which there is half of the light about that time."""
    slot = np.floor((time - time.min()) / width).astype(np.int64)
    order = np.argsort(slot, kind="stable")
    edges = np.searchsorted(slot[order], np.arange(int(slot.max()) + 2))
    usual = np.ones(edges.size - 1)
    for number in range(usual.size):
        # With the slots before and behind: a surface at a slot's edge is in two of them.
        first, last = edges[max(number - 1, 0)], edges[min(number + 2, edges.size - 1)]
        if first < last:
            usual[number] = find_brightness(values[order[first:last]])
    return usual[slot]


def weigh_candidates(
    frames: Frames,
    noise: MeasurementNoise,
    pulse: Pulse,
    pixel: IntArray,
    time: FloatArray,
    signal: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return by how many of its own standard deviations each candidate is brighter than nothing; by how
    much the measurements that see it exceed what the frames explain, and what these explain of them,
    both weighted by its light and the measurements' precision.
    """
    values, measured = to_numpy(frames.values), frames.measured
    order = np.argsort(time)
    at, first, last = time[order], *pulse.support
    information, missing, light, total = np.zeros((4, time.size))
    alive = np.isfinite(measured).any(axis=1, keepdims=True)
    # blocks of one shear
    number = frames.times.size
    changes = np.flatnonzero(np.diff(frames.shears, prepend=np.nan))
    edges = np.union1d(changes, [*range(0, number, FRAMES_PER_BLOCK), number])
    for start, stop in pairwise(edges.tolist()):
        if start in changes:
            operator = frames.camera.operator(float(frames.shears[start])).matrix
            squares = operator.copy()
            squares.data = squares.data**2
        pictures = values[start:stop].reshape(stop - start, -1).T.astype(np.float32)
        explained = operator @ pictures
        variance = noise.compute_variance(np.maximum(explained, 0))
        # Readings that are left out where the column measures otherwise are too bright: they speak for
        # what is bright there, and cannot tell whether it was spread. By what the others tell, an
        # excess counts as the root of their share of the light.
        precision = alive / np.maximum(variance, np.finfo(np.float32).tiny)
        rest = measured[:, start:stop] - explained
        told = np.isfinite(rest)
        rest[~told] = 0
        known = squares.T @ precision
        exceeds, explains, seen_light = (
            operator.T @ (part * precision) for part in (rest, explained, told * explained)
        )
        explains = np.sqrt(np.maximum(explains, 0) * np.maximum(seen_light, 0))
        for place in range(start, stop):
            instant = frames.times[place]
            # candidates whose pulse reaches this frame
            here = slice(*np.searchsorted(at, [instant - last, instant - first]))
            shape = np.maximum(pulse(instant - at[here]), 0)
            reached = order[here]
            seen = pixel[reached], place - start
            information[reached] += shape**2 * known[seen]
            missing[reached] += shape * exceeds[seen]
            light[reached] += shape * explains[seen]
            total[reached] += shape
    # The pulse's samples are a shape; a candidate's counts are its sum over the bins.
    height = signal / np.maximum(total, TINY)
    return height * np.sqrt(information), height * missing, height * light


def join_candidates(
    frames: Frames, pulse: Pulse, pixel: IntArray, found: FloatArray
) -> tuple[IntArray, FloatArray]:
    """Make one candidate of those of a pixel that are ripples of one surface's light, which the recovery
    spread over time. `pixel` (n,) and `found` (3, n), times (s), signals and deviations (s), in the order
    of pixels and times; return the same of the surfaces. Of such a surface the light says how far off its
    middle may be.
    """
    if pixel.size == 0:
        return pixel, found
    # the compiler takes as long to import as all else
    from tofclip.lidar.peak_kernels import join_spread

    times, (time, signal, deviation) = frames.times, found
    values = to_numpy(frames.values).reshape(times.size, -1)
    step = float(times[-1] - times[0]) / (times.size - 1)
    fine = np.linspace(*pulse.support, 256)
    shape = pulse(fine) ** 2
    late = float(np.average(fine, weights=shape))
    own = float(np.average((fine - late) ** 2, weights=shape))
    place = np.clip(np.searchsorted(times, time), 1, times.size - 1)
    place -= time - times[place - 1] < times[place] - time
    joined, moments = np.empty(time.size, np.int64), np.empty((3, time.size))
    half = int(pulse.fwhm / (2 * step))
    join_spread(values, times, pixel, place, half, own, joined, moments)
    first, number = np.unique(joined, return_inverse=True)
    alone = np.bincount(number) == 1
    _, middle, variance = moments[:, first]
    spread = np.sqrt(np.maximum(variance - own, 0))
    surfaces = np.array(
        [
            np.where(alone, time[first], middle - late),
            np.bincount(number, signal),
            np.hypot(deviation[first], np.where(alone, 0, SPREAD_ERROR * spread)),
        ]
    )
    return pixel[first], surfaces
