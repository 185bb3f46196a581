"""Recovery of what stands behind an occluder that a time gate has shown.

The occluder's own return tells where it stands. So it is known which pixels of which view it
covers, and which lamps it keeps from which place of the target; both go into the model F(d), and
the recovery compares no measurement with light that could not have come.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofclip.errors import InputError
from tofclip.occlusion.measurements import Return, Rig, TimedMeasurements
from tofclip.operators import Diagonal, LinearOperator, LinearShear, Stack
from tofclip.operators.shear import View
from tofclip.recovery.light_field import MAX_ITERATIONS, OBJECTIVE_TOLERANCE, ClipRecovery
from tofclip.solvers import TotalVariation

Array = NDArray[Any]

TV_WEIGHT = 3e-3
"""Of total variation, relative: of 1e-3, 3e-3, 5e-3 and 1e-2 the best for most scenes at sampling
ratios 0.5 and 1.
"""

GLINT_QUANTILE = 0.98
"""Share of the pixels that are no brighter than an occluder's usual ones."""


@dataclass(frozen=True)
class SeparatedImages:
    """Occluder and target, each from its own return."""

    # (rows, columns), as the reference view sees them at their own shears; the target as if nothing
    # stood before it
    occluder: Array
    # (rows, columns), as the reference view sees them at their own shears; the target as if nothing
    # stood before it
    target: Array
    plain: Array  # (rows, columns), the target by the model that knows of no occluder
    # of what sent light back, as the times of flight tell, m: occluder and target, or the occluder
    # alone, and then the target's pictures are dark
    distances: tuple[float, ...]

    @property
    def sees_target(self) -> bool:
        """Whether anything came from behind the occluder."""
        return len(self.distances) > 1


def find_occlusion_mask(occluder: Array) -> Array:
    """Return the pixels that an occluder's picture fills, (rows, columns) from 0 to 1."""
    from skimage.filters import threshold_otsu

    usual = np.minimum(
        occluder, np.quantile(occluder, GLINT_QUANTILE)
    )  # what enters the picture from beside it piles up there
    filled: Array = (usual > threshold_otsu(usual)).astype(np.float32)
    return filled


def build_occluded_model(
    rig: Rig, occlusion_mask: Array, shears: tuple[float, float]
) -> LinearOperator:
    """Return F(d) of a target behind an occluder: lamps' shadows, shear, hidden pixels, encoder of
    each view.

    `occlusion_mask` (rows, columns): pixels that the occluder fills in the reference view;
    `shears`: of occluder and target, pixels per view step. Returns (rows, columns) pictures of the
    target to (measurements,) vectors.
    """
    near, far = shears
    camera, array = rig.camera, rig.array
    steps = rig.lamps[:, 1::-1] / array.view_step  # (v, u) of each lamp
    lit = np.mean(
        [1 - _shear_mask(occlusion_mask, near - far, (v, u)) for v, u in steps.tolist()], axis=0
    )
    views = [camera.views[number] for number in camera.used_views]
    parts = [
        encoder
        @ Diagonal(1 - _shear_mask(occlusion_mask, near, view))
        @ LinearShear(array.image_shape, far, view)
        for view, encoder in zip(views, camera.encoders, strict=True)
    ]
    return Stack(parts) @ Diagonal(lit)


def separate_occluder(
    measurements: TimedMeasurements,
    weight: float = TV_WEIGHT,
    returns: tuple[Return, ...] | None = None,
) -> SeparatedImages:
    """Recover occluder and target from their returns.

    `weight`: of total variation, relative to the largest value of A'f; `returns`: of the occluder,
    and of what stands behind; found in the measurements by default. Returns where there is a single
    return the target's pictures are zero.
    """
    returns = measurements.find_returns() if returns is None else returns
    if not returns:
        raise InputError("no light comes back; is the clock set to the scene's distances?")
    distances = tuple(one.distance for one in returns)
    shears = [float(measurements.rig.array.shear(distance)) for distance in distances]
    usual = ClipRecovery(weight=weight)
    pictures = [
        usual.recover(measurements.measurement(one.bins), shear).picture
        for one, shear in zip(returns, shears, strict=True)
    ]
    occluder = pictures[0]
    if len(returns) == 1:
        return SeparatedImages(occluder, 0 * occluder, 0 * occluder, distances)
    target = _recover_behind(
        measurements, find_occlusion_mask(occluder), (shears[0], shears[1]), returns[1].bins, weight
    )
    return SeparatedImages(occluder, target, pictures[1], distances)


def _recover_behind(
    measurements: TimedMeasurements,
    occlusion_mask: Array,
    shears: tuple[float, float],
    bins: slice,
    weight: float,
) -> Array:
    """Recover what a return brings from behind a cover."""
    weighting = measurements.rig.camera.weighting()
    model = weighting @ build_occluded_model(measurements.rig, occlusion_mask, shears)
    gated = weighting(measurements.sum_gate(bins))[:, np.newaxis]
    picture: Array = (
        TotalVariation(weight, MAX_ITERATIONS, OBJECTIVE_TOLERANCE).recover(model, gated).frames[0]
    )
    return picture


def _shear_mask(occlusion_mask: Array, shear: float, view: View) -> Array:
    """Return a cover as seen from elsewhere; nothing, if it has left the picture."""
    if any(
        abs(shear * step) >= size for step, size in zip(view, occlusion_mask.shape, strict=True)
    ):
        return np.zeros_like(occlusion_mask)
    moved: Array = LinearShear(occlusion_mask.shape, shear, view)(occlusion_mask)
    return moved
