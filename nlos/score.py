"""How well a volume shows hidden points that are known, as in a simulation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nlos.volume import Grid, Volume
from tofclip.errors import InputError, ShapeError

# m; the usual measure for waves of some 12 cm.
SCORE_RADIUS_M = 0.04


@dataclass(frozen=True)
class PointScore:
    """Energy fraction and contrast of what lies near hidden points."""

    # sum of ``|u|^2`` over the voxels near a point, over that of all voxels, u the volume's values.
    # It depends on the space imaged, and on how far the virtual pulse reaches: most of what is not
    # near is its sidelobes along the line of sight
    energy: float
    # mean magnitude of the voxels near a point, over that of all others. It grows with the empty
    # space imaged
    contrast: float


def score_points(volume: Volume, points: Any, radius: float = SCORE_RADIUS_M) -> PointScore:
    """Compare the voxels near hidden points with all others.

    Unlike peak over mean it is not fooled by a bright spot in the wrong place.

    `points` (n, 3): metres; `radius`: what counts as near, m.
    """
    near = find_near_voxels(volume.grid, points, radius)
    if not near.any() or near.all():
        raise InputError(f"some voxels must lie within {radius} m of a hidden point, and some not")
    magnitude = volume.magnitude.astype(np.float64)
    if not magnitude[~near].any():
        raise InputError(
            "the volume is dark away from the hidden points: their contrast has no measure"
        )
    energy = magnitude**2
    return PointScore(
        float(energy[near].sum() / energy.sum()),
        float(magnitude[near].mean() / magnitude[~near].mean()),
    )


def find_near_voxels(grid: Grid, points: Any, radius: float = SCORE_RADIUS_M) -> NDArray[np.bool_]:
    """Find the voxels whose centres lie near hidden points.

    `points` (n, 3): metres; `radius`: what counts as near, m. Returns (z, y, x).
    """
    from scipy.spatial import cKDTree

    points = np.asarray(points, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise ShapeError("hidden points", "(n, 3)", points.shape)
    z, y, x = np.meshgrid(grid.z, grid.y, grid.x, indexing="ij")
    distance, _ = cKDTree(points).query(np.stack([x, y, z], axis=-1), distance_upper_bound=radius)
    return np.asarray(np.isfinite(distance))


def score_brightest(volume: Volume, occupied: NDArray[np.bool_]) -> float:
    """Of the K brightest voxels, the fraction that is occupied, where K voxels are.

    Unlike a share of energy it does not depend on the scale of brightness.

    `occupied` (z, y, x): voxels that hold something hidden, or lie near it. Returns 0 to 1.
    """
    count = int(np.count_nonzero(occupied))
    if count == 0:
        raise InputError("no voxel is occupied: there is nothing to find")
    brightest = np.argsort(-volume.magnitude, axis=None, kind="stable")[:count]
    return float(np.mean(occupied.ravel()[brightest]))
