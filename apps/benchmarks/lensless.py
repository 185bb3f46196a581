"""A lensless camera's picture beside another program's: the same measurements, point-spread function and
number of iterations, and the errors of both.
"""

from __future__ import annotations

import contextlib

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from apps.benchmarks.harness import Case, LenslessPeer, PeerUnavailableError, PreparedCase
from tofclip.metrics import nmse
from tofclip.operators import DenseSensor, PointSpreadConvolution
from tofclip.solvers import Sparse

SIDES_PX = (64, 128)
LENSLESS_ITERATIONS, NOISE_FRACTION = 60, 1e-3


def prepare_lensless(side: int) -> PreparedCase:
    """A lensless camera's picture by nonnegative least squares: the same measurements, point-spread
    function and number of iterations as the peer's.

    `side`: pixels of the sensor and of the picture, which is dark in its outer half.
    """
    random = np.random.default_rng(0)
    speckle = np.maximum(gaussian_filter(random.standard_normal((side, side)), 1.0), 0) ** 3
    spread = (speckle / speckle.sum()).astype(np.float32)
    scene = np.zeros((side, side), np.float32)
    patch = side // 16
    middle = slice(side // 2 - 4 * patch, side // 2 + 4 * patch)
    scene[middle, middle] = np.kron(random.random((8, 8)), np.ones((patch, patch)))
    model = DenseSensor((side, side)) @ PointSpreadConvolution((side, side), spread)
    light = model(scene)
    noise = random.normal(0, NOISE_FRACTION * light.max(), light.shape)
    readings = (light + noise).astype(np.float32)[:, np.newaxis]
    method = Sparse(0.0, LENSLESS_ITERATIONS, gap=0.0)
    peer = LenslessPeer(spread, readings.reshape(side, side), LENSLESS_ITERATIONS)

    def products() -> None:
        for _ in range(LENSLESS_ITERATIONS):
            model.adjoint(model(scene))

    def compare() -> dict[str, float]:
        found = {"nmse": compute_scaled_nmse(method.recover(model, readings).frames[0], scene)}
        with contextlib.suppress(PeerUnavailableError):
            peer()
        if peer.picture is not None:
            found["nmse_of_LenslessPiCam"] = compute_scaled_nmse(peer.picture, scene)
        return found

    return PreparedCase(
        lambda: method.recover(model, readings),
        products,
        1,
        {"LenslessPiCam": peer},
        figures=compare,
    )


def compute_scaled_nmse(picture: NDArray[np.float32], scene: NDArray[np.float32]) -> float:
    """Normalised squared error of a picture at its best scale: programs differ in theirs."""
    scale = float(np.vdot(picture, scene)) / float(np.vdot(picture, picture))
    return nmse(scale * picture, scene)


CASES = (
    Case(
        "clip-lensless",
        f"lensless camera, {LENSLESS_ITERATIONS} iterations of nonnegative least squares; the peer's are the same",
        "pixels a side",
        SIDES_PX,
        "pictures",
        "the products of its iterations alone",
        prepare_lensless,
    ),
)
