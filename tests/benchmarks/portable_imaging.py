"""How long imaging around a corner takes where the arrays are put, beside the compiled loops, and
how far it differs.

Run with ``python tests/benchmarks/portable_imaging.py [--device NAME ...] [--side N] [--repeats N]
[--json]``, for instance ``--device cuda --side 128``; without a name PyTorch on this processor. N x
N wall points over 2 m see four points; N^3 voxels; for back-projection half as many along every
side. Medians of the imaging alone, signals being there already; "prepared" is what the second
capture of one geometry takes.
"""

from __future__ import annotations

import argparse
import json
import time
import warnings
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from nlos import Backprojection, Capture, Grid, Hybrid, PlanarRSD, PreparedImaging, Volume
from nlos.method import Reconstructor
from nlos.sampling import AliasingWarning
from nlos.simulate import PointScene, build_relay_wall
from nlos.time_axis import TimeAxis
from tofclip.arrays import ComputeDevice, parse_device

POINTS = [[0.3, -0.2, 1.0], [-0.5, 0.4, 0.9], [0.1, 0.6, 1.4], [-0.6, -0.6, 1.1]]
SPOT = [0.1, 0.05, 0.02]
WIDTH = 2.0
AXIS = TimeAxis(512, 32e-12)
JITTER = 60e-12
WALL_POINTS_PER_WAVELENGTH = 4


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device", action="append")
    parser.add_argument("--side", type=int, default=32)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--json", action="store_true")
    asked = parser.parse_args()
    devices = [parse_device(name) for name in asked.device or ["torch:cpu"]]
    warnings.simplefilter("ignore", AliasingWarning)
    found = [row for case in cases(asked.side) for row in rows(*case, devices, asked.repeats)]
    if asked.json:
        print(json.dumps(found))
        return
    print(f"{asked.side} x {asked.side} wall points; difference: relative L2 of the volumes")
    print("what               where            seconds  prepared  compiled  difference")
    for row in found:
        print(
            f"{row['what']:18s} {row['where']:15s} {row['seconds']:8.3f}  {_or_none(row['seconds_prepared'])}"
            f"  {row['seconds_compiled']:8.3f}  {row['difference']:.1e}"
        )


def _or_none(seconds: float | None) -> str:
    return "       -" if seconds is None else f"{seconds:8.3f}"


def cases(side: int) -> list[tuple[str, Reconstructor, Capture, Grid]]:
    """What is imaged: a name, a method, a capture and the voxels."""
    wavelength = WALL_POINTS_PER_WAVELENGTH * WIDTH / (side - 1)
    few = side // 2
    return [
        (
            "rsd, one laser",
            PlanarRSD(wavelength),
            seen("planar", side, confocal=False),
            voxels(side),
        ),
        (
            "rsd, confocal",
            PlanarRSD(2 * wavelength),
            seen("planar", side, confocal=True),
            voxels(side),
        ),
        (
            "hybrid, one laser",
            Hybrid(wavelength),
            seen("cylinder", side, confocal=False),
            voxels(side),
        ),
        (
            "backprojection",
            Backprojection(2 * wavelength),
            seen("cylinder", few, confocal=False),
            voxels(few),
        ),
    ]


def seen(shape: str, side: int, confocal: bool) -> Capture:
    """Simulate the capture of the points before a wall."""
    wall = build_relay_wall(shape, side, WIDTH)
    return PointScene(np.array(POINTS)).simulate_capture(
        wall, wall if confocal else SPOT, AXIS, JITTER
    )


def voxels(side: int) -> Grid:
    """As many voxels in depth as across."""
    across = np.linspace(-WIDTH / 2, WIDTH / 2, side)
    return Grid(across, across, np.linspace(0.5, 2.0, side))


def rows(
    name: str,
    method: Reconstructor,
    capture: Capture,
    grid: Grid,
    devices: list[ComputeDevice],
    repeats: int,
) -> list[dict[str, Any]]:
    """Measure one case everywhere."""
    compiled_seconds, expected = _measured(partial(method.reconstruct, capture, grid), repeats)
    found = []
    for device in devices:
        moved = capture.on(device)
        seconds, volume = _measured(partial(method.reconstruct, moved, grid), repeats)
        prepared_seconds: float | None = None
        if isinstance(method, PlanarRSD | Hybrid):
            prepared = PreparedImaging(method, moved, grid)
            prepared_seconds, volume = _measured(partial(prepared.reconstruct, moved), repeats)
        difference = np.linalg.norm(volume.values - expected.values) / np.linalg.norm(
            expected.values
        )
        found.append(
            {
                "what": name,
                "where": str(device),
                "voxels": list(grid.shape),
                "wall_points": len(capture.points),
                "seconds": seconds,
                "seconds_prepared": prepared_seconds,
                "seconds_compiled": compiled_seconds,
                "difference": float(difference),
            }
        )
    return found


def _measured(image: Callable[[], Volume], repeats: int) -> tuple[float, Volume]:
    """Median time of some runs after a first one, in s, and the volume, brought here."""
    image()
    times = []
    for _ in range(repeats):
        started = time.perf_counter()
        volume = image()
        _ = float(abs(volume.values).max())  # graphics processors answer before they are done
        times.append(time.perf_counter() - started)
    return float(np.median(times)), volume.on(ComputeDevice())


if __name__ == "__main__":
    main()
