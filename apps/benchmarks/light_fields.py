"""Pictures of light fields from few measurements of their true views, the models of the cameras, and a
lensless camera beside another program's, each against the bare products.

What is timed of a recovery is what a user waits for: the choice of the prior's weight is part of it.
The quality cases recover recorded and rendered light fields, which `TOFCLIP_DATA` names, as a user
would, without the truth: NMSE in per cent of shift-and-add of the true views, mean and spread over
seeds of the angles or codes. Their limits are what total variation with the best weight reached.
"""

from __future__ import annotations

import contextlib
import os
import time
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
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
from tofclip.errors import InputError
from tofclip.io.light_fields import read_light_field
from tofclip.light_field import LightField
from tofclip.light_field.views import (
    CameraSetup,
    ClipMeasurement,
    corrupt_measurement,
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


BORDER_PX = 12
SEEDS = 5


LETTERS = "render_letters", -0.3
# Light field, shear, encoder, preset, and the NMSE in per cent that must not be exceeded, by the sampling
# ratio in per cent; behind the last dash of a name: measurements in per cent that are wildly wrong.
QUALITY: dict[str, tuple[str, float, str, str, dict[int, float]]] = {
    "letters-line-fast": (*LETTERS, "line", "fast", {25: 17.0, 50: 8.5, 100: 4.5, 200: 3.0}),
    "letters-line-quality": (*LETTERS, "line", "quality", {25: 10.0, 50: 4.5, 100: 3.0, 200: 2.0}),
    "letters-single-pixel-fast": (*LETTERS, "single-pixel", "fast", {25: 7.6, 50: 4.3, 100: 2.6}),
    "letters-single-pixel-quality": (
        *(*LETTERS, "single-pixel", "quality"),
        {25: 5.5, 50: 3.0, 100: 1.8},
    ),
    **{
        f"letters-line-{preset}-{percent}%": (*LETTERS, "line", preset, {100: 5.5})
        for preset in ("fast", "quality")
        for percent in (1, 5, 10)
    },
    "planes-line-fast": (
        *("render_planes", 0.0, "line", "fast"),
        {25: 10.8, 50: 6.9, 100: 4.1, 200: 2.6},
    ),
    "antinous-line-fast": (
        *("hci_antinous", 0.0, "line", "fast"),
        {25: 2.1, 50: 1.2, 100: 0.7, 200: 0.5},
    ),
}


def prepare_quality(name: str, ratio_percent: int) -> PreparedCase:
    """A recovery with the weight that the search found, against the products it needs."""
    source, shear, encoder, preset, limits = QUALITY[name]
    wrong = int(name.rpartition("-")[2][:-1]) / 100 if name.endswith("%") else 0.0
    path = Path(os.environ.get("TOFCLIP_DATA", ""), "lightfields", f"{source}.npz")
    if not path.is_file():
        raise InputError(f"{path} is missing: TOFCLIP_DATA names the folder of recorded data")
    light_field = read_light_field(path)
    truth = light_field.refocus(shear)
    settings = ClipRecovery(preset=preset, data_term="huber" if wrong else "squares")

    def measure_seed(seed: int) -> ClipMeasurement:
        setup = CameraSetup(encoder, ratio_percent / 100, seed)
        return corrupt_measurement(measure(light_field, setup), None, wrong)

    def recover(seed: int) -> tuple[float, float]:
        found = settings.recover(measure_seed(seed), shear)
        return 100 * nmse(found.picture, truth, BORDER_PX), found.seconds_weight

    def judge() -> dict[str, float]:
        errors, searches = zip(*map(recover, range(SEEDS)), strict=True)
        return {
            "nmse_percent": np.mean(errors),
            "spread_percent": np.std(errors, ddof=1),
            "limit_percent": limits[ratio_percent],
            "weight_search_s": np.median(searches),
        }

    measured = measure_seed(0)
    camera = measured.camera()
    first = settings.recover(measured, shear)
    solver = replace(settings, weight=first.weight)
    model = camera.weighting() @ camera.model(shear)
    products = repeat_products(model, first.iterations)
    return PreparedCase(lambda: solver.recover(measured, shear), products, 1, figures=judge)


PREPARE: dict[str, Prepare] = {
    "clip-1d": partial(prepare_recovery, "line", None),
    "clip-0d": partial(prepare_recovery, "single-pixel", None),
    "clip-2d": partial(prepare_recovery, "diffuser", None),
    "clip-given": partial(prepare_recovery, "diffuser", GIVEN_WEIGHT),
    "clip-lensless": prepare_lensless,
    **{f"camera-{name}": partial(prepare_camera, name) for name in CAMERAS},
    **{f"quality-{name}": partial(prepare_quality, name) for name in QUALITY},
}
