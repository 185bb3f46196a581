"""Dazzled measurements: those beside light so bright that what the model gets wrong of it drowns all
else.

A retroreflector's light falls a part of a column beside where the model has it, as any pixel's
does. Of light ten times the usual that part is as bright as a wall; least squares then put streaks
along its lines and leave out wall pixels to make up for them. Everything but the glint itself is
seen by views in which the glint lies elsewhere. So a frame with a glint is recovered twice: without
the dazzled measurements, and with them for the pixels that no other measurement sees.
"""

from __future__ import annotations

import numpy as np
import scipy
from numpy.typing import NDArray

from tofclip.camera import Measurement
from tofclip.lidar.significance import (
    DAZZLE_REACH_COLUMNS,
    LIT_DEVIATIONS,
    MeasurementNoise,
)
from tofclip.operators import LineProjection

DAZZLE_RATIO = 4.0
"""Light that dazzles, relative to the bright measurements' of the shot."""

BRIGHT_QUANTILE = 0.95
"""Of the measurements that are lit."""

MAX_DAZZLED_FRACTION = 0.05
"""Of the lit measurements; where more are that bright, they are the scene."""

MIN_DAZZLED_SHARE = 0.8
"""Of what a pixel's measurements weigh; a pixel that is dazzled more is part of the glint."""


def find_dazzle_limit(measurement: Measurement, floor: float) -> float:
    """Return the light that dazzles where there is other light at the same instant, counts.

    Parameters
    ----------
    measurement : Measurement
    floor : float
        Standard deviation of a dark measurement, counts.

    Returns
    -------
    float
        Infinite where there is none.
    """
    light = measurement.values[measurement.valid]
    lit = light[light > LIT_DEVIATIONS * floor]
    if not lit.size:
        return float("inf")
    limit = DAZZLE_RATIO * float(np.quantile(lit, BRIGHT_QUANTILE))
    number = np.count_nonzero(lit > limit)
    return limit if 0 < number <= MAX_DAZZLED_FRACTION * lit.size else float("inf")


def find_dazzled(measurement: Measurement, noise: MeasurementNoise) -> NDArray[np.bool_]:
    """Find the measurements beside light far brighter than what else there is.

    Parameters
    ----------
    measurement : Measurement
    noise : MeasurementNoise

    Returns
    -------
    (columns, frames) bool array
    """
    light = np.where(measurement.valid, measurement.values, 0)
    dazzling, size = noise.find_dazzling(light), 2 * DAZZLE_REACH_COLUMNS + 1
    return np.asarray(scipy.ndimage.maximum_filter1d(dazzling, size, axis=0))


def find_glints(operator: LineProjection, dazzled: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Find the pixels that are seen by dazzled measurements only.

    Parameters
    ----------
    operator : LineProjection
    dazzled : (columns, frames) bool array

    Returns
    -------
    (frames, rows, columns) bool array
    """
    transposed = operator.matrix.T
    weight = transposed @ np.ones(dazzled.shape[0], np.float32)
    share = (transposed @ dazzled.astype(np.float32)).T
    glints = share > MIN_DAZZLED_SHARE * np.maximum(weight, np.finfo(np.float32).tiny)
    return np.asarray(glints.reshape(-1, *operator.shape_in))
