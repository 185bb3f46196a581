"""Study: the same work where arrays are put (``TOFCLIP_BENCH_DEVICE=cuda``; without it PyTorch on the
CPU), against the compiled loops, and how far the results differ.

Recovery and ranging are those of a LIFT shot: 7 views, 1016 instants. Around corners N x N wall
points see four hidden points, and N^3 voxels are imaged; for back-projection half as many along
every side. Inputs are on the device when the clock starts; each action ends when its result is
there.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apps.benchmarks.harness import Prepare, PreparedCase
from nlos import Backprojection, Capture, Grid, Hybrid, PlanarRSD
from nlos.capture import TimeAxis
from nlos.illumination import AliasingWarning
from nlos.method import Method
from nlos.simulate import PointScene, build_relay_wall
from tofclip.arrays import Array, ComputeDevice, namespace, parse_device, to_numpy
from tofclip.camera import Camera
from tofclip.lidar import depth
from tofclip.shots import Frames
from tofclip.solvers import LinearInverse, Sparse, TotalVariation

DEVICE_VARIABLE = "TOFCLIP_BENCH_DEVICE"
VIEWS, FRAMES, ITERATIONS = 7, 1016, 30
BIN_S, FIRST_BIN_S = 20e-12, 10e-9
NOISE, PEAK = 3.0, 100.0
CARDS = 8  # a side
HIDDEN_POINTS_M = [[0.3, -0.2, 1.0], [-0.5, 0.4, 0.9], [0.1, 0.6, 1.4], [-0.6, -0.6, 1.1]]
LASER_M = [0.1, 0.05, 0.02]
WALL_WIDTH_M = 2.0
AXIS = TimeAxis(512, 32e-12)
JITTER_S = 60e-12
WALL_POINTS_PER_WAVELENGTH = 4


def find_device() -> ComputeDevice:
    """The device that the environment names."""
    return parse_device(os.environ.get(DEVICE_VARIABLE) or "torch:cpu")


def make_shot(side: int) -> tuple[Camera, NDArray[np.float32]]:
    """A camera, and what it measures of 8 x 8 cards at random ranges, (measurements, frames)."""
    random = np.random.default_rng(0)
    spacing = 0.8 * side
    angles = np.radians(np.linspace(-41, 41, VIEWS))
    width = round((VIEWS - 1) * spacing + 1.6 * side)
    centres = 0.8 * side + spacing * np.arange(VIEWS, dtype=np.float64)
    camera = Camera(centres, angles, (side, side), width, pulse_fwhm=3 * BIN_S)
    delay = np.arange(FRAMES) - random.uniform(0, FRAMES, (CARDS, CARDS, 1))
    cards = PEAK * np.exp(-4 * np.log(2) * (delay / 3) ** 2).astype(np.float32)
    truth = np.repeat(np.repeat(cards, side // CARDS, axis=0), side // CARDS, axis=1)
    measurements = camera.operator()(np.ascontiguousarray(truth))
    noise = NOISE * random.standard_normal(measurements.shape, np.float32)
    return camera, measurements + noise


def wait_for(result: Array) -> Array:
    """Return a result once it is there: other devices answer before they are done."""
    float(namespace(result).sum(abs(result)))
    return result


def compare_devices(
    work: Callable[[Any], Array], given: Any, moved: Any, amount: float
) -> PreparedCase:
    """The work on the input that was moved to the device, against the same by the compiled loops."""

    def judge() -> dict[str, float]:
        expected, found = to_numpy(work(given)), to_numpy(work(moved))
        if expected.shape != found.shape:  # another number of returns
            return {"relative difference": float("inf")}
        difference = np.linalg.norm(found - expected) / np.linalg.norm(expected)
        return {"relative difference": float(difference)}

    return PreparedCase(
        lambda: wait_for(work(moved)), lambda: wait_for(work(given)), amount, figures=judge
    )


def prepare_recovery(method: str, side: int) -> PreparedCase:
    """Frames from a shot's measurements by ``l1``, ``tv`` or ``linear``."""
    camera, measurements = make_shot(side)
    operator = camera.operator()
    inverse = LinearInverse().prepare(operator)
    recover: dict[str, Callable[[Array], Array]] = {
        "l1": lambda given: Sparse(iterations=ITERATIONS).recover(operator, given).frames,
        "tv": lambda given: TotalVariation(iterations=ITERATIONS).recover(operator, given).frames,
        "linear": lambda given: inverse.recover(given).frames,
    }
    moved = find_device().put(measurements)
    return compare_devices(recover[method], measurements, moved, FRAMES)


def prepare_ranging(side: int) -> PreparedCase:
    """Ranges of all returns in frames."""
    camera, measurements = make_shot(side)
    values = LinearInverse().prepare(camera.operator()).recover(measurements).frames
    times = FIRST_BIN_S + BIN_S * np.arange(FRAMES, dtype=np.float64)

    def find_ranges(given: Array) -> Array:
        return depth(Frames(given, times, camera)).range

    return compare_devices(find_ranges, values, find_device().put(values), side**2)


def prepare_imaging(
    make_method: Callable[[float], Method], shape: str, confocal: bool, side: int
) -> PreparedCase:
    """A hidden volume from a simulated capture of a wall of some shape; `make_method`: from a
    wavelength in m.
    """
    warnings.simplefilter("ignore", AliasingWarning)
    wavelength = WALL_POINTS_PER_WAVELENGTH * WALL_WIDTH_M / (side - 1)
    wall = build_relay_wall(shape, side, WALL_WIDTH_M)
    capture = PointScene(np.array(HIDDEN_POINTS_M)).simulate_capture(
        wall, wall if confocal else LASER_M, AXIS, JITTER_S
    )
    across = np.linspace(-WALL_WIDTH_M / 2, WALL_WIDTH_M / 2, side)
    grid = Grid(across, across, np.linspace(0.5, 2.0, side))
    method = make_method(wavelength)

    def image(given: Capture) -> Array:
        return method.reconstruct(given, grid).values

    return compare_devices(image, capture, capture.on(find_device()), 1)


PREPARE: dict[str, Prepare] = {
    **{f"device-{name}": partial(prepare_recovery, name) for name in ("l1", "tv", "linear")},
    "device-depth": prepare_ranging,
    "device-rsd": partial(prepare_imaging, PlanarRSD, "planar", False),
    "device-rsd-confocal": partial(prepare_imaging, lambda w: PlanarRSD(2 * w), "planar", True),
    "device-hybrid": partial(prepare_imaging, Hybrid, "cylinder", False),
    "device-backprojection": partial(
        prepare_imaging, lambda w: Backprojection(2 * w), "cylinder", False
    ),
}
