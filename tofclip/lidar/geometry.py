"""From pixels to directions."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from tofclip.arrays import FloatArray
from tofclip.camera import Camera
from tofclip.errors import CalibrationError

MAX_ITERATIONS = 50
CONVERGENCE_TOLERANCE = 1e-10  # in units of the focal length; far below a thousandth of a pixel


def compute_ray_directions(camera: Camera, rows: ArrayLike, columns: ArrayLike) -> FloatArray:
    """Direction in which each pixel of the reference view looks.

    A pinhole ``((column - column_0) / f, (row - row_0) / f, 1)``, normalised, with the camera's
    lens distortion undone.

    Parameters
    ----------
    camera : Camera
        Gives the focal length f, the optical axis and the distortion.
    rows, columns : (n,) array
        Pixel positions, not necessarily whole numbers.

    Returns
    -------
    (n, 3) array
        Unit vectors; x right, y down, z forward.

    Raises
    ------
    CalibrationError
        A distortion so strong that no direction leads to a pixel.
    """
    right, down = compute_slopes(camera, rows, columns)
    forward = 1 / np.sqrt(right * right + down * down + 1)
    return np.stack([right * forward, down * forward, forward], axis=-1)


def compute_slopes(
    camera: Camera, rows: ArrayLike, columns: ArrayLike
) -> tuple[FloatArray, FloatArray]:
    """Slopes x / z and y / z of the directions of `compute_ray_directions`."""
    axis_row, axis_column = camera.optical_axis_px
    right = (np.asarray(columns, dtype=np.float64) - axis_column) / camera.focal_length_px
    down = (np.asarray(rows, dtype=np.float64) - axis_row) / camera.focal_length_px
    if camera.distortion.any():
        right, down = undistort_directions(right, down, camera.distortion)
    return right, down


def distort_directions(
    right: FloatArray, down: FloatArray, coefficients: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Where a lens puts the direction (right, down, 1), in units of the focal length; k1, k2, p1, p2,
    k3 are those of D. C. Brown, "Close-range camera calibration", Photogramm. Eng. 37, 855 (1971).
    """
    k1, k2, p1, p2, k3 = coefficients
    square = right**2 + down**2
    radial = 1 + square * (k1 + square * (k2 + square * k3))
    return (
        right * radial + 2 * p1 * right * down + p2 * (square + 2 * right**2),
        down * radial + p1 * (square + 2 * down**2) + 2 * p2 * right * down,
    )


def undistort_directions(
    right: FloatArray, down: FloatArray, coefficients: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Undo `distort_directions`, by a fixed-point iteration."""
    x, y = right.copy(), down.copy()
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(MAX_ITERATIONS):
            seen_x, seen_y = distort_directions(x, y, coefficients)
            x += right - seen_x
            y += down - seen_y
        left = np.hypot(right - seen_x, down - seen_y).max(initial=0.0)
    if not left < CONVERGENCE_TOLERANCE:
        raise CalibrationError(
            "the camera's lens distortion is too strong to be undone within the picture"
        )
    return x, y
