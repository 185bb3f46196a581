"""How benchmarks are run: what a case is, one size of it in a fresh process, other programs that do
the same, all sizes of many cases, and the page of their figures.

``cases.csv`` says what is measured, in which module; that module's ``PREPARE`` makes the inputs.
"""

from __future__ import annotations

import contextlib
import csv
import importlib
import importlib.metadata
import json
import math
import os
import platform
import re
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from tofclip import __version__
from tofclip.arrays import AnyArray
from tofclip.errors import InputError
from tofclip.sequences.jobs import measure_peak_memory_bytes
from tofclip.threads import THREADS_VARIABLE, thread_count

Action = Callable[[], object]
# seconds that the work alone takes another program; raises `PeerUnavailableError`
Peer = Callable[[], float]


class PeerUnavailableError(Exception):
    """The other program cannot be had here, and why."""


@dataclass(frozen=True)
class PreparedCase:
    """A case at one size, ready to run."""

    action: Action  # what is measured
    floor: Action  # what it cannot do without, on the same data and threads
    amount: float  # how much one action does, in the case's unit
    peers: Mapping[str, Peer] = field(default_factory=dict)  # by their names
    # part of the floor that `floor` does, where all of it takes too long; above 1: it does more
    floor_fraction: float = 1.0
    # what else is to be said of this size, by names that end in their unit; called last
    figures: Callable[[], Mapping[str, float]] = dict


Prepare = Callable[[int], PreparedCase]


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
    prepare: Prepare  # makes the inputs of a size

    @property
    def group(self) -> str:
        return self.name.partition("-")[0]


PAGE_GROUPS = {
    "recovery": "Recovery of shots (7 views, 1344 slit pixels, 174 x 174 pixels)",
    "clip": "Rendered light fields from few measurements of their true views (8 x 8 views)",
    "depth": "Ranges (the demo's instrument)",
    "streaming": "Shots to clouds (the demo's instrument)",
    "rsd": "Around the corner: phasor fields",
    "propagation": "Around the corner: propagation",
    "confocal": "Around the corner: confocal",
    "backprojection": "Around the corner: back-projection",
    "decode": "Instruments",
}
# by name only: they need an extra program, recorded data, another device or much time
STUDY_GROUPS = {
    "camera": "Light-field cameras: one model each way",
    "device": "The same on another device",
    "corner": "Around the corner: beyond lattices",
    "viewer": "The viewer in a browser",
}
TABLE = Path(__file__).with_name("cases.csv")


def find_cases(name: str) -> tuple[Case, ...]:
    """Return the case of a name, those of a group, or the page's (some ten minutes) for ``all``."""
    with TABLE.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    cases = []
    for row in rows:
        own, group = row["name"], row["name"].partition("-")[0]
        if name not in (own, group) and not (name == "all" and group in PAGE_GROUPS):
            continue
        sizes, module = tuple(map(int, row.pop("sizes").split())), row.pop("module")
        try:
            prepare = importlib.import_module(f"apps.benchmarks.{module}").PREPARE[own]
        except ImportError as absence:
            missing = f"the benchmark '{own}' needs {absence.name}: pip install {absence.name}"
            raise InputError(missing) from absence
        cases.append(Case(**row, sizes=sizes, prepare=prepare))
    if not cases:
        groups = ", ".join([*PAGE_GROUPS, *STUDY_GROUPS])
        raise InputError(
            f"unknown benchmark '{name}'; take all, a group ({groups}) or one of a group, as recovery-l1"
        )
    return tuple(cases)


def main() -> None:
    """Print the figures of one case at one size, which the command line names, as JSON."""
    name, size = sys.argv[1:]
    print(json.dumps(measure_case(find_cases(name)[0], int(size))))


LIBRARIES = ("numpy", "scipy", "numba", "pyfftw", "h5py", "scikit-image")


def describe_machine() -> dict[str, Any]:
    """Return processor, cores, memory, devices and versions; no name of a machine or person.
    ``load``: how many other processes wanted a core, on average over the last minute; what the
    system does not report is None.
    """
    known = Path("/proc/cpuinfo")
    model = (
        re.search(r"^model name\s*: *(.+)$", known.read_text(), re.M) if known.is_file() else None
    )
    devices = ["cpu"]
    with contextlib.suppress(Exception):  # no CuPy, no driver, no device: all the same here
        runtime = importlib.import_module("cupy").cuda.runtime
        for number in range(runtime.getDeviceCount()):
            device = runtime.getDeviceProperties(number)["name"].decode()
            devices.append(f"cuda:{number} {device}")
    return {
        "processor": model[1] if model else platform.processor() or platform.machine(),
        "cores": thread_count(),
        "memory_gib": _ask_system(
            lambda: os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
        ),
        "system": f"{platform.system()} {platform.machine()}",
        "devices": devices,
        "load": _ask_system(lambda: os.getloadavg()[0]),
        "python": platform.python_version(),
        "tofclip": __version__,
        "libraries": {name: importlib.metadata.version(name) for name in LIBRARIES},
    }


def _ask_system(question: Callable[[], float]) -> float | None:
    try:
        return round(question(), 1)
    except (AttributeError, ValueError, OSError):
        return None


MIN_REPEATS, MAX_REPEATS = 3, 31
REPEAT_TIME_S, FLOOR_TIME_S = 1.0, 0.3  # repeats go on for so long
SLOW_TIME_S = 2.0  # what takes longer is measured once
BYTES_PER_MIB = 1 << 20


def measure_case(case: Case, size: int) -> dict[str, Any]:
    """Return the figures of a case at one size. Returns ``seconds`` (median, least and greatest of
    the repeats after one that warms up), ``per_second``, ``peak_mib`` of the process with its
    libraries and inputs, ``own_mib`` of that only while the action ran, ``floor_seconds``,
    ``times_floor``, ``peers``: seconds, or why there are none, and ``figures``, where the case has
    more to say.
    """
    ready = case.prepare(size)
    before = measure_peak_memory_bytes()
    ready.action()
    peak = measure_peak_memory_bytes()
    seconds = time_repeats(ready.action, REPEAT_TIME_S)
    ready.floor()
    floor = statistics.median(time_repeats(ready.floor, FLOOR_TIME_S)) / ready.floor_fraction
    median, peers = statistics.median(seconds), dict[str, Any]()
    for name, peer in ready.peers.items():
        try:
            peers[name] = {"seconds": peer()}
        except PeerUnavailableError as absence:
            peers[name] = {"absent": str(absence)}
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
        "peers": peers,
        **({"figures": figures} if figures else {}),
    }


def time_repeats(action: Action, seconds: float) -> list[float]:
    """Time an action again and again, until the repeats took so many seconds."""
    times: list[float] = []
    while len(times) < MAX_REPEATS:
        began = time.perf_counter()
        action()
        times.append(time.perf_counter() - began)
        enough = len(times) >= MIN_REPEATS or times[0] > SLOW_TIME_S
        if enough and sum(times) >= seconds:
            break
    return times


PEERS_VARIABLE = "TOFCLIP_PEERS"
PEER_TIMEOUT_S = 900  # a cube of 128^3 voxels, the page's largest, takes some of them minutes

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


def ask_peer(name: str, script: str, **arrays: Any) -> tuple[float, AnyArray | None]:
    """Run a script in the peers' Python: the seconds that it reports, and its array."""
    python = os.environ.get(PEERS_VARIABLE)
    if not python:
        raise PeerUnavailableError(f"{name}: --peers names no Python that has it")
    clean = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    with tempfile.TemporaryDirectory() as folder:
        path, saved = Path(folder) / "arrays.npz", Path(folder) / "result.npy"
        np.savez(path, **arrays)
        command = [python, "-c", script, str(path), str(saved)]
        try:
            done = _run(command, clean, PEER_TIMEOUT_S)
        except subprocess.TimeoutExpired as fault:
            raise PeerUnavailableError(f"{name}: takes more than {PEER_TIMEOUT_S} s") from fault
        reported = re.findall(r"^seconds (.+)$", done.stdout, re.M)
        if done.returncode or not reported:
            problem = (done.stderr.strip().splitlines() or ["no reason given"])[-1]
            raise PeerUnavailableError(f"{name}: {problem}")
        return float(reported[-1]), np.load(saved) if saved.exists() else None


def _run(command: list[str], environment: Mapping[str, str], timeout: float) -> Any:
    how: Any = {"capture_output": True, "text": True, "check": False}
    return subprocess.run(command, env=environment, timeout=timeout, **how)


# What has not begun by then is left out, so that a run has an end on any machine: twice what two
# slow cores take. The time of processes that ask other programs as well does not count.
TOTAL_TIMEOUT_S = 1200
CASE_TIMEOUT_S = 120


def run_cases(
    cases: Sequence[Case], peers: str | None, advance: Callable[[int], None]
) -> dict[str, Any]:
    """Measure cases one after the other; `advance` is called with 1 after each process. `peers`:
    Python in which other programs are installed. Returns ``machine`` and ``entries``, one for each
    case.
    """
    machine = describe_machine()  # before anything is measured: its load is that of others
    remaining_s = [float(TOTAL_TIMEOUT_S)]
    entries = [_run_case(case, peers, remaining_s, advance) for case in cases]
    return {"machine": machine, "entries": entries}


def count_processes(cases: Sequence[Case]) -> int:
    """Return how many processes `run_cases` starts."""
    return sum(len(case.sizes) + len(_list_thread_counts()) - 1 for case in cases)


def _list_thread_counts() -> list[int]:
    """The numbers of threads that are compared: 1 and all."""
    return sorted({1, thread_count()})


def _run_case(
    case: Case, peers: str | None, remaining_s: list[float], advance: Callable[[int], None]
) -> dict[str, Any]:
    *fewer, most = _list_thread_counts()
    runs = []
    for size in case.sizes:
        for count in [*fewer, most] if size == case.sizes[-1] else [most]:
            asked = peers if count == most else None  # a peer is asked once for each size
            figures = _run_process(case, (size, count), asked, remaining_s)
            if asked != peers and "peers" in figures:
                figures["peers"] = {}  # not asked: that says nothing of the Python that was named
            runs.append({"size": size, "threads": count, **figures})
            advance(1)
    texts = {key: getattr(case, key) for key in ("name", "title", "size", "unit", "floor")}
    # Power of the size with which the time grows, between the least and the greatest size.
    growth, known = None, [one for one in runs if one["threads"] == most and "seconds" in one]
    if len(known) > 1:
        first, last = known[0], known[-1]
        times = last["seconds"]["median"] / first["seconds"]["median"]
        growth = math.log(times) / math.log(last["size"] / first["size"])
    return {**texts, "runs": runs, "growth": growth}


def _run_process(
    case: Case, extent: tuple[int, int], peers: str | None, remaining_s: list[float]
) -> dict[str, Any]:
    """Figures of a fresh process for a size and threads, or ``problem``; its time is taken off."""
    if remaining_s[0] <= 0:
        return {"problem": f"left out: the others took {TOTAL_TIMEOUT_S} s"}
    longest = CASE_TIMEOUT_S + (PEER_TIMEOUT_S if peers else 0)  # what has begun may finish
    # with this program's own path: another one may lie in the folder that the user is in
    code = (
        f"import sys; sys.path[:] = {sys.path!r}; from apps.benchmarks.harness import main; main()"
    )
    command = [sys.executable, "-c", code, case.name, str(extent[0])]
    environment = {**os.environ, THREADS_VARIABLE: str(extent[1]), PEERS_VARIABLE: peers or ""}
    began = time.monotonic()
    try:
        done = _run(command, environment, longest)
    except subprocess.TimeoutExpired:
        return {"problem": f"took more than {longest:.0f} s"}
    finally:
        if not peers:
            remaining_s[0] -= time.monotonic() - began
    if done.returncode:
        complaints = done.stderr.strip().splitlines() or [f"ended with status {done.returncode}"]
        return {"problem": complaints[-1]}
    return json.loads(done.stdout.splitlines()[-1])


PAGE_HEADER = """\
# Benchmarks

Made by `{command}`; do not edit. Every figure comes from one run on one machine:

* {processor}, {cores} cores, {memory_gib} GiB, {system}
* devices: {device_list}
* other processes that wanted a core in the minute before: {load}
* tofclip {tofclip}, Python {python}, {library_list}

Each size and number of threads is a fresh process. Times are medians after one warm-up, with the least and the greatest
of the repeats; memory is the peak of the process with its libraries and inputs, and how much of it the work itself
added. *Floor* is what the work cannot do without, measured beside it on the same data and threads; *growth* the power
of the size with which the time grows between the first and the last size."""

TABLE_COLUMNS = ("", "size", "threads", "time", "rate", "memory", "floor", "x floor", "growth")


def render_page(figures: Mapping[str, Any], command: str) -> str:
    """Return the page, in Markdown, of the figures that a run of `command` gave."""
    known = figures["machine"]
    libraries = ", ".join(f"{name} {version}" for name, version in known["libraries"].items())
    devices = ", ".join(known["devices"])
    parts = [
        PAGE_HEADER.format(command=command, library_list=libraries, device_list=devices, **known)
    ]
    head = [f"| {' | '.join(row)} |" for row in (TABLE_COLUMNS, ["---"] * len(TABLE_COLUMNS))]
    for group, title in {**PAGE_GROUPS, **STUDY_GROUPS}.items():
        lines, notes = list[str](), list[str]()
        for entry in figures["entries"]:
            if entry["name"].partition("-")[0] == group:
                lines += (f"| {' | '.join(_format_cells(entry, one))} |" for one in entry["runs"])
                notes.append(_format_note(entry))
        if notes:
            parts.append("\n".join([f"## {title}", "", *head, *lines, "", *notes]))
    return "\n\n".join(parts) + "\n"


def _format_cells(entry: Mapping[str, Any], run: Mapping[str, Any]) -> list[str]:
    first = [entry["title"], str(run["size"]), str(run["threads"])]
    if "problem" in run:
        return [*first, run["problem"], "", "", "", "", ""]
    time = run["seconds"]
    median, least, greatest = (
        _format_seconds(time[name]) for name in ("median", "least", "greatest")
    )
    spread = f"{median} ({least} to {greatest})"
    last = run is entry["runs"][-1]
    return [
        *first,
        spread,
        f"{_format_digits(run['per_second'])} {entry['unit']}/s",
        f"{run['peak_mib']:.0f} MiB, own {run['own_mib']:.0f}",
        _format_seconds(run["floor_seconds"]),
        f"{run['times_floor']:.2f}",
        f"{entry['growth']:.1f}" if last and entry["growth"] is not None else "",
    ]


def _format_note(entry: Mapping[str, Any]) -> str:
    """What is measured, what other programs took where they were asked, and what else a size says."""
    comparisons: dict[str, list[str]] = {}
    absent: dict[str, str] = {}
    further = ""
    for run in entry["runs"]:
        for name, answer in run.get("peers", {}).items():
            if "absent" in answer:
                absent[name] = answer["absent"]
                continue
            ratio = answer["seconds"] / run["seconds"]["median"]
            extent = f"{run['size']}, {run['threads']} thread{'s' if run['threads'] > 1 else ''}"
            comparisons.setdefault(name, []).append(
                f"{_format_seconds(answer['seconds'])} at {extent} ({ratio:.1f} times ours)"
            )
        texts = [f"{name} {value:.3g}" for name, value in run.get("figures", {}).items()]
        if texts:
            further += f" At {run['size']}, threads {run['threads']}: {', '.join(texts)}."
    peers = [f" {name}: {'; '.join(texts)}." for name, texts in comparisons.items()]
    peers += [
        f" Not compared: {reason}." for name, reason in absent.items() if name not in comparisons
    ]
    what = f"sizes are {entry['size']}, the floor is {entry['floor']}"
    return f"* {entry['title']}: {what}.{''.join(peers)}{further}"


def _format_seconds(value: float) -> str:
    for unit, scale in (("s", 1.0), ("ms", 1e-3)):
        if value >= scale:
            return f"{_format_digits(value / scale)} {unit}"
    return f"{_format_digits(value / 1e-6)} us"


def _format_digits(value: float) -> str:
    """Three digits that count, without powers of ten."""
    return f"{value:.3g}" if value < 1000 else f"{value:.0f}"
