"""Ranges of a recovered shot, and a stream of shots to clouds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from apps.benchmarks.case import Case, Prepared
from apps.benchmarks.recovery import dense_products, operator, readings
from tofclip.lidar import depth
from tofclip.sequences.ranger import Ranger
from tofclip.sequences.streaming import stream_clouds
from tofclip.simulate import default_instrument, default_scene, simulate, true_frames
from tofclip.simulate.instrument import Instrument
from tofclip.threads import run_blocks

ROWS = (254, 1016)
STREAMED = 8


def instrument(rows: int) -> Instrument:
    """The demo's instrument with another number of time bins."""
    made = default_instrument()
    return replace(made, detector=replace(made.detector, rows=rows))


def ranges(rows: int) -> Prepared:
    """Every return of every pixel; reading the frames once is the floor."""
    frames = true_frames(default_scene(), instrument(rows), 1e4)
    target = np.empty_like(frames.values)

    def copy() -> None:
        run_blocks(lambda piece: np.copyto(target[piece], frames.values[piece]), rows)

    return Prepared(lambda: depth(frames), copy, frames.values[0].size)


def streaming(rows: int) -> Prepared:
    """Shots that were read already, one after the other: sweep, linear inverse, returns, clouds."""
    made = instrument(rows)
    streaks = [simulate(default_scene(), made, seed).streak for seed in range(3)]
    ranger = Ranger(made.camera, streaks[0].times)
    shots = [streaks[number % len(streaks)] for number in range(STREAMED)]
    projection, data = made.camera.operator(), readings(rows)[: made.camera.slit_width_px]
    if data.shape[0] != operator().shape_out[0]:
        raise RuntimeError("the demo's instrument has another slit than the benchmark's")
    return Prepared(
        lambda: list(stream_clouds(shots, ranger)),
        lambda: dense_products(projection, data),
        STREAMED,
        floor_share=1 / STREAMED,
    )


CASES = (
    Case(
        "depth-returns",
        "returns and ranges of every pixel",
        "time bins",
        ROWS,
        "pixels",
        "a copy of the frames",
        ranges,
    ),
    Case(
        "streaming-cloud",
        f"a stream of {STREAMED} shots to their clouds",
        "time bins",
        ROWS,
        "shots",
        "a dense and a sparse product of all rows alone",
        streaming,
    ),
)
