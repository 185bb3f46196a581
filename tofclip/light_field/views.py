"""The pictures of all views, the picture that refocusing makes of them, depth from focus (supplement Note
2), and measurements of a light-field camera: how they were made, how they are kept, and the problem that
they pose.

What every view sees of a picture whose pixels lie at shears of their own: nearer surfaces hide
farther ones, and what only that view sees continues the farther surface.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import scipy.ndimage
import scipy.sparse
from numpy.typing import ArrayLike, NDArray

from tofclip.arrays import AnyArray, FloatArray, IntArray
from tofclip.errors import (
    ShapeError,
    require,
    require_axes,
    require_known,
    require_positive,
    require_shape,
)
from tofclip.operators import LinearShear
from tofclip.operators.base import View
from tofclip.operators.cameras import CAMERAS, EvenAngleLineCamera, LightFieldCamera
from tofclip.operators.sparse import SparseMatrix
from tofclip.storage import (
    Storable,
    stored_array,
    stored_mapping,
    stored_part,
    stored_value,
)


@dataclass(frozen=True)
class LightField(Storable):
    """The sub-aperture `pictures` (views, rows, columns), float32, of a scene, and the `views`
    (views, 2), (v, u) of each on the view grid. `ShapeError` or `InputError` where they do not
    match, or the pictures hold NaN or are constant.
    """

    RECORD_KIND = "light_field"

    pictures: AnyArray = field(metadata=stored_array("", "view", "y", "x", dtype=np.float32))
    views: FloatArray = field(metadata=stored_array("", "view", "vu"))

    def __post_init__(self) -> None:
        require_axes("the pictures of a light field", "views, rows, columns", self.pictures.shape)
        require_shape("the views of a light field", (len(self.pictures), 2), self.views.shape)
        require(np.all(np.isfinite(self.pictures)), "a light field must not hold NaN or infinity")
        require(
            np.ptp(self.pictures) != 0,
            "a light field whose pictures are all one even tone shows nothing to recover",
        )

    def __repr__(self) -> str:
        views, rows, columns = self.pictures.shape
        return f"LightField({views} views of {rows} x {columns} pixels)"

    def refocus(self, shear: float, reference: tuple[float, float] = (0.0, 0.0)) -> AnyArray:
        """Shift and add: each view is shifted back by the `shear`, pixels per view step, and the mean
        taken of those that see the pixel, (rows, columns) float32, of the picture of view
        `reference`, (v, u).
        """
        shape = (self.pictures.shape[1], self.pictures.shape[2])
        total, seen = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
        inside = np.ones(shape, np.float32)
        for picture, (v, u) in zip(self.pictures, self.views, strict=True):
            back = LinearShear(shape, shear, (float(v), float(u)), reference).H
            total += back(picture)
            seen += back(inside)
        return total / np.maximum(seen, 1e-6)


SAME_SURFACE_PX = 1.0  # by which neighbours drift apart in the outermost view at most
SEEN_FRACTION = 0.5  # of a pixel, from which on a surface covers it
MIN_WEIGHT = 0.05  # of a surface's own pixels around a point; below, the point was hidden


def make_view_warp(labels: IntArray, shears: FloatArray, views: list[View]) -> SparseMatrix:
    """Return the map from the reference view's picture, (rows, columns), to the pictures of all views.

    `labels` (rows, columns) say which of the ascending shears each pixel of the reference view has. A
    view's pixel takes the light of the reference pixels that its own surface has there, ``h(x - s u, y
    - s v)`` with the shear s of what the view sees, between pixels linearly.
    """
    if labels.ndim != 2 or min(labels.shape) < 2:
        raise ShapeError("a map of depths", "(rows, columns), two or more of either", labels.shape)
    require(
        np.all(np.diff(shears) > 0) and labels.min() >= 0 and labels.max() < shears.size,
        "a map of depths needs ascending shears and a number for each pixel",
    )
    reach = max(float(np.max(np.abs(views))), 1.0)
    same = SAME_SURFACE_PX / reach
    nearest = {
        int(label): scipy.ndimage.distance_transform_edt(
            np.abs(shears[labels] - shears[label]) > same,
            return_distances=False,
            return_indices=True,
        )
        for label in np.unique(labels)
    }
    parts = [_make_view(labels, shears, view, same, nearest) for view in views]
    whole = scipy.sparse.csr_array(scipy.sparse.vstack(parts))
    return SparseMatrix(whole, labels.shape, (len(views), *labels.shape))


def find_view_labels(labels: IntArray, shears: FloatArray, view: View) -> IntArray:
    """Return which shear each pixel of another view has, (rows, columns)."""
    seen = np.full(labels.shape, -1, np.int64)
    for label in np.unique(labels)[::-1]:  # nearer surfaces are painted over farther ones
        shift = (shears[label] * view[0], shears[label] * view[1])
        cover = scipy.ndimage.shift((labels == label).astype(np.float32), shift, order=1)
        seen[cover >= SEEN_FRACTION] = label
    if np.all(seen < 0):
        return labels
    # What the reference view does not see is the farther surface's, as wide as both drift apart.
    drift = (shears[labels.max()] - shears[labels.min()]) * float(np.max(np.abs(view)))
    width = 2 * int(np.ceil(drift)) + 3
    while np.any(seen < 0):
        seen = np.where(seen < 0, scipy.ndimage.maximum_filter(seen, width), seen)
    return seen


def _make_view(
    labels: IntArray,
    shears: FloatArray,
    view: View,
    same: float,
    nearest: dict[int, NDArray[np.int32]],
) -> scipy.sparse.csr_array:
    """One view's matrix, (pixels, pixels)."""
    rows, columns = labels.shape
    seen = find_view_labels(labels, shears, view)
    down, right = np.indices(labels.shape)
    # beyond the picture it is taken to go on as at its border
    y = np.clip(down - shears[seen] * view[0], 0, rows - 1)
    x = np.clip(right - shears[seen] * view[1], 0, columns - 1)
    top, left = np.minimum(y.astype(int), rows - 2), np.minimum(x.astype(int), columns - 2)
    below, beside = y - top, x - left
    pixels, weights = np.zeros((2, 4, rows, columns))
    for corner in range(4):
        one, other = divmod(corner, 2)
        weight = (below if one else 1 - below) * (beside if other else 1 - beside)
        own = np.abs(shears[labels[top + one, left + other]] - shears[seen]) <= same
        weights[corner], pixels[corner] = weight * own, (top + one) * columns + left + other
    total = weights.sum(axis=0)
    hidden = total < MIN_WEIGHT
    weights /= np.where(hidden, 1, total)
    weights[:, hidden] = 0
    weights[0, hidden] = 1
    for label in np.unique(seen[hidden]):
        own = hidden & (seen == label)
        at = nearest[int(label)][:, np.rint(y[own]).astype(int), np.rint(x[own]).astype(int)]
        pixels[0, own] = at[0] * columns + at[1]
    target = np.broadcast_to(np.arange(labels.size), (4, labels.size)).ravel()
    entries = weights.reshape(-1).astype(np.float32), (target, pixels.reshape(-1).astype(np.int64))
    matrix = scipy.sparse.csr_array(entries, shape=(labels.size, labels.size))
    matrix.eliminate_zeros()  # points on pixels need one of four
    return matrix


@dataclass(frozen=True)
class CameraSetup:
    """Which camera measures."""

    # A name in `tofclip.operators.cameras.CAMERAS`
    encoder: str = field(metadata=stored_value(dtype=str))
    # measurements over pixels of one picture
    sampling_ratio: float = field(metadata=stored_value())
    seed: int = field(metadata=stored_value(dtype=int))

    def __post_init__(self) -> None:
        # The name in commands and files of version 0.1.0; to go with the next version.
        if self.encoder == "line-spread":
            object.__setattr__(self, "encoder", EvenAngleLineCamera.name)

    def camera(self, image_shape: tuple[int, int], views: FloatArray) -> LightFieldCamera:
        """Build the camera of views (v, u), (views, 2); the same setup builds the same one again."""
        require_known("encoder", self.encoder, CAMERAS)
        return CAMERAS[self.encoder](
            image_shape, [(v, u) for v, u in views.tolist()], self.sampling_ratio, self.seed
        )


@dataclass(frozen=True)
class ClipMeasurement(Storable):
    """Measurements and the camera that made them."""

    RECORD_KIND = "clip_measurement"

    values: AnyArray = field(
        metadata=stored_array("", "reading", dtype=np.float32, name="readings")
    )  # (measurements,)
    # (views, 2), (v, u) of every view
    views: FloatArray = field(metadata=stored_array("", "view", "vu"))
    image_shape: tuple[int, int] = field(metadata=stored_value("rows", "columns", dtype=int))
    setup: CameraSetup = field(metadata=stored_part(CameraSetup))
    # what a measurement of 1 means in counted photons; 0: not known
    photons_per_unit: float = field(default=0.0, metadata=stored_value())
    # how they came about
    provenance: Mapping[str, Any] = stored_mapping("provenance")

    def __post_init__(self) -> None:
        require(np.all(np.isfinite(self.values)), "the measurements hold NaN or infinity")
        require(self.values.any(), "every reading is zero; there is nothing to recover")

    def camera(self) -> LightFieldCamera:
        """Build the camera that made the measurements."""
        camera = self.setup.camera(self.image_shape, self.views)
        require_shape("the measurements of this camera", (camera.measurements,), self.values.shape)
        return camera

    def counts(self) -> AnyArray:
        """Return the measurements in photons, (measurements,) float32."""
        require(
            self.photons_per_unit > 0,
            "these measurements do not say how many photons they stand for; take squares or huber",
        )
        return self.values * np.float32(self.photons_per_unit)


def measure(light_field: LightField, setup: CameraSetup) -> ClipMeasurement:
    """Encode the true views, each by its own A_k and without noise: no model of refocusing takes part."""
    shape = (light_field.pictures.shape[1], light_field.pictures.shape[2])
    camera = setup.camera(shape, light_field.views)
    measurements = camera.light_field_model()(light_field.pictures[list(camera.used_views)])
    return ClipMeasurement(measurements, light_field.views, shape, setup)


def corrupt_measurement(
    measurement: ClipMeasurement, photons: float | None, bad_fraction: float
) -> ClipMeasurement:
    """Add the noise of so many photons of the largest measurement, None: no noise; then set a fraction
    of all measurements to 0 or to the largest, at random.
    """
    require(
        0 <= bad_fraction <= 1,
        f"the share of bad measurements must lie between 0 and 1, got {bad_fraction}",
    )
    if photons is not None:
        require_positive("the number of photons", photons)
    random = np.random.default_rng([measurement.setup.seed, 1])
    measurements = measurement.values.copy()
    largest = measurements.max()
    per_unit = 0.0 if photons is None else float(photons / largest)
    if photons is not None:
        counted = random.poisson(np.maximum(measurements, 0) * per_unit)
        measurements = (counted / per_unit).astype(np.float32)
    bad = random.permutation(measurements.size)[: round(bad_fraction * measurements.size)]
    measurements[bad] = random.choice(np.array([0, largest], np.float32), bad.size)
    return replace(measurement, values=measurements, photons_per_unit=per_unit)


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
        """Return each pixel from the picture whose number is in (rows, columns) `depths`."""
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
    """Return for each pixel the number of the picture of the `stack` in which it is sharp, (rows,
    columns).

    Sharpness, by a `measure` such as `compute_modified_laplacian`, is averaged over a Gaussian window of
    standard deviation `window_px`, which keeps noise from winning; labels are then chosen so that
    neighbours differ little, which lets pixels without texture follow those that have some.
    `smoothness` is the price of two neighbours being one picture apart, relative to a textured pixel
    being out of focus. `InputError` where the pictures have no texture.
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
