"""Returns of frames that no surface is near."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from tofclip.arrays import FloatArray
from tofclip.lidar import Detection
from tofclip.lidar.significance import DEFAULT_FALSE_ALARM
from tofclip.recovery.surfaces.amplitudes import (
    AGAINST_DIM,
    START_ITERATIONS,
    AmplitudeSolver,
    Tick,
)
from tofclip.recovery.surfaces.bodies import Body, lay_bodies, list_bodies
from tofclip.recovery.surfaces.extents import LEAST_GAIN, find_candidates, measure_gain
from tofclip.recovery.surfaces.patches import DIMMER_REACH_BINS, rank_within_pixels
from tofclip.recovery.surfaces.pulse import Image
from tofclip.recovery.surfaces.shapes import Pixels
from tofclip.recovery.surfaces.start import (
    SURE_FALSE_ALARM,
    find_brightest_patches,
    lay_out,
    measure_rays,
)
from tofclip.shots import Returns

# Bins in range, and pixels, within which frames' returns and surfaces are the same.
NEAR_BINS, NEAR_PX = 7.0, 1.5
# Logarithm of the odds that a return of the frames beside the surfaces is false: nothing known, for each
# deviation out of the noise that the whole shot shows, where there are few, and for each e-fold of the
# odds that the frames alone give it. From scenes of known returns, of those that the shot shows at all.
OTHER_ODDS, ENOUGH_SIGMAS, LEAST_DOUBT = np.array([4.64, -0.77, 1.06]), 15.0, 1e-4
# About such a return its range may have light as well: what is too dim to be a surface is seen at a few
# of its pixels, which would have the light of all.
ABOUT_OTHERS_PX = 1
Places = tuple[NDArray[Any], NDArray[Any], FloatArray]


def find_others(
    solver: AmplitudeSolver, found: Returns, tick: Tick
) -> tuple[Returns, AmplitudeSolver]:
    """Return those of the frames' returns that no surface is near and that the whole shot shows, with
    surfaces and all other returns free to take over their light; and the light of all.
    """
    others = _find_beside(solver, found)
    if not len(others):
        return others, solver
    dark = np.zeros(len(others), np.float32)
    together, own = _add_returns(solver, others, dark, 0, tick)
    weights = together.model.weights / together.estimate_local_variance()
    information = together.model.gather(weights, squared=True)[own]
    shown = np.minimum(together.amplitude[own] * np.sqrt(information), ENOUGH_SIGMAS)
    doubt = np.clip(np.nan_to_num(others.false_alarm, nan=SURE_FALSE_ALARM), LEAST_DOUBT, 0.5)
    known = [np.ones(shown.size), shown, scipy.special.logit(doubt)]
    doubt = scipy.special.expit(OTHER_ODDS @ np.array(known)).astype(np.float32)
    doubt[shown < 1] = 1
    others = replace(others, false_alarm=doubt)
    # Drawn is what is expected of each where it may be false, or noise (W. James and C. Stein, Proc. 4th
    # Berkeley Symp. 1, 361, 1961). The light of those that are not drawn, or dropped as all methods drop
    # them, goes to the others; and what lies about them is not theirs alone.
    drawn = doubt <= DEFAULT_FALSE_ALARM
    if not drawn.any():
        return others[doubt < 0.5], solver
    light = together.amplitude[own[drawn]]
    whole, own = _add_returns(solver, others[drawn], light, ABOUT_OTHERS_PX, tick)
    whole.amplitude[own] *= (1 - doubt[drawn]) * (1 - 1 / shown[drawn] ** 2)
    return others[doubt < 0.5], whole


def add_surfaces(solver: AmplitudeSolver, found: Returns, light: Image) -> AmplitudeSolver:
    """Add the surfaces of frames' returns that no surface is near, where they explain the shot better: what hides
    behind others may have been taken for a part of one, and bends it, as a melon does a table. `light`: of the
    frames, (rows, columns).
    """
    model, ray_length = solver.model, measure_rays(solver.model.camera)
    lost = _find_beside(solver, found)
    lost = lost[~(lost.false_alarm > SURE_FALSE_ALARM)]
    for basis, coefficients in zip(model.bases, model.state.coefficients, strict=True):
        pixel = lost.y.astype(np.intp) * ray_length.shape[1] + lost.x
        inverse = basis.compute_inverse(basis.evaluate(pixel), coefficients)
        off = ray_length.ravel()[pixel] / inverse - lost.range
        lost = lost[~(np.abs(off) < DIMMER_REACH_BINS * model.row_m)]
    patches = find_brightest_patches(lost, ray_length, model.row_m)
    if not patches:
        return solver
    masks, amplitude = lay_out(patches, lost, light, model.row_m)
    seen = np.zeros(masks.shape, np.float32)
    seen[masks] = amplitude
    bodies, known = list_bodies(solver), len(model.masks)
    for patch, mask, picture in zip(patches, masks, seen, strict=True):
        bodies.append(Body(mask, picture, patch.basis, patch.coefficients))
    shading = np.pad(model.state.shading, ((0, len(patches)), (0, 0)))
    more = lay_bodies(solver, bodies, shading)
    more.run(START_ITERATIONS, against_dim=AGAINST_DIM)
    gain = measure_gain(solver, more, more.model.surface >= known)
    kept = gain > LEAST_GAIN * solver.variance
    if not kept.any():
        return solver
    kept[:known] = True
    return more.cover(more.model.masks & kept[:, np.newaxis, np.newaxis])


def _find_beside(solver: AmplitudeSolver, found: Returns) -> Returns:
    """Return those of the frames' returns that no surface is near."""
    model = solver.model
    chosen = find_candidates(solver, solver.measure_significance(), Detection.signal_to_noise)
    points = model.row[chosen], model.column[chosen], model.distance[chosen]
    return found[~find_near((found.y, found.x, found.range), points, model.row_m)]


def _add_returns(
    solver: AmplitudeSolver, others: Returns, light: Image, margin_px: int, tick: Tick
) -> tuple[AmplitudeSolver, Pixels]:
    """Solve for the light of surfaces and of returns beside them, which is `light` at first; also return
    the returns' points. Light of a return's range may lie as many pixels about it.
    """
    model, shape = solver.model, solver.model.camera.image_shape
    pixel = others.y.astype(np.intp) * shape[1] + others.x
    order, rank = rank_within_pixels(pixel, others.range)
    layer = np.empty_like(rank)
    layer[order] = rank
    masks = np.zeros((int(rank.max(initial=-1)) + 1, *shape), bool)
    ranges = np.ones(masks.shape)
    place = layer, others.y, others.x
    masks[place], ranges[place] = True, others.range
    about = np.ones((2 * margin_px + 1,) * 2)
    for mask, distance in zip(masks, ranges, strict=True):
        nearest = scipy.ndimage.distance_transform_edt(
            ~mask, return_distances=False, return_indices=True
        )
        distance[...] = distance[tuple(nearest)]
        mask[...] = scipy.ndimage.binary_dilation(mask, about)
    point = model.surface.size + np.cumsum(masks).reshape(masks.shape)[place] - 1
    begin = np.append(solver.amplitude, np.zeros(masks.sum(), np.float32))
    begin[point] = light
    inverse = measure_rays(model.camera) / ranges
    together = AmplitudeSolver(model.add(masks, inverse), begin, solver.weight)
    together.run(START_ITERATIONS, tick)
    return together, point


def find_near(places: Places, others: Places, bin_m: float) -> NDArray[np.bool_]:
    """Say which places, rows, columns and ranges, have one of some others near. One in a neighbouring
    pixel may be a bin further off for each that it is aside.
    """
    reach = np.array([NEAR_PX, NEAR_PX, NEAR_BINS * bin_m])
    those, these = (np.transpose(one) / reach for one in (others, places))
    away, _ = scipy.spatial.cKDTree(those).query(these, p=np.inf, distance_upper_bound=1)
    return np.asarray(np.isfinite(away))
