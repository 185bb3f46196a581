"""Which candidates count as returns: by fractions of what is brightest (`Detection`), or judged by the
noise of the recovery that showed them (`SignificanceJudge`).

A recovered frame shows light where there is none: photons' noise, and what the recovery spreads.
How bright that is depends on what else the views saw at that instant, so no fraction of the scene's
brightest return tells it from a dim wall beside a retroreflector. Three things do:

* **Own significance** (`weigh_candidates`). A return of brightness h puts ``h a_m`` on measurement m
  of variance ``floor^2 + gain * (F h)_m``. With all other pixels known its brightness would be
  known to ``1 / sqrt(sum a_m^2 / variance_m)``: the diagonal of the linear inverse's covariance at
  the solution. A pixel of which some view saw little else is known well; one that bright objects
  cross in every view is hardly known.
* **Neighbours** (`CandidatePool`). Surfaces go on in the pixels around, at the same range; noise
  does not.
* **Decoys** (`estimate_false_alarms`). The same sums at ranges displaced by chance are what noise
  makes of this very shot. Where true and displaced sums are equally frequent, a candidate is noise;
  the ratio of their densities is the probability that it is (local false-discovery rate: B. Efron,
  J. Am. Stat. Assoc. 96, 1151 (2001); the decoys are those of proteomics).

What is spread around true returns goes on in neighbouring pixels as well, so decoys do not know it.
It is less significant, and weaker, than the surface of its own pixel (`MIN_PIXEL_SHARE`), and it is
less significant than most of what is at its range (`MIN_INSTANT_SHARE`), and far weaker
(`MIN_INSTANT_BRIGHTNESS`). The shares were found on two scenes by different forward models, in
bright, dark and dazzled shots.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from tofclip.arrays import FloatArray, to_numpy
from tofclip.camera.noise import MeasurementNoise
from tofclip.errors import InputError
from tofclip.lidar.pulse import Pulse
from tofclip.shots import Frames
from tofclip.units import SPEED_OF_LIGHT

SLOTS_PER_WIDTH = 4
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
        self, pixel: NDArray[np.int64], time: FloatArray, intensity: FloatArray, pulse_width: float
    ) -> NDArray[np.bool_]:
        """Say which candidates are strong enough.

        Parameters
        ----------
        pixel : (n,) int array
            Pixel number of each candidate.
        time : (n,) array
            Its instant, s.
        intensity : (n,) array
            Its brightness with the fall-off with range undone.
        pulse_width : float
            Instants that differ by less than this, s, are the same.

        Returns
        -------
        (n,) bool array
        """
        if pixel.size == 0:
            return np.zeros(0, bool)
        strongest, least = self._compare(pixel, time, intensity, pulse_width, time)
        return (intensity >= self.min_pixel_fraction * strongest[pixel]) & (intensity >= least)

    def compute_least_intensity(
        self,
        pixel: NDArray[np.int64],
        time: FloatArray,
        intensity: FloatArray,
        pulse_width: float,
        at: FloatArray,
    ) -> FloatArray:
        """Return what the scene and its other returns at the same instant ask of a return.

        Parameters
        ----------
        pixel, time, intensity, pulse_width
            As for `find_significant`; at least one candidate.
        at : (m,) array
            Instants, s.

        Returns
        -------
        (m,) float64 array
            Brightness with the fall-off with range undone.
        """
        return self._compare(pixel, time, intensity, pulse_width, at)[1]

    def _compare(
        self,
        pixel: NDArray[np.int64],
        time: FloatArray,
        intensity: FloatArray,
        width: float,
        at: FloatArray,
    ) -> tuple[FloatArray, FloatArray]:
        """Largest intensity of each pixel, 0 where there is no candidate, and `compute_least_intensity`."""
        strongest = np.zeros(int(pixel.max()) + 1)
        np.maximum.at(strongest, pixel, intensity)
        start, end = min(time.min(), at.min()), max(time.max(), at.max())

        def find_slot(instants: FloatArray) -> NDArray[np.int64]:
            slots = (instants - start) * (SLOTS_PER_WIDTH / width) + 0.5
            return np.asarray(slots, dtype=np.int64)

        brightest = np.zeros(int(find_slot(end)) + 1)
        np.maximum.at(brightest, find_slot(time), intensity)
        around = scipy.ndimage.maximum_filter1d(brightest, 2 * SLOTS_PER_WIDTH + 1)
        scene = find_quantile_value(strongest[strongest > 0], SCENE_BRIGHTNESS_QUANTILE)
        needed = np.maximum(self.min_scene_fraction * scene, self.min_time_bin_fraction * around)
        least: FloatArray = needed[find_slot(at)]
        return strongest, least


def find_quantile_value(values: NDArray[np.floating], fraction: float) -> float:
    """As `numpy.quantile`, in a tenth of its time: that one looks for two numbers at once."""
    place = fraction * (values.size - 1)
    before = int(place)
    ordered = np.partition(values, before)
    value = float(ordered[before])
    above = float(ordered[before + 1 :].min(initial=np.inf))
    return value + (place - before) * (above - value) if place > before else value


DEFAULT_FALSE_ALARM = 0.5  # probability of being noise above which a candidate is dropped

CANDIDATES = Detection(
    signal_to_noise=3.0,
    min_scene_fraction=0.0,
    min_time_bin_fraction=0.0,
    min_pixel_fraction=0.02,
    max_returns=6,
)
"""What is looked at: nearly everything that a trace shows."""

CORE_RADIUS_PX, POOL_RADIUS_PX = 1.5, 2.9
GATE_PULSES_PER_PX = 0.45  # the wider pool then reaches 1.3 pulse lengths in range

MIN_PIXEL_SHARE = 0.3
"""Of the pixel's most significant candidate, pooled over either radius. What is brighter than that
one is not what it spreads, however little is known of it at an instant full of light."""

MIN_INSTANT_SHARE, INSTANT_QUANTILE = 0.42, 0.8
"""Of what the upper candidates at the same range have. Streaks that a recovery from few views
draws across a dark background go on from pixel to pixel, as surfaces do, at the range of what they
come from. The quantile does not know how bright the brightest are."""

MIN_INSTANT_BRIGHTNESS = 0.06
"""Of the same quantile of the signals at the same range: what the model does not explain beside the
light of a bright shot is weak, however sure it is."""

DECOY_ROUNDS, DECOY_SEED = 3, 20220614
MIN_DISPLACEMENT_GATES = 6.0  # displaced candidates must not meet the surface they come from
MIN_RANGE_GATES = 4 * MIN_DISPLACEMENT_GATES
FRAMES_PER_BLOCK = 32


@dataclass(frozen=True)
class SignificanceJudge:
    """Decides which candidates of a transient cube are returns."""

    frames: Frames  # recovered, with what was known of the measurements' noise
    noise: MeasurementNoise
    pulse: Pulse
    max_false_alarm: float = DEFAULT_FALSE_ALARM

    def __post_init__(self) -> None:
        if not 0 < self.max_false_alarm <= 1:
            raise InputError(
                f"the probability of a false alarm lies between 0 and 1, got {self.max_false_alarm}"
            )

    def judge(
        self, pixel: NDArray[np.int64], time: FloatArray, signal: FloatArray
    ) -> tuple[NDArray[np.bool_], FloatArray]:
        """Say which candidates are returns, and how probable it is that each is noise. `pixel` (n,)
        does not decrease; `signal` (n,): counts, summed over the bins.
        """
        length = SPEED_OF_LIGHT / 2 * self.pulse.fwhm
        own = weigh_candidates(self.frames, self.noise, self.pulse, pixel, time, signal)
        distance = SPEED_OF_LIGHT / 2 * time
        shape = self.frames.camera.image_shape
        pool = CandidatePool(pixel, distance, own, shape, GATE_PULSES_PER_PX * length)
        core, whole = pool.sum_around(CORE_RADIUS_PX), pool.sum_around(POOL_RADIUS_PX)
        probability = estimate_false_alarms(pool, whole)
        kept = probability <= self.max_false_alarm
        if kept.any():
            at_range = find_usual_at_range(distance, np.where(kept, whole, 0), length)
            kept &= whole >= MIN_INSTANT_SHARE * at_range
            bright = find_usual_at_range(distance, np.where(kept, signal, 0), length)
            kept &= signal >= MIN_INSTANT_BRIGHTNESS * bright
        for pooled in (core, whole):
            best, brightness = find_most_significant(pixel, pooled, signal)
            kept &= (pooled >= MIN_PIXEL_SHARE * best) | (signal >= brightness)
        return kept, probability


def weigh_candidates(
    frames: Frames,
    noise: MeasurementNoise,
    pulse: Pulse,
    pixel: NDArray[np.int64],
    time: FloatArray,
    signal: FloatArray,
) -> FloatArray:
    """Return by how many of its own standard deviations each candidate is brighter than nothing."""
    values = to_numpy(frames.values)
    order = np.argsort(time)
    at, first, last = time[order], *pulse.support
    information, total = np.zeros((2, time.size))
    # blocks of one shear
    number = frames.times.size
    changes = np.flatnonzero(np.diff(frames.shears)) + 1
    edges = np.union1d(changes, [*range(0, number, FRAMES_PER_BLOCK), number])
    for start, stop in pairwise(edges.tolist()):
        operator = frames.camera.operator(float(frames.shears[start])).matrix
        pictures = values[start:stop].reshape(stop - start, -1).T.astype(np.float32)
        variance = noise.compute_variance(np.maximum(operator @ pictures, 0))
        squares = operator.copy()
        squares.data = squares.data**2
        known = squares.T @ (1 / np.maximum(variance, np.finfo(np.float32).tiny))
        for place in range(start, stop):
            instant = frames.times[place]
            # candidates whose pulse reaches this frame
            here = slice(*np.searchsorted(at, [instant - last, instant - first]))
            shape = np.maximum(pulse(instant - at[here]), 0)
            reached = order[here]
            information[reached] += shape**2 * known[pixel[reached], place - start]
            total[reached] += shape
    # The pulse's samples are a shape; a candidate's counts are its sum over the bins.
    height = signal / np.maximum(total, np.finfo(np.float64).tiny)
    return np.asarray(height * np.sqrt(information))


def find_most_significant(
    pixel: NDArray[np.int64], pooled: FloatArray, signal: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return significance and signal of the most significant candidate in each one's pixel; `pixel`
    does not decrease.
    """
    order = np.lexsort((pooled, pixel))
    last = order[np.searchsorted(pixel, pixel, side="right") - 1]
    return pooled[last], signal[last]


@dataclass(frozen=True)
class CandidatePool:
    """Candidates and what their neighbours bring."""

    pixel: NDArray[np.int64]  # (n,), not decreasing
    distance: FloatArray  # (n,), m
    own: FloatArray  # (n,), significance of each
    image_shape: tuple[int, int]
    # what ranges may differ by for each pixel of the pool's radius, m: it reaches less far in range
    # the further a neighbour is, like a ball
    gate: float

    def sum_around(self, radius: float, displaced: FloatArray | None = None) -> FloatArray:
        """Return each candidate's significance with those within `radius` pixels at the same range, m,
        or around the ranges `displaced`.
        """
        # the compiler takes as long to import as all else
        from tofclip.lidar.peak_kernels import pool_significance

        rows, columns = self.image_shape
        starts = np.searchsorted(self.pixel, np.arange(rows * columns + 1))
        at = self.distance if displaced is None else displaced
        pooled = np.empty(self.own.size)
        pool_significance(
            self.pixel,
            at,
            self.distance,
            self.own,
            starts,
            self.image_shape,
            (radius, self.gate),
            pooled,
        )
        return pooled


def find_usual_at_range(distance: FloatArray, pooled: FloatArray, length: float) -> FloatArray:
    """Return what the upper candidates within a pulse's `length`, m, of each one's range have; those
    of 0 do not count.
    """
    slot = np.floor((distance - distance.min()) / length).astype(np.int64)
    order = np.argsort(slot, kind="stable")
    edges = np.searchsorted(slot[order], np.arange(int(slot.max()) + 2))
    usual = np.zeros(edges.size - 1)
    for number in range(usual.size):
        # With the slots before and behind: a surface at a slot's edge is in two of them.
        first, last = edges[max(number - 1, 0)], edges[min(number + 2, edges.size - 1)]
        around = pooled[order[first:last]]
        around = around[around > 0]
        if around.size:
            usual[number] = np.quantile(around, INSTANT_QUANTILE)
    at_each: FloatArray = usual[slot]
    return at_each


def estimate_false_alarms(pool: CandidatePool, pooled: FloatArray) -> FloatArray:
    """Return the probability that each candidate is noise, by decoys at displaced ranges. `pooled`:
    of `POOL_RADIUS_PX`. 0 where all candidates lie so close together that no decoy can be had.
    """
    span = float(np.ptp(pool.distance)) if pooled.size else 0.0
    if span < MIN_RANGE_GATES * pool.gate:
        return np.zeros(pooled.size)
    noise, nearest = np.random.default_rng(DECOY_SEED), float(pool.distance.min())
    least = MIN_DISPLACEMENT_GATES * pool.gate
    decoys = []
    # By pixel and order in it: one candidate more or less changes no other's displacement.
    place = np.arange(pooled.size) - np.searchsorted(pool.pixel, pool.pixel)
    slots = (*pool.image_shape, CANDIDATES.max_returns)
    for _ in range(DECOY_ROUNDS):
        displacement = noise.uniform(least, span - least, slots).reshape(-1, slots[-1])
        further = pool.distance - nearest + displacement[pool.pixel, place]
        decoys.append(pool.sum_around(POOL_RADIUS_PX, nearest + further % span))
    everything = np.concatenate([pooled, *decoys])
    weights = np.full(everything.size, 1 / DECOY_ROUNDS)
    weights[: pooled.size] = 1.0
    is_decoy = np.arange(everything.size) >= pooled.size
    order = np.argsort(everything)
    # The stronger, the less probable a decoy is.
    fitted: Any = scipy.optimize.isotonic_regression(
        is_decoy[order].astype(np.float64), weights=weights[order], increasing=False
    )
    share = np.empty(everything.size)
    share[order] = fitted.x
    odds = share[: pooled.size] / np.maximum(1 - share[: pooled.size], 1e-9)
    return np.minimum(odds, 1.0)
