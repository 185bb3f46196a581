"""How fast phasor-field imaging around corners is, as ratios to bare Fourier transforms and to
y-tal 0.20.

Run with ``python tests/benchmarks/phasor_fields.py [--repeats N] [--ytal PYTHON] [--json]``. All
figures come from one run on one machine: medians of the repeats, solve call only. "bare" is one
inverse Fourier transform per frequency and depth of the doubled wall, what the plain way cannot do
without, on one thread. y-tal is measured in the Python given, which has it installed (``python -m
venv ...; pip install y-tal pyfftw``); without one its rows say that they were left out. The way in
time is measured on a few rows of the plane, twice, and continued in a straight line. Ratios that
are held to a limit stand beside it.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyfftw

from nlos import Capture, Grid, Hybrid, PlanarRSD, propagate
from nlos.illumination_groups import choose_unaliased_band
from nlos.plane import Plane
from nlos.sampling import AliasingWarning
from nlos.simulate import PointScene
from nlos.time_axis import TimeAxis
from tofclip.threads import thread_count

CYCLES = 4.24
LASER = np.array([0.1, 0.05, 0.02])
POINTS = np.array([[0.3, -0.2, 1.0], [-0.5, 0.4, 0.9], [0.1, 0.6, 1.4]])
ROWS_IN_TIME = (2, 6)
STRICT = 1e-4  # a tolerance that only direct sums keep

Row = dict[str, object]

YTAL = """
import sys, time, resource
import numpy as np
from tal.io.capture_data import NLOSCaptureData
from tal.enums import CameraSystem, HFormat, GridFormat, VolumeFormat
from tal.reconstruct import pf
stored = np.load(sys.argv[1])
data = NLOSCaptureData()
data.H = stored["signal"].transpose(0, 2, 1).astype(np.float32)
data.H_format, data.sensor_grid_format, data.laser_grid_format = HFormat.T_Sx_Sy, GridFormat.X_Y_3, GridFormat.X_Y_3
data.sensor_grid_xyz = stored["wall"].transpose(1, 0, 2).astype(np.float32)
data.laser_grid_xyz = stored["laser"].reshape(1, 1, 3).astype(np.float32)
data.sensor_xyz = data.laser_xyz = np.zeros(3, np.float32)
data.delta_t, data.t_start, data.t_accounts_first_and_last_bounces = float(stored["spacing"]), 0.0, False
data.volume_format, data.scene_info = VolumeFormat.X_Y_Z_3, {}
volume = np.stack(np.meshgrid(stored["x"], stored["y"], stored["z"], indexing="ij"), -1).astype(np.float32)
start, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_SELF)
pf.solve(data, float(stored["wavelength"]), float(stored["cycles"]), CameraSystem.DIRECT_LIGHT, volume)
after = resource.getrusage(resource.RUSAGE_SELF)
print("seconds", time.perf_counter() - start, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
"""


def scene(
    count: int, relief: float, bins: int = 512, bin_width: float = 32e-12
) -> tuple[Capture, Grid, float]:
    """A capture, a grid of ``count ** 3`` voxels, and a wavelength of four wall points."""
    axis = np.linspace(-1, 1, count)
    x, y = np.meshgrid(axis, axis)
    wall = np.stack([x, y, relief / 2 * (1 + np.sin(3 * x + 1) * np.cos(2 * y))], axis=-1)
    laser = LASER * [1, 1, relief > 0]
    capture = PointScene(POINTS).simulate_capture(wall, laser, TimeAxis(bins, bin_width), 60e-12)
    return capture, Grid(axis, axis, np.linspace(0.6, 1.6, count)), 8 / count


def seconds(action: Callable[[], object], repeats: int) -> float:
    """Median of the repeats after one warm-up."""
    action()
    taken = []
    for _ in range(repeats):
        start = time.perf_counter()
        action()
        taken.append(time.perf_counter() - start)
    return float(np.median(taken))


def bare_transforms(count: int, frequencies: int) -> float:
    """Seconds of one inverse transform of the doubled plane per frequency and depth."""
    source, target = (pyfftw.zeros_aligned((2 * count, 2 * count), np.complex64) for _ in range(2))
    plan = pyfftw.FFTW(
        source, target, axes=(0, 1), direction="FFTW_BACKWARD", flags=("FFTW_MEASURE",)
    )
    return seconds(plan.execute, 50) * frequencies * count


def ytal_row(
    python: str | None, capture: Capture, method: PlanarRSD, grid: Grid, planar: float
) -> Row:
    """Wall-clock and processor seconds of y-tal's phasor fields on the same arrays, or why there
    are none.
    """
    name = f"y-tal {grid.x.size}"
    if python is None:
        return {"name": name, "skipped": "no Python with y-tal was given (--ytal)"}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "capture.npz"
        numbers = {
            "spacing": capture.axis.spacing,
            "wavelength": method.wavelength,
            "cycles": CYCLES,
        }
        axes = {"x": grid.x, "y": grid.y, "z": grid.z}
        np.savez(
            path, signal=capture.signal, wall=capture.wall, laser=capture.laser, **axes, **numbers
        )
        clean = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
        try:
            command = [python, "-c", YTAL, str(path)]
            done = subprocess.run(command, capture_output=True, text=True, check=False, env=clean)
        except OSError as problem:
            return {"name": name, "skipped": f"{python} does not run: {problem.strerror}"}
    last = [line.split() for line in done.stdout.splitlines() if line.startswith("seconds ")]
    if done.returncode or not last:
        return {
            "name": name,
            "skipped": (done.stderr.strip().splitlines() or ["no figure was printed"])[-1],
        }
    wall, processor = float(last[0][1]), float(last[0][2])
    ratio = {"times_planar": wall / planar, "at_least": 40}
    return {"name": name, "seconds": wall, "processor_seconds": processor, **ratio}


def planar_rows(repeats: int, python: str | None) -> list[Row]:
    """Planar and curved walls at 64 and 128."""
    rows: list[Row] = []
    for count in (64, 128):
        capture, grid, wavelength = scene(count, 0.0)
        curved, _, _ = scene(count, 0.3)
        method = PlanarRSD(wavelength, CYCLES)
        frequencies = choose_unaliased_band(capture, grid, method.pulse).wavenumbers.size
        bare = bare_transforms(count, frequencies)
        planar = seconds(lambda method=method, c=capture, g=grid: method.reconstruct(c, g), repeats)
        hybrid = seconds(
            lambda w=wavelength, c=curved, g=grid: Hybrid(w, CYCLES).reconstruct(c, g), repeats
        )
        rows.append({"name": f"bare {count}, {frequencies} frequencies", "seconds": bare})
        rows.append(
            {
                "name": f"planar RSD {count}",
                "seconds": planar,
                "times_bare": planar / bare,
                "at_most": 1,
            }
        )
        rows.append(
            {"name": f"hybrid, curved {count}", "seconds": hybrid, "times_bare": hybrid / bare}
        )
        rows[-1] |= {"times_planar": hybrid / planar, "at_most": 3}
        rows.append(ytal_row(python, capture, method, grid, planar))
    return rows


def propagation_rows(repeats: int) -> list[Row]:
    """From a relief of 0.3 m onto a plane of as many points, spectrally and in time, 1016 bins."""
    rows: list[Row] = []
    before = float("nan")
    for count in (64, 128):
        capture, grid, wavelength = scene(count, 0.3, 1016, 16e-12)
        pulse = PlanarRSD(wavelength, CYCLES).pulse
        plane = Plane(grid.x, grid.y, 0.4)
        spectral = seconds(lambda c=capture, p=plane, q=pulse: propagate(c, p, q), 3 * repeats)
        few = [Plane(grid.x, grid.y[:rows_in_time], 0.4) for rows_in_time in ROWS_IN_TIME]
        first, second = (
            seconds(lambda c=capture, p=p, q=pulse: propagate(c, p, q, "time"), repeats)
            for p in few
        )
        a_row = (second - first) / (ROWS_IN_TIME[1] - ROWS_IN_TIME[0])
        in_time = first + a_row * (count - ROWS_IN_TIME[0])
        rows.append({"name": f"propagation {count}, spectral", "seconds": spectral})
        if count == 128:
            rows[-1] |= {"times_64": spectral / before, "at_most": 10}
        before = spectral
        rows.append(
            {
                "name": f"propagation {count}, time",
                "seconds": in_time,
                "times_spectral": in_time / spectral,
            }
        )
    return [*rows[:-1], rows[-1] | {"at_least": 200}]


def scattered_row(repeats: int) -> Row:
    """From 16384 scattered points onto 128 x 128, by non-uniform transforms, and directly onto
    every eighth row.
    """
    random = np.random.default_rng(0)
    wall = random.uniform([-1, -1, 0], [1, 1, 0.3], (128 * 128, 3))
    capture = PointScene(POINTS).simulate_capture(wall, LASER, TimeAxis(512, 32e-12), 60e-12)
    pulse, axis = PlanarRSD(8 / 128, CYCLES).pulse, np.linspace(-1, 1, 128)
    taken = seconds(lambda: propagate(capture, Plane(axis, axis, 0.4), pulse), repeats)
    direct = 8 * seconds(
        lambda: propagate(capture, Plane(axis, axis[::8], 0.4), pulse, tolerance=STRICT), repeats
    )
    return {
        "name": "propagation 128, scattered points",
        "seconds": taken,
        "direct_times_this": direct / taken,
    }


def large_scene() -> tuple[Capture, Grid]:
    """A wall of 125 x 125 points and 1016 bins of 4.6 ps, relief 0.15 m, and 100^3 voxels of 6 mm."""
    x, y = np.meshgrid(np.linspace(-0.69, 0.69, 125), np.linspace(-0.65, 0.65, 125))
    wall = np.stack([x, y, 0.075 * np.sin(2 * x + y)], axis=-1)
    capture = PointScene([[0.1, -0.05, 0.35]]).simulate_capture(
        wall, LASER / 2, TimeAxis(1016, 4.6e-12, 0.14), 20e-12
    )
    axis = 0.006 * (np.arange(100) - 49.5)
    return capture, Grid(axis, axis, 0.16 + 0.004 * np.arange(100))


def large_row(repeats: int) -> Row:
    """Time here, and peak memory of a fresh process."""
    capture, grid = large_scene()
    taken = seconds(lambda: Hybrid(0.048).reconstruct(capture, grid), repeats)
    command = [sys.executable, __file__, "--only-large"]
    peak = int(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
    limits = {"at_most_seconds": 1.5, "peak_memory_mb": peak / 1e6, "at_most_mb": 1000}
    return {"name": "hybrid, 125 x 125 x 1016 to 100^3", "seconds": taken, **limits}


def main() -> None:
    """Print the table or, with ``--json``, one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--ytal", metavar="PYTHON", help="Python that has y-tal installed")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--only-large", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    warnings.simplefilter("ignore", AliasingWarning)
    if arguments.only_large:
        capture, grid = large_scene()
        Hybrid(0.048).reconstruct(capture, grid)
        print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024)
        return
    rows = [*planar_rows(arguments.repeats, arguments.ytal), *propagation_rows(arguments.repeats)]
    rows += [scattered_row(arguments.repeats), large_row(arguments.repeats)]
    if arguments.json:
        print(json.dumps({"threads": thread_count(), "rows": rows}))
        return
    print(f"{thread_count()} threads")
    for row in rows:
        if "skipped" in row:
            print(f"{row['name']:36}{'-':>9}    {row['skipped']}")
            continue
        rest = "  ".join(
            f"{name} {value:.3g}" for name, value in row.items() if name not in ("name", "seconds")
        )
        print(f"{row['name']:36}{row['seconds']:9.3f} s  {rest}")


if __name__ == "__main__":
    main()
