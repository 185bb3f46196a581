"""Walls of the shapes that around-the-corner imaging has to manage, and a scene in front of them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nlos import Capture
from nlos.capture import TimeAxis
from nlos.simulate import PointScene

SPOT = np.array([0.1, 0.05, 0.02])
POINTS = np.array([[0.3, -0.2, 1.0], [-0.5, 0.4, 0.9], [0.1, 0.6, 1.4], [-0.6, -0.6, 1.1]])
JITTER = 60e-12
AXIS = TimeAxis(512, 32e-12)
SHAPES = ("planar", "cylinder", "wavy", "relief", "plates")


def shaped_wall(shape: str, count: int) -> NDArray[np.float64]:
    """A wall of 2 m x 2 m: planar, a cylinder of radius 2.5 m, waves of 0.1 m, relief of 0.3 m, or
    two plates.
    """
    x, y = np.meshgrid(np.linspace(-1, 1, count), np.linspace(-1, 1, count))
    depths = {
        "planar": 0 * x,
        "cylinder": 2.5 - np.sqrt(2.5**2 - x**2),
        "wavy": 0.1 * np.sin(5 * x) * np.cos(4 * y),
        "relief": 0.15 * (1 + np.sin(3 * x + 1) * np.cos(2 * y)),
        "plates": np.where(x < 0, 0.0, 0.15),
    }
    wall = np.stack([x, y, depths[shape]], axis=-1)
    if shape == "plates":
        wall[np.abs(x) < 0.15] = np.nan
    return wall


def shaped_capture(shape: str, count: int, laser: NDArray[np.float64] | None = None) -> Capture:
    """Four hidden points seen from such a wall."""
    wall = shaped_wall(shape, count)
    return PointScene(POINTS).simulate_capture(wall, SPOT if laser is None else laser, AXIS, JITTER)
