"""A real lensless camera: the hand of the DiffuserCam recordings, from a dense and from sparse
sensors (Note 3).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofclip.errors import InputError, ShapeError
from tofclip.io.archive import Archive
from tofclip.operators import LinearOperator, PitchedSensor
from tofclip.operators.light_field_camera import MeasuredCamera
from tofclip.operators.point_spreads import MeasuredPointSpreads
from tofclip.solvers import TotalVariation, relative_residual

TV_WEIGHT = 1e-4  # relative to the largest A'f; ten times less lowers the residual by a tenth
ITERATIONS = 200


@dataclass(frozen=True)
class DiffuserRecording:
    """What a diffuser put on an area sensor, and what it does to a point source.

    Parameters
    ----------
    point_spread : (rows, columns) array
        Background taken off.
    measurements : (rows, columns) array
        Background taken off; any scale.

    Raises
    ------
    ShapeError, InputError
        PSF and measurements are not of one shape, or nothing was recorded.
    """

    point_spread: NDArray[np.float64]
    measurements: NDArray[np.float64]

    def __post_init__(self) -> None:
        if self.point_spread.ndim != 2 or self.measurements.shape != self.point_spread.shape:
            raise ShapeError(
                "the readings", f"{self.point_spread.shape} like the PSF", self.measurements.shape
            )
        if not (np.all(np.isfinite(self.measurements)) and self.measurements.max() > 0):
            raise InputError("the readings must be finite and show something; check the background")


@dataclass(frozen=True)
class DiffuserRecovery:
    """The scene behind a recording.

    Parameters
    ----------
    scene : (2 rows, 2 columns) float32 array
        Twice as high and wide as the sensor: a PSF as large as the sensor brings light from there.
    pitch_px : int
        Every so manieth pixel of either axis was used.
    relative_residual : float
        ``|A h - f| / |f|`` over the measurements that were used.
    iterations : int
    seconds : float
    """

    scene: NDArray[Any]
    pitch_px: int
    relative_residual: float
    iterations: int
    seconds: float


def read_diffuser_recording(path: str | Path) -> DiffuserRecording:
    """Read an ``.npz`` with `psf` and `raw`, both (rows, columns) in counts, and one number
    `background`.

    Raises
    ------
    StorageError, FileFormatError, InputError
        The file cannot be read, an entry is absent or of another shape, or nothing is above the
        background.
    """
    archive = Archive(path)
    background = float(archive.finite_array("background"))
    spread, measurements = (
        np.clip(archive.finite_array(name, None, None) - background, 0, None)
        for name in ("psf", "raw")
    )
    return DiffuserRecording(spread, measurements)


def build_diffuser_model(recording: DiffuserRecording, pitch_px: int) -> LinearOperator:
    """Return the map from the scene, twice as high and wide as the sensor, to every n-th pixel's
    measurements.

    Parameters
    ----------
    recording : DiffuserRecording
        Sensor image and measured point-spread function.
    pitch_px : int
        Sensor pixels from one used pixel to the next.

    Returns
    -------
    LinearOperator
        (2 rows, 2 columns) pictures to (measurements,) vectors.
    """
    rows, columns = recording.measurements.shape
    measured = MeasuredPointSpreads(recording.point_spread[np.newaxis], [0.0])
    sensor = PitchedSensor((rows, columns), (pitch_px, pitch_px))
    # light from beside the sensor's field falls on it too
    return MeasuredCamera((2 * rows, 2 * columns), measured, sensor).model(0.0)


def recover_diffuser_scene(
    recording: DiffuserRecording, pitch_px: int, iterations: int = ITERATIONS
) -> DiffuserRecovery:
    """Recover the scene with nonnegative total variation from every n-th pixel of either axis.

    Parameters
    ----------
    recording : DiffuserRecording
    pitch_px : int
        1 for the full measurement.
    iterations : int
        About 16 ms each for a sensor of 300 x 400 pixels on one core.

    Returns
    -------
    DiffuserRecovery
    """
    model = build_diffuser_model(recording, pitch_px)
    every_nth = recording.measurements[::pitch_px, ::pitch_px]
    measurements = (every_nth / recording.measurements.max()).astype(np.float32).reshape(-1, 1)
    started = perf_counter()
    result = TotalVariation(TV_WEIGHT, iterations).recover(model, measurements)
    seconds = perf_counter() - started
    residual = relative_residual(model, result.frames, measurements)
    return DiffuserRecovery(result.frames[0], pitch_px, residual, result.iterations, seconds)
