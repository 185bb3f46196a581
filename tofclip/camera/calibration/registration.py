"""Fine calibration from the shot itself: skew, gain and centre of every view, by lowering the data
residual.

Recovering the pictures and registering the views to them alternate. Given the pictures, a view's
measurements change to first order with its time offset, time stretch, gain and slit centre, so that
one small least-squares problem a view yields all four; a few rounds suffice because the coarse
calibration is within a pixel.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tofclip.camera import Camera, Measurement, SkewSweep, measure
from tofclip.errors import CalibrationError
from tofclip.operators import LineProjection
from tofclip.solvers import Progress, Sparse, ignore_progress, relative_residual

Array = NDArray[np.float32]
FloatArray = NDArray[np.float64]

ROUND_COUNT = 5
MAX_FRAMES = 320  # ten cache blocks, spread over the shot's energy
REGISTRATION_METHOD = Sparse(weight=1e-3, iterations=20)
RELAXATION = (
    1.5  # alternating steps fall short of the joint minimum; a measured speed-up without overshoot
)
CENTRE_PRIOR_PX = 1.0  # how far a slit centre may plausibly be off its calibration
FLOOR_FRACTION = 0.1  # frames dimmer than this share of the brightest count less, lest noise decide


@dataclass(frozen=True)
class Registration:
    """A refined camera and what the refinement gained.

    Parameters
    ----------
    camera : Camera
        With sweep, gains and centres refined.
    residuals : (rounds + 1,) array
        Relative data residual of the frames used, before each round and after the last.
    """

    camera: Camera
    residuals: FloatArray


def register_views(
    counts: Array,
    saturated: NDArray[np.bool_] | None,
    camera: Camera,
    progress: Progress = ignore_progress,
) -> Registration:
    """Refine a camera whose sweep is a `SkewSweep`.

    Parameters
    ----------
    counts : (rows, columns) array
        Raw streak image.
    saturated : (rows, columns) bool array or None
    camera : Camera
        Coarse calibration: centres within about a pixel, skew within a few rows.
    progress : callable
        Called with the number of frame iterations just done.

    Returns
    -------
    Registration
        The best camera of all rounds, and the residual of each.
    """
    start, residuals, best = camera, [], (np.inf, camera)
    for last in [False] * ROUND_COUNT + [True]:
        measurement = measure(counts, saturated, camera)
        chosen = _select_frames(measurement)
        part = Measurement(measurement.values[:, chosen], measurement.valid[:, chosen])
        operator = camera.operator()
        pictures = REGISTRATION_METHOD.recover(operator, part.values, part.valid, progress).frames
        residuals.append(relative_residual(operator, pictures, part.values, part.valid))
        best = min(best, (residuals[-1], camera), key=lambda pair: pair[0])
        if not last:
            camera = _refine_camera(camera, start, measurement, chosen, pictures)
    return Registration(best[1], np.array(residuals))


def count_registration_iterations() -> int:
    """Frame iterations that `register_views` reports."""
    return (ROUND_COUNT + 1) * REGISTRATION_METHOD.work(MAX_FRAMES)


def _select_frames(measurement: Measurement) -> NDArray[np.intp]:
    """Pick instants evenly in cumulated brightness, so that far and dim objects are represented
    too.
    """
    brightness = np.sqrt(
        np.maximum((measurement.values * measurement.valid).sum(axis=0, dtype=np.float64), 0)
    )
    share = np.cumsum(brightness) / brightness.sum()
    wanted = (np.arange(MAX_FRAMES) + 0.5) / MAX_FRAMES
    return np.unique(np.searchsorted(share, wanted).clip(0, brightness.size - 1))


def _refine_camera(
    camera: Camera,
    start: Camera,
    measurement: Measurement,
    chosen: NDArray[np.intp],
    pictures: Array,
) -> Camera:
    """Solve for every view's corrections and apply them; the reference view keeps its time, gains
    average 1.
    """
    sweep = camera.sweep
    if not isinstance(sweep, SkewSweep):
        raise CalibrationError(
            "only a skew per view can be refined; this camera's sweep was measured as a whole"
        )
    blocks = np.ascontiguousarray(np.moveaxis(pictures, 0, -1))
    misfit = measurement.values[:, chosen] - camera.operator()(blocks)
    slope = np.gradient(measurement.values, axis=1)[:, chosen]
    drift = camera.centres_px - start.centres_px
    evidence = _ViewResiduals(blocks, misfit, slope, measurement.valid[:, chosen], chosen)
    corrections = np.array(
        [evidence.solve_corrections(camera, view, drift[view]) for view in range(camera.views)]
    )
    offset, stretch, gain, centre = RELAXATION * corrections.T
    reference = int(np.argmin(np.abs(camera.view_positions)))
    gains = np.maximum(camera.gains * (1 + gain), 0.05)
    # Where the parallax was measured so were the centres; a scene at several ranges would only pull
    # them about.
    centres = camera.centres_px + centre * (camera.lenslet_pitch == 0)
    improved = SkewSweep(
        centres,
        sweep.offsets_bin + offset - offset[reference],
        sweep.stretches + stretch - stretch[reference],
    )
    return camera.replace(centres_px=centres, gains=gains / gains.mean(), sweep=improved)


@dataclass(frozen=True)
class _ViewResiduals:
    """What a round knows: pictures, the misfit they leave, the measurements' slope in time, all at
    the chosen rows.
    """

    pictures: Array
    misfit: Array
    slope: Array
    valid: NDArray[np.bool_]
    rows: NDArray[np.intp]

    def solve_corrections(self, camera: Camera, view: int, drift: float) -> FloatArray:
        """Offset (rows), stretch, relative gain and centre (px) that best explain one view's
        misfit.

        A centre that has drifted far from its calibration is held back by a prior of
        `CENTRE_PRIOR_PX`.

        Parameters
        ----------
        camera : Camera
        view : int
            Number of the view, from 0.
        drift : float
            How far the centre has moved from its calibration, px.

        Returns
        -------
        (4,) float64 array
            Offset in rows, stretch, relative gain and centre in px.
        """
        predicted = _make_view_projection(camera, view)(self.pictures)
        half = camera.image_shape[1] // 2
        middle = round(camera.centres_px[view])
        window = slice(max(0, middle - half), middle + half + 1)
        energy = np.sqrt(np.sum(predicted**2, axis=0, dtype=np.float64))
        weight = self.valid[window] / (
            # bright columns count as much as dim ones; the floor keeps columns without light from
            # counting at all
            energy + FLOOR_FRACTION * energy.max() + np.finfo(np.float64).tiny
        )
        slope, parallax = self.slope[window], np.gradient(predicted, axis=0)[window]
        effects = [-slope, -slope * self.rows, predicted[window], -parallax]
        design = np.stack(
            [(effect * weight).ravel() for effect in effects], axis=1, dtype=np.float64
        )
        return _solve_least_squares(design, (self.misfit[window] * weight).ravel(), drift)


def _make_view_projection(camera: Camera, view: int) -> LineProjection:
    one = slice(view, view + 1)
    return LineProjection(
        camera.image_shape,
        camera.slit_width_px,
        camera.centres_px[one],
        camera.angles[one],
        camera.gains[one],
    )


def _solve_least_squares(design: FloatArray, target: FloatArray, drift: float) -> FloatArray:
    """Solve the scaled normal equations, with the prior on the last unknown, the centre."""
    scale = np.linalg.norm(design, axis=0) + np.finfo(np.float64).tiny
    scaled = design / scale
    normal, moment = scaled.T @ scaled, scaled.T @ target
    strength = float(np.mean(target**2)) / CENTRE_PRIOR_PX**2
    normal[-1, -1] += strength / scale[-1] ** 2
    moment[-1] -= strength * drift / scale[-1]
    # A view without any structure leaves a column of zeros: the ridge keeps its numbers as they
    # are.
    solution: FloatArray = np.linalg.solve(normal + 1e-9 * np.eye(normal.shape[0]), moment) / scale
    return solution
