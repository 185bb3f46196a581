"""Walls and hidden points that the tests of imaging around corners share, and how alike fields are."""

from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from nlos import Grid
from nlos.capture import TimeAxis
from nlos.simulate import PointScene, build_relay_wall
from tofclip.arrays import to_numpy
from tofclip.errors import InputError

AXIS = TimeAxis(bins=256, bin_width=16e-12, start=0.4)
LONG = TimeAxis(560, AXIS.bin_width, 0.4)  # holds every path by way of the voxels of most tests
JITTER = 20e-12
# Off every symmetry axis and between no two alike: a swapped or mirrored axis puts it elsewhere.
HIDDEN = (0.15, -0.2, 0.65)
THREE_POINTS = (HIDDEN, (-0.2, 0.1, 0.75), (0.05, -0.05, 0.5))
SPOTS = np.array([[0.12, 0.05, 0.0], [-0.3, 0.2, 0.0]])

# Before walls of 2 m x 2 m.
SHAPED_SPOT = np.array([0.1, 0.05, 0.02])
SHAPED_POINTS = np.array([[0.3, -0.2, 1.0], [-0.5, 0.4, 0.9], [0.1, 0.6, 1.4], [-0.6, -0.6, 1.1]])
SHAPED_JITTER, SHAPED_AXIS = 60e-12, TimeAxis(512, 32e-12)


# Not centred on the wall, voxels finer than the wall's points along x and coarser along y, depths
# unevenly spaced; and before walls of 2 m x 2 m.
UNEVEN_DEPTHS = Grid(
    np.arange(-0.3, 0.42, 0.05), np.arange(-0.4, 0.25, 0.06), [0.45, 0.5, 0.56, 0.65, 0.8]
)
SHAPED = Grid(np.linspace(-0.9, 0.9, 13), np.linspace(-0.8, 0.85, 12), [0.62, 0.8, 1.0, 1.1, 1.45])
# Depths an eighth of a wavelength apart, of which some are interpolated.
FINE_DEPTHS = Grid(np.linspace(-0.3, 0.4, 5), np.linspace(-0.4, 0.2, 4), 0.4 + np.arange(32) / 64)
FIVE_POINTS = np.array(
    [[0.0, 0.05, 0.7], [0.3, -0.25, 0.8], [-0.35, 0.2, 0.85], [0.2, 0.4, 0.95], [-0.3, -0.4, 1.05]]
)


def planar_wall(rows=17, columns=21):
    """A wall of 1.2 m x 1 m at z = 0, rows downwards."""
    x, y = np.meshgrid(np.linspace(-0.6, 0.6, columns), np.linspace(-0.5, 0.5, rows))
    return np.stack([x, y, np.zeros_like(x)], axis=-1)


def curved_wall(rows=17, columns=21):
    """A cylinder about the vertical, bulging 7 cm towards the scene, with ripples of 1.5 cm."""
    wall = planar_wall(rows, columns)
    wall[..., 2] = 0.07 - 0.2 * wall[..., 0] ** 2 + 0.015 * np.cos(7 * wall[..., 1])
    return wall


def see(
    points,
    wall,
    laser,
    axis=AXIS,
    jitter=JITTER,
    albedo=None,
):
    """Hidden points seen from a wall that is lit at one spot, at several (n, 3) one after the other,
    confocally, or at another spot for every wall point (paired).
    """
    named = {"confocal": wall, "paired": wall[::-1] + np.array([0.01, -0.02, 0.0])}
    named["single"] = np.array([0.12, 0.05, 0.01])
    laser = named[laser] if isinstance(laser, str) else np.asarray(laser)
    if laser.ndim == 2 and wall.ndim == 3:
        wall = np.stack([wall] * len(laser))
        laser = np.broadcast_to(laser[:, None, None], wall.shape)
    return PointScene(points, albedo).simulate_capture(wall, laser, axis, jitter)


def see_shaped(shape, count, laser=SHAPED_SPOT):
    """Four hidden points seen from a wall of 2 m x 2 m."""
    return see(SHAPED_POINTS, build_relay_wall(shape, count), laser, SHAPED_AXIS, SHAPED_JITTER)


def around(point, half=0.12, voxel=0.04):
    """Voxels about a point, which is the middle one."""
    steps = voxel * np.arange(-round(half / voxel), round(half / voxel) + 1)
    return Grid(*(c + steps for c in point))


def distance_to_nearest(grid, points):
    """From every voxel (z, y, x) to the nearest of some points, m."""
    return cKDTree(np.asarray(points)).query(grid.points)[0]


def energy_fraction(values, near):
    """Energy of some voxels over that of all."""
    energy = np.abs(values).astype(np.float64) ** 2
    return float(energy[near].sum() / energy.sum())


def relative_error(found, expected):
    return float(np.linalg.norm(to_numpy(found) - expected) / np.linalg.norm(expected))


def scaled_error(found, expected):
    """Relative difference after one scale factor."""
    return relative_error(np.vdot(found, expected) / np.vdot(found, found) * found, expected)


def find_refusal(method, capture, grid):
    """Return the reason that a plan is refused for; empty if it is not."""
    try:
        method.plan(capture, grid)
    except InputError as refused:
        return str(refused)
    return ""


def reorder(capture, kept, earlier=0.0):
    """Some of a capture's points in another order, of a record that begins so much path earlier."""
    bins = round(earlier / capture.axis.spacing)
    signal = np.pad(capture.signal.reshape(capture.axis.bins, -1)[:, kept], ((bins, 0), (0, 0)))
    wall, laser = capture.wall.reshape(-1, 3)[kept], capture.laser
    laser = laser if laser.ndim == 1 else laser.reshape(-1, 3)[kept]
    start = capture.start - bins * capture.axis.spacing
    return replace(capture, signal=signal, wall=wall, laser=laser, start=start)
