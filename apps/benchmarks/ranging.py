"""Ranges of a recovered shot, and a stream of shots to clouds."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache

import numpy as np

from apps.benchmarks.harness import Case, PreparedCase
from apps.benchmarks.recovery import make_operator, measurements, run_dense_products
from tofclip.lidar import depth
from tofclip.sequences.ranger import RangingPipeline
from tofclip.sequences.streaming import stream_clouds
from tofclip.shots import Streak
from tofclip.simulate import (
    Instrument,
    make_default_instrument,
    make_default_scene,
    render_true_frames,
    simulate_shot,
)
from tofclip.solvers import LinearInverse, ProximalMethod, Sparse
from tofclip.threads import run_blocks

ROWS = (254, 1016)
STREAM_SHOTS = 8
PACE_SHOTS_PER_S, PACED_SHOTS = 60, 48
"""Pace at which the latency of a live view is measured, and for how many shots."""


def make_instrument(rows: int) -> Instrument:
    """The demo's instrument with another number of time bins."""
    made = make_default_instrument()
    return replace(made, detector=replace(made.detector, rows=rows))


def prepare_ranges(rows: int) -> PreparedCase:
    """Every return of every pixel; reading the frames once is the floor."""
    frames = render_true_frames(make_default_scene(), make_instrument(rows), 1e4)
    target = np.empty_like(frames.values)

    def copy() -> None:
        run_blocks(lambda piece: np.copyto(target[piece], frames.values[piece]), rows)

    return PreparedCase(lambda: depth(frames), copy, frames.values[0].size)


@lru_cache(maxsize=1)
def simulate_shots(rows: int) -> list[Streak]:
    """Three shots of the demo's scene that differ in their noise."""
    scene, made = make_default_scene(), make_instrument(rows)
    return [simulate_shot(scene, made, seed).streak for seed in range(3)]


def bring_shots(streaks: list[Streak], shots: int, period_s: float) -> Iterator[Streak]:
    """Bring a shot every `period_s` seconds.

    `streaks`: used in turn.
    """
    began = time.perf_counter()
    for number in range(shots):
        time.sleep(max(0.0, began + number * period_s - time.perf_counter()))
        yield streaks[number % len(streaks)]


def prepare_streaming(rows: int, method: LinearInverse | ProximalMethod) -> PreparedCase:
    """Shots that were read already, one after the other: sweep, recovery, returns, clouds.

    `method`: one with a prior begins each shot at the last one's pictures; its first shot is not
    counted.
    """
    made = make_instrument(rows)
    streaks = simulate_shots(rows)
    pipeline = RangingPipeline(made.camera, streaks[0].times, method)
    shots = [streaks[number % len(streaks)] for number in range(STREAM_SHOTS)]
    projection, data = made.camera.operator(), measurements(rows)[: made.camera.slit_width_px]
    if data.shape[0] != make_operator().shape_out[0]:
        raise RuntimeError("the demo's instrument has another slit than the benchmark's")
    if pipeline.in_order:
        list(stream_clouds(shots[:1], pipeline))

    def measure_latency() -> dict[str, float]:
        coming = bring_shots(streaks, PACED_SHOTS, 1 / PACE_SHOTS_PER_S)
        late = [one.latency for one in stream_clouds(coming, pipeline, policy="drop_oldest")]
        return {
            f"latency_p95_ms at {PACE_SHOTS_PER_S} shots/s": 1e3 * float(np.percentile(late, 95)),
            "clouds_per_shot there": len(late) / PACED_SHOTS,
        }

    return PreparedCase(
        lambda: list(stream_clouds(shots, pipeline)),
        lambda: run_dense_products(projection, data),
        STREAM_SHOTS,
        floor_fraction=1 / STREAM_SHOTS,
        figures=measure_latency,
    )


CASES = (
    Case(
        "depth-returns",
        "returns and ranges of every pixel",
        "time bins",
        ROWS,
        "pixels",
        "a copy of the frames",
        prepare_ranges,
    ),
    Case(
        "streaming-cloud",
        f"a stream of {STREAM_SHOTS} shots to their clouds",
        "time bins",
        ROWS,
        "shots",
        "a dense and a sparse product of all rows alone",
        lambda rows: prepare_streaming(rows, LinearInverse()),
    ),
    Case(
        "streaming-l1",
        f"a stream of {STREAM_SHOTS} shots to clouds by l1, each begun at the last one's pictures",
        "time bins",
        ROWS,
        "shots",
        "a dense and a sparse product of all rows alone",
        lambda rows: prepare_streaming(rows, Sparse()),
    ),
)
