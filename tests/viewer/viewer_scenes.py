"""Small things to look at, with known truth."""

import numpy as np
from small_instrument import (
    BIN_WIDTH,
    ROWS,
    SQUARE_ROWS,
    SQUARES,
    draw_squares,
    make_camera,
    take_shot,
)

from apps.viewer.source import Source, View, make_cloud
from nlos import Grid, Volume
from tofclip.shots import Frames
from tofclip.units import SPEED_OF_LIGHT

FRAMES = ROWS
NEAR_FRAME, FAR_FRAME = SQUARE_ROWS
NEAR, FAR = SQUARES


def camera():
    """Seven views whose light of range 0 would arrive 10 ns before the first row."""
    return make_camera(-10e-9)


def frames():
    """A square at the upper left, later one at the lower right, each as long as a pulse of 60 ps."""
    return Frames(draw_squares(), np.arange(FRAMES) * BIN_WIDTH + 10e-9, camera())


def range_of(frame):
    """Range whose light arrives in a frame, m."""
    return (frame * BIN_WIDTH + 10e-9) * SPEED_OF_LIGHT / 2


def streak(seed=3):
    """The shot of these frames, with Poisson noise."""
    return take_shot(camera(), frames().values, seed)


def plane(points, distance=2.0, seed=0):
    """Points scattered over a plane across the line of sight, 1 m wide."""
    random = np.random.default_rng(seed)
    xyz = np.column_stack([random.uniform(-0.5, 0.5, (points, 2)), np.full(points, distance)])
    return make_cloud(
        xyz.astype(np.float32), {"intensity": random.uniform(1, 9, points).astype(np.float32)}
    )


def column(ranges):
    """Points along the z axis at these ranges."""
    return make_cloud(np.column_stack([np.zeros((len(ranges), 2)), ranges]))


def volume():
    """A bright ball of 4 cm about (0.05, -0.05, 0.5), in a box of 2 cm voxels."""
    grid = Grid.box((-0.2, 0.2), (-0.2, 0.2), (0.3, 0.7), 0.02)
    z, y, x = np.meshgrid(grid.z, grid.y, grid.x, indexing="ij")
    square = (x - 0.05) ** 2 + (y + 0.05) ** 2 + (z - 0.5) ** 2
    return Volume(np.exp(-square / (2 * 0.04**2)).astype(np.float32), grid)


class PlaneSource(Source):
    """Frame `n` is a plane at 2 m + n cm."""

    def __init__(self, count=5, points=40):
        super().__init__("planes", 10.0)
        self._count, self._points = count, points

    def __len__(self):
        return self._count

    def view(self, number):
        return View(plane(self._points, 2 + number / 100))
