"""Derivatives of the modelled streak image by what is solved for beside the amplitudes."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tofclip.recovery.surfaces.model import FloatArray, Image, SurfaceModel
from tofclip.recovery.surfaces.places import measure_height
from tofclip.recovery.surfaces.pulse import differentiate_pulse
from tofclip.threads import map_parallel
from tofclip.units import SPEED_OF_LIGHT

WIDTH_STEP = 0.02  # relative; for the derivative by a pulse's width
CLUSTER_ROWS, CLUSTER_COLUMNS = 12, 48  # measurements whose misfits may depend on each other
LEAST_VARIANCE = 1e-12  # of the largest one
MAX_LEVERAGE = 0.9  # of a cluster: what it alone determines, its misfit says nothing about


class Derivatives(NamedTuple):
    """Derivatives of the streak image by some unknowns, on the part of it that they change."""

    # field of `SurfaceState`, number of the surface or 0, number of the entry
    names: list[tuple[str, int, int]]
    row: int  # of the part's corner
    column: int  # of the part's corner
    images: Image  # (unknowns, rows, columns)


def iterate_derivatives(model: SurfaceModel, amplitude: Image) -> Iterator[Derivatives]:
    """Yield the image's derivatives by the unknowns of the state, each view's and surface's.

    The reference view keeps its delay and stretch: time zero is its own. Derivatives by gains
    and widths are by their logarithms.

    `amplitude` (points,).
    """
    views = range(model.camera.views)
    yield from map_parallel(lambda view: _differentiate_view(model, view, amplitude), views)
    yield from map_parallel(
        lambda view: _differentiate_sweep(model, view, amplitude),
        [view for view in views if view != model.reference],
    )
    yield from map_parallel(
        lambda surface: _differentiate_surface(model, surface, amplitude),
        range(len(model.masks)),
    )


def _differentiate_view(model: SurfaceModel, view: int, amplitude: Image) -> Derivatives:
    kernel, own = model.kernels[view], model.overlap(view)
    wider = model.make_kernel(view, 1 + WIDTH_STEP)
    images = {
        "gains": model.project(view, amplitude, kernel),
        "widths": model.project(view, amplitude, (wider - kernel) / np.float32(WIDTH_STEP)),
    }
    unknowns = [(name, 0, view) for name in images]
    projected = list(images.values())
    for surface in np.unique(model.surface[model.behind]):
        chosen = model.behind & (model.surface == surface)
        unknowns.append(("shading", int(surface), view))
        projected.append(model.project(view, amplitude * chosen, kernel))
    stacked = np.stack(projected)[:, :, own[0]] * np.float32(model.state.gains[view])
    return Derivatives(unknowns, 0, own[1].start, stacked)


def _differentiate_sweep(model: SurfaceModel, view: int, amplitude: Image) -> Derivatives:
    """By delay and stretch at a view's centre, which the views beside it feel as well."""
    felt = []
    for other, place in enumerate(model.footprints):
        weight = place.between.weigh_centre(view)
        if not weight.any():
            continue
        slope = differentiate_pulse(model.kernels[other])
        slope *= np.float32(model.state.gains[other])
        light = amplitude * weight
        late = light * measure_height(place.row, model.image.shape[0])
        own, slit = model.overlap(other)
        images = [
            model.project(other, one.astype(np.float32), slope)[:, own] for one in (light, late)
        ]
        felt.append((slit, images))
    first = min((slit.start for slit, _ in felt), default=0)
    last = max((slit.stop for slit, _ in felt), default=first + 1)
    total = np.zeros((2, model.image.shape[0], last - first), np.float32)
    for slit, images in felt:
        total[:, :, slit.start - first : slit.stop - first] += images
    return Derivatives([("delays", 0, view), ("stretches", 0, view)], 0, first, total)


def _differentiate_surface(model: SurfaceModel, surface: int, amplitude: Image) -> Derivatives:
    part, monomials = model.parts[surface], model.monomials[surface]
    first = min(int(one.row[part].min(initial=0)) for one in model.footprints) - model.half
    last = max(int(one.row[part].max(initial=0)) for one in model.footprints) + model.half + 3
    first = min(max(first, 0), model.image.shape[0] - 1)
    last = max(min(last, model.image.shape[0]), first + 1)
    there = 2 * model.distance[part] / SPEED_OF_LIGHT + model.camera.time_zero
    rows_per_metre = 2 / SPEED_OF_LIGHT / np.interp(there, model.times, np.gradient(model.times))
    # range = length / inverse depth
    by_inverse = -(model.distance[part] ** 2) / model.ray_length[part] * rows_per_metre
    in_range = (amplitude[part] * by_inverse)[:, np.newaxis] * monomials
    lights = np.ascontiguousarray(in_range.T, np.float32)
    images = np.zeros((len(lights), last - first, model.image.shape[1]), np.float32)
    for view, place in enumerate(model.footprints):
        slope = differentiate_pulse(model.kernels[view])
        slope *= np.float32(model.state.gains[view] * place.rows_per_instant)
        own, slit = model.overlap(view)
        for number, light in enumerate(lights):
            image = model.project(view, light, slope, part, (first, last))
            images[number, :, slit] += image[:, own]
    names = [("coefficients", surface, number) for number in range(len(lights))]
    return Derivatives(names, first, 0, images)


class ClusterProducts(NamedTuple):
    """What a part of the image says of the unknowns that change it."""

    own: NDArray[np.intp]  # (n,), numbers of these unknowns
    normal: Image  # (n, n), j'WJ of the part
    score: Image  # (n,), j'W of its misfit


class NormalEquations(NamedTuple):
    """What a Gauss-Newton step is made of."""

    normal: FloatArray  # (unknowns, unknowns), j'WJ
    slope: FloatArray  # (unknowns,), j' of what is to be explained
    clusters: list[ClusterProducts]  # what each part of the image adds to them

    def sum_squared_scores(self, inverse: FloatArray) -> FloatArray:
        """Return the sum of squares of the clusters' scores, as they were before the step.

        A step explains a part of each cluster's misfit, the more the fewer clusters there are, and what
        is left is too little. With the leverage h of a cluster, ``1 - h`` of its variance is left
        (R. Bell and D. McCaffrey, Surv. Methodol. 28, 169, 2002).

        `inverse` (unknowns, unknowns): of the normal matrix. Returns (unknowns, unknowns).
        """
        scores = np.zeros((len(self.clusters), self.slope.size))
        for score, (own, normal, pull) in zip(scores, self.clusters, strict=True):
            factor, inverse_factor = _take_root(inverse[np.ix_(own, own)])
            leverage, directions = np.linalg.eigh(factor.T @ normal @ factor)
            left = np.sqrt(1 - np.clip(leverage, 0, MAX_LEVERAGE))
            along = directions.T @ (factor.T @ pull)
            score[own] = inverse_factor.T @ (directions @ (along / left))
        return scores.T @ scores


def _take_root(covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return F with ``F F' = C``, and its inverse.

    Products in float32 may leave a covariance with a variance of zero or below along directions that
    a shot says nothing about, where no Cholesky factor is. There it is taken for very small.
    """
    unit = np.sqrt(np.maximum(np.abs(np.diag(covariance)), np.finfo(np.float64).tiny))
    variances, axes = np.linalg.eigh(covariance / np.outer(unit, unit))
    deviations = np.sqrt(np.maximum(variances, LEAST_VARIANCE * variances.max()))
    return unit[:, np.newaxis] * axes * deviations, (axes / deviations).T / unit


def multiply_derivatives(
    groups: list[Derivatives], weights: Image, rest: Image, error: Image
) -> NormalEquations:
    """Return the products of all derivatives with each other and with misfits.

    Cluster by cluster: what is on one stays in cache, and most derivatives are on few.

    `weights` (rows, columns); `rest` (rows, columns): misfit that a step is to explain; `error`
    (rows, columns): misfit of the clusters' scores.
    """
    ends = np.cumsum([0] + [len(group.names) for group in groups])
    normal, slope = np.zeros((ends[-1], ends[-1])), np.zeros(ends[-1])
    clusters = []
    for top in range(0, weights.shape[0], CLUSTER_ROWS):
        for left in range(0, weights.shape[1], CLUSTER_COLUMNS):
            area = np.s_[top : top + CLUSTER_ROWS, left : left + CLUSTER_COLUMNS]
            own, images = _cut_out(groups, ends, area, weights[area].shape)
            if own.size == 0:
                continue
            weighted: Image = images * weights[area].ravel()
            product: Image = weighted @ images.T
            score: Image = weighted @ error[area].ravel()
            normal[np.ix_(own, own)] += product
            slope[own] += weighted @ rest[area].ravel()
            clusters.append(ClusterProducts(own, product, score))
    return NormalEquations(normal, slope, clusters)


def _cut_out(
    groups: list[Derivatives],
    ends: NDArray[np.int64],
    area: tuple[slice, slice],
    shape: tuple[int, ...],
) -> tuple[NDArray[np.intp], Image]:
    """The unknowns that change a part of the image, and their derivatives there, (n, pixels)."""
    own, parts = [], []
    top, left = area[0].start, area[1].start
    for group, first, last in zip(groups, ends[:-1], ends[1:], strict=True):
        row, column = group.row - top, group.column - left
        here = group.images[
            :, max(-row, 0) : max(shape[0] - row, 0), max(-column, 0) : max(shape[1] - column, 0)
        ]
        if not here.any():
            continue
        row, column = max(row, 0), max(column, 0)
        part = np.zeros((here.shape[0], *shape), np.float32)
        part[:, row : row + here.shape[1], column : column + here.shape[2]] = here
        own.append(np.arange(first, last))
        parts.append(part.reshape(here.shape[0], -1))
    if not own:
        return np.zeros(0, np.intp), np.zeros((0, shape[0] * shape[1]), np.float32)
    return np.concatenate(own), np.concatenate(parts)
