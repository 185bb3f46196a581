"""Returns with the corrections that their camera's range calibration knows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tofclip.camera import RangeCalibration
from tofclip.shots import Returns
from tofclip.units import SPEED_OF_LIGHT

FloatArray = NDArray[np.float64]


def correct_returns(returns: Returns) -> Returns:
    """Undo range walk and the pixels' offsets where the camera knows them, where returns are listed.

    Ranges, times and intensities are corrected; deviations get the calibration's.
    """
    known = returns.camera.range_calibration
    if known is None:
        return returns
    distance, intensity, sigma = correct_ranges(
        known,
        returns.range,
        returns.intensity / square_range(returns.range),
        returns.confidence.astype(np.float64),
        (returns.y, returns.x),
    )
    return replace(
        returns,
        range=distance,
        intensity=intensity.astype(np.float32),
        confidence=sigma.astype(np.float32),
        time=2 * distance / SPEED_OF_LIGHT,
    )


def correct_ranges(
    known: RangeCalibration,
    distance: FloatArray,
    signal: FloatArray,
    sigma: FloatArray,
    pixel: tuple[NDArray[np.integer], NDArray[np.integer]],
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Undo range walk and the pixels' offsets.

    `distance` (n,): ranges as they were measured, m; `signal` (n,): counts of the returns; `sigma`
    (n,): one standard deviation of the ranges, m; `pixel`: rows and columns. Returns `distance`
    (n,): m; `intensity` (n,): counts, referred to a range of 1 m; `sigma` (n,): m.
    """
    excess, further = known.compute_excess(signal, *pixel)
    corrected = distance - excess
    return corrected, signal * corrected**2, np.hypot(sigma, further)


def square_range(distance: FloatArray) -> FloatArray:
    """Square of measured ranges, by which their intensities were referred to 1 m; never 0."""
    return np.maximum(distance**2, np.finfo(np.float64).tiny)
