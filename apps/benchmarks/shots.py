"""Recovery of shots at the size of a real instrument, against the bare products it stands on; ranges
of a recovered shot, and a stream of shots to clouds.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from apps.benchmarks.harness import ASTRA_SCRIPT, Peer, Prepare, PreparedCase, ask_peer
from tofclip.arrays import Float32Array, FloatArray
from tofclip.camera import Camera
from tofclip.lidar import depth
from tofclip.operators import LineProjection
from tofclip.sequences.ranger import RangingPipeline
from tofclip.sequences.streaming import stream_clouds
from tofclip.shots import Frames, Streak
from tofclip.simulate import (
    Instrument,
    make_default_instrument,
    make_default_scene,
    render_true_frames,
    simulate_shot,
)
from tofclip.solvers import (
    Backprojection,
    LinearInverse,
    Method,
    ProximalMethod,
    Sparse,
    TotalVariation,
)
from tofclip.threads import LANES, limit_blas_threads, run_blocks

ITERATIONS = 30
ANGLES_RAD: FloatArray = np.radians(np.array([-44.0, -26.0, -12.5, 0.8, 22.0, 37.5, 48.0]))
CENTRES_PX: FloatArray = np.array([168.0 + 172.5 * view for view in range(7)])
SLIT_WIDTH_PX = 1344
SIDE_PX = 174
DENSE_BLOCK_ROWS = 336  # of the dense matrix, which are read from memory once for all frames


def make_operator(side: int = SIDE_PX) -> LineProjection:
    """The paper's instrument: 7 views on 1344 slit pixels."""
    return Camera(CENTRES_PX, ANGLES_RAD, (side, side), SLIT_WIDTH_PX).operator()


def measurements(frames: int) -> Float32Array:
    """Positive measurements with noise, (1344, frames); what they show does not change the work."""
    return np.abs(np.random.default_rng(0).standard_normal((SLIT_WIDTH_PX, frames))).astype(
        np.float32
    )


def run_products(projection: LineProjection, data: Float32Array) -> None:
    """Multiply each way on every frame as often as a method iterates, nothing else."""

    def work(piece: slice) -> None:
        block = np.ones((*projection.shape_in, LANES), np.float32)
        for _ in range(ITERATIONS):
            block = projection.adjoint(projection(block))
            # so that the values neither overflow nor become subnormal, which would be slow
            block *= np.float32(1e-3)

    run_blocks(work, data.shape[1])


def run_adjoints(projection: LineProjection, data: Float32Array) -> None:
    """One product with the transpose for every frame of `data` (measurements, frames)."""
    block = np.ascontiguousarray(data[:, :LANES])

    def work(_: slice) -> None:
        projection.adjoint(block)

    run_blocks(work, data.shape[1])


def run_dense_products(projection: LineProjection, data: Float32Array) -> None:
    """A product with a dense matrix and one with the sparse transpose for every frame of `data`."""
    matrix = np.eye(SLIT_WIDTH_PX, dtype=np.float32)
    weights = np.empty_like(data)

    def multiply(piece: slice) -> None:
        np.matmul(matrix[piece], data, out=weights[piece])

    def project(piece: slice) -> None:
        projection.adjoint(np.ascontiguousarray(weights[:, piece]))

    with limit_blas_threads():
        run_blocks(multiply, SLIT_WIDTH_PX, DENSE_BLOCK_ROWS)
    run_blocks(project, data.shape[1])


def prepare_method(method: Method, projection: LineProjection) -> Callable[[Any], Any]:
    """What recovers measurements by a method; the linear inverse is prepared."""
    if isinstance(method, LinearInverse):
        return method.prepare(projection).recover
    return partial(method.recover, projection)


def prepare_recovery(
    method: Method, floor: Callable[[LineProjection, Float32Array], None], frames: int
) -> PreparedCase:
    """A method beside the products that it needs."""
    projection, data = make_operator(), measurements(frames)
    recover = prepare_method(method, projection)
    return PreparedCase(lambda: recover(data), lambda: floor(projection, data), frames)


def prepare_projection(side: int) -> PreparedCase:
    """One picture onto the slit."""
    model, picture = make_operator(side), np.random.default_rng(1).random((side, side), np.float32)
    matrix, flat = model.matrix, picture.ravel()
    peers: dict[str, Peer] = {
        "scikit-image radon": partial(time_radon, picture),
        "ASTRA": lambda: ask_peer("ASTRA", ASTRA_SCRIPT, picture=picture, angles=ANGLES_RAD)[0],
    }
    return PreparedCase(lambda: model(picture), lambda: matrix @ flat, 1, peers)


def time_radon(picture: Float32Array) -> float:
    """Seconds of scikit-image's projections of the picture at the seven angles."""
    from skimage.transform import radon

    radon(picture, np.rad2deg(ANGLES_RAD), circle=False)
    began = time.perf_counter()
    radon(picture, np.rad2deg(ANGLES_RAD), circle=False)
    return time.perf_counter() - began


STREAM_SHOTS = 8
PACE_SHOTS_PER_S, PACED_SHOTS = 60, 48  # at which, and for how many, a live view's lag is measured


def make_instrument(rows: int) -> Instrument:
    """The demo's instrument with another number of time bins."""
    made = make_default_instrument()
    return replace(made, detector=replace(made.detector, rows=rows))


def render_frames(rows: int) -> Frames:
    """The demo's scene without noise."""
    return render_true_frames(make_default_scene(), make_instrument(rows), 1e4)


def prepare_ranges(rows: int) -> PreparedCase:
    """Every return of every pixel; reading the frames once is the floor."""
    frames = render_frames(rows)
    target = np.empty_like(frames.values)

    def copy() -> None:
        run_blocks(lambda piece: np.copyto(target[piece], frames.values[piece]), rows)

    return PreparedCase(lambda: depth(frames), copy, frames.values[0].size)


def bring_shots(streaks: list[Streak], shots: int, period_s: float) -> Iterator[Streak]:
    """Bring a shot every `period_s` seconds, the given ones in turn."""
    began = time.perf_counter()
    for number in range(shots):
        time.sleep(max(0.0, began + number * period_s - time.perf_counter()))
        yield streaks[number % len(streaks)]


def prepare_streaming(rows: int, method: LinearInverse | ProximalMethod) -> PreparedCase:
    """Shots that were read already, one after the other: sweep, recovery, returns, clouds. A method
    with a prior begins each shot at the last one's pictures; its first shot is not counted.
    """
    scene, made = make_default_scene(), make_instrument(rows)
    streaks = [simulate_shot(scene, made, seed).streak for seed in range(3)]
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


PREPARE: dict[str, Prepare] = {
    "recovery-l1": partial(prepare_recovery, Sparse(iterations=ITERATIONS), run_products),
    "recovery-tv": partial(prepare_recovery, TotalVariation(iterations=ITERATIONS), run_products),
    "recovery-linear": partial(prepare_recovery, LinearInverse(), run_dense_products),
    "recovery-adjoint": partial(prepare_recovery, Backprojection(), run_adjoints),
    "recovery-projection": prepare_projection,
    "depth-returns": prepare_ranges,
    "streaming-cloud": partial(prepare_streaming, method=LinearInverse()),
    "streaming-l1": partial(prepare_streaming, method=Sparse()),
}
