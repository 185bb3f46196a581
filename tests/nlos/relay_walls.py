"""Walls, lasers and a hidden point that the tests of imaging around corners share."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nlos.capture import TimeAxis

AXIS = TimeAxis(bins=256, bin_width=16e-12, start=0.4)
JITTER = 20e-12
# Off every symmetry axis and between no two alike: a swapped or mirrored axis puts it elsewhere.
HIDDEN = (0.15, -0.2, 0.65)


def planar_wall(rows: int = 17, columns: int = 21) -> NDArray[np.float64]:
    """A wall of 1.2 m x 1 m at z = 0, rows downwards."""
    x, y = np.meshgrid(np.linspace(-0.6, 0.6, columns), np.linspace(-0.5, 0.5, rows))
    return np.stack([x, y, np.zeros_like(x)], axis=-1)


def curved_wall(rows: int = 17, columns: int = 21) -> NDArray[np.float64]:
    """A cylinder about the vertical, bulging 7 cm towards the scene, with ripples of 1.5 cm."""
    wall = planar_wall(rows, columns)
    x, y = wall[..., 0], wall[..., 1]
    wall[..., 2] = 0.07 - 0.2 * x**2 + 0.015 * np.cos(7 * y)
    return wall


def lasers_for(wall: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
    """A fixed spot off the centre, the wall itself, and another spot for every wall point."""
    return {
        "single": np.array([0.12, 0.05, 0.01]),
        "confocal": wall,
        "paired": wall[::-1] + np.array([0.01, -0.02, 0.0]),
    }
