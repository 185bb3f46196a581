"""Study: walls beyond the page's: propagation in time, scattered wall points, and one large capture."""

from __future__ import annotations

import numpy as np

from apps.benchmarks.harness import Case, PreparedCase
from apps.benchmarks.nlos import CYCLES, HIDDEN_POINTS_M, LASER_M, RELIEF_M, make_scene
from nlos import Capture, Grid, Hybrid, PlanarRSD, propagate
from nlos.band import VirtualPulse
from nlos.capture import TimeAxis
from nlos.plane import Plane
from nlos.simulate import PointScene

STRICT_TOLERANCE = 1e-4  # one that only direct sums keep
ROWS_IN_TIME = 2
ROW_STEP = 8
LARGE_WAVELENGTH_M = 0.048


def prepare_propagation_in_time(count: int) -> PreparedCase:
    """A few rows of the plane in time; the floor takes all of them spectrally."""
    capture, grid, wavelength = make_scene(count, RELIEF_M)
    pulse, distance = VirtualPulse(wavelength, CYCLES), RELIEF_M + 0.1
    few, every = Plane(grid.x, grid.y[:ROWS_IN_TIME], distance), Plane(grid.x, grid.y, distance)
    return PreparedCase(
        lambda: propagate(capture, few, pulse, "time"),
        lambda: propagate(capture, every, pulse),
        ROWS_IN_TIME / count,
        floor_fraction=count / ROWS_IN_TIME,
    )


def prepare_scattered(count: int) -> PreparedCase:
    """Scattered wall points by non-uniform transforms; the floor sums directly for some rows."""
    wall = np.random.default_rng(0).uniform([-1, -1, 0], [1, 1, RELIEF_M], (count**2, 3))
    capture = PointScene(HIDDEN_POINTS_M).simulate_capture(
        wall, LASER_M, TimeAxis(512, 32e-12), 60e-12
    )
    pulse, axis = VirtualPulse(8 / count, CYCLES), np.linspace(-1, 1, count)
    plane, some = (Plane(axis, rows, RELIEF_M + 0.1) for rows in (axis, axis[::ROW_STEP]))
    return PreparedCase(
        lambda: propagate(capture, plane, pulse),
        lambda: propagate(capture, some, pulse, tolerance=STRICT_TOLERANCE),
        1,
        floor_fraction=1 / ROW_STEP,
    )


def prepare_large(count: int) -> PreparedCase:
    """A relief of 0.15 m and 1016 bins of 4.6 ps to 100^3 voxels; the floor is a planar wall."""
    x, y = np.meshgrid(np.linspace(-0.69, 0.69, count), np.linspace(-0.65, 0.65, count))
    axis = 0.006 * (np.arange(100, dtype=np.float64) - 49.5)
    grid = Grid(axis, axis, 0.16 + 0.004 * np.arange(100, dtype=np.float64))

    def capture_of(relief: float) -> Capture:
        wall = np.stack([x, y, relief / 2 * np.sin(2 * x + y)], axis=-1)
        laser = LASER_M / 2 * [1, 1, relief > 0]
        scene = PointScene(np.array([[0.1, -0.05, 0.35]]))
        return scene.simulate_capture(wall, laser, TimeAxis(1016, 4.6e-12, 0.14), 20e-12)

    curved, planar = capture_of(0.15), capture_of(0.0)
    return PreparedCase(
        lambda: Hybrid(LARGE_WAVELENGTH_M).reconstruct(curved, grid),
        lambda: PlanarRSD(LARGE_WAVELENGTH_M).reconstruct(planar, grid),
        1,
    )


CASES = (
    Case(
        "corner-time",
        "curved wall's field onto a plane, in time",
        "wall points a side",
        (32, 64),
        "fields",
        "the same spectrally",
        prepare_propagation_in_time,
    ),
    Case(
        "corner-scattered",
        "scattered wall points' field onto a plane",
        "square root of the wall points",
        (64, 128),
        "fields",
        "the same by direct sums",
        prepare_scattered,
    ),
    Case(
        "corner-large",
        "curved wall, 1016 bins, to 100^3 voxels",
        "wall points a side",
        (64, 125),
        "volumes",
        "a planar wall of the same size",
        prepare_large,
    ),
)
