"""What a recovery knows of its measurements: how they fluctuate, and where they are cut off."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from tofclip.camera import Measurement, estimate_dark_level
from tofclip.camera.measurement import MeasurementNoise, find_dazzle_limit
from tofclip.recovery.defects import estimate_noise
from tofclip.shots import Streak
from tofclip.solvers import ClippedSquares, LeastSquares, Method, ProximalMethod
from tofclip.storage import Scalar

CLIPPED_FRACTION = 0.9
"""Of the limit above the dark: rectifying mixes what is cut off with its neighbours."""

MIN_NOISE_COUNT = 0.3
"""A dark image whose readings are whole counts still hides this much."""


def adapt_to_clipping(method: Method, streak: Streak, clipping: float) -> Method:
    """Return a method with a prior that knows where a streak image is cut off.

    Parameters
    ----------
    method : Method
    streak : Streak
    clipping : float
        Value at which it is cut off, see `find_clipping_level`.

    Returns
    -------
    Method
        The same where nothing is cut off, or where it has a data term of its own.
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

    Parameters
    ----------
    streak : Streak
    measurement : Measurement
        Made of it.

    Returns
    -------
    MeasurementNoise
        Its misfit is known only after the recovery.
    """
    _, floor, gain = estimate_noise(streak.counts)
    least = max(float(floor), MIN_NOISE_COUNT)
    return MeasurementNoise(least, float(gain), dazzle=find_dazzle_limit(measurement, least))


def list_noise_figures(
    noise: MeasurementNoise, measurement: Measurement, used: NDArray[np.bool_], residual: float
) -> dict[str, Scalar]:
    """List what the frames have to know of their measurements: noise, and what the model misses.

    Parameters
    ----------
    noise : MeasurementNoise
    measurement : Measurement
    used : (readings, frames) bool array
        The measurements that were fitted.
    residual : float
        Norm of what is left of those over theirs.

    Returns
    -------
    dict of str to float
    """
    light = np.where(used, measurement.values, 0)
    energy = float(np.sum(light**2, dtype=np.float64))
    explained = noise.floor**2 * np.count_nonzero(used) + noise.gain * float(
        np.sum(np.maximum(light, 0), dtype=np.float64)
    )
    misfit = np.sqrt(max(residual**2 - explained / energy, 0.0)) if energy > 0 else 0.0
    return replace(noise, misfit=float(misfit)).list_figures()
