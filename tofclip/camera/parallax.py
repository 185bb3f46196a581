"""How far the views move apart with range: lenslet pitch and focus distance.

They come from shears, or slit centres, of targets at known distances; the shears from the shot
itself, whose time gates are in focus where the views agree with one picture.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from tofclip.arrays import Float32Array, FloatArray
from tofclip.camera.model import Camera
from tofclip.camera.rectifier import Measurement
from tofclip.errors import CalibrationError, ShapeError, require
from tofclip.solvers import Progress, Sparse, ignore_progress, relative_residual

# How a gate is recovered to see whether its views agree.
GATE_METHOD = Sparse(weight=5e-3, iterations=30)
SIGNIFICANCE = 2.0  # standard deviations by which a parallax must differ from none
MIN_CHANGE_PX = 1e-3  # of shear over the distances; less is rounding


@dataclass(frozen=True)
class Parallax:
    """A fitted ``s(d) = -strength * (1/d - focus_dioptres)``: `strength` is focal length (px)
    times lenslet pitch (m), px m; `focus_dioptres` the inverse of the focus distance, 1/m,
    slightly negative perhaps where the views are focused on infinity; `misfit_px` the root mean
    square of what the fit leaves, pixels of shear, or of a slit centre.
    """

    strength: float
    focus_dioptres: float
    misfit_px: float

    def apply_to(self, camera: Camera) -> Camera:
        """Return `camera` with this parallax.

        A negative strength (views numbered against the sense in which near objects move) turns the
        view positions round, so that near objects have negative shear. A focus beyond infinity
        counts as infinity.
        """
        return camera.replace(
            view_positions=camera.view_positions * np.sign(self.strength),
            lenslet_pitch=abs(self.strength) / camera.focal_length_px,
            focus_distance=1 / self.focus_dioptres if self.focus_dioptres > 0 else np.inf,
        )


@dataclass(frozen=True)
class FocusCurve:
    """How well the views agree, gate by gate, over shears: `agreement` (gates, shears), energy of
    the measurements over that of the residual, 0 for dark gates; `shears` (gates,) where it is
    highest, between those tried; `weight` (gates,) how surely: relative curvature at the
    maximum times the gate's light, 0 where the maximum lies at an end.
    """

    agreement: FloatArray
    shears: FloatArray
    weight: FloatArray


def fit_parallax_to_shears(
    shears: ArrayLike, distances: ArrayLike, weight: ArrayLike | None = None
) -> Parallax:
    """Fit s(d) to `shears` (n,), pixels per view step, of surfaces at known `distances` (n,), m,
    each with a `weight` (n,), all alike by default. `CalibrationError` for fewer than two different
    distances, or shears that change with distance by no more than their errors.
    """
    s, d = np.asarray(shears, dtype=np.float64), np.asarray(distances, dtype=np.float64)
    w = np.ones(s.shape) if weight is None else np.asarray(weight, dtype=np.float64)
    if not s.shape == d.shape == w.shape or s.ndim != 1:
        raise ShapeError("distances and weights", s.shape, d.shape)
    if not np.all(np.isfinite(s)) or not np.all(d > 0) or np.unique(d[w > 0]).size < 2:
        raise CalibrationError("a parallax needs finite shears at two or more positive distances")
    # s(d) = -strength / d + constant is linear in both; weights of squares enter by their roots.
    root = np.sqrt(w)
    design = np.stack([-1 / d, np.ones_like(d)], axis=1)
    (strength, constant), *_ = np.linalg.lstsq(design * root[:, np.newaxis], s * root, rcond=None)
    misfit = np.sqrt(np.average((design @ [strength, constant] - s) ** 2, weights=w))
    _require_signal(float(strength), design * root[:, np.newaxis], float(misfit**2 * w.sum()))
    return Parallax(float(strength), float(constant / strength), float(misfit))


def _require_signal(strength: float, design: FloatArray, squares: float) -> None:
    """Refuse a strength, px m, that could as well be zero, and with it a sign and a focus at random,
    given the fit's weighted design and the squares that it leaves.
    """
    used = design[np.any(design != 0, axis=1)]
    freedom = max(len(used) - 2, 1)  # two shears fit exactly, and say nothing about their errors
    covariance = np.linalg.inv(used.T @ used) * squares / freedom
    change_px = abs(strength) * float(np.ptp(used[:, 0] / used[:, 1]))
    if abs(strength) <= SIGNIFICANCE * np.sqrt(covariance[0, 0]) or change_px < MIN_CHANGE_PX:
        raise CalibrationError(
            f"the shears do not determine a parallax: they change by {change_px:.2g} px over the distances, "
            "no more than their errors; take surfaces at distances that differ more, or a shot with more light"
        )


def fit_parallax_to_centres(
    camera: Camera, centres_px: ArrayLike, distances: ArrayLike
) -> Parallax:
    """Fit s(d) to the views' slit centres, `centres_px` (views, n), measured with a target at
    known `distances` (n,), m. The own centres of `camera` are those at the focus distance that
    is to be found. `ShapeError` where the centres are not (views, distances).
    """
    centres = np.asarray(centres_px, dtype=np.float64)
    if centres.ndim != 2 or centres.shape[0] != camera.views:
        raise ShapeError("slit centres", f"({camera.views}, distances)", centres.shape)
    aside = camera.view_positions - camera.view_positions.mean()
    moved = centres - camera.centres_px[:, np.newaxis]
    moved -= moved.mean(axis=0)  # all views together: the target was moved sideways
    shears = aside @ moved / np.sum(aside**2)
    fitted = fit_parallax_to_shears(shears, distances)
    nearness = 1 / np.asarray(distances, dtype=np.float64) - fitted.focus_dioptres
    left = moved + fitted.strength * aside[:, np.newaxis] * nearness
    left -= left.mean(axis=1, keepdims=True)  # a view's own centre is not the parallax's concern
    return Parallax(fitted.strength, fitted.focus_dioptres, float(np.sqrt(np.mean(left**2))))


def find_sharpest_shears(
    measurement: Measurement,
    camera: Camera,
    gates: Sequence[slice],
    shears: ArrayLike,
    progress: Progress = ignore_progress,
) -> FocusCurve:
    """Recover every gate at every shear and see where the views agree best with one picture.

    Wrongly sheared views contradict each other, and no nonnegative picture of few bright pixels
    explains them all. In the depth-of-field arrangement, where little defocuses, that tells more
    than the pictures' sharpness.

    Parameters
    ----------
    measurement : Measurement
        Rectified measurements.
    camera : Camera
    gates : sequence of slice
        Frames of each gate.
    shears : (n,) array
        Evenly spaced, pixels per view step.
    progress : callable
        Called with the number of frame iterations just done.

    Raises
    ------
    InputError
        There are fewer than two finite shears.
    """
    tried = np.asarray(shears, dtype=np.float64)
    require(
        tried.ndim == 1 and tried.size >= 2 and np.all(np.isfinite(tried)),
        "at least two finite shears have to be tried",
    )
    table = np.zeros((len(gates), tried.size))
    for column, shear in enumerate(tried):
        operator = camera.operator(float(shear))
        for row, gate in enumerate(gates):
            part = measurement.select(gate)
            if operator.adjoint(part.values * part.valid).max() <= 0:
                progress(GATE_METHOD.work(part.values.shape[1]))  # dark
                continue
            frames = GATE_METHOD.recover(operator, part.values, part.valid, progress).frames
            left = relative_residual(operator, frames, part.values, part.valid)
            table[row, column] = left**-2
    good = measurement.values * measurement.valid
    light = np.array([np.sum(good[:, gate].clip(0)) for gate in gates])
    return _fit_focus_curve(table, tried, light)


def measure_sharpness(frames: Float32Array) -> float:
    """Mean square over squared mean of the frames, weighted by their light; 1 for even pictures, 0
    without light.
    """
    flat = frames.reshape(frames.shape[0], -1)
    light = flat.sum(axis=1, dtype=np.float64)
    square = np.einsum("tp,tp->t", flat, flat, dtype=np.float64)
    lit = light > 0
    if not lit.any():
        return 0.0
    return float(np.average(square[lit] * flat.shape[1] / light[lit] ** 2, weights=light[lit]))


def _fit_focus_curve(table: FloatArray, tried: FloatArray, light: FloatArray) -> FocusCurve:
    """Vertex of the parabola through each maximum and its neighbours."""
    rows = np.arange(table.shape[0])
    best = table.argmax(axis=1)
    # At the end of what was tried there is no neighbour on one side: no vertex, no weight.
    inner = best.clip(1, max(1, tried.size - 2))
    around = ((inner + side).clip(0, tried.size - 1) for side in (-1, 0, 1))
    left, centre, right = (table[rows, columns] for columns in around)
    bend = 2 * centre - left - right
    firm = (best == inner) & (bend > 0)
    beyond = np.divide((right - left) / 2, bend, out=np.zeros_like(centre), where=firm)
    step = tried[1] - tried[0]
    # A sharp maximum in much light says most about the shear; a flat one next to nothing.
    weight = np.where(firm, light * bend / np.maximum(centre, np.finfo(np.float64).tiny), 0.0)
    return FocusCurve(table, tried[best] + np.where(firm, beyond, 0.0) * step, weight)
