"""Recovery of one picture of a light field from few readings, against the bare products of its model."""

from __future__ import annotations

from functools import partial

import numpy as np

from apps.benchmarks.case import Case, Prepared
from apps.benchmarks.peers import lensless_seconds
from tofclip.light_field import LightField
from tofclip.light_field.measurement import Setup, measure
from tofclip.recovery.light_field import ClipRecovery

SIDES = (64, 128)
SHEAR = -0.3
WEIGHT = 2e-3
VIEWS = np.array([(v, u) for v in range(-4, 4) for u in range(-4, 4)], dtype=np.float64)


def light_field(side: int) -> LightField:
    """Even patches of random brightness, the same in all 8 x 8 views."""
    patches = np.random.default_rng(0).random((8, 8)).astype(np.float32)
    picture = np.kron(patches, np.ones((side // 8, side // 8), np.float32))
    return LightField(np.broadcast_to(picture, (len(VIEWS), side, side)).copy(), VIEWS)


def recovery(encoder: str, side: int) -> Prepared:
    """One picture by total variation at a given weight; the floor takes as many products as the recovery needed."""
    measurement = measure(light_field(side), Setup(encoder, 0.5, 0))
    method = ClipRecovery(weight=WEIGHT)
    needed = method.recover(measurement, SHEAR).iterations
    camera = measurement.camera()
    model = camera.weighting() @ camera.model(SHEAR)
    picture = np.ones(model.shape_in, np.float32)

    def products() -> None:
        for _ in range(needed):
            model.adjoint(model(picture))

    peers = {"LenslessPiCam": partial(lensless_seconds, side, needed)} if encoder == "diffuser" else {}
    return Prepared(lambda: method.recover(measurement, SHEAR), products, 1, peers)


FLOOR = "the products of its iterations alone"

CASES = (
    Case(
        "clip-1d",
        "CLIP-1D, half as many readings as pixels",
        "pixels a side",
        SIDES,
        "pictures",
        FLOOR,
        partial(recovery, "line"),
    ),
    Case(
        "clip-0d",
        "CLIP-0D, half as many readings as pixels",
        "pixels a side",
        SIDES,
        "pictures",
        FLOOR,
        partial(recovery, "single-pixel"),
    ),
    Case(
        "clip-2d",
        "CLIP-2D (diffuser), half as many readings as pixels; the peer takes as many iterations of one view",
        "pixels a side",
        SIDES,
        "pictures",
        FLOOR,
        partial(recovery, "diffuser"),
    ),
)
