"""How measurements fluctuate, and light that dazzles what lies beside it.

A retroreflector's light falls a part of a column beside where the model has it, as any pixel's
does. Of light ten times the usual that part is as bright as a wall; least squares then put streaks
along its lines and leave out wall pixels to make up for them. Everything but the glint itself is
seen by views in which the glint lies elsewhere. So a frame with a glint is recovered twice: without
the dazzled measurements, and with them for the pixels that no other measurement sees.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from tofclip.arrays import AnyArray, BoolArray, Float32Array
from tofclip.camera.rectifier import Measurement
from tofclip.operators import LineProjection
from tofclip.storage import Scalar

# by which frames know the fields of `MeasurementNoise`
FIGURES = {
    "noise_floor_count": "floor",
    "noise_gain_count": "gain",
    "noise_misfit_fraction": "misfit",
    "noise_dazzle_count": "dazzle",
}
# Columns beside light above `MeasurementNoise.dazzle` that it dazzles: the model's error and the slit's
# blur.
DAZZLE_REACH_COLUMNS = 2
# Of the lit measurements of a frame; light that dazzles is that many times as bright.
USUAL_QUANTILE, FRAME_DAZZLE_RATIO = 0.75, 5.0
LIT_DEVIATIONS = 4.0
DAZZLE_MISFIT = 0.3  # of such light, that the model has in a neighbouring column
DAZZLE_RATIO = 4.0  # light that dazzles, relative to the bright measurements' of the shot
BRIGHT_QUANTILE = 0.95  # of the measurements that are lit
MAX_DAZZLED_FRACTION = 0.05  # of the lit ones; where more are that bright, they are the scene
MIN_DAZZLED_SHARE = 0.8  # of what a pixel's measurements weigh; beyond, it is part of the glint


@dataclass(frozen=True)
class MeasurementNoise:
    """Variance of a measurement: ``floor^2 + gain * signal + (misfit * usual)^2``.

    The last is what the model does not explain, which falls beside the light, on measurements that
    should be dark; `usual` is the root mean square of a frame's signal. Beside light that dazzles
    there is `DAZZLE_MISFIT` of that light in addition.
    """

    floor: float  # standard deviation in the dark, counts
    gain: float  # counts of variance for a count of signal
    # of the recovery's residual, what noise does not explain, relative to the signal
    misfit: float = 0.0
    dazzle: float = np.inf  # light above this, counts, dazzles the columns beside it

    @classmethod
    def from_figures(cls, known: Mapping[str, Scalar]) -> MeasurementNoise | None:
        """Return what a recovery wrote down of its measurements; None if it did not."""
        found = {field: float(known[name]) for name, field in FIGURES.items() if name in known}
        return cls(**found) if {"floor", "gain"} <= set(found) else None

    def list_figures(self) -> dict[str, Scalar]:
        """List what frames have to know of their measurements."""
        found = {name: getattr(self, field) for name, field in FIGURES.items()}
        return {name: value for name, value in found.items() if np.isfinite(value)}

    def compute_variance(self, light: Float32Array) -> Float32Array:
        """Return each measurement's variance, (columns, frames), of so much predicted light."""
        variance = self.floor**2 + self.gain * light
        if light.max(initial=0) <= self.dazzle:
            variance += self.misfit**2 * np.mean(light**2, axis=0)
        else:
            dazzling = self.find_dazzling(light)
            variance += self.misfit**2 * np.mean(np.where(dazzling, 0, light) ** 2, axis=0)
            beside = _take_brightest_around(np.where(dazzling, light, 0))
            variance += (DAZZLE_MISFIT * beside) ** 2
        return np.asarray(variance, dtype=np.float32)

    def find_dazzling(self, light: Float32Array) -> BoolArray:
        """Find light that is too bright for what else there is at the same instant. Where a bright
        object is alone, there is nothing that it could dazzle. Counts, (columns, frames).
        """
        dazzling = light > self.dazzle
        for frame in np.flatnonzero(dazzling.any(axis=0)):
            lit = light[light[:, frame] > LIT_DEVIATIONS * self.floor, frame]
            usual = float(np.quantile(lit, USUAL_QUANTILE)) if lit.size else 0.0
            dazzling[:, frame] &= light[:, frame] > FRAME_DAZZLE_RATIO * usual
        return dazzling


def find_dazzle_limit(measurement: Measurement, floor: float) -> float:
    """Return the light that dazzles where there is other light at the same instant, counts; infinite
    where there is none. `floor` is the standard deviation of a dark measurement.
    """
    light = measurement.values[measurement.valid]
    lit = light[light > LIT_DEVIATIONS * floor]
    if not lit.size:
        return float("inf")
    limit = DAZZLE_RATIO * float(np.quantile(lit, BRIGHT_QUANTILE))
    number = np.count_nonzero(lit > limit)
    return limit if 0 < number <= MAX_DAZZLED_FRACTION * lit.size else float("inf")


def find_dazzled(measurement: Measurement, noise: MeasurementNoise) -> BoolArray:
    """Find the measurements, (columns, frames), beside light far brighter than what else there is."""
    light = np.where(measurement.valid, measurement.values, 0)
    return _take_brightest_around(noise.find_dazzling(light))


def find_glints(operator: LineProjection, dazzled: BoolArray) -> BoolArray:
    """Find the pixels, (frames, rows, columns), that only dazzled measurements see."""
    transposed = operator.matrix.T
    weight = transposed @ np.ones(dazzled.shape[0], np.float32)
    share = (transposed @ dazzled.astype(np.float32)).T
    glints = share > MIN_DAZZLED_SHARE * np.maximum(weight, np.finfo(np.float32).tiny)
    return glints.reshape(-1, *operator.shape_in)


def _take_brightest_around(light: AnyArray) -> AnyArray:
    """Return the greatest value within `DAZZLE_REACH_COLUMNS`, (columns, frames)."""
    from scipy.ndimage import maximum_filter1d  # reading a shot has to be quick

    size = 2 * DAZZLE_REACH_COLUMNS + 1
    return maximum_filter1d(light, size, axis=0, mode="constant")
