"""The method "surfaces": the surfaces of a shot as points, with the frames that they render."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import scipy

from tofclip.arrays import FloatArray
from tofclip.camera import measure
from tofclip.camera.model import interpolate_linearly
from tofclip.errors import InputError
from tofclip.lidar import Detection
from tofclip.lidar.significance import DEFAULT_FALSE_ALARM
from tofclip.recovery.surfaces.amplitudes import REFINEMENT_ITERATIONS, START_ITERATIONS
from tofclip.recovery.surfaces.fit import MAX_REFINEMENTS, MIN_REFINEMENTS, fit_surfaces
from tofclip.recovery.surfaces.model import SurfaceModel
from tofclip.recovery.surfaces.pulse import EXTENT_SIGMAS, Image
from tofclip.recovery.surfaces.returns import list_returns
from tofclip.recovery.surfaces.start import call_dark, estimate_darkness
from tofclip.shots import Frames, Streak
from tofclip.solvers import Method, Progress, Sparse, TotalVariation, ignore_progress
from tofclip.units import SPEED_OF_LIGHT

# Of the light: what is left of shots that are as the model says is up to 0.03, of those with a floor that is
# too steep for frames 0.15 or more, and of ones so dark that a wall is not found 0.17 to 0.4.
MUCH_UNEXPLAINED = 0.05
NO_SHARES = Detection(min_scene_fraction=0.0, min_time_bin_fraction=0.0, min_pixel_fraction=0.0)


@dataclass(frozen=True)
class SurfaceRecovery:
    """Surfaces from a whole shot, and frames as their rendering.

    Parameters
    ----------
    weight : float
        Of total variation of the amplitudes, in standard deviations of what photon noise makes of
        the misfit's gradient. It needs no knowledge of the scene or of the light's amount.
    iterations : int
        Of FISTA after the ranges are known; before that there are 45 to 65 more.
    start : Method
        Recovers the frames in whose returns the surfaces are looked for.
    detection : Detection
        Which points of the surfaces are returned.
    otherwise : Method, optional
        Recovers the frames of a shot that is not of surfaces; without one it is refused.

    Notes
    -----
    Right for shots of surfaces: smoke, light in flight and relay walls stay with frames. Views are
    taken to see the same surfaces: what one hides from a view but not from another is not modelled.
    """

    weight: float = 2.0
    iterations: int = 60
    start: Method = field(default_factory=lambda: Sparse(iterations=40))
    detection: Detection = field(default_factory=lambda: NO_SHARES)
    otherwise: Method | None = None
    name = "surfaces"

    def __post_init__(self) -> None:
        if not (np.isfinite(self.weight) and self.weight > 0 and self.iterations >= 1):
            raise InputError("surfaces need a positive weight and at least one iteration")

    @property
    def steps(self) -> int:
        """Iterations of FISTA at most."""
        refinements = MIN_REFINEMENTS + MAX_REFINEMENTS
        return 2 * START_ITERATIONS + refinements * REFINEMENT_ITERATIONS + self.iterations

    def work(self, frames: int) -> int:
        """Frame iterations that are reported at most: the start's, one per frame and iteration, and
        those of the frames in place of surfaces.
        """
        instead = 0 if self.otherwise is None else self.otherwise.work(frames)
        return self.start.work(frames) + self.steps * frames + instead

    def recover_surfaces(
        self,
        streak: Streak,
        frames: Frames,
        progress: Progress = ignore_progress,
        calibrated_px: FloatArray | None = None,
    ) -> Frames:
        """Recover the surfaces of a shot.

        Parameters
        ----------
        streak : Streak
        frames : Frames
            A fast recovery of the same shot, with the camera to use.
        progress : callable
            Called with the number of frame iterations just done.
        calibrated_px : (views,) array, optional
            Slit centres as they were calibrated, if the camera's are others.

        Returns
        -------
        Frames
            With ``.returns``.

        Raises
        ------
        InputError
            Most of the light does not come from surfaces, or none stands out of the noise.
        """
        fit = fit_surfaces(streak, frames, self.weight, self.iterations, progress)
        returns = list_returns(fit, self.detection, calibrated_px)
        if not np.any(returns.false_alarm <= DEFAULT_FALSE_ALARM):
            raise call_dark(estimate_darkness(streak, frames))
        model, amplitude, camera = fit.whole.model, fit.whole.amplitude, returns.camera
        rendered, unknown = model.render(amplitude), model.weights == 0
        # Rectified like every other method's: its residual is of measurements, not of raw pixels.
        predicted, measured = (
            measure(image, unknown, model.camera, 0.0) for image in (rendered, model.image)
        )
        started = {name: one for name, one in frames.figures.items() if name != "duality_gap"}
        light, explained = (
            float(np.sum(image[~unknown], dtype=np.float64)) for image in (model.image, rendered)
        )
        if light - explained > MUCH_UNEXPLAINED * light:
            started["unexplained_light"] = 1 - explained / light
        error = np.linalg.norm((predicted.values - measured.values)[measured.valid])
        distance = SPEED_OF_LIGHT * np.maximum(frames.times / 2, frames.bin_width)
        return replace(
            frames,
            values=_render_frames(frames, model, model.shade(model.reference, amplitude)),
            camera=camera,
            figures={
                **started,
                "method": self.name,
                "focus": "depth-locked",
                "iterations": START_ITERATIONS
                + fit.refinement.steps * REFINEMENT_ITERATIONS
                + self.iterations,
                "stopped_because": "iterations done",
                "relative_residual": float(error / np.linalg.norm(measured.values[measured.valid])),
                "surfaces": len(fit.solver.model.masks),
            },
            shears=np.asarray(camera.shear_at(distance)),
            returns=returns,
        )


def _render_frames(start: Frames, model: SurfaceModel, amplitude: Image) -> Image:
    """The surfaces as a reference view without blur would see them over time."""
    lit = np.flatnonzero(amplitude)
    time = 2 * model.distance[lit] / SPEED_OF_LIGHT
    row = interpolate_linearly(time, start.times, np.arange(float(start.times.size)))
    sigma = model.pulse.sigma
    half = int(np.ceil(EXTENT_SIGMAS * sigma + 0.5))
    rows = np.round(row).astype(np.intp)[:, np.newaxis] + np.arange(-half, half + 2)
    upto = scipy.special.ndtr((rows - 0.5 - row[:, np.newaxis]) / sigma)
    light = amplitude[lit][:, np.newaxis] * np.diff(upto, axis=1)
    rows = rows[:, :-1]
    values = np.zeros(start.values.shape, np.float32)
    inside = (rows >= 0) & (rows < len(values))
    pixel = np.broadcast_to(model.pixel[lit][:, np.newaxis], rows.shape)
    np.add.at(values.reshape(len(values), -1), (rows[inside], pixel[inside]), light[inside])
    if model.pulse.reach:
        tail = model.pulse.extend(np.ones(1, np.float32))
        values = scipy.ndimage.convolve1d(values, tail, axis=0, mode="constant")
    return values


def recover_automatically() -> SurfaceRecovery:
    """Surfaces where a shot is of surfaces, otherwise frames by total variation."""
    return SurfaceRecovery(otherwise=TotalVariation())
