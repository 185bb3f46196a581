"""Calibration from the shot itself: the views' time skew first, then skew, gain and centre of every
view, by lowering the data residual; and how far the views move apart with range (lenslet pitch and focus
distance), from shears, or slit centres, of targets at known distances.

Every view sees the same scene, so every view receives the same energy at the same instant: where
the sweep is skewed, its curve of energy versus row is shifted and stretched against the reference
view's. Recovering the pictures and registering the views to them alternate. Given the pictures, a view's
measurements change to first order with its time offset, time stretch, gain and slit centre, so that
one small least-squares problem a view yields all four; a few rounds suffice because the coarse
calibration is within a few pixels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from tofclip.arrays import BoolArray, Float32Array, FloatArray, IndexArray
from tofclip.camera.model import Camera, SkewSweep, split_by_shear
from tofclip.camera.rectifier import Measurement, estimate_dark_level, measure, require_width
from tofclip.errors import CalibrationError, ShapeError, require
from tofclip.solvers import Progress, Sparse, ignore_progress, relative_residual
from tofclip.units import SPEED_OF_LIGHT

MAX_OFFSET_FRACTION = 0.08  # of the rows; beyond it a picture's start or end would be lost anyway
# Slower changes than this are the scene's fall-off with range, not structure to match.
TREND_ROWS = 40
MIN_CORRELATION = 0.6
# Of the correlations at all delays: in little light noise lowers every one, but a view that follows still
# stands out of them. Curves of noise alone reach 4, views in 50 photons 6 to 9, whose delays are
# right to a row (root mean square); where views reach less than 4 they are not.
CHANCE_SIGMAS = 5.0


@dataclass(frozen=True)
class SkewEstimate:
    """A `sweep` found from energy curves, and the `correlations` (views,) of each view's curve
    with the reference view's; 1 at the reference.
    """

    sweep: SkewSweep
    correlations: FloatArray


def estimate_skew(counts: Float32Array, camera: Camera) -> SkewEstimate:
    """Match each view's energy curve in the raw `counts` (rows, columns) to the reference view's by
    ``row_k = offset_k + (1 + stretch_k) * row``.

    The centres of `camera` say where the views are; the view whose position is nearest 0 is the
    reference. `CalibrationError` where a view's curve does not resemble the reference's, or the picture
    is not as wide as the camera's slit.
    """
    from scipy.ndimage import gaussian_filter1d

    # The root takes range away, as near objects outshine far ones by 1/r^2, and gives bright and dim
    # returns the same noise, so that a single bright one does not decide.
    roots = np.sqrt(np.maximum(sum_view_energies(counts, camera), 0))
    curves = roots - gaussian_filter1d(roots, TREND_ROWS, axis=1)
    reference = int(np.argmin(np.abs(camera.view_positions)))
    found = [
        (0.0, 0.0, 1.0) if view == reference else _match_curves(curve, curves[reference])
        for view, curve in enumerate(curves)
    ]
    offsets, stretches, correlations = np.array(found).T
    chance = CHANCE_SIGMAS * np.array([_spread_by_chance(one, curves[reference]) for one in curves])
    sure = np.minimum(chance, MIN_CORRELATION)
    worst = int(np.argmin(correlations - sure))
    if not correlations[worst] > sure[worst]:
        raise CalibrationError(
            f"view {worst} does not follow the reference view in time (correlation "
            f"{correlations[worst]:.2f}, chance makes {chance[worst]:.2f}): check the slit centres, average "
            "shots where there is little light, or give the camera a measured sweep"
        )
    return SkewEstimate(SkewSweep(camera.centres_px, offsets, stretches), correlations)


def sum_view_energies(counts: Float32Array, camera: Camera) -> FloatArray:
    """Sum of each row over each view's part of the slit, above the dark level; (views, rows)."""
    require_width(counts, camera)
    # Without its dark level, which would swamp the correlation with a constant.
    signal = counts - np.float32(estimate_dark_level(counts))
    # No wider than half the way to the neighbour, whose light comes at other rows.
    pitch = np.diff(np.sort(camera.centres_px)).min(initial=2 * camera.slit_width_px)
    half = min(camera.image_shape[1] // 2, int(pitch) // 2)
    edges = [(max(0, round(c) - half), round(c) + half + 1) for c in camera.centres_px]
    return np.array([signal[:, first:last].sum(axis=1, dtype=np.float64) for first, last in edges])


def _spread_by_chance(curve: FloatArray, reference: FloatArray) -> float:
    """Root mean square of two curves' correlations at all delays, going round at the ends."""
    spectrum, other = (np.fft.rfft(one - one.mean()) for one in (curve, reference))
    products = np.fft.irfft(spectrum * other.conj(), curve.size) / curve.size
    return float(products.std() / max(curve.std() * reference.std(), np.finfo(np.float64).tiny))


def _match_curves(curve: FloatArray, reference: FloatArray) -> tuple[float, float, float]:
    """Offset, stretch and correlation that bring `curve` onto `reference`."""
    from scipy.optimize import minimize

    rows = np.arange(reference.size, dtype=np.float64)

    def disagreement(skew: FloatArray) -> float:
        shifted = np.interp(skew[0] + (1 + skew[1]) * rows, rows, curve)
        spread = float(np.std(shifted) * np.std(reference))
        if spread == 0:
            return 1.0
        return -float(np.mean((shifted - shifted.mean()) * (reference - reference.mean()))) / spread

    reach = max(2, round(MAX_OFFSET_FRACTION * rows.size))
    # The correlation has a maximum wherever two returns meet: whole rows first, or the search would
    # stay at the nearest one.
    coarse = min(range(-reach, reach + 1), key=lambda offset: disagreement(np.array([offset, 0.0])))
    # Small enough to stay on the hill that the coarse search found: 3 rows, 1 % of stretch.
    simplex = np.array([[coarse, 0.0], [coarse + 3.0, 0.0], [coarse, 0.01]])
    options = {"initial_simplex": simplex, "xatol": 1e-4, "fatol": 1e-8}
    best = minimize(disagreement, simplex[0], method="Nelder-Mead", options=options)
    return float(best.x[0]), float(best.x[1]), -float(best.fun)


MIN_ROUND_COUNT, MAX_ROUND_COUNT = 5, 10
SETTLED_PX = 0.05  # no centre moves further in a round: enough rounds
# Three cache blocks, spread over the shot's energy. On simulated shots of 1,900, 200 and 50 photons
# at the brightest, 320 frames find no camera better, and at 50 a worse one: their noise is fitted.
MAX_FRAMES = 96
# Too few iterations or too strong a prior pull the centres by some hundredths of a pixel.
REGISTRATION_METHOD = Sparse(weight=3e-4, iterations=30)
# Alternating steps fall short of the joint minimum; a measured speed-up without overshoot.
RELAXATION = 1.5
# Centres fall shorter than the rest: pictures recovered at wrong centres agree with these in part.
CENTRE_RELAXATION = 2.5
CENTRE_PRIOR_PX = 3.0  # how far a slit centre may plausibly be off its calibration
SHEAR_TOLERANCE_PX = 0.1  # of a view's place on the slit, where frames share an operator
MIN_RANGE_M = 0.01
MIN_VIEWS_TO_SHIFT = 3  # of two views, all that the centres say is where the picture lies
FLOOR_FRACTION = 0.1  # frames dimmer than this share of the brightest count less, lest noise decide


@dataclass(frozen=True)
class Registration:
    """A refined `camera`, and what the refinement gained: `residuals` (rounds + 1,), the relative
    data residual of the frames used, before each round and after the last.
    """

    camera: Camera
    residuals: FloatArray


def register_views(
    counts: Float32Array,
    saturated: BoolArray | None,
    camera: Camera,
    progress: Progress = ignore_progress,
    times: FloatArray | None = None,
    max_rounds: int = MAX_ROUND_COUNT,
) -> Registration:
    """Refine a camera whose sweep is a `SkewSweep`, known coarsely: centres within a few pixels, skew within
    a few rows; by a raw streak image, `counts` (rows, columns), and what of it is `saturated`.

    Of a camera that knows its lenslet pitch, every instant is modelled at the shear of its range:
    surfaces at several ranges then agree about the centres. A shift of all centres alike, or in
    proportion to tan(angle), only shifts the pictures, and no shot can tell; there the camera's own
    centres hold. Without `times` (rows,), times of flight of the rows, s, the centres of such a camera
    stay as they are. Of the refinements, `max_rounds` at most, two leave a tenth of the first misfit's
    excess: enough to read what is written on a surface, not to measure. `progress` is called with the
    number of frame iterations just done.
    """
    start, residuals, best, moved_px = camera, [], (np.inf, camera), np.inf
    for number in range(max_rounds + 1):
        measurement = measure(counts, saturated, camera)
        chosen = _select_frames(measurement)
        part = measurement.select(chosen)
        groups: Groups = [(slice(0, chosen.size), 0.0)]
        if times is not None and camera.lenslet_pitch > 0:
            distance = np.maximum(SPEED_OF_LIGHT * times[chosen] / 2, MIN_RANGE_M)
            groups = split_by_shear(camera, distance, SHEAR_TOLERANCE_PX)
        found, predicted = list[Float32Array](), list[Float32Array]()
        for frames, shear in groups:
            operator, some = camera.operator(shear), part.select(frames)
            one = REGISTRATION_METHOD.recover(operator, some.values, some.valid, progress)
            found.append(np.moveaxis(one.frames, 0, -1))
            predicted.append(operator(found[-1]))
        pictures = np.ascontiguousarray(np.concatenate(found, axis=-1))
        misfit, good = part.values - np.concatenate(predicted, axis=1), part.valid
        residual = np.linalg.norm(misfit[good]) / np.linalg.norm(part.values[good])
        residuals.append(float(residual))
        best = min(best, (residuals[-1], camera), key=lambda pair: pair[0])
        if number == max_rounds or (number >= MIN_ROUND_COUNT and moved_px < SETTLED_PX):
            break
        evidence = _Evidence(pictures, groups, misfit, part.valid, chosen)
        slope = np.gradient(measurement.values, axis=1)[:, chosen]
        before = camera.centres_px
        camera = _refine_camera(camera, start, evidence, slope, times is not None)
        moved_px = float(np.abs(camera.centres_px - before).max())
    return Registration(best[1], np.array(residuals))


def count_registration_iterations() -> int:
    """Frame iterations that `register_views` reports at most."""
    return (MAX_ROUND_COUNT + 1) * REGISTRATION_METHOD.work(MAX_FRAMES)


def _select_frames(measurement: Measurement) -> IndexArray:
    """Pick instants evenly in cumulated brightness: far and dim objects are represented too."""
    light = (measurement.values * measurement.valid).sum(axis=0, dtype=np.float64)
    brightness = np.sqrt(np.maximum(light, 0))
    share = np.cumsum(brightness) / brightness.sum()
    wanted = (np.arange(MAX_FRAMES) + 0.5) / MAX_FRAMES
    return np.unique(np.searchsorted(share, wanted).clip(0, brightness.size - 1))


Groups = list[tuple[slice, float]]
"""Consecutive ones of the chosen frames, and their shear in pixels per view step."""


def _refine_camera(
    camera: Camera, start: Camera, evidence: _Evidence, slope: Float32Array, knows_times: bool
) -> Camera:
    """Correct every view; the reference view keeps its time, gains average 1."""
    sweep = camera.sweep
    if not isinstance(sweep, SkewSweep):
        raise CalibrationError(
            "only a skew per view can be refined; this camera's sweep was measured as a whole"
        )
    drift = camera.centres_px - start.centres_px
    corrections = [
        evidence.solve_corrections(camera, view, drift[view], slope) for view in range(camera.views)
    ]
    offset, stretch, gain, centre = RELAXATION * np.transpose(corrections)
    centre = CENTRE_RELAXATION / RELAXATION * centre
    reference = int(np.argmin(np.abs(camera.view_positions)))
    gains = np.maximum(camera.gains * (1 + gain), 0.05)
    centres = camera.centres_px
    if camera.lenslet_pitch == 0:
        centres = centres + centre
    elif knows_times:
        # Without times, a scene at several ranges would only pull the centres about.
        centres = centres + _remove_picture_shift(camera, centre)
    improved = SkewSweep(
        centres,
        sweep.offsets_bin + offset - offset[reference],
        sweep.stretches + stretch - stretch[reference],
    )
    return camera.replace(centres_px=centres, gains=gains / gains.mean(), sweep=improved)


def _remove_picture_shift(camera: Camera, moves: FloatArray) -> FloatArray:
    """Leave out what would only shift the pictures: the part along 1 and tan(angle)."""
    if camera.views < MIN_VIEWS_TO_SHIFT:
        return moves
    shifts = np.stack([np.ones(camera.views), np.tan(camera.angles)], axis=1)
    return moves - shifts @ np.linalg.lstsq(shifts, moves, rcond=None)[0]


@dataclass(frozen=True)
class _Evidence:
    """What a round knows: pictures, their groups, and the misfit they leave, at the chosen rows."""

    pictures: Float32Array
    groups: Groups
    misfit: Float32Array
    valid: BoolArray
    rows: IndexArray

    def solve_corrections(
        self, camera: Camera, view: int, drift: float, slope: Float32Array
    ) -> FloatArray:
        """Offset (rows), stretch, relative gain and centre (px) that best explain one view's
        misfit. `slope` (columns, frames) is that of the measurements in time, a row. A centre that
        has drifted far from its calibration is held back by a prior of `CENTRE_PRIOR_PX`.
        """
        one = slice(view, view + 1)
        alone = camera.replace(
            centres_px=camera.centres_px[one],
            angles=camera.angles[one],
            gains=camera.gains[one],
            view_positions=camera.view_positions[one],
            sweep=None,
            angle_uncertainty=np.empty(0),
            centre_uncertainty_px=np.empty(0),
        )
        seen = [alone.operator(shear)(self.pictures[..., part]) for part, shear in self.groups]
        predicted = np.concatenate(seen, axis=1)
        half = camera.image_shape[1] // 2
        middle = round(camera.centres_px[view])
        window = slice(max(0, middle - half), middle + half + 1)
        energy = np.sqrt(np.sum(predicted**2, axis=0, dtype=np.float64))
        # bright columns count as much as dim ones; the floor keeps columns without light from
        # counting at all
        floor = FLOOR_FRACTION * energy.max() + np.finfo(np.float64).tiny
        weight = self.valid[window] / (energy + floor)
        slope, parallax = slope[window], np.gradient(predicted, axis=0)[window]
        effects = [-slope, -slope * self.rows, predicted[window], -parallax]
        design = np.stack([(effect * weight).ravel() for effect in effects], axis=1, dtype=float)
        target = (self.misfit[window] * weight).ravel()
        # The scaled normal equations, with the prior on the last unknown, the centre.
        scale = np.linalg.norm(design, axis=0) + np.finfo(np.float64).tiny
        scaled = design / scale
        normal, moment = scaled.T @ scaled, scaled.T @ target
        strength = float(np.mean(target**2)) / CENTRE_PRIOR_PX**2
        normal[-1, -1] += strength / scale[-1] ** 2
        moment[-1] -= strength * drift / scale[-1]
        # A view without any structure leaves a column of zeros: the ridge keeps its numbers as
        # they are.
        ridge = 1e-9 * np.eye(normal.shape[0])
        return np.linalg.solve(normal + ridge, moment) / scale


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

    The `measurement` of `camera` is rectified; `gates` are the frames of each, `shears` (n,) evenly
    spaced, pixels per view step, and `progress` is called with the number of frame iterations just
    done. `InputError` for fewer than two finite shears.
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
