"""How many shots of 1016 rows become clouds in a second, and how much memory that takes.

Run with ``python tests/benchmarks/sequence.py [--shots N] [--iterative] [--json]``. The shots are
three simulated ones over and over, 128 x 128 pixels behind 1344 slit pixels, read from memory; each
becomes a cloud by the linear inverse. Peak memory is that of the process before the iterative path;
to see that it stays, compare ``--shots 20`` with ``--shots 200``. Processor time counts all
threads, so that a busy machine changes it little. ``--iterative`` times one shot by total variation
as well.
"""

from __future__ import annotations

import argparse
import json
import resource
import time
from dataclasses import replace
from functools import partial

from tofclip.lidar import depth, point_cloud
from tofclip.recovery import recover
from tofclip.sequences.ranger import RangingPipeline, make_clouds
from tofclip.shots import Streak
from tofclip.simulate import make_default_instrument, make_default_scene, simulate_shot
from tofclip.threads import thread_count

ROW = 10


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--shots", type=int, default=20)
    parser.add_argument("--iterative", action="store_true")
    parser.add_argument("--json", action="store_true")
    asked = parser.parse_args()
    instrument = make_default_instrument()
    instrument = replace(instrument, detector=replace(instrument.detector, rows=1016))
    streaks = [simulate_shot(make_default_scene(), instrument, seed).streak for seed in range(3)]
    pipeline = RangingPipeline(instrument.camera, streaks[0].times)
    shots = [partial(_one, streaks, number) for number in range(asked.shots)]
    next(make_clouds(shots[:1], pipeline))  # loads the compiled loops
    began, busy = time.perf_counter(), time.process_time()
    finished = [began, *(time.perf_counter() for _ in make_clouds(shots, pipeline))]
    # Clouds come in bursts, one of each core: some of them in a row tell the rate.
    rates = [ROW / (late - early) for early, late in zip(finished, finished[ROW:], strict=False)]
    figures = {
        "shots": asked.shots,
        "threads": thread_count(),
        "shots_per_second": asked.shots / (finished[-1] - began),
        "shots_per_second_best": max(rates, default=float("nan")),
        "processor_ms_per_shot": 1e3 * (time.process_time() - busy) / asked.shots,
        "peak_memory_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
    }
    if asked.iterative:
        began = time.perf_counter()
        point_cloud(depth(recover(streaks[0], method="tv")))
        figures["tv_seconds_per_shot"] = time.perf_counter() - began
    print(
        json.dumps(figures)
        if asked.json
        else "\n".join(f"{name:22} {value:g}" for name, value in figures.items())
    )


def _one(streaks: list[Streak], number: int) -> Streak:
    return streaks[number % len(streaks)]


if __name__ == "__main__":
    main()
