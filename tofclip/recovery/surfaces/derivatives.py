"""Derivatives of the modelled streak image by what is solved for beside the amplitudes."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from tofclip.recovery.surfaces.model import FloatArray, Image, SurfaceModel
from tofclip.recovery.surfaces.places import measure_height
from tofclip.recovery.surfaces.pulse import differentiate_pulse
from tofclip.threads import map_parallel
from tofclip.units import SPEED_OF_LIGHT

WIDTH_STEP = 0.02  # relative; for the derivative by a pulse's width
CLUSTER_ROWS, CLUSTER_COLUMNS = 12, 48  # measurements whose misfits may depend on each other


class Derivatives(NamedTuple):
    """Derivatives of the streak image by some unknowns, on the part of it that they change.

    Attributes
    ----------
    names : list of (str, int, int)
        Field of `SurfaceState`, number of the surface or 0, number of the entry.
    row, column : int
        Of the part's corner.
    images : (unknowns, rows, columns) float32 array
    """

    names: list[tuple[str, int, int]]
    row: int
    column: int
    images: Image


def iterate_derivatives(model: SurfaceModel, amplitude: Image) -> Iterator[Derivatives]:
    """Yield the image's derivatives by the unknowns of the state, each view's and surface's.

    The reference view keeps its delay and stretch: time zero is its own. Derivatives by gains
    and widths are by their logarithms.

    Parameters
    ----------
    model : SurfaceModel
    amplitude : (points,) float32 array
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


def multiply_groups(groups: list[Derivatives], weights: Image) -> FloatArray:
    """Return J'WJ, group by group, over the part of the image that two groups share.

    Parameters
    ----------
    groups : list of Derivatives
    weights : (rows, columns) float32 array

    Returns
    -------
    (unknowns, unknowns) float array
    """
    starts = np.cumsum([0] + [len(group.names) for group in groups])
    normal = np.zeros((starts[-1], starts[-1]))
    for i, one in enumerate(groups):
        height, width = one.images.shape[1:]
        area = np.s_[one.row : one.row + height, one.column : one.column + width]
        weighted = one.images * weights[area]
        for j, other in enumerate(groups[: i + 1]):
            top, left = max(one.row, other.row), max(one.column, other.column)
            bottom = min(one.row + height, other.row + other.images.shape[1])
            right = min(one.column + width, other.column + other.images.shape[2])
            if bottom <= top or right <= left:
                continue
            here, there = (
                images[
                    :,
                    top - group.row : bottom - group.row,
                    left - group.column : right - group.column,
                ].reshape(len(group.names), -1)
                for images, group in ((weighted, one), (other.images, other))
            )
            block = (here @ there.T).astype(np.float64)
            normal[starts[i] : starts[i + 1], starts[j] : starts[j + 1]] = block
            normal[starts[j] : starts[j + 1], starts[i] : starts[i + 1]] = block.T
    return normal


def sum_scores(groups: list[Derivatives], pull: Image) -> FloatArray:
    """Return derivatives of the misfit, summed over clusters of measurements.

    Parameters
    ----------
    groups : list of Derivatives
    pull : (rows, columns) float32 array
        Weighted misfit.

    Returns
    -------
    (unknowns, clusters) float array
    """
    tall, wide = -(-pull.shape[0] // CLUSTER_ROWS), -(-pull.shape[1] // CLUSTER_COLUMNS)
    found = []
    for group in groups:
        count, height, width = group.images.shape
        area = np.s_[group.row : group.row + height, group.column : group.column + width]
        scores = group.images * pull[area]
        row = (group.row + np.arange(height)) // CLUSTER_ROWS
        column = (group.column + np.arange(width)) // CLUSTER_COLUMNS
        first_row, first_column = (
            np.unique(row, return_index=True),
            np.unique(column, return_index=True),
        )
        scores = np.add.reduceat(scores, first_row[1], axis=1, dtype=np.float64)
        scores = np.add.reduceat(scores, first_column[1], axis=2)
        placed = np.zeros((count, tall, wide))
        placed[:, first_row[0][:, np.newaxis], first_column[0]] = scores
        found.append(placed.reshape(count, -1))
    return np.concatenate(found)
