"""A picture that is sharp at all depths, and the depths, from one shot of a light-field camera.

Refocusing explains the measurements by one picture at one depth, and everything else blurs it. Here
each pixel lies at a shear of its own (`tofclip.light_field.warp`), so that one picture h explains all
measurements:

    minimise over h >= 0:  ``1/2 |A W h - f|^2 + weight TV(h)``,

with W from the reference view's picture to all views, what hides what included, and the views'
encoders A. Where the depths are not known they come from the sharpest of pictures refocused at
several.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from time import perf_counter
from typing import Any

import numpy as np
import scipy.ndimage
from numpy.typing import ArrayLike, NDArray

from tofclip.errors import InputError, ShapeError
from tofclip.light_field import FocalStack, estimate_depth_from_focus
from tofclip.light_field.measurement import ClipMeasurement
from tofclip.light_field.warp import make_view_warp
from tofclip.recovery.light_field import MAX_ITERATIONS, OBJECTIVE_TOLERANCE, ClipRecovery
from tofclip.solvers import TotalVariation

# Of the largest A'f; far below that of refocusing, as nothing is out of focus. Letters at four depths,
# CLIP-1D with even angles, SR 1, no noise: NMSE 0.45 % with the map, 0.75 % at 1e-3.
DEFAULT_WEIGHT = 3e-4
MAP_ERROR_PX = 0.1  # by which rounding a known map displaces the outermost view at most


@dataclass(frozen=True)
class AllInFocus:
    """A picture with the depth of each pixel.

    Parameters
    ----------
    picture : (rows, columns) float32 array
        What the reference view (0, 0) sees.
    shears : (rows, columns) float64 array
        Pixels per view step.
    refocused : (rows, columns) float32 array or None
        The same from pictures refocused one by one; None where the depths were known.
    iterations : int
    stop_reason : str
    seconds : float
    """

    picture: NDArray[Any]
    shears: NDArray[np.float64]
    refocused: NDArray[Any] | None
    iterations: int
    stop_reason: str
    seconds: float


def recover_all_in_focus(
    measurement: ClipMeasurement, shears: ArrayLike, weight: float = DEFAULT_WEIGHT
) -> AllInFocus:
    """Recover an all-in-focus picture and its depths from one shot.

    Parameters
    ----------
    measurement : ClipMeasurement
    shears : (depths,) array_like
        That surfaces may have, pixels per view step, ascending; two or more.
    weight : float
        Of total variation, relative to the largest value of A'f.

    Returns
    -------
    AllInFocus

    Raises
    ------
    InputError
        The shears do not ascend, or the pictures have no texture.
    """
    began = perf_counter()
    depths = np.asarray(shears, np.float64)
    if depths.ndim != 1 or depths.size < 2 or not np.all(np.diff(depths) > 0):
        raise InputError("depths are looked for among two or more ascending shears")
    recovery = ClipRecovery()
    # the weight found in the middle serves all depths
    middle = recovery.recover(measurement, float(depths[depths.size // 2]))
    recovery = replace(recovery, weight=middle.weight)
    pictures = [recovery.recover(measurement, float(shear)).picture for shear in depths]
    stack = FocalStack(np.stack(pictures), depths)
    labels = estimate_depth_from_focus(stack)
    found = _solve(measurement, labels, depths, weight, began)
    return replace(found, refocused=stack.all_in_focus(labels))


def recover_on_depth_map(
    measurement: ClipMeasurement, shears: NDArray[np.float64], weight: float = DEFAULT_WEIGHT
) -> AllInFocus:
    """Recover an all-in-focus picture where the depths are known.

    Parameters
    ----------
    measurement : ClipMeasurement
    shears : (rows, columns) array
        Of the reference view's pixels, pixels per view step; infinite where there is nothing.
    weight : float
        Of total variation, relative to the largest value of A'f.

    Returns
    -------
    AllInFocus

    Raises
    ------
    ShapeError, InputError
        The map is of another size, or has no finite shear.
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
    return _solve(measurement, nearer, levels * step, weight, began)


def _solve(
    measurement: ClipMeasurement,
    labels: NDArray[np.int64],
    shears: NDArray[np.float64],
    weight: float,
    began: float,
) -> AllInFocus:
    """The picture for known labels."""
    camera = measurement.camera()
    weighting = camera.weighting()
    warp = make_view_warp(labels, shears, [camera.views[k] for k in camera.used_views])
    method = TotalVariation(weight, MAX_ITERATIONS, OBJECTIVE_TOLERANCE)
    result = method.recover(
        weighting @ camera.light_field_model() @ warp,
        weighting(measurement.values)[:, np.newaxis],
    )
    return AllInFocus(
        result.frames[0],
        shears[labels],
        None,
        result.iterations,
        result.stop_reason,
        perf_counter() - began,
    )
