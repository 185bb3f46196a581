"""How fast and how large recovery is, as ratios to the bare sparse products it cannot do without.

Run with ``python tests/benchmarks/recovery.py [--frames N] [--repeats N] [--json]``. All figures come from one run on
one machine: medians with the least and the greatest of the repeats. The scene is random; nothing about its content
changes the work. Peak memory is that of a fresh process for each method.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import time
from collections.abc import Callable

import numpy as np

from tofclip.arrays import LANES, run_blocks, thread_count
from tofclip.camera import Camera
from tofclip.operators import LineProjection
from tofclip.recovery import Adjoint, LinearInverse, Method, Sparse, TotalVariation

ITERATIONS = 30
METHODS: dict[str, Method] = {
    "l1": Sparse(iterations=ITERATIONS),
    "tv": TotalVariation(iterations=ITERATIONS),
    "linear": LinearInverse(),
    "adjoint": Adjoint(),
}


def operator() -> LineProjection:
    """The size of a real instrument: 7 views on 1344 slit pixels, pictures of 174 x 174."""
    centres = 168.0 + 172.5 * np.arange(7)
    angles = np.deg2rad([-44.0, -26.0, -12.5, 0.8, 22.0, 37.5, 48.0])
    return Camera(centres, angles, (174, 174), 1344).operator()


def readings(frames: int) -> np.ndarray:
    """Positive readings with noise, (1344, frames) float32."""
    return np.abs(np.random.default_rng(0).standard_normal((1344, frames))).astype(np.float32)


def bare_products(projection: LineProjection, frames: int, iterations: int) -> None:
    """The floor: `iterations` products each way on every frame, in blocks on all threads, nothing else."""

    def work(piece: slice) -> None:
        block = np.ones((*projection.shape_in, LANES), np.float32)
        for _ in range(iterations):
            block = projection.adjoint(projection(block))
            block *= np.float32(1e-3)

    run_blocks(work, frames)


def scipy_products(projection: LineProjection, frames: int, iterations: int) -> None:
    """A peer: scipy's own sparse product on the same blocks and threads."""
    matrix, transposed = projection.matrix, projection.matrix.T.tocsr()

    def work(piece: slice) -> None:
        block = np.ones((matrix.shape[1], LANES), np.float32)
        for _ in range(iterations):
            block = transposed @ (matrix @ block)
            block *= np.float32(1e-3)

    run_blocks(work, frames)


def measured(action: Callable[[], object], repeats: int) -> list[float]:
    """Seconds of each repeat, sorted, after one warm-up."""
    action()
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        action()
        seconds.append(time.perf_counter() - start)
    return sorted(seconds)


def peak_memory_bytes(method: str, frames: int) -> int:
    """Peak resident memory of a fresh process that runs `method` once."""
    command = [sys.executable, __file__, "--only", method, "--frames", str(frames)]
    return int(subprocess.run(command, check=True, capture_output=True, text=True).stdout)


def run_once(method: str, frames: int) -> int:
    """Run `method` and return this process's peak resident memory in bytes."""
    METHODS[method].recover(operator(), readings(frames))
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def table(frames: int, repeats: int) -> list[dict[str, object]]:
    """Measure everything; one row for each action."""
    projection, data = operator(), readings(frames)
    prepared = LinearInverse().prepare(projection)
    memory = np.empty((frames, *projection.shape_in), np.float32)
    actions: dict[str, Callable[[], object]] = {
        "bare products": lambda: bare_products(projection, frames, ITERATIONS),
        "scipy products": lambda: scipy_products(projection, frames, ITERATIONS),
        **{name: (lambda method=method: method.recover(projection, data)) for name, method in METHODS.items()},
        "linear, prepared": lambda: prepared.recover(data),
        "linear, in place": lambda: prepared.recover(data, out=memory),
    }
    rows: list[dict[str, object]] = []
    floor = 0.0
    for name, action in actions.items():
        seconds = measured(action, repeats)
        median = float(np.median(seconds))
        floor = floor or median
        rows.append(
            {
                "name": name,
                "seconds": [round(seconds[0], 4), round(median, 4), round(seconds[-1], 4)],
                "frames_per_second": round(frames / median),
                "times_bare_products": round(median / floor, 3),
                "peak_memory_mb": round(peak_memory_bytes(name, frames) / 1e6) if name in METHODS else None,
            }
        )
    return rows


def main() -> None:
    """Print the table or, with ``--json``, one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=1016)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--only", choices=METHODS, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.only:
        print(run_once(arguments.only, arguments.frames))
        return
    rows = table(arguments.frames, arguments.repeats)
    if arguments.json:
        print(json.dumps({"frames": arguments.frames, "threads": thread_count(), "rows": rows}))
        return
    print(f"{arguments.frames} frames, {ITERATIONS} iterations where iterative, {thread_count()} threads")
    print(f"{'':18}{'least':>9}{'median':>9}{'most s':>9}{'frames/s':>10}{'x bare':>8}{'MB':>7}")
    for row in rows:
        seconds = "".join(f"{value:9.3f}" for value in row["seconds"])
        memory = row["peak_memory_mb"] or ""
        print(f"{row['name']:18}{seconds}{row['frames_per_second']:10}{row['times_bare_products']:8}{memory:>7}")


if __name__ == "__main__":
    main()
