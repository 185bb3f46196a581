"""From a streak image and a camera to transient frames: the main path, as a paragraph."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from tofclip.arrays import CPU, ComputeDevice, parse_device, to_numpy
from tofclip.camera import Camera, Measurement, measure
from tofclip.camera.calibration.registration import count_registration_iterations, register_views
from tofclip.camera.calibration.skew import estimate_skew
from tofclip.errors import InputError
from tofclip.recovery.focus import DEFAULT_FOCUS, Focus
from tofclip.recovery.segments import compute_segments_residual, recover_segments
from tofclip.shots import Frames, Streak
from tofclip.solvers import (
    Backprojection,
    LinearInverse,
    Method,
    Progress,
    Sparse,
    TotalVariation,
    ignore_progress,
)
from tofclip.storage import Scalar
from tofclip.units import PICOSECOND

MAX_ROW_PER_PULSE = 100.0
"""Longest row, in widths of the pulse: beyond, the unit of one of them is wrong."""

METHODS: dict[str, Callable[..., Method]] = {
    "tv": TotalVariation,
    "l1": Sparse,
    "linear": LinearInverse,
    "adjoint": Backprojection,
}


def make_method(name: str, **settings: Any) -> Method:
    """Make a recovery method by its short name, with settings of its own where given.

    Parameters
    ----------
    name : str
        ``"tv"``, ``"l1"``, ``"linear"`` or ``"adjoint"``.
    **settings
        Passed on, such as ``iterations`` and ``weight`` of the iterative methods.
    """
    if name not in METHODS:
        raise InputError(f"unknown method '{name}'; choose one of {', '.join(METHODS)}")
    try:
        return METHODS[name](**settings)
    except TypeError as fault:
        raise InputError(f"method '{name}' does not take {', '.join(settings)}") from fault


@dataclass(frozen=True)
class RecoveryTask:
    """A recovery that is about to run, so that a progress bar can know its length.

    Parameters
    ----------
    streak : Streak
    camera : Camera
    method : Method
    focus : Focus
        At which shear each frame is recovered.
    device : Place
        Where: measurements are put there, and frames fetched from there. What precedes the recovery is
        done in NumPy.
    """

    streak: Streak
    camera: Camera
    method: Method
    focus: Focus = DEFAULT_FOCUS
    device: ComputeDevice = CPU

    @property
    def work(self) -> int:
        """Frame iterations that will be reported at most."""
        frames = self.streak.counts.shape[0]
        own = self.method.work(frames) + self.focus.work(frames)
        return own + (count_registration_iterations() if self.camera.sweep is None else 0)

    def run(self, progress: Progress = ignore_progress) -> Frames:
        """Recover; see `recover`."""
        started = time.perf_counter()
        camera = self.camera
        if camera.sweep is None:
            camera = fit_camera_to_shot(self.streak, camera, progress)
        measurement = measure(self.streak.counts, self.streak.saturated, camera)
        times = self.streak.times - camera.time_zero
        solving = time.perf_counter()
        pieces = self.focus.plan_segments(camera, times, measurement, progress)
        with self.device.activate():
            there = Measurement(
                self.device.put(measurement.measurements), self.device.put(measurement.valid)
            )
            result = recover_segments(self.method, camera, there, pieces, progress)
            values = to_numpy(result.frames)
            solved = time.perf_counter()
            residual = compute_segments_residual(camera, result.frames, there, pieces)
        figures: dict[str, Scalar] = {
            "method": self.method.name,
            "focus": str(self.focus),
            "iterations": result.iterations,
            "stopped_because": result.stop_reason,
            "relative_residual": residual,
            "seconds": time.perf_counter() - started,
            "frames_per_second": result.frames.shape[0] / (solved - solving - result.setup_seconds),
            "setup_seconds": result.setup_seconds,
            "device": str(self.device),
        }
        return Frames(
            values=values,
            times=times,
            camera=camera,
            shears=np.repeat([piece.shear for piece in pieces], [piece.size for piece in pieces]),
            figures=figures,
            attachments=self.streak.attachments,
            provenance={**self.streak.provenance, "objective": result.objective.tolist()},
        )


def recover(
    streak: Streak,
    camera: Camera | None = None,
    method: str | Method = "tv",
    progress: Progress = ignore_progress,
    focus: Focus | None = None,
    device: str = "cpu",
) -> Frames:
    """Recover every transient frame of a streak image.

    A camera without a sweep has it estimated from the shot (`estimate_skew`), refined together with
    the views' gains and centres (`register_views`); the frames carry the camera that was used.

    Parameters
    ----------
    streak : Streak
        With a time axis.
    camera : Camera, optional
        Defaults to the one that the streak image carries.
    method : str or Method
        ``"tv"`` (default), ``"l1"``, ``"linear"``, ``"adjoint"``, or a configured `tofclip.solvers`
        method.
    progress : callable
        Called with the number of frame iterations just done.
    focus : Focus, optional
        `FixedFocus` (the default, at shear 0), `DepthLocked` or `SharpestFocus` of
        `tofclip.recovery`.
    device : str
        ``"cpu"``, ``"cuda"``, ``"cuda:1"``, ``"auto"`` or a PyTorch device, see
        `tofclip.arrays.parse_device`.

    Returns
    -------
    Frames
        ``(time, y, x)`` in counts, with time of flight in seconds.

    Raises
    ------
    MissingTimeAxisError
        The streak image does not say how long a row lasts.
    CalibrationError
        The camera does not belong to the streak image.
    InputError
        There is no camera, no light, or no such method or name of a device.
    MissingDependencyError
        There is no such device.
    """
    return prepare_recovery(streak, camera, method, focus, device).run(progress)


def prepare_recovery(
    streak: Streak,
    camera: Camera | None = None,
    method: str | Method = "tv",
    focus: Focus | None = None,
    device: str = "cpu",
) -> RecoveryTask:
    """Check what `recover` needs before any work is done; arguments as there.

    Parameters
    ----------
    streak : Streak
    camera : Camera, optional
        Instead of the one that the streak image carries.
    method : str or Method
    focus : Focus, optional
    device : str
        See `tofclip.arrays.parse_device`.

    Returns
    -------
    RecoveryTask

    Raises
    ------
    InputError
        There is no camera, the shot has no time axis, or the focus does not fit the camera.
    """
    camera = camera or streak.camera
    if camera is None:
        raise InputError(
            f"{streak.source} carries no camera: give one (--camera camera.h5, made by calibrate)"
        )
    require_plausible_rows(streak, camera)  # before minutes of work
    focus = DEFAULT_FOCUS if focus is None else focus
    focus.check_camera(camera)
    solver = make_method(method) if isinstance(method, str) else method
    return RecoveryTask(streak, camera, solver, focus, parse_device(device))


def require_plausible_rows(streak: Streak, camera: Camera) -> None:
    """Refuse a time axis whose rows do not go with the camera's pulse, as of a wrong unit.

    Parameters
    ----------
    streak : Streak
    camera : Camera

    Raises
    ------
    MissingTimeAxisError
        There is no time axis.
    InputError
        A row is far longer than the pulse, or all rows together are shorter than it.
    """
    times, pulse = streak.times, camera.pulse_fwhm
    rows = times.size
    width = (times[-1] - times[0]) / max(rows - 1, 1)
    if width > MAX_ROW_PER_PULSE * pulse:
        fault = f"is {width / pulse:.3g} times as long as the pulse"
    elif 0 < width * rows < pulse:
        fault = f"is so short that all {rows} rows are shorter than the pulse"
    else:
        return
    raise InputError(
        f"{streak.source}: a row of {width / PICOSECOND:.4g} ps {fault} ({pulse / PICOSECOND:.3g} ps); "
        "check the unit of --bin-width-ps, or give the pulse to calibrate (--pulse-ps)"
    )


def fit_camera_to_shot(
    streak: Streak, camera: Camera, progress: Progress = ignore_progress
) -> Camera:
    """Return `camera` with sweep, gains and centres found from the shot itself.

    Parameters
    ----------
    streak : Streak
    camera : Camera
        Where the search starts.
    progress : callable
        Called as the search for the views goes on.

    Returns
    -------
    Camera
    """
    skew = estimate_skew(streak.counts, camera)
    coarse = replace(camera, sweep=skew.sweep)
    return register_views(streak.counts, streak.saturated, coarse, progress).camera


def compute_view_delays_bins(camera: Camera) -> list[float]:
    """Rows by which each view is late at the first row, relative to the reference view."""
    if camera.sweep is None:
        return [0.0] * camera.views
    rows, _ = camera.sweep.raw_position(np.zeros(camera.views), camera.centres_px)
    reference = int(np.argmin(np.abs(camera.view_positions)))
    return [float(row) for row in rows - rows[reference]]
