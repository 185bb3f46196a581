"""Defective measurements of a streak image: pixels that are hot or struck by a particle, columns
that are dead or have a dark level of their own, light that is cut off at the sensor's limit; and how the
others fluctuate.

Light of a scene comes in pulses, and no sum of pulses is sharper in time than the instrument's
response: the logarithm of a Gaussian of full width w (rows) has the second difference
``-8 ln 2 / w^2``, and that of a sum of such is nowhere below. So a reading v with
``v^2 > 2^(8 / w^2) * before * after`` is not light, however bright, while a retroreflector, which
is as small but lasts as long as the pulse, is left as it is.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import scipy

from tofclip.arrays import BoolArray, Float32Array, FloatArray
from tofclip.camera import Measurement, estimate_dark_level
from tofclip.camera.noise import MeasurementNoise, find_dazzle_limit
from tofclip.camera.rectifier import part_quiet_rows
from tofclip.shots import Streak
from tofclip.solvers import ClippedSquares, DataTermMaker, LeastSquares
from tofclip.storage import Scalar
from tofclip.units import MAD_TO_SIGMA

DEFECTS_KEY, CLIPPED_KEY = "defective_readings", "clipped_readings"
# Full widths of the shortest pulse that is distinguished from a single row; and of the longest, as
# what an instrument says of its own is often too long.
MIN_PULSE_ROWS, MAX_PULSE_ROWS = 2.0, 3.0
MAX_DEFECT_FRACTION = (
    0.25  # of bright measurements; beyond, the response is sharper than it is said
)
# By this factor a reading has to exceed what its neighbours in time allow; a response may rise
# faster than a Gaussian of its width.
SHARPNESS_MARGIN = 1.5
MIN_SIGNIFICANCE = 5.0  # standard deviations in favour of the neighbours
# Of the image's bright pixels: weaker defects do no harm and are not distinguished from noise.
MIN_PEAK_FRACTION, BRIGHT_QUANTILE = 0.2, 0.999
MIN_DEFECT_PHOTONS = 20.0  # with fewer, neighbours in time may well have none
# Measurements that say how light fluctuates: this far above the noise, at least this number of them;
# those as bright as the ratio are looked at together.
LIT_DEVIATIONS, MIN_LIT_MEASUREMENTS, LIGHT_RATIO = 4.0, 100, 1.5
MEDIAN_OF_SQUARES = 0.4549  # of a Gaussian's, relative to their mean: chi-squared of one freedom
DEAD_COLUMN_FRACTION = 0.1  # of the usual column's fluctuation: a column that changes less is dead
MEAN_CHANGE = 2 / np.sqrt(np.pi)  # of the difference of two Gaussian numbers, in deviations
MAX_CONSTANT_FRACTION = 0.1  # of columns: where more never change, no noise tells a dead one
# Pixels at the highest value, and how many times as many they have to be as at any of the next
# lower values, to be a plateau: brightness falls off towards the highest otherwise.
MIN_CLIPPED_PIXELS, MIN_CLIPPED_RATIO, COMPARED_VALUES = 20, 3.0, 3
MAX_ROUNDS = 40  # rows of a track that are taken off from either end
# Of a column's readings, at least as many are dark; and how often those near their mean are chosen anew.
LEVEL_QUANTILE, LEVEL_ROUNDS = 0.25, 5
CLIPPED_FRACTION = 0.9  # of the limit above the dark: rectifying mixes light with its neighbours
MIN_NOISE_COUNT = 0.3  # a dark image whose readings are whole counts still hides this much


@dataclass(frozen=True)
class Defects:
    """What is wrong with a streak image."""

    pixels: BoolArray  # (rows, columns), measurements that are sharper in time than a pulse
    columns: BoolArray  # (columns,), columns that see nothing

    @property
    def mask(self) -> BoolArray:
        """Measurements that cannot be trusted, (rows, columns)."""
        return self.pixels | self.columns

    @property
    def count(self) -> int:
        """Number of defective measurements."""
        return int(np.count_nonzero(self.mask))


def find_defects(streak: Streak, pulse_rows: float) -> Defects:
    """Find measurements that no light explains, of pulses of so many rows (full width) or more."""
    counts = streak.counts.astype(np.float32)
    defects = np.zeros(counts.shape, bool)
    dark, noise, gain = estimate_noise(counts)
    columns = find_dead_columns(counts, noise)
    if pulse_rows < MIN_PULSE_ROWS or counts.shape[0] < 5:
        return Defects(defects, columns)
    light = counts - np.float32(dark)
    # As bright as the darker of its neighbours in time: defects do not say what is bright.
    sound = np.minimum(light[:-2], light[2:])
    usual = float(np.quantile(sound, BRIGHT_QUANTILE))
    least = max(MIN_PEAK_FRACTION * usual, MIN_DEFECT_PHOTONS * gain)
    factor = SHARPNESS_MARGIN * 2.0 ** (4 / min(pulse_rows, MAX_PULSE_ROWS) ** 2)
    bright = np.count_nonzero(light > least)
    some = np.arange(light.shape[1])
    for _ in range(MAX_ROUNDS):
        part = light[:, some]
        before, after = np.roll(part, 1, axis=0), np.roll(part, -1, axis=0)
        before[0], after[-1] = after[0], before[-1]
        allowed = np.ones_like(part)
        for side in (before, after):
            brightest = np.maximum(side, 0)
            allowed *= brightest + MIN_SIGNIFICANCE * np.sqrt(noise**2 + gain * brightest)
        sharp = (part > factor * np.sqrt(allowed)) & (part > least)
        hit = sharp.any(axis=0)
        if not hit.any():
            break
        # What is left of a track is looked at again, from its ends on.
        defects[:, some] |= sharp
        light[:, some] = np.where(sharp, np.minimum(before, after), part)
        some = some[hit]
    if np.count_nonzero(defects) > MAX_DEFECT_FRACTION * bright:
        defects[:] = False
    return Defects(defects & ~columns, columns)


def find_clipping_level(counts: Float32Array) -> float:
    """Find the value at which a streak image is cut off; infinite where nothing is. What is cut off
    is at least as bright as it shows, which says more than nothing: it is not masked, but fitted
    from below (`tofclip.solvers.ClippedSquares`).
    """
    highest = float(np.max(counts))
    number = np.count_nonzero(counts == highest)
    if number < MIN_CLIPPED_PIXELS or highest == float(counts.min()):
        return float("inf")
    # a few times as many of the brightest are enough to see how many there are of each value
    most = min(int(counts.size), 20 * int(number))
    brightest = np.partition(counts, counts.size - most, axis=None)[counts.size - most :]
    _, each = np.unique(brightest[brightest < highest], return_counts=True)
    usual = max([1, *each[-COMPARED_VALUES:].tolist()])
    return highest if number > MIN_CLIPPED_RATIO * usual else float("inf")


def estimate_noise(counts: Float32Array) -> tuple[float, float, float]:
    """Estimate dark level and its noise, counts, and the variance that a count of light adds."""
    if len(counts) < 3:  # no row has two neighbours to differ from: photons' own noise
        dark = float(np.median(counts))
        return dark, float(np.sqrt(max(dark, 1.0))), 1.0
    rough = (counts[1:-1] - (counts[:-2] + counts[2:]) / 2) / np.sqrt(1.5)
    dark = float(np.median(counts))
    changes = np.abs(rough)
    if not np.median(changes):  # a detector that counts hardly anything, or cuts off the dark
        changes = changes[changes > 0] if changes.any() else changes
    noise = MAD_TO_SIGMA * float(np.median(changes))
    level = (counts[:-2] + counts[1:-1] + counts[2:]) / 3 - dark
    lit = level > max(LIT_DEVIATIONS * noise, float(np.finfo(np.float32).tiny))
    if np.count_nonzero(lit) < MIN_LIT_MEASUREMENTS:
        return dark, noise, 1.0
    # Medians do not see defects as long as these are fewer than what is sound. What a pulse bends
    # counts in `rough` as well, but grows with the square of the light.
    light, square = level[lit], rough[lit] ** 2
    group = np.floor(np.log(light) / np.log(LIGHT_RATIO))
    rows, variances = [], []
    for number in np.unique(group):
        own = group == number
        if np.count_nonzero(own) < MIN_LIT_MEASUREMENTS / 2:
            continue
        usual = float(np.median(light[own]))
        found = float(np.median(square[own])) / MEDIAN_OF_SQUARES - noise**2
        # a median of n squares is known to about this fraction of itself
        weight = np.sqrt(np.count_nonzero(own)) / max(found, noise**2, usual)
        rows.append((weight * usual, weight * usual**2))
        variances.append(weight * found)
    if not rows:
        return dark, noise, 1.0
    fitted, _ = scipy.optimize.nnls(np.array(rows), np.array(variances))
    return dark, noise, max(1.0, float(fitted[0]))


def find_dead_columns(counts: Float32Array, noise: float) -> BoolArray:
    """Find columns, (columns,), that do not even show the noise of the others in the dark."""
    changes = np.abs(np.diff(counts, axis=0))
    rough = changes.mean(axis=0)
    # Of a bright scene the usual column is lit; a column that sees none of it is not dead.
    usual = min(float(np.median(rough)), MEAN_CHANGE * noise)
    dead = rough < DEAD_COLUMN_FRACTION * usual
    if not np.median(changes):  # no noise by which a column is known to be alive
        return np.zeros(dead.shape, bool)
    return dead if dead.mean() <= MAX_CONSTANT_FRACTION else np.zeros(dead.shape, bool)


def measure_levels(counts: Float32Array) -> FloatArray:
    """Return what columns have at all times more or less than the usual one, (columns,), as of ambient light
    or a dark level of their own; 0 where that is no more than noise.

    That is by how much the dark readings of columns differ in all other rows, as far as they do so in the
    quietest rows as well: light that comes and goes does not.
    """
    dark, noise, gain = estimate_noise(counts)
    quiet, others = part_quiet_rows(counts)
    rest = counts[others]
    level = np.quantile(rest, LEVEL_QUANTILE, axis=0) if len(rest) else np.full(rest.shape[1], dark)
    for _ in range(LEVEL_ROUNDS):
        own = rest <= level + 2 * np.sqrt(noise**2 + gain * np.maximum(level - dark, 0))
        level = np.sum(rest, axis=0, where=own) / np.maximum(np.count_nonzero(own, axis=0), 1)
    level -= np.median(level)
    seen = counts[quiet].mean(axis=0)
    seen = seen - np.median(seen)
    energy = float(level @ level)
    share = float(level @ seen) / energy if energy else 0.0
    # what quiet rows leave of it is their noise
    if not share * np.sqrt(energy) > MIN_SIGNIFICANCE * np.std(seen - share * level):
        return np.zeros(level.size)
    return np.asarray(share * level, np.float64)


def take_levels(counts: Float32Array, levels: FloatArray) -> Float32Array:
    """Return a streak image without its columns' levels; what is cut off stays as bright as all that is."""
    level = counts - levels.astype(np.float32)
    return np.where(counts >= find_clipping_level(counts), counts, level).astype(np.float32)


def mask_defects(streak: Streak, pulse_fwhm: float) -> Streak:
    """Return a streak image whose columns are level and whose defects are masked as ``saturated``, and
    mended for methods that know no mask; ``metadata`` says how many there are. The same where nothing is
    wrong with it. `pulse_fwhm`: full width at half maximum of the instrument's response, s.
    """
    rows = streak.counts.shape[0]
    if rows < 2:
        return streak
    levels, times = measure_levels(streak.counts.astype(np.float32)), streak.times
    if levels.any():
        streak = replace(streak, counts=take_levels(streak.counts, levels))
    defects = find_defects(streak, pulse_fwhm * (rows - 1) / float(times[-1] - times[0]))
    if not defects.count:
        return streak
    # what those before and after a defective measurement say of it
    mended, places = streak.counts.astype(np.float32), np.arange(rows)
    for column in np.flatnonzero(defects.pixels.any(axis=0)):
        bad = defects.pixels[:, column]
        if not bad.all():
            mended[bad, column] = np.interp(places[bad], places[~bad], mended[~bad, column])
    return replace(
        streak,
        counts=mended,
        saturated=defects.mask if streak.saturated is None else streak.saturated | defects.mask,
        metadata={**streak.metadata, DEFECTS_KEY: str(defects.count)},
    )


def count_defects(streak: Streak, clipping: float) -> dict[str, Scalar]:
    """Count the readings that are defective and those that are cut off, where there are any."""
    clipped = int(np.count_nonzero(streak.counts >= clipping))
    found = {DEFECTS_KEY: int(streak.metadata.get(DEFECTS_KEY, 0)), CLIPPED_KEY: clipped}
    return {name: number for name, number in found.items() if number}


def clip_from_below(streak: Streak, clipping: float) -> DataTermMaker:
    """Return the data term of a streak image that is cut off at a level; infinite: nowhere."""
    if not np.isfinite(clipping):
        return LeastSquares
    limit = CLIPPED_FRACTION * (clipping - estimate_dark_level(streak.counts))
    return partial(ClippedSquares, limit=limit)


def describe_noise(streak: Streak, measurement: Measurement) -> MeasurementNoise:
    """Say how the measurements fluctuate, by which returns are judged later. For frames with a
    prior, which fit the measurements as well as these allow: what a linear inverse spreads over the
    picture has another cause. Their misfit is known after the recovery.
    """
    _, floor, gain = estimate_noise(streak.counts)
    least = max(float(floor), MIN_NOISE_COUNT)
    return MeasurementNoise(least, float(gain), dazzle=find_dazzle_limit(measurement, least))


def list_noise_figures(
    noise: MeasurementNoise, measurement: Measurement, used: BoolArray, residual: float
) -> dict[str, Scalar]:
    """List what the frames have to know of their measurements: noise, and what the model misses.
    `used` (measurements, frames): those that were fitted; `residual`: norm of what is left of them
    over theirs.
    """
    light = np.where(used, measurement.values, 0)
    energy = float(np.sum(light**2, dtype=np.float64))
    signal = float(np.sum(np.maximum(light, 0), dtype=np.float64))
    explained = noise.floor**2 * np.count_nonzero(used) + noise.gain * signal
    misfit = np.sqrt(max(residual**2 - explained / energy, 0.0)) if energy > 0 else 0.0
    return replace(noise, misfit=float(misfit)).list_figures()
