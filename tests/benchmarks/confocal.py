"""Time and memory of the confocal methods on 64 x 64 points with 512 bins; run as a script, ``--json`` for figures."""

from __future__ import annotations

import json
import statistics
import sys
import threading
import time
from pathlib import Path

import numpy as np

from nlos import Capture, FKMigration, Grid, LightCone
from nlos.simulate import relay_wall
from tofclip.arrays import thread_count

REPEATS = 5
WATCH_SECONDS = 2e-3


def resident_bytes() -> int:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * 4096


def peak_beyond_start(work: object) -> int:
    """Largest growth of the process while `work` runs, bytes."""
    start, done, peak = resident_bytes(), threading.Event(), [0]

    def watch() -> None:
        while not done.is_set():
            peak[0] = max(peak[0], resident_bytes() - start)
            time.sleep(WATCH_SECONDS)

    watcher = threading.Thread(target=watch)
    watcher.start()
    work()
    done.set()
    watcher.join()
    return peak[0]


def main() -> None:
    wall = relay_wall("planar", 64)
    signal = np.random.default_rng(0).random((512, 64, 64), np.float32)
    capture = Capture(signal, wall, wall, 32e-12)
    axis = np.linspace(-1, 1, 64)
    grid = Grid(axis, axis, np.linspace(0.4, 2.2, 64))
    figures: dict[str, float] = {"threads": thread_count()}
    for name, method in (("light cone", LightCone()), ("f-k", FKMigration())):
        figures[f"{name}, peak memory, MB"] = round(
            peak_beyond_start(lambda m=method: m.reconstruct(capture, grid)) / 1e6
        )
        seconds = []
        for _ in range(REPEATS):
            started = time.perf_counter()
            method.reconstruct(capture, grid)
            seconds.append(time.perf_counter() - started)
        figures[f"{name}, median, s"] = round(statistics.median(seconds), 3)
        figures[f"{name}, best, s"] = round(min(seconds), 3)
    if "--json" in sys.argv:
        print(json.dumps(figures))
        return
    for name, figure in figures.items():
        print(f"{name:36} {figure}")


if __name__ == "__main__":
    main()
