"""How long recovery and ranging take where the arrays are put, beside the compiled loops, and how
far results differ.

Run with ``python tests/benchmarks/places.py [--device NAME ...] [--side PX] [--frames N] [--repeats
N] [--json]``, for instance ``--device cuda``; without a name PyTorch on this processor. The size of
a LIFT shot (letters hidden around a corner): 1016 instants of 128 x 128 pixels, 7 views. Medians
without the set-up, with readings and frames already there.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofclip.arrays import CPU, Array, ComputeDevice, namespace, parse_device, to_numpy
from tofclip.camera import Camera
from tofclip.lidar import Detection
from tofclip.lidar.search import ReturnSearch
from tofclip.lidar.search.array_api import ArrayTraces
from tofclip.lidar.traces import FrameTraces
from tofclip.shots import Frames
from tofclip.solvers import LinearInverse, Sparse, TotalVariation

VIEWS = 7
BIN = 20e-12
ITERATIONS = 30
NOISE = 3.0


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device", action="append")
    parser.add_argument("--side", type=int, default=128)
    parser.add_argument("--frames", type=int, default=1016)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--json", action="store_true")
    asked = parser.parse_args()
    devices = [parse_device(name) for name in asked.device or ["torch:cpu"]]
    found = table(shot(asked.side, asked.frames), devices, asked.repeats)
    if asked.json:
        print(json.dumps(found))
        return
    print(
        f"{asked.frames} frames of {asked.side} x {asked.side}; difference relative to the largest value"
    )
    print("what     where            seconds  compiled  difference")
    for row in found:
        print(
            f"{row['what']:8s} {row['where']:15s} {row['seconds']:8.3f} {row['seconds_compiled']:9.3f}"
            f"  {row['difference']:.1e}"
        )


def shot(side: int, frames: int) -> tuple[Camera, NDArray[np.float32]]:
    """A camera, and what it reads of cards at as many ranges as there are instants, (readings,
    frames).
    """
    random = np.random.default_rng(0)
    spacing = 0.8 * side
    angles = np.radians(np.linspace(-41, 41, VIEWS))
    width = round((VIEWS - 1) * spacing + 1.6 * side)
    centres = 0.8 * side + spacing * np.arange(VIEWS, dtype=np.float64)
    camera = Camera(centres, angles, (side, side), width, pulse_fwhm=3 * BIN)
    truth = np.zeros((side, side, frames), np.float32)
    late = np.arange(frames)[np.newaxis, np.newaxis, :] - random.uniform(0, frames, (8, 8, 1))
    cards = 100 * np.exp(-4 * np.log(2) * (late / 3) ** 2).astype(np.float32)
    part = side // 8
    for row in range(8):
        for column in range(8):
            truth[row * part : (row + 1) * part, column * part : (column + 1) * part] = cards[
                row, column
            ]
    measurements = camera.operator()(truth)
    return camera, measurements + NOISE * random.standard_normal(measurements.shape, np.float32)


def table(
    measured: tuple[Camera, NDArray[np.float32]], devices: list[ComputeDevice], repeats: int
) -> list[dict[str, Any]]:
    """One row for each method and place."""
    camera, measurements = measured
    operator, rows = camera.operator(), []
    inverse = LinearInverse().prepare(operator)
    recoveries: dict[str, Callable[[Array], Array]] = {
        "l1": lambda given: Sparse(iterations=ITERATIONS).recover(operator, given).frames,
        "tv": lambda given: TotalVariation(iterations=ITERATIONS).recover(operator, given).frames,
        "linear": lambda given: inverse.recover(given).frames,
        "depth": Ranging(camera, measurements.shape[1]),
    }
    for name, recover in recoveries.items():
        given = inverse.recover(measurements).frames if name == "depth" else measurements
        expected, compiled = timed(recover, given, repeats)
        for device in devices:
            result, seconds = timed(recover, device.put(given), repeats)
            same = result.shape == expected.shape  # as many returns
            off = (
                float(np.abs(result - expected).max() / np.abs(expected).max())
                if same
                else float("inf")
            )
            told = {
                "what": name,
                "where": str(device),
                "seconds": seconds,
                "seconds_compiled": compiled,
            }
            rows.append({**told, "difference": off})
    return rows


class Ranging:
    """The ranges of all returns in frames wherever they are, in m."""

    def __init__(self, camera: Camera, frames: int) -> None:
        self._times = 10e-9 + BIN * np.arange(frames, dtype=np.float64)
        self._camera, self._search = camera, ReturnSearch(camera, self._times, Detection())

    def __call__(self, values: Array) -> Array:
        """Search frames (time, y, x)."""
        frames = Frames(values, self._times, self._camera)
        return self._search.find_returns(
            FrameTraces(frames) if ComputeDevice.of(values) == CPU else ArrayTraces(frames)
        ).range


def timed(
    action: Callable[[Array], Array], given: Array, repeats: int
) -> tuple[NDArray[Any], float]:
    """Result and median seconds of an action, after a first one that sets things up and loads
    loops.
    """
    result, seconds = action(given), []
    for _ in range(repeats):
        start = time.perf_counter()
        result = action(given)
        float(namespace(result).sum(result))  # waits until it is there
        seconds.append(time.perf_counter() - start)
    return to_numpy(result), float(np.median(seconds))


if __name__ == "__main__":
    main()
