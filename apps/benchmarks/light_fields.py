"""Recovery of one picture of a rendered light field from few measurements of its true views, against
the bare products of its model.

What is timed is what a user waits for: the choice of the prior's weight is part of it.
"""

from __future__ import annotations

from functools import cache, partial

import numpy as np

from apps.benchmarks.harness import Case, PreparedCase
from tofclip.light_field import LightField
from tofclip.light_field.measurement import CameraSetup, measure
from tofclip.metrics import nmse
from tofclip.recovery.light_field import ClipRecovery
from tofclip.simulate.light_fields import CameraArray, render_light_field
from tofclip.simulate.scenes import make_scene

SIDES_PX = (96, 128)
"""From 96 on single pixels make so many measurements that the choice of a weight takes one fold."""
SCENE, SHEAR = "letters", -0.4
GIVEN_WEIGHT = 2e-3
PAPER_SIDE_PX, PAPER_FOCAL_LENGTH_PX, PAPER_VIEW_STEP_M = 128, 160.0, 0.0125
VIEW_POSITIONS = np.array([(v, u) for v in range(-4, 4) for u in range(-4, 4)], dtype=np.float64)


@cache
def render_scene(side: int) -> LightField:
    """Letters at three depths in 8 x 8 views, of the paper's field of view."""
    coarseness = PAPER_SIDE_PX / side
    # Views wider apart: the scene's shears, pixels per view step, stay those of the paper's size.
    array = CameraArray(
        (side, side),
        8,
        PAPER_FOCAL_LENGTH_PX / coarseness,
        PAPER_VIEW_STEP_M * coarseness,
        samples=1,
    )
    return render_light_field(make_scene(SCENE, array), array).light_field


def prepare_recovery(encoder: str, weight: float | None, side: int) -> PreparedCase:
    """One picture by total variation; the floor takes as many products as its last recovery needed.

    `encoder`: A key of `CAMERAS`; `weight`: of the prior; None: chosen by cross-validation, as part
    of the work; `side`: pixels of the picture.
    """
    light_field = render_scene(side)
    measurement = measure(light_field, CameraSetup(encoder, 0.5, 0))
    method = ClipRecovery(weight=weight)
    found = method.recover(measurement, SHEAR)
    camera = measurement.camera()
    model = camera.weighting() @ camera.model(SHEAR)
    picture = np.ones(model.shape_in, np.float32)

    def products() -> None:
        for _ in range(found.iterations):
            model.adjoint(model(picture))

    def judge() -> dict[str, float]:
        error = nmse(found.picture, light_field.refocus(SHEAR), side // 10)
        return {"nmse_percent": 100 * error, "weight_search_s": found.seconds_weight}

    return PreparedCase(lambda: method.recover(measurement, SHEAR), products, 1, figures=judge)


FLOOR_TEXT = "the products of its last recovery's iterations alone"

CASES = (
    Case(
        "clip-1d",
        "CLIP-1D, half as many measurements as pixels, weight included",
        "pixels a side",
        SIDES_PX,
        "pictures",
        FLOOR_TEXT,
        partial(prepare_recovery, "line", None),
    ),
    Case(
        "clip-0d",
        "CLIP-0D, half as many measurements as pixels, weight included",
        "pixels a side",
        SIDES_PX,
        "pictures",
        FLOOR_TEXT,
        partial(prepare_recovery, "single-pixel", None),
    ),
    Case(
        "clip-2d",
        "CLIP-2D (diffuser), half as many measurements as pixels, weight included",
        "pixels a side",
        SIDES_PX,
        "pictures",
        FLOOR_TEXT,
        partial(prepare_recovery, "diffuser", None),
    ),
    Case(
        "clip-given",
        "CLIP-2D at a given weight",
        "pixels a side",
        SIDES_PX,
        "pictures",
        FLOOR_TEXT,
        partial(prepare_recovery, "diffuser", GIVEN_WEIGHT),
    ),
)
