"""Where surfaces are lit, how far they reach, and which two are one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy
from numpy.typing import NDArray

from tofclip.arrays import FloatArray
from tofclip.recovery.surfaces.amplitudes import (
    AmplitudeSolver,
    share_misfit,
)
from tofclip.recovery.surfaces.patches import (
    MARGIN_PX,
    MIN_BEHIND_FRACTION,
    rank_within_pixels,
)
from tofclip.recovery.surfaces.pulse import TINY, Image
from tofclip.recovery.surfaces.shapes import Pixels

# Of a surface's lit points: that many within as many bins of another's, and what as many pixels of that span, may
# be the other's
DOUBLE_FRACTION, DOUBLE_BINS, DOUBLE_PX = 0.2, 7.0, 3.0
MIN_BRIGHTNESS_FRACTION = 0.1  # of the surface's usual brightness: fainter is not looked at
# Of it, and of the deviations that a pixel alone needs, for a point that its neighbours speak for: of the returns that
# were missed in 50 photons a fifth stood out of the noise by three to five.
AS_BRIGHT, NEEDED = 0.5, 0.6
SURE_SIGMAS = 20.0  # points of which a surface certainly consists
UPPER_QUANTILE = 0.9
# Of what certainly is a surface, and beyond: points that are fainter are looked at no further.
LIT_SIGMAS, LIT_FRACTION, LIT_MARGIN_PX = 3.5, 0.05, 3
# Of a surface that goes on beyond the border of where it may be: how far out of the noise it is lit at how many
# pixels that near the border, and by how much of the noise's variance the misfit falls for each new lit point
# (7 and more of tables and a plate in 200 photons; in 50, up to 2.7 of surfaces that end there).
SURELY_LIT_SIGMAS, BORDER_PX, MIN_BORDER_PX, LEAST_GAIN = 5.0, 2, 10, 4.0
# The range that a pixel spans, in the pulse's deviations, mean over a surface's light, from which on it is steep.
STEEP_PULSES = 2.0
MOST_EXCESS = 4.0  # of the misfit's variance over the noise's: 1 of simulated shots, 60 of the recorded scene5


def grow_surfaces(solver: AmplitudeSolver) -> AmplitudeSolver:
    """Let surfaces reach further where they are lit up to the border of where they may be, as long as that
    explains the shot better: of one that is dim or turned far, frames in little light show a part.
    """
    if solver.variance >= MOST_EXCESS:  # more of it may be what the model does not explain
        return solver
    growing = np.array([basis.is_quadratic for basis in solver.model.bases])
    beside, near = (np.ones((2 * far + 1,) * 2) for far in (BORDER_PX, MARGIN_PX))
    while growing.any():
        masks, further = solver.model.masks, np.zeros_like(solver.model.masks)
        lit = find_lit(solver, SURELY_LIT_SIGMAS, MIN_BEHIND_FRACTION)
        for one in np.flatnonzero(growing):
            within = scipy.ndimage.binary_erosion(masks[one], beside, border_value=1)
            if np.count_nonzero(lit[one] & ~within) >= MIN_BORDER_PX:
                further[one] = scipy.ndimage.binary_dilation(lit[one] & ~within, near) & ~masks[one]
        if not further.any():
            break
        grown = solver.cover(masks | further)
        grown.run_briefly()
        gain = measure_gain(solver, grown, further[grown.model.masks])
        growing &= gain > LEAST_GAIN * grown.variance
        if growing.any():
            solver = grown.cover(masks | further & growing[:, np.newaxis, np.newaxis])
    return solver


def measure_gain(
    solver: AmplitudeSolver, further: AmplitudeSolver, new: NDArray[np.bool_]
) -> FloatArray:
    """By how much the misfit falls for each of the new points, (points,), that is lit, mean over each surface,
    (surfaces,).
    """
    model, light = further.model, further.model.render(further.amplitude)
    left, less = (model.image - one for one in (solver.model.render(solver.amplitude), light))
    gained = share_misfit(model, further.amplitude, light, model.weights * (left**2 - less**2))
    new = new & (further.amplitude > 0)
    gain, points = (
        np.bincount(model.surface[new], one, len(model.masks)) for one in (gained[new], new[new])
    )
    return np.asarray(gain / np.maximum(points, 1))


def keep_lit(solver: AmplitudeSolver) -> AmplitudeSolver:
    """Leave out the points of surfaces that are dark and far from any that is not, beside what is usual
    on their own surface: others may be far brighter.
    """
    near = np.ones((2 * LIT_MARGIN_PX + 1,) * 2)
    lit = find_lit(solver, LIT_SIGMAS, LIT_FRACTION)
    kept = [scipy.ndimage.binary_dilation(one, near) for one in lit] & solver.model.masks
    return solver.cover(kept) if kept.any() else solver


def find_lit(solver: AmplitudeSolver, sigmas: float, fraction: float) -> NDArray[np.bool_]:
    """Say where surfaces are lit, (surfaces, rows, columns): so far out of the noise, and so bright beside
    what is usual on them.
    """
    model, significance = solver.model, solver.measure_significance()
    lit = np.zeros_like(model.masks)
    for own, mask, part in zip(lit, model.masks, model.parts, strict=True):
        amplitude, out = solver.amplitude[part], significance[part]
        least = fraction * find_usual_brightness(amplitude, out, LIT_SIGMAS)
        own[mask] = (out > sigmas) & (amplitude > least)
    return lit


def find_steep(solver: AmplitudeSolver) -> NDArray[np.bool_]:
    """Say which surfaces are so steep, (surfaces,), that a pixel has no one range."""
    model, light = solver.model, solver.amplitude + np.float32(TINY)
    spans = np.hypot(*model.compute_slopes()) / (model.pulse.sigma * model.row_m)
    whole, spanned = (np.bincount(model.surface, one) for one in (light, light * spans))
    return np.asarray(spanned >= STEEP_PULSES * whole)


def find_candidates(
    solver: AmplitudeSolver, significance: Image, limit: float
) -> NDArray[np.bool_]:
    """Say which points stand out of the noise, by their significance, and are not far fainter than
    their surface. Those that are half as bright as it is need less: their neighbours speak for them.
    """
    model, amplitude = solver.model, solver.amplitude
    usual = [find_usual_brightness(amplitude[p], significance[p], limit) for p in model.parts]
    part = np.where(significance > limit, MIN_BRIGHTNESS_FRACTION, AS_BRIGHT)
    bright = amplitude > part * np.array(usual)[model.surface]
    return np.asarray((significance > NEEDED * limit) & bright)


def find_usual_brightness(amplitude: Image, significance: Image, limit: float) -> float:
    """Return the usual amplitude of the points of which a surface certainly consists; infinite if
    none is that many standard deviations out of the noise. In little light none is 20 out of it, but
    some are further than others.
    """
    upper = float(np.quantile(significance, UPPER_QUANTILE)) if significance.size else np.inf
    sure = amplitude[significance > min(SURE_SIGMAS, max(limit, upper / 2))]
    return float(np.median(sure)) if sure.size else np.inf


def join_surfaces(solver: AmplitudeSolver) -> AmplitudeSolver:
    """Make one of two surfaces that are both lit in the same pixels within a pulse of each other, if that
    explains the shot better: returns of frames are bent about what stands on a table, and surfaces that
    follow these take the table's light for theirs.
    """
    doubles = _list_doubles(solver)
    while doubles:
        pair = doubles.pop(0)
        apart, own = take_apart(solver, pair), int(pair[0] > pair[1])
        apart.run_briefly()
        # where the smaller is far off, the larger alone is the better guess
        trials = [apart, *(_join(apart, own, 1 - own, like) for like in ([0, 1], [own]))]
        for trial in trials[1:]:
            trial.run_briefly()
        best = int(np.argmin([trial.measure_misfit() for trial in trials]))
        if best:
            solver = _join(solver, *pair, [*pair][: 3 - best])
            solver.run_briefly()
            doubles = _list_doubles(solver)
    return solver


def take_apart(solver: AmplitudeSolver, surfaces: Sequence[int] | Pixels) -> AmplitudeSolver:
    """Return some surfaces before what the others leave of the shot."""
    model, own = solver.model, np.zeros(len(solver.model.masks), bool)
    own[np.asarray(surfaces)] = True
    apart = solver.cover(model.masks & own[:, np.newaxis, np.newaxis])
    others = np.where(own[model.surface], np.float32(0), solver.amplitude)
    apart.model.image = model.image - model.render(others)
    return apart


def _list_doubles(solver: AmplitudeSolver) -> list[tuple[int, int]]:
    """Pairs of surfaces of which the smaller is, in a part of its pixels, where the larger is; the larger
    one first.
    """
    model = solver.model
    lit = np.flatnonzero(solver.measure_significance() > LIT_SIGMAS)
    order, rank = rank_within_pixels(model.pixel[lit], model.distance[lit])
    nearer, farther = lit[order[:-1]], lit[order[1:]]
    apart = DOUBLE_BINS * model.row_m + DOUBLE_PX * np.hypot(*model.compute_slopes())[farther]
    near = (rank[1:] > 0) & (model.distance[farther] - model.distance[nearer] < apart)
    size = np.bincount(model.surface[lit], minlength=len(model.parts))
    shared = np.zeros((size.size, size.size))
    np.add.at(shared, (model.surface[nearer[near]], model.surface[farther[near]]), 1)
    shared = np.triu(shared + shared.T, 1)
    pairs = np.argwhere(shared > DOUBLE_FRACTION * np.minimum.outer(size, size))
    pairs = pairs[np.argsort(-shared[tuple(pairs.T)])]
    return [(int(a), int(b)) if size[a] >= size[b] else (int(b), int(a)) for a, b in pairs]


def _join(solver: AmplitudeSolver, large: int, small: int, like: list[int]) -> AmplitudeSolver:
    """Give the light and the pixels of one surface to another, as the quadratic nearest to some."""
    model = solver.model
    points = np.flatnonzero(np.isin(model.surface, like))
    nearest = model.find_quadratic(points, solver.amplitude)
    masks, pictures = model.masks.copy(), np.zeros(model.masks.shape, np.float32)
    pictures[masks] = solver.amplitude
    masks[large] |= masks[small]
    pictures[large] += pictures[small]
    masks[small] = False
    joined = solver.cover(masks)
    joined.amplitude = pictures[masks]
    joined.model = joined.model.reshape({large - (small < large): nearest})
    return joined
