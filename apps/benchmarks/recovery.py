"""Recovery of shots at the size of a real instrument, against the bare products it stands on."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apps.benchmarks.case import Case, Prepared
from apps.benchmarks.peers import astra_seconds
from tofclip.camera import Camera
from tofclip.operators import LineProjection
from tofclip.solvers import Adjoint, LinearInverse, Method, Sparse, TotalVariation
from tofclip.solvers.direct import DENSE_ROWS
from tofclip.threads import LANES, one_blas_thread, run_blocks

ITERATIONS = 30
FRAMES = (256, 1016)
ANGLES: NDArray[np.float64] = np.radians(np.array([-44.0, -26.0, -12.5, 0.8, 22.0, 37.5, 48.0]))
CENTRES: NDArray[np.float64] = np.array([168.0 + 172.5 * view for view in range(7)])
SLIT_WIDTH = 1344
PICTURES = (87, 174)


def operator(side: int = PICTURES[-1]) -> LineProjection:
    """The paper's instrument: 7 views on 1344 slit pixels."""
    return Camera(CENTRES, ANGLES, (side, side), SLIT_WIDTH).operator()


def readings(frames: int) -> NDArray[np.float32]:
    """Positive readings with noise, (1344, frames); what they show does not change the work."""
    return np.abs(np.random.default_rng(0).standard_normal((SLIT_WIDTH, frames))).astype(np.float32)


def products(projection: LineProjection, frames: int, iterations: int) -> None:
    """So many products each way on every frame, in blocks on all threads, nothing else."""

    def work(piece: slice) -> None:
        block = np.ones((*projection.shape_in, LANES), np.float32)
        for _ in range(iterations):
            block = projection.adjoint(projection(block))
            block *= np.float32(1e-3)

    run_blocks(work, frames)


def adjoints(projection: LineProjection, data: NDArray[np.float32]) -> None:
    """One product with the transpose for every frame."""
    block = np.ascontiguousarray(data[:, :LANES])

    def work(_: slice) -> None:
        projection.adjoint(block)

    run_blocks(work, data.shape[1])


def dense_products(projection: LineProjection, data: NDArray[np.float32]) -> None:
    """A product with a dense matrix and one with the sparse transpose for every frame."""
    matrix = np.eye(SLIT_WIDTH, dtype=np.float32)
    weights = np.empty_like(data)

    def multiply(piece: slice) -> None:
        np.matmul(matrix[piece], data, out=weights[piece])

    def project(piece: slice) -> None:
        projection.adjoint(np.ascontiguousarray(weights[:, piece]))

    with one_blas_thread():
        run_blocks(multiply, SLIT_WIDTH, DENSE_ROWS)
    run_blocks(project, data.shape[1])


def iterative(method: Method, frames: int) -> Prepared:
    """A method that multiplies again and again."""
    projection, data = operator(), readings(frames)
    return Prepared(lambda: method.recover(projection, data), lambda: products(projection, frames, ITERATIONS), frames)


def linear(frames: int) -> Prepared:
    """The linear inverse, prepared."""
    projection, data = operator(), readings(frames)
    inverse = LinearInverse().prepare(projection)
    return Prepared(lambda: inverse.recover(data), lambda: dense_products(projection, data), frames)


def adjoint(frames: int) -> Prepared:
    """The adjoint, scaled."""
    projection, data = operator(), readings(frames)
    return Prepared(lambda: Adjoint().recover(projection, data), lambda: adjoints(projection, data), frames)


def projection(side: int) -> Prepared:
    """One picture onto the slit."""
    model, picture = operator(side), np.random.default_rng(1).random((side, side), np.float32)
    matrix, flat = model.matrix, picture.ravel()
    peers = {"scikit-image radon": partial(radon_seconds, picture), "ASTRA": partial(astra_seconds, picture, ANGLES)}
    return Prepared(lambda: model(picture), lambda: matrix @ flat, 1, peers)


def radon_seconds(picture: NDArray[np.float32]) -> float:
    """Seconds of scikit-image's projections of the picture at the seven angles."""
    from skimage import transform

    radon: Any = transform.radon  # it has no types
    radon(picture, np.rad2deg(ANGLES), circle=False)
    began = time.perf_counter()
    radon(picture, np.rad2deg(ANGLES), circle=False)
    return time.perf_counter() - began


def _frames_case(name: str, title: str, floor: str, prepare: Callable[[int], Prepared]) -> Case:
    return Case(f"recovery-{name}", title, "frames", FRAMES, "frames", floor, prepare)


SAME_PRODUCTS = f"the {2 * ITERATIONS} sparse products alone"

CASES = (
    _frames_case(
        "l1", f"l1, {ITERATIONS} iterations", SAME_PRODUCTS, partial(iterative, Sparse(iterations=ITERATIONS))
    ),
    _frames_case(
        "tv",
        f"total variation, {ITERATIONS} iterations",
        SAME_PRODUCTS,
        partial(iterative, TotalVariation(iterations=ITERATIONS)),
    ),
    _frames_case("linear", "linear inverse, prepared", "a dense and a sparse product alone", linear),
    _frames_case("adjoint", "adjoint", "one sparse product alone", adjoint),
    Case(
        "recovery-projection",
        "one picture onto the slit, 7 views",
        "pixels a side",
        PICTURES,
        "pictures",
        "scipy's product with the same sparse matrix",
        projection,
    ),
)
