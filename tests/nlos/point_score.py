"""How well a volume shows hidden points that are known, as in a simulation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from nlos.volume import Grid, Volume

# m; the usual measure for waves of some 12 cm.
SCORE_RADIUS_M = 0.04


@dataclass(frozen=True)
class PointScore:
    """Energy fraction of the voxels near hidden points, over all voxels, and their mean magnitude,
    over that of all others: a bright spot in the wrong place scores badly, however bright.
    """

    energy: float
    contrast: float


def score_points(volume: Volume, points: Any) -> PointScore:
    """Compare the voxels near hidden points (n, 3), m, with all others."""
    near, magnitude = find_near_voxels(volume.grid, points), volume.magnitude.astype(np.float64)
    energy = magnitude**2
    return PointScore(
        float(energy[near].sum() / energy.sum()),
        float(magnitude[near].mean() / magnitude[~near].mean()),
    )


def find_near_voxels(grid: Grid, points: Any, radius: float = SCORE_RADIUS_M) -> NDArray[np.bool_]:
    """Find the voxels (z, y, x) whose centres lie near hidden points (n, 3), m."""
    z, y, x = np.meshgrid(grid.z, grid.y, grid.x, indexing="ij")
    voxels = np.stack([x, y, z], axis=-1)
    return np.isfinite(cKDTree(np.asarray(points)).query(voxels, distance_upper_bound=radius)[0])


def score_brightest(volume: Volume, occupied: NDArray[np.bool_]) -> float:
    """Of the K brightest voxels, the fraction that is occupied, where K voxels are."""
    count = int(np.count_nonzero(occupied))
    brightest = np.argsort(-volume.magnitude, axis=None, kind="stable")[:count]
    return float(np.mean(occupied.ravel()[brightest]))
