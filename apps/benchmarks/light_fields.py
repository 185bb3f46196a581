"""Pictures of light fields from few measurements of their true views, the models of the cameras, and a
lensless camera beside another program's, each against the bare products.

What is timed of a recovery is what a user waits for: the choice of the prior's weight is part of it.
"""

from __future__ import annotations

import contextlib
import time
from functools import cache, partial
from typing import Any

import numpy as np
import scipy.fft
import scipy.linalg
from scipy.ndimage import gaussian_filter

from apps.benchmarks.harness import (
    LENSLESS_SCRIPT,
    Action,
    PeerUnavailableError,
    Prepare,
    PreparedCase,
    ask_peer,
)
from tofclip.arrays import AnyArray, Float32Array
from tofclip.light_field import LightField
from tofclip.light_field.views import (
    CameraSetup,
    measure,
)
from tofclip.metrics import nmse
from tofclip.operators import DenseSensor, LinearOperator, PointSpreadConvolution
from tofclip.operators.cameras import CAMERAS, LineCamera
from tofclip.recovery.light_field import ClipRecovery
from tofclip.simulate.light_fields import CameraArray, render_light_field
from tofclip.simulate.scenes import make_scene
from tofclip.solvers import Sparse

SCENE, SHEAR = "letters", -0.4
GIVEN_WEIGHT = 2e-3
PAPER_SIDE_PX, PAPER_FOCAL_LENGTH_PX, PAPER_VIEW_STEP_M = 128, 160.0, 0.0125
VIEW_POSITIONS = np.array([(v, u) for v in range(-4, 4) for u in range(-4, 4)], dtype=np.float64)


@cache
def render_scene(side: int) -> LightField:
    """Letters at three depths in 8 x 8 views, of the paper's field of view."""
    coarseness = PAPER_SIDE_PX / side
    # Views wider apart: the scene's shears, pixels per view step, stay those of the paper's size.
    focal_length_px, step = PAPER_FOCAL_LENGTH_PX / coarseness, PAPER_VIEW_STEP_M * coarseness
    array = CameraArray((side, side), 8, focal_length_px, step, samples=1)
    return render_light_field(make_scene(SCENE, array), array).light_field


def repeat_products(model: LinearOperator, number: int) -> Action:
    """The floor of a recovery: so many products each way."""
    picture = np.ones(model.shape_in, np.float32)

    def products() -> None:
        for _ in range(number):
            model.adjoint(model(picture))

    return products


def prepare_recovery(encoder: str, weight: float | None, side: int) -> PreparedCase:
    """One picture by total variation, at a weight or with its choice, against the last products."""
    light_field = render_scene(side)
    measurement = measure(light_field, CameraSetup(encoder, 0.5, 0))
    method = ClipRecovery(weight=weight)
    found = method.recover(measurement, SHEAR)
    camera = measurement.camera()
    products = repeat_products(camera.weighting() @ camera.model(SHEAR), found.iterations)

    def judge() -> dict[str, float]:
        error = nmse(found.picture, light_field.refocus(SHEAR), side // 10)
        return {"nmse_percent": 100 * error, "weight_search_s": found.seconds_weight}

    return PreparedCase(lambda: method.recover(measurement, SHEAR), products, 1, figures=judge)


LENSLESS_ITERATIONS, NOISE_FRACTION = 60, 1e-3


def prepare_lensless(side: int) -> PreparedCase:
    """A lensless camera's picture; readings and iterations are the peer's."""
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

    @cache
    def ask() -> tuple[float, AnyArray | None]:
        return ask_peer(
            "LenslessPiCam",
            LENSLESS_SCRIPT,
            spread=spread,
            readings=readings.reshape(side, side),
            iterations=LENSLESS_ITERATIONS,
        )

    def compare() -> dict[str, float]:
        errors = {"nmse": compute_scaled_nmse(method.recover(model, readings).frames[0], scene)}
        with contextlib.suppress(PeerUnavailableError):
            _, picture = ask()
            if picture is not None:
                errors["nmse_of_LenslessPiCam"] = compute_scaled_nmse(picture, scene)
        return errors

    return PreparedCase(
        lambda: method.recover(model, readings),
        repeat_products(model, LENSLESS_ITERATIONS),
        1,
        {"LenslessPiCam": lambda: ask()[0]},
        figures=compare,
    )


def compute_scaled_nmse(picture: Float32Array, scene: Float32Array) -> float:
    """Normalised squared error of a picture at its best scale: programs differ in theirs."""
    scale = np.vdot(picture, scene) / np.vdot(picture, picture)
    return nmse(scale * picture, scene)


SAMPLING_RATIO = 0.5
VIEWS = [(float(v), float(u)) for v, u in VIEW_POSITIONS]
PADDING = 1.5  # of a picture whose transforms must not wrap around


def multiply_matrix(side: int) -> Action:
    """One product each way with the line camera's sparse matrix."""
    model: Any = LineCamera((side, side), VIEWS, SAMPLING_RATIO, 0).model(SHEAR)
    matrix = model.matrix
    transpose = matrix.T.tocsr()
    picture, slit = (np.ones(size, np.float32) for size in matrix.shape[::-1])
    return lambda: (matrix @ picture, transpose @ slit)


def multiply_codes(side: int) -> Action:
    """Hadamard products on either side of a picture for each view, both ways."""
    hadamard = scipy.linalg.hadamard(side).astype(np.float32)
    picture = np.ones((side, side), np.float32)
    return lambda: [hadamard @ picture @ hadamard for _ in range(2 * len(VIEWS))]


def transform_picture(side: int) -> Action:
    """A forward and an inverse FFT of a padded square, twice."""
    picture = np.ones((round(PADDING * side),) * 2, np.float32)
    return lambda: [scipy.fft.irfft2(scipy.fft.rfft2(picture), s=picture.shape) for _ in range(2)]


FLOORS = dict.fromkeys(("line", "line-even"), multiply_matrix) | {"single-pixel": multiply_codes}


def prepare_camera(name: str, side: int) -> PreparedCase:
    """A weighted model and its adjoint on one picture; its set-up is timed beside."""

    def make_model() -> LinearOperator:
        camera = CAMERAS[name]((side, side), VIEWS, SAMPLING_RATIO, 0)
        return camera.weighting() @ camera.model(SHEAR)

    model = make_model()
    picture = np.random.default_rng(0).random(model.shape_in).astype(np.float32)
    make_floor = FLOORS.get(name, transform_picture)

    def time_setup() -> dict[str, float]:
        began = time.perf_counter()
        make_model()
        return {"set_up_ms": 1e3 * (time.perf_counter() - began)}

    return PreparedCase(
        lambda: model.adjoint(model(picture)), make_floor(side), 1, figures=time_setup
    )


PREPARE: dict[str, Prepare] = {
    "clip-1d": partial(prepare_recovery, "line", None),
    "clip-0d": partial(prepare_recovery, "single-pixel", None),
    "clip-2d": partial(prepare_recovery, "diffuser", None),
    "clip-given": partial(prepare_recovery, "diffuser", GIVEN_WEIGHT),
    "clip-lensless": prepare_lensless,
    **{f"camera-{name}": partial(prepare_camera, name) for name in CAMERAS},
}
