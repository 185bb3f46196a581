"""Study: many shots: how late a cloud is when shots come at an instrument's pace, whether memory
stays flat, and how much faster two workers of a cluster are than one.
"""

from __future__ import annotations

import atexit
import contextlib
import hashlib
import itertools
import logging
import os
import statistics
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

from distributed import LocalCluster

from apps.benchmarks.harness import BYTES_PER_MIB, Prepare, PreparedCase
from apps.benchmarks.shots import bring_shots, make_instrument, simulate_shots
from tofclip.sequences import RangingSettings, list_shots
from tofclip.sequences.jobs import Summary, run_jobs
from tofclip.sequences.ranger import RangingPipeline
from tofclip.sequences.streaming import stream_clouds

RATE_FRACTION = 0.75  # of the rate that a stream reaches: the pace at which latency is measured

ROWS, SMALL_ROWS, CLUSTER_ROWS = 1016, 576, 254
SUFFIX = ".npz"


def prepare_stream(rows: int, shots: int) -> PreparedCase:
    """Shots as fast as they are taken, then at three quarters of that rate."""
    streaks = simulate_shots(rows)
    pipeline = RangingPipeline.for_shot(streaks[0])

    def stream(period_s: float = 0.0, number: int = shots) -> list[float]:
        clouds = stream_clouds(bring_shots(streaks, number, period_s), pipeline)
        return [one.latency for one in clouds]

    def measure_latency() -> dict[str, float]:
        began = time.perf_counter()
        stream()
        period_s = (time.perf_counter() - began) / shots
        late = stream(period_s / RATE_FRACTION)
        return {
            "latency_median_ms": 1e3 * statistics.median(late),
            "latency_p95_ms": 1e3 * statistics.quantiles(late, n=20)[-1],
        }

    return PreparedCase(
        stream,
        lambda: stream(number=1),
        shots,
        floor_fraction=1 / shots,
        figures=measure_latency,
    )


@contextlib.contextmanager
def start_workers(number: int) -> Iterator[str]:
    """Address of a scheduler with workers of one thread each."""
    with LocalCluster(
        n_workers=number,
        threads_per_worker=1,
        dashboard_address="127.0.0.1:0",
        silence_logs=logging.CRITICAL,
        env={"TOFCLIP_THREADS": "1"},
    ) as cluster:
        yield cluster.scheduler_address


def record_shots(folder: Path, number: int) -> Path:
    """Simulate some shots, and link to them under as many names as asked for."""
    streaks, shots = simulate_shots(CLUSTER_ROWS), folder / "shots"
    shots.mkdir()
    for place in range(number):
        path = shots / f"shot{place:04d}.h5"
        if place < len(streaks):
            streaks[place].save(path)
        else:
            os.link(shots / f"shot{place % len(streaks):04d}.h5", path)
    make_instrument(CLUSTER_ROWS).camera.save(folder / "camera.h5")
    return shots


def make_clouds(shots: Path, out: Path, cluster: str | None) -> Summary:
    """Make the clouds of all shots of a folder."""
    jobs = RangingSettings(shots.parent / "camera.h5").jobs(list_shots(shots), out, SUFFIX)
    return run_jobs(jobs, cluster)


def hash_clouds(folder: Path) -> list[str]:
    """Hashes of the clouds, in the order of their shots."""
    return [
        hashlib.sha256(path.read_bytes()).hexdigest() for path in sorted(folder.glob(f"*{SUFFIX}"))
    ]


def prepare_cluster(number: int) -> PreparedCase:
    """Two workers, against half of the time of one."""
    stack = contextlib.ExitStack()
    atexit.register(stack.close)
    folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
    shots, run = record_shots(folder, number), itertools.count()
    one, two = (stack.enter_context(start_workers(count)) for count in (1, 2))

    def judge() -> dict[str, float]:
        make_clouds(shots, folder / "here", None)
        summary = make_clouds(shots, folder / "there", two)
        identical = hash_clouds(folder / "here") == hash_clouds(folder / "there")
        return {
            "clouds as without a cluster": float(identical),
            "worker_peak_mib": summary.peak_bytes / BYTES_PER_MIB,
        }

    return PreparedCase(
        lambda: make_clouds(shots, folder / f"two{next(run)}", two),
        lambda: make_clouds(shots, folder / f"one{next(run)}", one),
        number,
        floor_fraction=2,
        figures=judge,
    )


PREPARE: dict[str, Prepare] = {
    "sequence-latency": partial(prepare_stream, ROWS),
    "sequence-memory": lambda shots: replace(prepare_stream(SMALL_ROWS, shots), figures=dict),
    "sequence-cluster": prepare_cluster,
}
