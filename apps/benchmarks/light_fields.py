"""Recovery of one picture of a light field from few measurements, against the bare products of its
model.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from apps.benchmarks.case import Case, PreparedCase
from apps.benchmarks.peers import time_lensless
from tofclip.light_field import LightField
from tofclip.light_field.measurement import CameraSetup, measure
from tofclip.recovery.light_field import ClipRecovery

SIDES_PX = (64, 128)
SHEAR = -0.3
PRIOR_WEIGHT = 2e-3
VIEW_POSITIONS = np.array([(v, u) for v in range(-4, 4) for u in range(-4, 4)], dtype=np.float64)


def make_light_field(side: int) -> LightField:
    """Even patches of random brightness, the same in all 8 x 8 views."""
    patches = np.random.default_rng(0).random((8, 8)).astype(np.float32)
    picture = np.kron(patches, np.ones((side // 8, side // 8), np.float32))
    return LightField(
        np.broadcast_to(picture, (len(VIEW_POSITIONS), side, side)).copy(), VIEW_POSITIONS
    )


def prepare_recovery(encoder: str, side: int) -> PreparedCase:
    """One picture by total variation at a given weight; the floor takes as many products as the
    recovery needed.

    Parameters
    ----------
    encoder : str
        A key of `CAMERAS`.
    side : int
        Pixels of the picture.

    Returns
    -------
    PreparedCase
    """
    measurement = measure(make_light_field(side), CameraSetup(encoder, 0.5, 0))
    method = ClipRecovery(weight=PRIOR_WEIGHT)
    needed = method.recover(measurement, SHEAR).iterations
    camera = measurement.camera()
    model = camera.weighting() @ camera.model(SHEAR)
    picture = np.ones(model.shape_in, np.float32)

    def products() -> None:
        for _ in range(needed):
            model.adjoint(model(picture))

    peers = {"LenslessPiCam": partial(time_lensless, side, needed)} if encoder == "diffuser" else {}
    return PreparedCase(lambda: method.recover(measurement, SHEAR), products, 1, peers)


FLOOR_TEXT = "the products of its iterations alone"

CASES = (
    Case(
        "clip-1d",
        "CLIP-1D, half as many measurements as pixels",
        "pixels a side",
        SIDES_PX,
        "pictures",
        FLOOR_TEXT,
        partial(prepare_recovery, "line"),
    ),
    Case(
        "clip-0d",
        "CLIP-0D, half as many measurements as pixels",
        "pixels a side",
        SIDES_PX,
        "pictures",
        FLOOR_TEXT,
        partial(prepare_recovery, "single-pixel"),
    ),
    Case(
        "clip-2d",
        "CLIP-2D (diffuser), half as many measurements as pixels; the peer takes as many iterations of one view",
        "pixels a side",
        SIDES_PX,
        "pictures",
        FLOOR_TEXT,
        partial(prepare_recovery, "diffuser"),
    ),
)
