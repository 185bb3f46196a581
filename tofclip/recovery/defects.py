"""Defective measurements of a streak image: pixels that are hot or struck by a particle, and columns
that are dead.

Light of a scene comes in pulses, and no sum of pulses is sharper in time than the instrument's
response: the logarithm of a Gaussian of full width w (rows) has the second difference
``-8 ln 2 / w^2``, and that of a sum of such is nowhere below. So a reading v with
``v^2 > 2^(8 / w^2) * before * after`` is not light, however bright, while a retroreflector, which
is as small but lasts as long as the pulse, is left as it is.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tofclip.shots import Streak

FloatImage = NDArray[np.float32]
Mask = NDArray[np.bool_]

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

BRIGHT_QUANTILE = 0.999
LIT_DEVIATIONS, MIN_LIT_MEASUREMENTS, DISCARDED_FRACTION = 4.0, 100, 0.01
"""Measurements that say how light fluctuates: this far above the noise, at least this number of them, and without
the wildest of them, which may be defects themselves."""

DEAD_COLUMN_FRACTION = 0.1
"""Of the usual column's fluctuation: a column that changes less is dead."""

MAX_CONSTANT_FRACTION = 0.1
"""Of the columns: where more never change, there is no noise by which a dead one is known."""

MAX_ROUNDS = 40
"""Rows of a track that are taken off from either end."""


@dataclass(frozen=True)
class Defects:
    """What is wrong with a streak image.

    Parameters
    ----------
    pixels : (rows, columns) bool array
        Measurements that are sharper in time than a pulse.
    columns : (columns,) bool array
        Columns that see nothing.
    """

    pixels: Mask
    columns: Mask

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

    Parameters
    ----------
    streak : Streak
    pulse_rows : float
        Full width at half maximum of the shortest pulse, in rows.

    Returns
    -------
    Defects
    """
    counts = streak.counts.astype(np.float32)
    defects = np.zeros(counts.shape, bool)
    columns = find_dead_columns(counts)
    if pulse_rows < MIN_PULSE_ROWS or counts.shape[0] < 5:
        return Defects(defects, columns)
    dark, noise, gain = estimate_noise(counts)
    light = counts - np.float32(dark)
    least = max(MIN_PEAK_FRACTION * float(np.quantile(light, BRIGHT_QUANTILE)), 0.0)
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


def estimate_noise(counts: FloatImage) -> tuple[float, float, float]:
    """Estimate dark level, its noise, and the variance that a count of light adds.

    Parameters
    ----------
    counts : (rows, columns) array

    Returns
    -------
    (float, float, float)
        Counts, counts, and counts squared per count.
    """
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
    # What a pulse bends counts here as well, so that the estimate errs on the careful side.
    spread, light = np.maximum(rough[lit] ** 2 - noise**2, 0), level[lit]
    kept = spread <= np.quantile(spread, 1 - DISCARDED_FRACTION)
    return dark, noise, max(1.0, float(spread[kept].sum() / light[kept].sum()))


def find_dead_columns(counts: FloatImage) -> Mask:
    """Find columns that do not even show the noise of the others.

    Parameters
    ----------
    counts : (rows, columns) array

    Returns
    -------
    (columns,) bool array
    """
    changes = np.abs(np.diff(counts, axis=0))
    rough = changes.mean(axis=0)
    dead: Mask = rough < DEAD_COLUMN_FRACTION * float(np.median(rough))
    if not np.median(changes):  # no noise by which a column is known to be alive
        return np.zeros(dead.shape, bool)
    return dead if dead.mean() <= MAX_CONSTANT_FRACTION else np.zeros(dead.shape, bool)


def interpolate_rows(values: FloatImage, defects: Mask) -> FloatImage:
    """Replace defective measurements by what those before and after them say.

    Parameters
    ----------
    values : (rows, columns) array
    defects : (rows, columns) bool array

    Returns
    -------
    (rows, columns) array
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

    Parameters
    ----------
    streak : Streak
        With a time axis.
    pulse_fwhm : float
        Full width at half maximum of the instrument's response, s.

    Returns
    -------
    Streak
        The same image where nothing is wrong with it. Otherwise ``saturated`` marks the defects
        too, and ``metadata`` says how many there are (``defective_readings``).
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
        metadata={**streak.metadata, "defective_readings": str(defects.count)},
    )
