"""Which candidates count as returns, judged by the noise of the recovery that showed them.

A recovered frame shows light where there is none: photons' noise, and what the recovery spreads.
How bright that is depends on what else the views saw at that instant, so no fraction of the scene's
brightest return tells it from a dim wall beside a retroreflector. Three things do:

* **Own significance** (`weigh_candidates`). A return of brightness h puts ``h a_m`` on measurement m
  of variance ``floor^2 + gain * (F h)_m``. With all other pixels known its brightness would be
  known to ``1 / sqrt(sum a_m^2 / variance_m)``: the diagonal of the linear inverse's covariance at
  the solution. A pixel of which some view saw little else is known well; one that bright objects
  cross in every view is hardly known.
* **Neighbours** (`pool_significance`). Surfaces go on in the pixels around, at the same range; noise
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
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from tofclip.arrays import to_numpy
from tofclip.camera.rectifier import MeasurementNoise
from tofclip.errors import InputError
from tofclip.lidar.detection import Detection
from tofclip.lidar.pulse import Pulse
from tofclip.shots import Frames
from tofclip.units import SPEED_OF_LIGHT

FloatArray = NDArray[np.float64]

DEFAULT_FALSE_ALARM = 0.5
"""Probability of being noise above which a candidate is dropped."""

CANDIDATES = Detection(
    signal_to_noise=3.0,
    min_scene_fraction=0.0,
    min_time_bin_fraction=0.0,
    min_pixel_fraction=0.02,
    max_returns=6,
)
"""What is looked at: nearly everything that a trace shows."""

POOL_RADIUS_PX = 2.9
CORE_RADIUS_PX = 1.5
MIN_PIXEL_SHARE = 0.3
"""Of the pixel's most significant candidate, pooled over either radius. What is brighter than that
one is not what it spreads, however little is known of it at an instant full of light."""

GATE_PULSES_PER_PX = 0.45
"""A pool of 2.9 pixels then reaches 1.3 pulse lengths in range."""

MIN_INSTANT_SHARE, INSTANT_QUANTILE = 0.42, 0.8
"""Of what the upper candidates at the same range have. Streaks that a recovery from few views
draws across a dark background go on from pixel to pixel, as surfaces do, at the range of what they
come from. The quantile does not know how bright the brightest are."""

MIN_INSTANT_BRIGHTNESS = 0.06
"""Of the same quantile of the signals at the same range: what the model does not explain beside the
light of a bright shot is weak, however sure it is."""

DECOY_ROUNDS = 3
MIN_DISPLACEMENT_GATES = 6.0
MIN_RANGE_GATES = 4 * MIN_DISPLACEMENT_GATES
"""Displaced candidates must not meet the surface they come from."""

DECOY_SEED = 20220614
FRAMES_PER_BLOCK = 32


@dataclass(frozen=True)
class SignificanceJudge:
    """Decides which candidates of a transient cube are returns."""

    frames: Frames  # recovered, with what was known of the measurements' noise
    noise: MeasurementNoise
    pulse: Pulse
    # candidates that are noise with a higher probability are dropped
    max_false_alarm: float = DEFAULT_FALSE_ALARM

    def __post_init__(self) -> None:
        if not 0 < self.max_false_alarm <= 1:
            raise InputError(
                f"the probability of a false alarm lies between 0 and 1, got {self.max_false_alarm}"
            )

    def judge(
        self, pixel: NDArray[np.int64], time: FloatArray, signal: FloatArray
    ) -> tuple[NDArray[np.bool_], FloatArray]:
        """Say which candidates are returns, and how probable it is that each is noise.

        `pixel` (n,): number of the pixel, not decreasing; `time` (n,): instant, s; `signal` (n,):
        counts, summed over the bins. Returns `kept` (n,); `probability` (n,).
        """
        length = SPEED_OF_LIGHT / 2 * self.pulse.fwhm
        gate = GATE_PULSES_PER_PX * length
        own = weigh_candidates(self.frames, self.noise, self.pulse, pixel, time, signal)
        distance = SPEED_OF_LIGHT / 2 * time
        pool = CandidatePool(pixel, distance, own, self.frames.camera.image_shape, gate)
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


def find_most_significant(
    pixel: NDArray[np.int64], pooled: FloatArray, signal: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return significance and signal of the most significant candidate in each one's pixel.

    `pixel` (n,): not decreasing; `pooled` (n,): significance; `signal` (n,): counts. Returns
    `significance, signal` (n,).
    """
    order = np.lexsort((pooled, pixel))
    last = order[np.searchsorted(pixel, pixel, side="right") - 1]
    return pooled[last], signal[last]


def weigh_candidates(
    frames: Frames,
    noise: MeasurementNoise,
    pulse: Pulse,
    pixel: NDArray[np.int64],
    time: FloatArray,
    signal: FloatArray,
) -> FloatArray:
    """Return by how many of its own standard deviations each candidate is brighter than nothing.

    `pixel` (n,); `time` (n,): s; `signal` (n,): counts, summed over the bins. Returns (n,).
    """
    values = to_numpy(frames.values)
    order = np.argsort(time)
    at, first, last = time[order], *pulse.support
    information = np.zeros(time.size)
    total = np.zeros(time.size)
    for start, stop in _list_blocks(frames.shears):
        operator = frames.camera.operator(float(frames.shears[start])).matrix
        pictures = values[start:stop].reshape(stop - start, -1).T.astype(np.float32)
        light = np.maximum(operator @ pictures, 0)
        variance = noise.compute_variance(light)
        squares = operator.copy()
        squares.data = squares.data**2
        known = squares.T @ (1 / np.maximum(variance, np.finfo(np.float32).tiny))
        for place in range(start, stop):
            # Candidates whose pulse reaches this frame.
            here = slice(
                *np.searchsorted(at, [frames.times[place] - last, frames.times[place] - first])
            )
            some = order[here]
            shape = np.maximum(pulse(frames.times[place] - at[here]), 0)
            information[some] += shape**2 * known[pixel[some], place - start]
            total[some] += shape
    # The pulse's samples are a shape; a candidate's counts are its sum over the bins.
    height = signal / np.maximum(total, np.finfo(np.float64).tiny)
    return np.asarray(height * np.sqrt(information))


def _list_blocks(shears: FloatArray) -> list[tuple[int, int]]:
    """Cut the frames into blocks of one shear."""
    edges = np.concatenate([[0], np.flatnonzero(np.diff(shears)) + 1, [shears.size]])
    return [
        (start, min(start + FRAMES_PER_BLOCK, stop))
        for first, stop in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True)
        for start in range(first, stop, FRAMES_PER_BLOCK)
    ]


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
        """Return each candidate's significance together with those around it, at the same range.

        `radius`: pixels; `displaced` (n,): ranges at which neighbours are looked for instead, m.
        Returns (n,).
        """
        from tofclip.lidar.candidate_loops import pool_significance

        starts = np.searchsorted(
            self.pixel, np.arange(self.image_shape[0] * self.image_shape[1] + 1)
        )
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
    """Return what the upper candidates within a pulse of each one's range have.

    `distance` (n,): m; `pooled` (n,): significance; candidates of 0 do not count; `length`: of a
    pulse, m. Returns (n,).
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
    """Return the probability that each candidate is noise, by decoys at displaced ranges.

    `pooled` (n,): of `CandidatePool.sum_around` with `POOL_RADIUS_PX`. Returns (n,): 0 where all
    candidates lie so close together that no decoy can be had.
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
