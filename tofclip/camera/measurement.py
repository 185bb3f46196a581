"""From a raw streak image to the readings that the forward operator predicts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tofclip.camera.model import Camera
from tofclip.camera.sweep import Sweep
from tofclip.errors import CalibrationError, InputError

FloatImage = NDArray[np.float32]
Mask = NDArray[np.bool_]

QUIET_SHARE = 0.05


@dataclass(frozen=True)
class Measurement:
    """Rectified readings with the dark level taken off.

    Parameters
    ----------
    readings : (columns, frames) float32 array
        Slit readings, one column of the array for each instant. May be negative: noise about a dark level is.
    good : (columns, frames) bool array
        False where a sensor pixel was saturated or dead, or where the raw image ends.
    """

    readings: FloatImage
    good: Mask


def measure(counts: FloatImage, saturated: Mask | None, camera: Camera, dark: float | None = None) -> Measurement:
    """Subtract the dark level and rectify the sweep.

    Parameters
    ----------
    counts : (rows, columns) array
        Raw streak image, rows = time.
    saturated : (rows, columns) bool array or None
    camera : Camera
        Its sweep says where each rectified pixel lies; without one the rows are taken as they are.
    dark : float, optional
        Dark level in counts; by default `dark_level` of the picture.

    Raises
    ------
    CalibrationError
        The picture is not as wide as the camera's slit.
    InputError
        Nothing remains above the dark level, or no reading can be trusted.
    """
    require_width(counts, camera)
    dark = dark_level(counts) if dark is None else dark
    signal = counts - np.float32(dark)
    bad = np.zeros(counts.shape, bool) if saturated is None else saturated
    if camera.sweep is not None:
        signal, bad = rectify(signal, bad, camera.sweep)
    good = ~(bad | camera.dead_columns)
    if not good.any():
        raise InputError("no reading can be trusted: every pixel is saturated, dead or outside the sweep")
    if not np.any(signal[good] > 0):
        raise InputError("nothing rises above the dark level; was there any light?")
    return Measurement(np.ascontiguousarray(signal.T), np.ascontiguousarray(good.T))


def require_width(counts: FloatImage, camera: Camera) -> None:
    """Raise `CalibrationError` unless the picture is as wide as the camera's slit."""
    if counts.shape[1] != camera.slit_width_px:
        raise CalibrationError(
            f"the streak image has {counts.shape[1]} columns but the camera's slit has {camera.slit_width_px}; "
            "use the camera file that belongs to this instrument"
        )


def dark_level(counts: FloatImage) -> float:
    """Median of the quietest rows, in counts.

    Taken from whole rows, before or after the light came, so that it stays where the readings scatter about it: the
    least value of a picture would turn noise into an offset.
    """
    row_sums = counts.sum(axis=1, dtype=np.float64)
    quiet = np.argsort(row_sums)[: max(1, round(QUIET_SHARE * row_sums.size))]
    return float(np.median(counts[quiet]))


def rectify(signal: FloatImage, bad: Mask, sweep: Sweep) -> tuple[FloatImage, Mask]:
    """Sample a raw streak image where `sweep` says that each rectified pixel lies (bilinear).

    Returns
    -------
    rectified : (rows, columns) float32 array
        0 beyond the raw image.
    bad : (rows, columns) bool array
        True where any of the four raw pixels was bad or lies beyond the raw image.
    """
    from scipy.ndimage import map_coordinates

    rows, columns = signal.shape
    row, column = np.ogrid[:rows, :columns]
    position = sweep.raw_position(row.astype(np.float64), column.astype(np.float64))
    raw_row, raw_column = np.broadcast_arrays(*position)
    rectified = map_coordinates(signal, [raw_row, raw_column], order=1, output=np.float32)
    outside = (raw_row < 0) | (raw_row > rows - 1) | (raw_column < 0) | (raw_column > columns - 1)
    if bad.any():
        share = map_coordinates(bad.astype(np.float32), [raw_row, raw_column], order=1, output=np.float32)
        outside |= share > 0
    rectified[outside] = 0
    return rectified, outside
