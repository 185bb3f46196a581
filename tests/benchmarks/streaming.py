"""How many shots a second a stream turns into clouds, how late each cloud is, and whether memory
stays flat.

Run with ``python tests/benchmarks/streaming.py [--shots N] [--flat N] [--json]``. The shots are
three simulated ones of 1016 rows over and over, 128 x 128 pixels behind 1344 slit pixels, brought
from memory at first as fast as they are taken, which tells the rate, and then at three quarters of
it, as an instrument would, which tells the latency. `--flat` streams so many small shots and
compares peak memory after a tenth of them and at the end.
"""

from __future__ import annotations

import argparse
import json
import resource
import statistics
import time
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

from tofclip.sequences.ranger import RangingPipeline
from tofclip.sequences.streaming import stream_clouds
from tofclip.shots import Streak
from tofclip.simulate import make_default_instrument, make_default_scene, simulate_shot
from tofclip.threads import thread_count

SHARE_OF_RATE = 0.75
SMALL_ROWS = 96


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--shots", type=int, default=60)
    parser.add_argument("--flat", type=int, default=0, help="small shots whose memory is watched")
    parser.add_argument("--json", action="store_true")
    asked = parser.parse_args()
    figures: dict[str, Any] = {
        "shots": asked.shots,
        "threads": thread_count(),
        **timed(asked.shots),
    }
    if asked.flat:
        figures |= memory(asked.flat)
    print(
        json.dumps(figures)
        if asked.json
        else "\n".join(f"{name:24} {value:g}" for name, value in figures.items())
    )


def timed(shots: int) -> dict[str, float]:
    """Stream shots of full size, without pause and paced."""
    streaks = simulated(1016)
    pipeline = RangingPipeline.for_shot(streaks[0])
    list(stream_clouds(streaks, pipeline))  # loads the compiled loops
    began = time.perf_counter()
    stages: dict[str, list[float]] = {}
    for one in stream_clouds(paced(streaks, shots, 0.0), pipeline):
        for name, seconds in one.seconds.items():
            stages.setdefault(name, []).append(seconds)
    rate = shots / (time.perf_counter() - began)
    late = [
        one.latency
        for one in stream_clouds(paced(streaks, shots, 1 / (SHARE_OF_RATE * rate)), pipeline)
    ]
    medians = {f"{name}_ms": 1e3 * statistics.median(seconds) for name, seconds in stages.items()}
    quantiles = statistics.quantiles(late, n=20)
    return {
        "shots_per_second": rate,
        "latency_median_ms": 1e3 * statistics.median(late),
        "latency_p95_ms": 1e3 * quantiles[-1],
        **medians,
    }


def memory(shots: int) -> dict[str, float]:
    """Peak memory of the process after a tenth of the shots and after all."""
    streaks = simulated(SMALL_ROWS)
    stream = stream_clouds(paced(streaks, shots, 0.0), RangingPipeline.for_shot(streaks[0]))
    early = 0.0
    for one in stream:
        if one.shot == shots // 10:
            early = peak_mib()
    return {"flat_shots": shots, "peak_mib_at_a_tenth": early, "peak_mib_at_the_end": peak_mib()}


def simulated(rows: int) -> list[Streak]:
    """Three shots that differ in their noise."""
    instrument = make_default_instrument()
    detector = replace(
        instrument.detector,
        rows=rows,
        bin_width=instrument.detector.bin_width * 576 / min(rows, 576),
    )
    return [
        simulate_shot(make_default_scene(), replace(instrument, detector=detector), seed).streak
        for seed in range(3)
    ]


def paced(streaks: list[Streak], shots: int, period: float) -> Iterator[Streak]:
    """Bring a shot every `period` seconds."""
    began = time.perf_counter()
    for number in range(shots):
        time.sleep(max(0.0, began + number * period - time.perf_counter()))
        yield streaks[number % len(streaks)]


def peak_mib() -> float:
    """Peak memory of this process."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


if __name__ == "__main__":
    main()
