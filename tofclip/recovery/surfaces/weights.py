"""What a shot says, and how surely: measurements above the dark with weights, and what is left of them."""

from __future__ import annotations

import numpy as np
import scipy
from numpy.typing import NDArray

from tofclip.camera import Camera, estimate_dark_level
from tofclip.shots import Streak

Image = NDArray[np.float32]

# Of the brightest measurement: what the model leaves even without noise.
MODEL_ERROR_FRACTION = 0.015
SMOOTHING_PX = 2.0


def weigh_measurements(streak: Streak, camera: Camera) -> tuple[Image, Image]:
    """Return the measurements above the dark level, and one over their variance.

    Returns `image, weights` (rows, columns): weights are 0 where a measurement is not valid.
    """
    dark = estimate_dark_level(streak.counts)
    image = (streak.counts - np.float32(dark)).astype(np.float32)
    smooth = np.maximum(scipy.ndimage.gaussian_filter(streak.counts.astype(np.float32), 1.0), 0)
    # The variance of a measurement is its photons; the floor stands for what the model cannot explain.
    weights = 1 / (smooth + MODEL_ERROR_FRACTION * smooth.max() + max(dark, 0.0))
    if streak.saturated is not None:
        weights[streak.saturated] = 0
    weights[:, camera.dead_columns] = 0
    return image, weights.astype(np.float32)


def compare_smoothed(predicted: Image, measured: Image, valid: NDArray[np.bool_]) -> float:
    """Return the norm of what is left over that of the measurements, both smoothed.

    `predicted, measured` (rows, columns); `valid` (rows, columns).
    """
    error, image = (
        scipy.ndimage.gaussian_filter(one * valid, SMOOTHING_PX)
        for one in (measured - predicted, measured)
    )
    signal = float(np.linalg.norm(image))
    return float(np.linalg.norm(error)) / signal if signal else 1.0
