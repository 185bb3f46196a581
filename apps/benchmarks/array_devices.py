"""Study: the same work where arrays are put (``TOFCLIP_BENCH_DEVICE=cuda``; without it PyTorch on the
CPU), against the compiled loops, and how far the results differ.

Recovery is that of a LIFT shot, 7 views and 1016 instants, ranges are those of the demonstration's
frames. Around corners N x N wall points see four hidden points, and N^3 voxels are imaged; for
back-projection half as many along every side. Inputs are on the device when the clock starts; each
action ends when its result is there.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from apps.benchmarks.harness import Prepare, PreparedCase
from apps.benchmarks.nlos import RELIEF_M, make_scene
from apps.benchmarks.shots import (
    ITERATIONS,
    make_operator,
    measurements,
    prepare_method,
    render_frames,
)
from nlos import Backprojection, Capture, Hybrid, PlanarRSD
from nlos.method import Method as Imaging
from tofclip.arrays import Array, ComputeDevice, namespace, parse_device, to_numpy
from tofclip.lidar import depth
from tofclip.solvers import LinearInverse, Method, Sparse, TotalVariation

DEVICE_VARIABLE = "TOFCLIP_BENCH_DEVICE"
FRAMES = 1016


def find_device() -> ComputeDevice:
    """The device that the environment names."""
    return parse_device(os.environ.get(DEVICE_VARIABLE) or "torch:cpu")


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


def prepare_recovery(method: Method, side: int) -> PreparedCase:
    """Frames from a shot's measurements."""
    recover, data = prepare_method(method, make_operator(side)), measurements(FRAMES)
    moved = find_device().put(data)
    return compare_devices(lambda given: recover(given).frames, data, moved, FRAMES)


def prepare_ranging(rows: int) -> PreparedCase:
    """Ranges of all returns in frames."""
    frames = render_frames(rows)
    values, moved = frames.values, find_device().put(frames.values)

    def find_ranges(given: Array) -> Array:
        return depth(replace(frames, values=given)).range

    return compare_devices(find_ranges, values, moved, values[0].size)


def prepare_imaging(
    make_method: Callable[[float], Imaging], relief: float, confocal: bool, side: int
) -> PreparedCase:
    """A hidden volume of a wall with some relief, m, by a method made from a wavelength."""
    capture, grid, wavelength = make_scene(side, relief, confocal)
    method = make_method(wavelength)

    def image(given: Capture) -> Array:
        return method.reconstruct(given, grid).values

    return compare_devices(image, capture, capture.on(find_device()), 1)


PREPARE: dict[str, Prepare] = {
    "device-l1": partial(prepare_recovery, Sparse(iterations=ITERATIONS)),
    "device-tv": partial(prepare_recovery, TotalVariation(iterations=ITERATIONS)),
    "device-linear": partial(prepare_recovery, LinearInverse()),
    "device-depth": prepare_ranging,
    "device-rsd": partial(prepare_imaging, PlanarRSD, 0.0, False),
    "device-rsd-confocal": partial(prepare_imaging, lambda w: PlanarRSD(2 * w), 0.0, True),
    "device-hybrid": partial(prepare_imaging, Hybrid, RELIEF_M, False),
    "device-backprojection": partial(
        prepare_imaging, lambda w: Backprojection(2 * w), RELIEF_M, False
    ),
}
