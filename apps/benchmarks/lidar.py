"""Ranges of a recovered shot, and shots to clouds one after the other."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from apps.benchmarks.case import Case, Prepared
from apps.benchmarks.recovery import dense_products, operator, readings
from tofclip.lidar import depth
from tofclip.lidar.sequence import Jitter, Ranger, averaged, light_over_time
from tofclip.simulate import default_instrument, default_scene, simulate, true_frames
from tofclip.simulate.instrument import Instrument
from tofclip.threads import run_blocks

ROWS = (254, 1016)


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
    """A shot that was read already: time of arrival, sweep, linear inverse, returns, cloud."""
    made = instrument(rows)
    streak = simulate(default_scene(), made, 0).streak
    ranger = Ranger(made.camera, streak.times)
    jitter = Jitter(light_over_time(streak, made.camera))
    projection, data = made.camera.operator(), readings(rows)[: made.camera.slit_width_px]
    if data.shape[0] != operator().shape_out[0]:
        raise RuntimeError("the demo's instrument has another slit than the benchmark's")
    return Prepared(lambda: averaged([lambda: streak], ranger, jitter), lambda: dense_products(projection, data), 1)


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
        "a shot to its cloud",
        "time bins",
        ROWS,
        "shots",
        "a dense and a sparse product alone",
        streaming,
    ),
)
