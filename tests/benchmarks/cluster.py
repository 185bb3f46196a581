"""A sequence on workers: the same clouds, how much faster two are than one, and what is left after
every mishap.

Run with ``python tests/benchmarks/cluster.py [--shots N] [--json]``; no less than 400 shots say
anything about speed. Workers have one thread each and are warm when the clock starts. Then a worker
is killed, a shot in the middle is broken and the disk, a small one in memory, fills up (that last
part needs the right to mount; without, it is left out).
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import json
import logging
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from distributed import LocalCluster

from tofclip.sequences import RangingSettings, list_shots
from tofclip.sequences.jobs import Summary, run_jobs
from tofclip.simulate import make_default_instrument, make_default_scene, simulate_shot

ROWS = 254
DISTINCT = 10
SUFFIX = ".npz"
SMALL_DISK_SHARE = 0.6
"""Of the clouds that fit on the small disk."""


@contextlib.contextmanager
def workers(number: int) -> Iterator[LocalCluster]:
    """Workers of one thread each."""
    with LocalCluster(
        n_workers=number,
        threads_per_worker=1,
        dashboard_address="127.0.0.1:0",
        silence_logs=logging.CRITICAL,
        env={"TOFCLIP_THREADS": "1"},
    ) as cluster:
        yield cluster


def record_shots(folder: Path, number: int) -> Path:
    """Simulate some shots and lay down as many files as asked for."""
    instrument = make_default_instrument()
    instrument = replace(instrument, detector=replace(instrument.detector, rows=ROWS))
    shots = folder / "shots"
    shots.mkdir()
    for place in range(number):
        path = shots / f"shot{place:04d}.h5"
        if place < DISTINCT:
            simulate_shot(make_default_scene(), instrument, place).streak.save(path)
        else:
            os.link(shots / f"shot{place % DISTINCT:04d}.h5", path)
    instrument.camera.save(folder / "camera.h5")
    return shots


def ranged(shots: Path, out: Path, cluster: str | None, number: int | None = None) -> Summary:
    """Make the clouds of the first `number` shots."""
    jobs = RangingSettings(shots.parent / "camera.h5").jobs(list_shots(shots), out, SUFFIX)
    return run_jobs(jobs[:number], cluster)


def timed(shots: Path, out: Path, number: int, one: str) -> tuple[float, int]:
    """Seconds that warm workers take, and the most memory of one, bytes."""
    shutil.rmtree(out.with_name("warm"), ignore_errors=True)
    ranged(shots, out.with_name("warm"), one, 4 * number)
    summary = ranged(shots, out, one)
    return summary.seconds, summary.peak_bytes


def content(folder: Path) -> dict[str, str]:
    """Hash of each cloud's points."""
    import numpy as np

    found = {}
    for path in sorted(folder.glob(f"*{SUFFIX}")):
        with np.load(path) as arrays:
            found[path.name] = hashlib.sha256(
                b"".join(arrays[name].tobytes() for name in sorted(arrays))
            ).hexdigest()
    return found


def speed(shots: Path, folder: Path) -> dict[str, Any]:
    """Here, one worker, two workers."""
    here = ranged(shots, folder / "here", None)
    seconds, peaks = {}, {}
    for number in (1, 2):
        with workers(number) as cluster:
            seconds[number], peaks[number] = timed(
                shots, folder / f"of{number}", number, cluster.scheduler_address
            )
    truth = content(folder / "here")
    return {
        "seconds_here": here.seconds,
        "seconds_one_worker": seconds[1],
        "seconds_two_workers": seconds[2],
        "times_faster": seconds[1] / seconds[2],
        "identical": content(folder / "of1") == content(folder / "of2") == truth and len(truth) > 0,
        "peak_memory_mib_per_worker": peaks[2] / (1 << 20),
    }


def verb(shots: Path, out: Path, address: str) -> list[str]:
    """The command line of a sequence."""
    program = [
        sys.executable,
        "-m",
        "apps",
        "lidar",
        "sequence",
        str(shots),
        "--out",
        str(out),
        "--suffix",
        SUFFIX,
    ]
    return [*program, "--camera", str(shots.parent / "camera.h5"), "--cluster", address, "--json"]


def told(command: list[str]) -> dict[str, Any]:
    """Run a command to its end; its figures and exit status."""
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    return {**json.loads(done.stdout), "status": done.returncode}


def mishaps(shots: Path, out: Path, truth: dict[str, str], grow: Any = None) -> dict[str, Any]:
    """Kill a worker in the middle, with a broken shot (and on a disk too small); then mend all and
    start again.
    """
    broken = sorted(shots.iterdir())[len(truth) // 2]
    whole = broken.read_bytes()
    broken.unlink()
    broken.write_bytes(whole[:5000])
    with workers(2) as cluster:
        command = verb(shots, out, cluster.scheduler_address)
        process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        while len(list(out.glob(f"*{SUFFIX}"))) < len(truth) // 4:
            time.sleep(0.05)
        os.kill(cluster.workers[0].process.pid, signal.SIGKILL)
        text, _ = process.communicate()
        first = json.loads(text)
        after = content(out)
        hidden = [path.name for path in out.iterdir() if path.name.startswith(".")]
        broken.unlink()
        broken.write_bytes(whole)
        if grow is not None:
            grow()
        second = told(command)
    problems = sorted({failure["problem"].split(": ", 1)[1] for failure in first["failures"]})
    return {
        "first_status": process.returncode,
        "first_results": first["results"],
        "first_failed": first["failed"],
        "problems": problems,
        "others_whole": all(truth[name] == hashed for name, hashed in after.items()),
        "temporary_files_left": len(hidden),
        "second_status": second["status"],
        "second_results": second["results"],
        "all_identical": content(out) == truth,
    }


def on_small_disk(shots: Path, folder: Path, truth: dict[str, str]) -> dict[str, Any] | None:
    """The same on a disk in memory that holds a part of the clouds."""
    small = folder / "small"
    small.mkdir()
    size = int(sum(path.stat().st_size for path in (folder / "here").iterdir()) * SMALL_DISK_SHARE)
    mounting = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(small)]
    if subprocess.run(mounting, capture_output=True, check=False).returncode:
        return None

    def grow() -> None:
        subprocess.run(["mount", "-o", f"remount,size={10 * size}", str(small)], check=True)

    try:
        return mishaps(shots, small / "clouds", truth, grow)
    finally:
        subprocess.run(["umount", str(small)], check=True)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--shots", type=int, default=400)
    parser.add_argument("--json", action="store_true")
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        shots = record_shots(folder, asked.shots)
        figures: dict[str, Any] = {
            "shots": asked.shots,
            "rows": ROWS,
            "speed": speed(shots, folder),
        }
        truth = content(folder / "here")
        figures["killed worker, broken shot"] = mishaps(shots, folder / "mishaps", truth)
        figures["the same on a full disk"] = on_small_disk(shots, folder, truth)
    if asked.json:
        print(json.dumps(figures))
        return
    for name, value in figures.items():
        print(f"{name}:" if isinstance(value, dict) else f"{name}: {value}")
        if isinstance(value, dict):
            print("\n".join(f"    {key:28} {figure}" for key, figure in value.items()))


if __name__ == "__main__":
    main()
