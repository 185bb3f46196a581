"""Study: the models of the light-field cameras, each against the bare product that it stands for."""

from __future__ import annotations

import time
from functools import partial
from typing import Any

import numpy as np
import scipy.fft
import scipy.linalg

from apps.benchmarks.harness import Action, Case, PreparedCase
from apps.benchmarks.light_fields import SHEAR, VIEW_POSITIONS
from tofclip.operators.cameras import CAMERAS, LineCamera

SAMPLING_RATIO = 0.5
SIDES_PX = (64, 128)
VIEWS = [(float(v), float(u)) for v, u in VIEW_POSITIONS]
PADDING = 1.5  # of a picture whose transforms must not wrap around

MATRIX_FLOOR_TEXT = "scipy's products with the line camera's matrix and its transpose"
CODES_FLOOR_TEXT = "two Hadamard products on either side for each view"
TRANSFORM_FLOOR_TEXT = "two pairs of transforms of the padded picture"


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


FLOORS = {
    "line": (MATRIX_FLOOR_TEXT, multiply_matrix),
    "line-even": (MATRIX_FLOOR_TEXT, multiply_matrix),
    "single-pixel": (CODES_FLOOR_TEXT, multiply_codes),
}


def prepare_camera(name: str, side: int) -> PreparedCase:
    """A weighted model and its adjoint on one picture; its set-up is timed beside.

    `name`: A key of `CAMERAS`; `side`: pixels of the picture.
    """

    def make_model() -> object:
        camera = CAMERAS[name]((side, side), VIEWS, SAMPLING_RATIO, 0)
        return camera.weighting() @ camera.model(SHEAR)

    camera = CAMERAS[name]((side, side), VIEWS, SAMPLING_RATIO, 0)
    model = camera.weighting() @ camera.model(SHEAR)
    picture = np.random.default_rng(0).random(model.shape_in).astype(np.float32)
    _, make_floor = FLOORS.get(name, (TRANSFORM_FLOOR_TEXT, transform_picture))

    def time_setup() -> dict[str, float]:
        began = time.perf_counter()
        make_model()
        return {"set_up_ms": 1e3 * (time.perf_counter() - began)}

    return PreparedCase(
        lambda: model.adjoint(model(picture)), make_floor(side), 1, figures=time_setup
    )


CASES = tuple(
    Case(
        f"camera-{name}",
        f"model of the {name} camera and its adjoint, half as many measurements as pixels",
        "pixels a side",
        SIDES_PX,
        "pictures",
        FLOORS.get(name, (TRANSFORM_FLOOR_TEXT, transform_picture))[0],
        partial(prepare_camera, name),
    )
    for name in CAMERAS
)
