"""Look-ups per second of back-projection: one laser, a confocal scan, a grid of lasers; ``--json`` for figures."""

from __future__ import annotations

import json
import statistics
import sys
import time

import numpy as np

from nlos import Backprojection, Capture, Grid
from tofclip.arrays import thread_count

REPEATS = 3
BINS = 512


def captures() -> dict[str, Capture]:
    random = np.random.default_rng(0)
    x, y = np.meshgrid(np.linspace(-1, 1, 48), np.linspace(-1, 1, 48))
    wall = np.stack([x, y, np.zeros_like(x)], axis=-1)
    signal = random.random((BINS, 48, 48), np.float32)
    lasers = random.uniform(-1, 1, (9, 3)) * [1, 1, 0]
    few = wall[::3, ::3]
    pairs = random.random((BINS, 9, 16, 16), np.float32)
    return {
        "single laser": Capture(signal, wall, [0.1, 0, 0], 32e-12),
        "confocal": Capture(signal, wall, wall, 32e-12),
        "exhaustive": Capture.exhaustive(pairs, few, lasers, 32e-12),
    }


def main() -> None:
    grid = Grid.box((-1, 1), (-1, 1), (0.5, 1.5), (2 / 63, 2 / 63, 1 / 63))
    method = Backprojection(0.6, 5)
    figures = {"threads": thread_count()}
    for name, capture in captures().items():
        method.reconstruct(capture, Grid(grid.x, grid.y, grid.z[:8]))
        seconds = []
        for _ in range(REPEATS):
            started = time.perf_counter()
            method.reconstruct(capture, grid)
            seconds.append(time.perf_counter() - started)
        figures[f"{name}, million look-ups/s"] = round(method.lookups(capture, grid) / statistics.median(seconds) / 1e6)
    if "--json" in sys.argv:
        print(json.dumps(figures))
        return
    for name, figure in figures.items():
        print(f"{name:60} {figure}")


if __name__ == "__main__":
    main()
