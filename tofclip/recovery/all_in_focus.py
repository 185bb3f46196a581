"""A picture that is sharp at all depths, and the depths, from one shot of a light-field camera.

Refocusing explains the measurements by one picture at one depth, and everything else blurs it. Here
each pixel lies at a shear of its own (`tofclip.light_field.views`), so that one picture h explains all
measurements:

    minimise over h >= 0:  ``1/2 |A W h - f|^2 + weight TV(h)``,

with W from the reference view's picture to all views, what hides what included, and the views'
encoders A. Where the depths are not known they come from the sharpest of pictures refocused at
several. Shift-and-add of the views W h is the picture refocused at any depth.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from time import perf_counter
from typing import Any

import numpy as np
import scipy.ndimage
from numpy.typing import ArrayLike, NDArray

from tofclip.errors import InputError, ShapeError
from tofclip.light_field import FocalStack, LightField, estimate_depth_from_focus
from tofclip.light_field.measurement import ClipMeasurement
from tofclip.light_field.views import make_view_warp
from tofclip.recovery.light_field import ClipRecovery, WeightSearch
from tofclip.solvers import Progress, ignore_progress

# The weight is relative to the largest A'f, and far below that of refocusing, as nothing is out of
# focus: 3e-5 to 3e-3 on rendered scenes without noise. One fold of eight, stopped early, finds it;
# eight folds would take longer than all the rest.
SURFACE_WEIGHT_SEARCH = WeightSearch(first=3e-4, max_folds=1, tolerance=1e-3)
REFOCUSING_WEIGHT_SEARCH = WeightSearch(max_folds=1, tolerance=1e-3)
# Four times that of depth from focus alone: a wrong depth costs more here than a shifted border. On
# rendered scenes it lowers the error of refocused pictures by up to a fifth.
SMOOTHNESS = 0.4
MAP_ERROR_PX = 0.1  # by which rounding a known map displaces the outermost view at most
SHEAR_STEP_PX = 0.6  # by which the outermost view moves between depths that are tried


@dataclass(frozen=True)
class AllInFocus:
    """A picture with the depth of each pixel."""

    picture: NDArray[Any]  # (rows, columns), what the reference view (0, 0) sees
    shears: NDArray[np.float64]  # (rows, columns), pixels per view step
    # (rows, columns), the same from pictures refocused one by one; None where the depths were known
    refocused: NDArray[Any] | None
    weight: float  # of the prior, relative to the largest value of A'f
    iterations: int
    stop_reason: str
    seconds: float

    def render_views(self, views: ArrayLike) -> LightField:
        """Return what views, (views, 2) of (v, u) in view steps, see of it: each pixel is moved by its
        own shear.
        """
        wanted = np.asarray(views, np.float64)
        depths, labels = np.unique(self.shears, return_inverse=True)
        warp = make_view_warp(
            labels.reshape(self.shears.shape), depths, [(v, u) for v, u in wanted.tolist()]
        )
        return LightField(warp(self.picture), wanted)


def make_shear_range(
    nearest: float, farthest: float, views: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return shears, (depths,), to look for surfaces at between two of them, pixels per view step, as
    close as the views, (views, 2) of (v, u) in view steps, can tell them apart.
    """
    if not (np.isfinite([nearest, farthest]).all() and nearest < farthest):
        raise InputError(
            f"surfaces are looked for from a smaller shear to a larger one, not from {nearest} to {farthest}"
        )
    step = SHEAR_STEP_PX / max(float(np.abs(views).max()), 1.0)
    return np.linspace(nearest, farthest, 1 + int(np.ceil((farthest - nearest) / step - 1e-9)))


def recover_all_in_focus(
    measurement: ClipMeasurement,
    shears: ArrayLike,
    weight: float | None = None,
    recovery: ClipRecovery | None = None,
    progress: Progress = ignore_progress,
) -> AllInFocus:
    """Recover an all-in-focus picture and its depths from one shot. `shears` (depths,): that
    surfaces may have, pixels per view step, two or more; `weight`: of the prior, by
    cross-validation if not given; `recovery`: prior and data term of all pictures, and the weight
    of the refocused ones; `progress`: called with the number of recoveries just done, of
    `count_recoveries`.
    """
    began = perf_counter()
    depths = np.asarray(shears, np.float64)
    if depths.ndim != 1 or depths.size < 2 or not np.all(np.diff(depths) > 0):
        raise InputError("depths are looked for among two or more ascending shears")
    refocusing = recovery or ClipRecovery()
    # the weight found in the middle serves all depths
    camera = measurement.camera()
    middle = refocusing.recover_picture(
        measurement,
        camera,
        camera.model(float(depths[depths.size // 2])),
        search=REFOCUSING_WEIGHT_SEARCH,
    )
    progress(1)
    refocusing = replace(refocusing, weight=middle.weight)
    pictures = []
    for shear in depths:
        pictures.append(refocusing.recover(measurement, float(shear)).picture)
        progress(1)
    stack = FocalStack(np.stack(pictures), depths)
    labels = estimate_depth_from_focus(stack, smoothness=SMOOTHNESS)
    found = _solve(measurement, labels, depths, replace(refocusing, weight=weight), began)
    progress(1)
    return replace(found, refocused=stack.all_in_focus(labels))


def count_recoveries(shears: ArrayLike) -> int:
    """Return how many recoveries `recover_all_in_focus` reports for so many shears."""
    return np.size(shears) + 2


def recover_on_depth_map(
    measurement: ClipMeasurement,
    shears: NDArray[np.float64],
    weight: float | None = None,
    recovery: ClipRecovery | None = None,
) -> AllInFocus:
    """Recover an all-in-focus picture where the depths are known: shears of the reference view's pixels,
    (rows, columns), pixels per view step, infinite where there is nothing. The weight is found by
    cross-validation if not given.
    """
    began = perf_counter()
    if shears.shape != measurement.image_shape:
        raise ShapeError("the map of shears", measurement.image_shape, shears.shape)
    known = np.isfinite(shears)
    if not known.any():
        raise InputError("the map of shears is nowhere finite")
    step = 2 * MAP_ERROR_PX / max(float(np.abs(measurement.views).max()), 1.0)
    # where there is nothing it is dark, at whatever depth: the farthest hides nothing
    filled = np.where(known, shears, shears[known].max())
    levels, labels = np.unique(np.rint(filled / step), return_inverse=True)
    # pixels on the border of two surfaces hold some of the nearer one's light, and move with it
    nearer = scipy.ndimage.minimum_filter(labels.reshape(shears.shape), 3)
    settings = replace(recovery or ClipRecovery(), weight=weight)
    return _solve(measurement, nearer, levels * step, settings, began)


def _solve(
    measurement: ClipMeasurement,
    labels: NDArray[np.int64],
    shears: NDArray[np.float64],
    recovery: ClipRecovery,
    began: float,
) -> AllInFocus:
    """The picture for known labels."""
    camera = measurement.camera()
    used = [camera.views[number] for number in camera.used_views]
    model = camera.light_field_model() @ make_view_warp(labels, shears, used)
    found = recovery.recover_picture(measurement, camera, model, search=SURFACE_WEIGHT_SEARCH)
    return AllInFocus(
        found.picture,
        shears[labels],
        None,
        found.weight,
        found.iterations,
        found.stop_reason,
        perf_counter() - began,
    )
