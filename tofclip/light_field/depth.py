"""Depth from focus: refocus on many depths and find, for each pixel, the one where it is sharp
(supplement Note 2), such that neighbours agree.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from tofclip.arrays import AnyArray, FloatArray, IntArray
from tofclip.errors import ShapeError, require, require_axes, require_shape
from tofclip.light_field.views import LightField

MAX_ITERATIONS = 40
MAX_LABEL_STEP = 3  # labels farther apart cost no more: depth may jump at an object's border


def find_smooth_labels(
    costs: AnyArray, smoothness: float, iterations: int = MAX_ITERATIONS
) -> IntArray:
    """Choose labels (rows, columns) of low total cost: each pixel's own, of `costs` (labels, rows,
    columns), and `smoothness` times the steps between neighbours; zero takes each pixel's
    cheapest label. Messages travel one pixel in each of the `iterations`. Memory is ten times
    that of `costs` in float32.

    Damped min-sum belief propagation with a truncated linear price, all pixels at once (P. F.
    Felzenszwalb, D. P. Huttenlocher, Int. J. Comput. Vis. 70, 41, 2006).

    Raises
    ------
    ShapeError, InputError
        The costs have not three dimensions, one is not finite, or the smoothness is negative.
    """
    require_axes("costs", "labels, rows, columns", costs.shape)
    require(
        np.all(np.isfinite(costs)) and smoothness >= 0,
        "costs must be finite and the smoothness zero or more",
    )
    own = costs.astype(np.float32)
    messages = np.zeros((4, *own.shape), np.float32)  # from above, below, left, right
    for _ in range(iterations if smoothness > 0 else 0):
        belief = own + messages.sum(axis=0)
        for towards in range(4):
            # what a pixel passes to a neighbour leaves out what came from that neighbour
            said = _pass_message(belief - messages[towards ^ 1], np.float32(smoothness))
            ends = slice(None, -1), slice(1, None)
            pixels, neighbours = ends if towards % 2 == 0 else ends[::-1]
            if towards < 2:
                said, heard = said[:, pixels], messages[towards, :, neighbours]
            else:
                said, heard = said[..., pixels], messages[towards, ..., neighbours]
            heard += (said - heard) / 2  # half of the step: undamped messages may oscillate
    return (own + messages.sum(axis=0)).argmin(axis=0)


def _pass_message(costs: AnyArray, price: np.float32) -> AnyArray:
    """Cheapest cost of each label l at the neighbour: min over k of ``costs(k) + price(|l - k|)``."""
    cheapest = costs.min(axis=0)
    # truncated: from here on a jump costs the same, however far
    found = np.minimum(costs, cheapest + MAX_LABEL_STEP * price)
    for step in range(1, MAX_LABEL_STEP):
        np.minimum(found[step:], costs[:-step] + step * price, out=found[step:])
        np.minimum(found[:-step], costs[step:] + step * price, out=found[:-step])
    return found - cheapest


TYPICAL_QUANTILE = 0.9  # quantile of the best sharpness: what a textured pixel has
SMOOTHNESS = 0.1
WINDOW_PX = 1.5


@dataclass(frozen=True)
class FocalStack:
    """One scene refocused at several depths, from a light field or from recoveries: `pictures`
    (depths, rows, columns), and the `shears` (depths,) of each, pixels per view step,
    ascending. `ShapeError` or `InputError` where they do not match, hold NaN, or do not ascend.
    """

    pictures: AnyArray
    shears: FloatArray

    def __post_init__(self) -> None:
        if self.pictures.ndim != 3 or self.shears.shape != (len(self.pictures),):
            raise ShapeError(
                "the pictures of a focal stack", "(shears, rows, columns)", self.pictures.shape
            )
        require(
            np.all(np.isfinite(self.pictures)) and np.all(np.diff(self.shears) > 0),
            "a focal stack needs finite pictures and ascending shears",
        )

    def all_in_focus(self, depths: IntArray) -> AnyArray:
        """Return the all-in-focus picture: each pixel from the picture whose number is in (rows,
        columns) `depths`.
        """
        require_shape("the map of depths", self.pictures.shape[1:], depths.shape)
        return np.take_along_axis(self.pictures, depths[np.newaxis], axis=0)[0]


def make_focal_stack(
    light_field: LightField, shears: ArrayLike, reference: tuple[float, float] = (0.0, 0.0)
) -> FocalStack:
    """Refocus a `light_field` at several `shears` (depths,), pixels per view step, as seen from
    `reference`, any (v, u) in view steps, fractions included. Depth from focus and
    `FocalStack.all_in_focus` on a stack from another reference synthesise that viewpoint.
    """
    depths = np.asarray(shears, np.float64)
    pictures = [light_field.refocus(float(shear), reference) for shear in depths]
    return FocalStack(np.stack(pictures), depths)


def compute_modified_laplacian(pictures: AnyArray) -> AnyArray:
    """Second differences of `pictures` (..., rows, columns) along rows and columns, their sizes
    added (S. K. Nayar, Y. Nakagawa, TPAMI 16, 824, 1994).
    """
    padded = np.pad(pictures, [(0, 0)] * (pictures.ndim - 2) + [(1, 1), (1, 1)], mode="edge")
    middle = 2 * padded[..., 1:-1, 1:-1]
    # absolute values first: second derivatives of opposite sign must not cancel
    down = np.abs(middle - padded[..., :-2, 1:-1] - padded[..., 2:, 1:-1])
    across = np.abs(middle - padded[..., 1:-1, :-2] - padded[..., 1:-1, 2:])
    return down + across


def compute_image_energy(pictures: AnyArray) -> AnyArray:
    """Squared slopes along rows and columns, added; shapes as in `compute_modified_laplacian`."""
    down, across = np.gradient(pictures, axis=(-2, -1))
    return down**2 + across**2


def estimate_depth_from_focus(
    stack: FocalStack,
    measure: Callable[[AnyArray], AnyArray] = compute_image_energy,
    window_px: float = WINDOW_PX,
    smoothness: float = SMOOTHNESS,
) -> IntArray:
    """Return for each pixel the number of the picture of the stack in which it is sharp, (rows,
    columns).

    Sharpness is averaged over a Gaussian window, which keeps noise from winning; labels are then
    chosen so that neighbours differ little, which lets pixels without texture follow those that
    have some.

    Parameters
    ----------
    stack : FocalStack
    measure : callable
        `compute_modified_laplacian` or `compute_image_energy`, or another one.
    window_px : float
        Standard deviation of the window.
    smoothness : float
        Price of two neighbours being one picture apart, relative to a textured pixel being out of
        focus.

    Raises
    ------
    InputError
        The pictures have no texture.
    """
    from scipy.ndimage import gaussian_filter

    sharpness = gaussian_filter(
        measure(stack.pictures.astype(np.float32)), (0, window_px, window_px)
    )
    best = sharpness.max(axis=0)
    typical = float(np.quantile(best, TYPICAL_QUANTILE))
    require(
        typical != 0, "these pictures are even nearly everywhere; depth from focus needs texture"
    )
    # in units of a textured pixel's sharpness, so that the smoothness suits pictures of any
    # contrast
    return find_smooth_labels((best - sharpness) / typical, smoothness)
