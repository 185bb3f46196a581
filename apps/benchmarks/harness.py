"""What a benchmark consists of.

What figures were measured on, without the name of any machine or person.

Run one case at one size in this process, which is fresh: time, memory, floor and peers.

Other programs that do the same. They run in a Python of their own, named by `--peers`, where
they are installed.

Run cases, each size and number of threads in a fresh process, and put the figures together.
"""

from __future__ import annotations

import importlib
import importlib.metadata
import json
import math
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from tofclip import __version__
from tofclip.sequences.jobs import measure_peak_memory_bytes
from tofclip.threads import THREADS_VARIABLE, thread_count

if TYPE_CHECKING:
    from nlos import Capture, Grid


Action = Callable[[], object]
Peer = Callable[[], float]
"""Does the same with another program, and returns the seconds of its work alone; raises
`PeerUnavailableError`.
"""


class PeerUnavailableError(Exception):
    """The other program cannot be had here, and why."""


@dataclass(frozen=True)
class PreparedCase:
    """A case at one size, ready to run."""

    action: Action  # what is measured
    floor: Action  # what it cannot do without, on the same data and threads
    amount: float  # how much one action does, in the case's unit
    # the same by other programs, by their names
    peers: Mapping[str, Peer] = field(default_factory=dict)
    # part of the floor that `floor` does, where all of it would take too long; above 1 where it
    # does more
    floor_fraction: float = 1.0
    # what else is to be said of this size, by names that end in their unit: errors, latencies.
    # Called once, after the times were taken
    figures: Callable[[], Mapping[str, float]] = dict


@dataclass(frozen=True)
class Case:
    """Something that is measured at several sizes."""

    name: str  # ``group-what``, what a user types; the group alone names all of its cases
    title: str  # what it does, as a row of a table says it
    size: str  # what its sizes count
    # rising. Growth is from each to the next; threads and floor are reported for the last
    sizes: tuple[int, ...]
    unit: str  # what `PreparedCase.amount` counts
    floor: str  # what it is held against, in words
    prepare: Callable[[int], PreparedCase]  # makes the inputs of a size

    @property
    def group(self) -> str:
        """The first word of the name."""
        return self.name.partition("-")[0]


LIBRARIES = ("numpy", "scipy", "numba", "pyfftw", "h5py", "scikit-image")


def describe_machine() -> dict[str, Any]:
    """Return processor, cores, memory, devices and versions."""
    return {
        "processor": read_processor(),
        "cores": thread_count(),
        "memory_gib": read_memory_gib(),
        "system": f"{platform.system()} {platform.machine()}",
        "devices": find_devices(),
        "load": read_load(),
        "python": platform.python_version(),
        "tofclip": __version__,
        "libraries": {name: importlib.metadata.version(name) for name in LIBRARIES},
    }


def read_processor() -> str:
    """Return the model of the processor, as the system calls it."""
    known = Path("/proc/cpuinfo")
    if known.is_file():
        for line in known.read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def read_memory_gib() -> float | None:
    """Return the memory of the machine; None where the system does not report it."""
    try:
        return round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / (1 << 30), 1)
    except (AttributeError, ValueError, OSError):
        return None


def read_load() -> float | None:
    """Return how many other processes wanted a core, on average over the last minute; None where it
    is not reported.
    """
    try:
        return round(os.getloadavg()[0], 1)
    except (AttributeError, OSError):
        return None


def find_devices() -> list[str]:
    """Return what arrays can be computed on: the processor, and what CuPy finds beside it."""
    try:
        cupy: Any = importlib.import_module("cupy")
        runtime = cupy.cuda.runtime
        numbers = range(runtime.getDeviceCount())
        return [
            "cpu",
            *(f"cuda:{n} {runtime.getDeviceProperties(n)['name'].decode()}" for n in numbers),
        ]
    except Exception:  # no CuPy, no driver, no device: all the same here
        return ["cpu"]


MIN_REPEATS, MAX_REPEATS = 3, 31
REPEAT_TIME_S = 1.0
"""Repeats go on for so long, or until there are `MAX_REPEATS`."""

SLOW_TIME_S = 2.0
"""What takes longer is measured once."""

FLOOR_TIME_S = 0.3
BYTES_PER_MIB = 1 << 20


def measure_case(case: Case, size: int) -> dict[str, Any]:
    """Return the figures of a case at one size.

    Returns ``seconds`` (median, least and greatest of the repeats after one that warms up),
    ``per_second``, ``peak_mib`` of the process with its libraries and inputs, ``own_mib`` of that
    only while the action ran, ``floor_seconds``, ``times_floor``, ``peers``: seconds, or why there
    are none, and ``figures``, where the case has more to say.
    """
    ready = case.prepare(size)
    before = measure_peak_memory_bytes()
    ready.action()
    peak = measure_peak_memory_bytes()
    seconds = time_repeats(ready.action, REPEAT_TIME_S)
    ready.floor()
    floor = statistics.median(time_repeats(ready.floor, FLOOR_TIME_S)) / ready.floor_fraction
    median = statistics.median(seconds)
    figures = dict(ready.figures())
    return {
        "seconds": {
            "median": median,
            "least": min(seconds),
            "greatest": max(seconds),
            "repeats": len(seconds),
        },
        "per_second": ready.amount / median,
        "peak_mib": peak / BYTES_PER_MIB,
        "own_mib": (peak - before) / BYTES_PER_MIB,
        "floor_seconds": floor,
        "times_floor": median / floor,
        "peers": {name: _time_peer(peer) for name, peer in ready.peers.items()},
        **({"figures": figures} if figures else {}),
    }


def time_repeats(action: Action, seconds: float) -> list[float]:
    """Time an action again and again.

    `seconds`: stop when the repeats took this long; from `MIN_REPEATS` to `MAX_REPEATS` of them.
    Returns seconds.
    """
    found: list[float] = []
    while len(found) < MAX_REPEATS:
        began = time.perf_counter()
        action()
        found.append(time.perf_counter() - began)
        enough = len(found) >= MIN_REPEATS or found[0] > SLOW_TIME_S
        if enough and sum(found) >= seconds:
            break
    return found


def _time_peer(peer: Any) -> dict[str, Any]:
    try:
        return {"seconds": peer()}
    except PeerUnavailableError as absence:
        return {"absent": str(absence)}


PEERS_VARIABLE = "TOFCLIP_PEERS"
PEER_TIMEOUT_S = 900
"""A cube of 128^3 voxels, the page's largest, takes some of them minutes."""

YTAL_SCRIPT = """
import sys, time
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
start = time.perf_counter()
pf.solve(data, float(stored["wavelength"]), float(stored["cycles"]), CameraSystem.DIRECT_LIGHT, volume)
print("seconds", time.perf_counter() - start)
"""

ASTRA_SCRIPT = """
import sys, time
import astra, numpy as np
stored = np.load(sys.argv[1])
picture, angles = stored["picture"], stored["angles"]
volume = astra.create_vol_geom(*picture.shape)
sinogram = astra.create_proj_geom("parallel", 1.0, int(1.5 * picture.shape[0]), angles)
projector = astra.create_projector("linear", sinogram, volume)
astra.create_sino(picture, projector)
start = time.perf_counter()
astra.create_sino(picture, projector)
print("seconds", time.perf_counter() - start)
"""

LENSLESS_SCRIPT = """
import sys, time
import numpy as np
from lensless import FISTA
stored = np.load(sys.argv[1])
spread, readings, iterations = stored["spread"], stored["readings"], int(stored["iterations"])
method = FISTA(spread[np.newaxis, :, :, np.newaxis])
method.set_data(readings[np.newaxis, :, :, np.newaxis])
method.apply(n_iter=1, disp_iter=None, plot=False, save=False)
start = time.perf_counter()
picture = method.apply(n_iter=iterations, disp_iter=None, plot=False, save=False)
seconds = time.perf_counter() - start
np.save(sys.argv[2], np.squeeze(picture))
print("seconds", seconds)
"""


@dataclass
class LenslessPeer:
    """LenslessPiCam's FISTA on a sensor's picture of a known point-spread function."""

    spread: NDArray[np.float32]  # (rows, columns)
    readings: NDArray[np.float32]  # (rows, columns)
    iterations: int
    picture: NDArray[Any] | None = None  # (rows, columns), what it made, once it was timed
    _seconds: float = 0.0

    def __call__(self) -> float:
        """Return the seconds of its iterations alone; it runs once."""
        if self.picture is not None:
            return self._seconds
        with tempfile.TemporaryDirectory() as folder:
            path, made = Path(folder) / "readings.npz", Path(folder) / "picture.npy"
            np.savez(path, spread=self.spread, readings=self.readings, iterations=self.iterations)
            self._seconds = run_peer(LENSLESS_SCRIPT, "LenslessPiCam", str(path), str(made))
            self.picture = np.load(made)
        return self._seconds


def time_astra(picture: NDArray[np.float32], angles: NDArray[np.float64]) -> float:
    """Seconds of ASTRA's parallel projections of a picture, linear interpolation, processor.

    `picture` (rows, columns); `angles` (angles,): rad. Returns seconds.
    """
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "picture.npz"
        np.savez(path, picture=picture, angles=angles)
        return run_peer(ASTRA_SCRIPT, "ASTRA", str(path))


def time_ytal(capture: Capture, grid: Grid, wavelength: float, cycles: float) -> float:
    """Seconds of y-tal's phasor fields on the same arrays, its solve call alone.

    `wavelength`: metres. Returns seconds.
    """
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "capture.npz"
        arrays: dict[str, Any] = {
            "signal": capture.signal,
            "wall": capture.wall,
            "laser": capture.laser,
        }
        arrays |= {"x": grid.x, "y": grid.y, "z": grid.z}
        arrays |= {"spacing": capture.axis.spacing, "wavelength": wavelength, "cycles": cycles}
        np.savez(path, **arrays)
        return run_peer(YTAL_SCRIPT, "y-tal", str(path))


def run_peer(script: str, name: str, *words: str) -> float:
    """Run a script in the peers' Python and return the seconds that its last lines report.

    `name`: of the peer, for the message; `*words`: the script's arguments. Returns seconds.
    """
    python = os.environ.get(PEERS_VARIABLE)
    if not python:
        raise PeerUnavailableError(f"{name}: --peers names no Python that has it")
    clean = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    command = [python, "-c", script, *words]
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, check=False, env=clean, timeout=PEER_TIMEOUT_S
        )
    except subprocess.TimeoutExpired as fault:
        raise PeerUnavailableError(f"{name}: takes more than {PEER_TIMEOUT_S} s") from fault
    reported = [line.split() for line in done.stdout.splitlines() if line.startswith("seconds ")]
    if done.returncode or not reported:
        problem = (done.stderr.strip().splitlines() or ["no reason given"])[-1]
        raise PeerUnavailableError(f"{name}: {problem}")
    return float(reported[-1][1])


CASE_TIMEOUT_S = 120
TOTAL_TIMEOUT_S = 1200
"""What has not begun by then is left out, so that a run has an end on any machine: twice what two
slow cores take. The time of processes that ask other programs as well does not count.
"""


class TimeBudget:
    """Counts down `TOTAL_TIMEOUT_S`."""

    def __init__(self) -> None:
        self.remaining_s = float(TOTAL_TIMEOUT_S)
        """Seconds that are left, not negative."""

    def spend(self, seconds: float) -> None:
        """Take off what a process took."""
        self.remaining_s = max(0.0, self.remaining_s - seconds)


def run_cases(
    cases: Sequence[Case], peers: str | None, advance: Callable[[int], None]
) -> dict[str, Any]:
    """Measure cases one after the other.

    `peers`: python in which other programs are installed; `advance`: called with 1 after each
    process; there are `count_processes` of them. Returns ``describe_machine`` and ``entries``, one
    for each case.
    """
    machine = describe_machine()  # before anything is measured: its load is that of others
    clock = TimeBudget()
    return {
        "machine": machine,
        "entries": [_run_case(case, peers, clock, advance) for case in cases],
    }


def count_processes(cases: Sequence[Case]) -> int:
    """Return how many processes `run_cases` starts."""
    return sum(len(case.sizes) + len(list_thread_counts()) - 1 for case in cases)


def list_thread_counts() -> list[int]:
    """Return the numbers of threads that are compared: 1 and all, which is 2 on the smallest
    machines.
    """
    return sorted({1, thread_count()})


def _run_case(
    case: Case, peers: str | None, clock: TimeBudget, advance: Callable[[int], None]
) -> dict[str, Any]:
    *fewer, most = list_thread_counts()
    runs = []
    for size in case.sizes:
        for count in [*fewer, most] if size == case.sizes[-1] else [most]:
            wanted = peers if count == most else None  # a peer is asked once for each size
            figures = _run_process(case, (size, count), wanted, clock)
            if wanted != peers and "peers" in figures:
                figures["peers"] = {}  # not asked: that says nothing of the Python that was named
            runs.append({"size": size, "threads": count, **figures})
            advance(1)
    return {
        "name": case.name,
        "title": case.title,
        "size": case.size,
        "unit": case.unit,
        "floor": case.floor,
        "runs": runs,
        "growth": _fit_growth(runs, most),
    }


def _run_process(
    case: Case, extent: tuple[int, int], peers: str | None, clock: TimeBudget
) -> dict[str, Any]:
    """Figures of a fresh process for a size and a number of threads, or ``problem``: why there are
    none.
    """
    size, count = extent
    if clock.remaining_s == 0:
        return {"problem": f"left out: the others took {TOTAL_TIMEOUT_S} s"}
    longest = CASE_TIMEOUT_S + (PEER_TIMEOUT_S if peers else 0)  # what has begun may finish
    # with this program's own path: another one may lie in the folder that the user is in
    code = f"import sys; sys.path[:] = {sys.path!r}; import apps.benchmarks.__main__ as one; one.main()"
    command = [sys.executable, "-c", code, case.name, str(size)]
    environment = {**os.environ, THREADS_VARIABLE: str(count), PEERS_VARIABLE: peers or ""}
    began = time.monotonic()
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, check=False, env=environment, timeout=longest
        )
    except subprocess.TimeoutExpired:
        return {"problem": f"took more than {longest:.0f} s"}
    finally:
        if not peers:
            clock.spend(time.monotonic() - began)
    if done.returncode:
        return {
            "problem": (
                done.stderr.strip().splitlines() or [f"ended with status {done.returncode}"]
            )[-1]
        }
    figures: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return figures


def _fit_growth(runs: Sequence[dict[str, Any]], count: int) -> float | None:
    """Power of the size with which the time grows, between the least and the greatest size."""
    known = [run for run in runs if run["threads"] == count and "seconds" in run]
    if len(known) < 2:
        return None
    first, last = known[0], known[-1]
    times = last["seconds"]["median"] / first["seconds"]["median"]
    return math.log(times) / math.log(last["size"] / first["size"])
