"""Defective measurements of a streak image: pixels that are hot or struck by a particle, columns
that are dead, light that is cut off at the sensor's limit; and how the others fluctuate.

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
from numpy.typing import NDArray

from tofclip.camera import Measurement, estimate_dark_level
from tofclip.camera.noise import MeasurementNoise, find_dazzle_limit
from tofclip.shots import Streak
from tofclip.solvers import ClippedSquares, LeastSquares, Method, ProximalMethod
from tofclip.storage import Scalar

FloatImage = NDArray[np.float32]
Mask = NDArray[np.bool_]

DEFECTS_KEY, CLIPPED_KEY = "defective_readings", "clipped_readings"

MIN_PULSE_ROWS = 2.0
"""Full width of the shortest pulse that is distinguished from a single row."""

MAX_PULSE_ROWS = 3.0
"""Longer responses are taken as this long: what an instrument says of its own is often too long."""

MAX_DEFECT_FRACTION = 0.25
"""Of the bright measurements; where more are sharp, the response is sharper than it is said to be."""

SHARPNESS_MARGIN = 1.5
"""By this factor a reading has to exceed what its neighbours in time allow; a response may rise
faster than a Gaussian of its width."""

MIN_SIGNIFICANCE = 5.0
"""Standard deviations in favour of the neighbours."""

MIN_PEAK_FRACTION = 0.2
"""Of the image's bright pixels: weaker defects do no harm and are not distinguished from noise."""

MIN_DEFECT_PHOTONS = 20.0
"""With fewer photons than this, neighbours in time may well have none."""

BRIGHT_QUANTILE = 0.999
LIT_DEVIATIONS, MIN_LIT_MEASUREMENTS = 4.0, 100
"""Measurements that say how light fluctuates: this far above the noise, at least this number of
them."""

LIGHT_RATIO = 1.5
"""Measurements as bright as that are looked at together."""

MEDIAN_OF_SQUARES = 0.4549
"""Of a Gaussian's squares, relative to their mean: a chi-squared law of one degree of freedom."""

DEAD_COLUMN_FRACTION = 0.1
"""Of the usual column's fluctuation: a column that changes less is dead."""

MEAN_CHANGE = 2 / np.sqrt(np.pi)
"""Of the size of the difference of two Gaussian numbers, in their standard deviations."""

MAX_CONSTANT_FRACTION = 0.1
"""Of the columns: where more never change, there is no noise by which a dead one is known."""

MIN_CLIPPED_PIXELS, MIN_CLIPPED_RATIO, COMPARED_VALUES = 20, 3.0, 3
"""Pixels at the highest value, and how many times as many they have to be as at any of the next
lower values, to be a plateau: brightness falls off towards the highest otherwise."""

MAX_ROUNDS = 40
"""Rows of a track that are taken off from either end."""

CLIPPED_FRACTION = 0.9
"""Of the limit above the dark: rectifying mixes what is cut off with its neighbours."""

MIN_NOISE_COUNT = 0.3
"""A dark image whose readings are whole counts still hides this much."""


@dataclass(frozen=True)
class Defects:
    """What is wrong with a streak image."""

    pixels: Mask  # (rows, columns), measurements that are sharper in time than a pulse
    columns: Mask  # (columns,), columns that see nothing

    @property
    def mask(self) -> Mask:
        """Measurements that cannot be trusted, (rows, columns)."""
        return self.pixels | self.columns

    @property
    def count(self) -> int:
        """Number of defective measurements."""
        return int(np.count_nonzero(self.mask))


def find_defects(streak: Streak, pulse_rows: float) -> Defects:
    """Find measurements that no light explains.

    `pulse_rows`: full width at half maximum of the shortest pulse, in rows.
    """
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


def find_clipping_level(counts: FloatImage) -> float:
    """Find the value at which a streak image is cut off.

    What is cut off is at least as bright as it shows, which says more than nothing: it is not
    masked, but fitted from below (`tofclip.solvers.ClippedSquares`).

    `counts` (rows, columns). Returns infinite where nothing is.
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


def estimate_noise(counts: FloatImage) -> tuple[float, float, float]:
    """Estimate dark level, its noise, and the variance that a count of light adds.

    `counts` (rows, columns). Returns counts, counts, and counts squared per count.
    """
    if len(counts) < 3:  # no row has two neighbours to differ from: photons' own noise
        dark = float(np.median(counts))
        return dark, float(np.sqrt(max(dark, 1.0))), 1.0
    rough = (counts[1:-1] - (counts[:-2] + counts[2:]) / 2) / np.sqrt(1.5)
    dark = float(np.median(counts))
    changes = np.abs(rough)
    if not np.median(changes):  # a detector that counts hardly anything, or cuts off the dark
        changes = changes[changes > 0] if changes.any() else changes
    noise = 1.4826 * float(np.median(changes))
    level = (counts[:-2] + counts[1:-1] + counts[2:]) / 3 - dark
    lit = level > max(LIT_DEVIATIONS * noise, float(np.finfo(np.float32).tiny))
    if np.count_nonzero(lit) < MIN_LIT_MEASUREMENTS:
        return dark, noise, 1.0
    # Medians do not see defects as long as these are fewer than what is sound. What a pulse bends
    # counts in `rough` as well, but grows with the square of the light.
    light, square = level[lit], rough[lit] ** 2
    group = np.asarray(np.floor(np.log(light) / np.log(LIGHT_RATIO)), dtype=np.int64)
    group -= int(group.min())
    rows, variances, weights = [], [], []
    for number in range(int(group.max()) + 1):
        if np.count_nonzero(group == number) < MIN_LIT_MEASUREMENTS / 2:
            continue
        usual = float(np.median(light[group == number]))
        found = float(np.median(square[group == number])) / MEDIAN_OF_SQUARES - noise**2
        # a median of n squares is known to about this fraction of itself
        weights.append(np.sqrt(np.count_nonzero(group == number)) / max(found, noise**2, usual))
        rows.append((usual, usual**2))
        variances.append(found)
    if not rows:
        return dark, noise, 1.0
    each = np.array(weights)
    fitted, _ = scipy.optimize.nnls(np.array(rows) * each[:, None], np.array(variances) * each)
    return dark, noise, max(1.0, float(fitted[0]))


def find_dead_columns(counts: FloatImage, noise: float) -> Mask:
    """Find columns that do not even show the noise of the others.

    `counts` (rows, columns); `noise`: standard deviation in the dark, counts. Returns (columns,).
    """
    changes = np.abs(np.diff(counts, axis=0))
    rough = changes.mean(axis=0)
    # Of a bright scene the usual column is lit; a column that sees none of it is not dead.
    usual = min(float(np.median(rough)), MEAN_CHANGE * noise)
    dead: Mask = rough < DEAD_COLUMN_FRACTION * usual
    if not np.median(changes):  # no noise by which a column is known to be alive
        return np.zeros(dead.shape, bool)
    return dead if dead.mean() <= MAX_CONSTANT_FRACTION else np.zeros(dead.shape, bool)


def interpolate_rows(values: FloatImage, defects: Mask) -> FloatImage:
    """Replace defective measurements by what those before and after them say.

    `values` (rows, columns); `defects` (rows, columns). Returns (rows, columns).
    """
    mended = values.copy()
    rows = np.arange(values.shape[0])
    for column in np.flatnonzero(defects.any(axis=0)):
        bad = defects[:, column]
        if not bad.all():
            mended[bad, column] = np.interp(rows[bad], rows[~bad], values[~bad, column])
    return mended


def mask_defects(streak: Streak, pulse_fwhm: float) -> Streak:
    """Return a streak image whose defects are masked, and mended for methods that know no mask.

    `streak`: with a time axis; `pulse_fwhm`: full width at half maximum of the instrument's
    response, s. Returns the same image where nothing is wrong with it. Otherwise ``saturated``
    marks the defects too, and ``metadata`` says how many there are (``defective_readings``).
    """
    rows = streak.counts.shape[0]
    if rows < 2:
        return streak
    times = streak.times
    defects = find_defects(streak, pulse_fwhm * (rows - 1) / float(times[-1] - times[0]))
    if not defects.count:
        return streak
    known = defects.mask if streak.saturated is None else streak.saturated | defects.mask
    mended = interpolate_rows(streak.counts.astype(np.float32), defects.pixels)
    return replace(
        streak,
        counts=mended,
        saturated=known,
        metadata={**streak.metadata, DEFECTS_KEY: str(defects.count)},
    )


def count_defects(streak: Streak, clipping: float) -> dict[str, Scalar]:
    """Count the readings that are defective and those that are cut off, where there are any.

    `clipping`: value at which it is cut off, see `find_clipping_level`.
    """
    clipped = int(np.count_nonzero(streak.counts >= clipping))
    defective = int(streak.metadata.get(DEFECTS_KEY, 0))
    found: dict[str, Scalar] = {DEFECTS_KEY: defective, CLIPPED_KEY: clipped}
    return {name: number for name, number in found.items() if number}


def adapt_to_clipping(method: Method, streak: Streak, clipping: float) -> Method:
    """Return a method with a prior that knows where a streak image is cut off.

    `clipping`: value at which it is cut off, see `find_clipping_level`. Returns the same where
    nothing is cut off, or where it has a data term of its own.
    """
    if not isinstance(method, ProximalMethod) or method.data_term is not LeastSquares:
        return method
    if not np.isfinite(clipping):
        return method
    limit = CLIPPED_FRACTION * (clipping - estimate_dark_level(streak.counts))
    return replace(method, data_term=partial(ClippedSquares, limit=limit))


def describe_noise(streak: Streak, measurement: Measurement) -> MeasurementNoise:
    """Say how the measurements fluctuate, by which returns are judged later.

    For frames with a prior, which fit the measurements as well as these allow: what a linear
    inverse spreads over the picture has another cause.

    `measurement`: made of it. Returns its misfit is known only after the recovery.
    """
    _, floor, gain = estimate_noise(streak.counts)
    least = max(float(floor), MIN_NOISE_COUNT)
    return MeasurementNoise(least, float(gain), dazzle=find_dazzle_limit(measurement, least))


def list_noise_figures(
    noise: MeasurementNoise, measurement: Measurement, used: NDArray[np.bool_], residual: float
) -> dict[str, Scalar]:
    """List what the frames have to know of their measurements: noise, and what the model misses.

    `used` (readings, frames): the measurements that were fitted; `residual`: norm of what is left
    of those over theirs.
    """
    light = np.where(used, measurement.values, 0)
    energy = float(np.sum(light**2, dtype=np.float64))
    explained = noise.floor**2 * np.count_nonzero(used) + noise.gain * float(
        np.sum(np.maximum(light, 0), dtype=np.float64)
    )
    misfit = np.sqrt(max(residual**2 - explained / energy, 0.0)) if energy > 0 else 0.0
    return replace(noise, misfit=float(misfit)).list_figures()
