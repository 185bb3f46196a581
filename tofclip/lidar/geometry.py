"""From pixels to directions."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tofclip.camera import Camera


def ray_directions(camera: Camera, rows: ArrayLike, columns: ArrayLike) -> NDArray[np.float64]:
    """Direction in which each pixel of the reference view looks.

    A pinhole without lens distortion: ``((column - column_0) / f, (row - row_0) / f, 1)``, normalised.

    Parameters
    ----------
    camera : Camera
        Gives the focal length f and the optical axis.
    rows, columns : (n,) array
        Pixel positions, not necessarily whole numbers.

    Returns
    -------
    (n, 3) array
        Unit vectors; x right, y down, z forward.
    """
    axis_row, axis_column = camera.optical_axis_px
    right = (np.asarray(columns, dtype=np.float64) - axis_column) / camera.focal_length_px
    down = (np.asarray(rows, dtype=np.float64) - axis_row) / camera.focal_length_px
    directions = np.stack([right, down, np.ones_like(right)], axis=-1)
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    return directions
