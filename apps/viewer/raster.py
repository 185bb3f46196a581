"""Points drawn by NumPy alone: no graphics library, no display."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from apps.viewer.viewpoint import Viewpoint

BACKGROUND = (24, 27, 33)


def rasterise_points(
    xyz: NDArray[np.float32],
    colours: NDArray[np.uint8],
    viewpoint: Viewpoint,
    shape: tuple[int, int],
    size_px: int,
) -> NDArray[np.uint8]:
    """Draw points as squares, near ones over far ones.

    Parameters
    ----------
    xyz : (n, 3) array
        m.
    colours : (n, 3) array
    viewpoint : Viewpoint
    shape : (int, int)
        Rows and columns of the picture.
    size_px : int
        Side of a square.

    Returns
    -------
    (rows, columns, 3) uint8 array
    """
    picture = np.empty((*shape, 3), np.uint8)
    picture[:] = BACKGROUND
    row, column, depth = viewpoint.project(xyz, shape)
    with np.errstate(invalid="ignore"):
        seen = (np.abs(row - shape[0] / 2) < shape[0]) & (np.abs(column - shape[1] / 2) < shape[1])
    order = np.flatnonzero(seen)
    order = order[
        np.argsort(-depth[order], kind="stable")
    ]  # of writes to one pixel the last one stays
    first_row = np.rint(row[order] - (size_px - 1) / 2).astype(np.intp)
    first_column = np.rint(column[order] - (size_px - 1) / 2).astype(np.intp)
    ordered = colours[order]
    # All pixels of one point before those of the next, or far points would show at the edges of
    # near ones.
    offsets = np.arange(size_px)
    rows = (
        (first_row[:, np.newaxis, np.newaxis] + offsets[:, np.newaxis])
        .repeat(size_px, axis=2)
        .reshape(-1)
    )
    columns = (
        (first_column[:, np.newaxis, np.newaxis] + offsets).repeat(size_px, axis=1).reshape(-1)
    )
    inside = (rows >= 0) & (rows < shape[0]) & (columns >= 0) & (columns < shape[1])
    picture[rows[inside], columns[inside]] = ordered.repeat(size_px**2, axis=0)[inside]
    return picture
