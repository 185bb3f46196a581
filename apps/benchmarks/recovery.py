"""Recovery of shots at the size of a real instrument, against the bare products it stands on."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apps.benchmarks.harness import Case, PreparedCase, time_astra
from tofclip.camera import Camera
from tofclip.operators import LineProjection
from tofclip.solvers import Backprojection, LinearInverse, Method, Sparse, TotalVariation
from tofclip.threads import LANES, limit_blas_threads, run_blocks

ITERATIONS = 30
FRAME_COUNTS = (256, 1016)
ANGLES_RAD: NDArray[np.float64] = np.radians(np.array([-44.0, -26.0, -12.5, 0.8, 22.0, 37.5, 48.0]))
CENTRES_PX: NDArray[np.float64] = np.array([168.0 + 172.5 * view for view in range(7)])
SLIT_WIDTH_PX = 1344
PICTURE_SIDES_PX = (87, 174)
DENSE_BLOCK_ROWS = 336  # of the dense matrix, which are read from memory once for all frames


def make_operator(side: int = PICTURE_SIDES_PX[-1]) -> LineProjection:
    """The paper's instrument: 7 views on 1344 slit pixels."""
    return Camera(CENTRES_PX, ANGLES_RAD, (side, side), SLIT_WIDTH_PX).operator()


def measurements(frames: int) -> NDArray[np.float32]:
    """Positive measurements with noise, (1344, frames); what they show does not change the work."""
    return np.abs(np.random.default_rng(0).standard_normal((SLIT_WIDTH_PX, frames))).astype(
        np.float32
    )


def run_products(projection: LineProjection, frames: int, iterations: int) -> None:
    """Multiply `iterations` times each way on every frame, in blocks on all threads, nothing else."""

    def work(piece: slice) -> None:
        block = np.ones((*projection.shape_in, LANES), np.float32)
        for _ in range(iterations):
            block = projection.adjoint(projection(block))
            # so that the values neither overflow nor become subnormal, which would be slow
            block *= np.float32(1e-3)

    run_blocks(work, frames)


def run_adjoints(projection: LineProjection, data: NDArray[np.float32]) -> None:
    """One product with the transpose for every frame.

    `data` (measurements, frames).
    """
    block = np.ascontiguousarray(data[:, :LANES])

    def work(_: slice) -> None:
        projection.adjoint(block)

    run_blocks(work, data.shape[1])


def run_dense_products(projection: LineProjection, data: NDArray[np.float32]) -> None:
    """A product with a dense matrix and one with the sparse transpose for every frame.

    `data` (measurements, frames).
    """
    matrix = np.eye(SLIT_WIDTH_PX, dtype=np.float32)
    weights = np.empty_like(data)

    def multiply(piece: slice) -> None:
        np.matmul(matrix[piece], data, out=weights[piece])

    def project(piece: slice) -> None:
        projection.adjoint(np.ascontiguousarray(weights[:, piece]))

    with limit_blas_threads():
        run_blocks(multiply, SLIT_WIDTH_PX, DENSE_BLOCK_ROWS)
    run_blocks(project, data.shape[1])


def prepare_iterative(method: Method, frames: int) -> PreparedCase:
    """A method that multiplies again and again."""
    projection, data = make_operator(), measurements(frames)
    return PreparedCase(
        lambda: method.recover(projection, data),
        lambda: run_products(projection, frames, ITERATIONS),
        frames,
    )


def prepare_linear(frames: int) -> PreparedCase:
    """The linear inverse, prepared."""
    projection, data = make_operator(), measurements(frames)
    inverse = LinearInverse().prepare(projection)
    return PreparedCase(
        lambda: inverse.recover(data), lambda: run_dense_products(projection, data), frames
    )


def prepare_adjoint(frames: int) -> PreparedCase:
    """The adjoint, scaled."""
    projection, data = make_operator(), measurements(frames)
    return PreparedCase(
        lambda: Backprojection().recover(projection, data),
        lambda: run_adjoints(projection, data),
        frames,
    )


def prepare_projection(side: int) -> PreparedCase:
    """One picture onto the slit."""
    model, picture = make_operator(side), np.random.default_rng(1).random((side, side), np.float32)
    matrix, flat = model.matrix, picture.ravel()
    peers = {
        "scikit-image radon": partial(time_radon, picture),
        "ASTRA": partial(time_astra, picture, ANGLES_RAD),
    }
    return PreparedCase(lambda: model(picture), lambda: matrix @ flat, 1, peers)


def time_radon(picture: NDArray[np.float32]) -> float:
    """Seconds of scikit-image's projections of the picture at the seven angles."""
    from skimage import transform

    radon: Any = transform.radon  # it has no types
    radon(picture, np.rad2deg(ANGLES_RAD), circle=False)
    began = time.perf_counter()
    radon(picture, np.rad2deg(ANGLES_RAD), circle=False)
    return time.perf_counter() - began


def _make_frames_case(
    name: str, title: str, floor: str, prepare: Callable[[int], PreparedCase]
) -> Case:
    return Case(f"recovery-{name}", title, "frames", FRAME_COUNTS, "frames", floor, prepare)


SPARSE_FLOOR_TEXT = f"the {2 * ITERATIONS} sparse products alone"

CASES = (
    _make_frames_case(
        "l1",
        f"l1, {ITERATIONS} iterations",
        SPARSE_FLOOR_TEXT,
        partial(prepare_iterative, Sparse(iterations=ITERATIONS)),
    ),
    _make_frames_case(
        "tv",
        f"total variation, {ITERATIONS} iterations",
        SPARSE_FLOOR_TEXT,
        partial(prepare_iterative, TotalVariation(iterations=ITERATIONS)),
    ),
    _make_frames_case(
        "linear", "linear inverse, prepared", "a dense and a sparse product alone", prepare_linear
    ),
    _make_frames_case("adjoint", "adjoint", "one sparse product alone", prepare_adjoint),
    Case(
        "recovery-projection",
        "one picture onto the slit, 7 views",
        "pixels a side",
        PICTURE_SIDES_PX,
        "pictures",
        "scipy's product with the same sparse matrix",
        prepare_projection,
    ),
)
