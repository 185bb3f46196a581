"""From a streak image and a camera to transient frames: a shot is opened, planned and run.

The three steps, in this order: `open_shot` settles which camera took the shot and where its time
zero lies, `plan_recovery` checks method, focus and device against it, and `RecoveryPlan.run` does
the work, segment by segment, each with the operator of its own shear. `recover` is the three in one
call. docs/recovery_algorithm.md has the equations.
"""

from __future__ import annotations

import re
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from tofclip.arrays import (
    CPU,
    Array,
    BoolArray,
    ComputeDevice,
    Float32Array,
    FloatArray,
    namespace,
    parse_device,
    to_numpy,
    zeros,
)
from tofclip.camera import Camera, Measurement, measure
from tofclip.camera.noise import MeasurementNoise, find_dazzled, find_glints
from tofclip.camera.registration import count_registration_iterations
from tofclip.errors import InputError, require_type
from tofclip.plugins import DENOISERS, METHODS, list_settings
from tofclip.recovery.defects import (
    clip_from_below,
    count_defects,
    describe_noise,
    find_clipping_level,
    list_noise_figures,
)
from tofclip.recovery.shot import (
    DEFAULT_FOCUS,
    DepthLockedFocus,
    Focus,
    FrameSegment,
    Shot,
    count_needless_rows,
    open_shot,
    parse_focus,
)
from tofclip.recovery.surfaces import SurfaceRecovery
from tofclip.shots import RELAY_WALL, Frames, Streak
from tofclip.solvers import (
    DataTermMaker,
    IterationHistory,
    LeastSquares,
    Method,
    Progress,
    Result,
    ignore_progress,
)
from tofclip.solvers.methods import frames_per_block, sum_residual
from tofclip.storage import Scalar, collect_provenance
from tofclip.threads import split_blocks, thread_count

# Of memory: the operator with its transpose, for each view and pixel; blocks of frames, for each thread and
# pixel; compiled code. Frames with what is made beside them, in sizes of the frames, and what is added
# by surfaces and by fitting the camera
OPERATOR_BYTES, BLOCKS_BYTES, COMPILED_BYTES = 32, 768, 130 << 20
FRAMES_COPIES, SURFACES_COPIES, FITTING_COPIES = 1.7, 2.6, 0.5

AnyMethod = Method | SurfaceRecovery
DEFAULT_METHOD = "auto"

# Of `l1` where iterations are not given: a bright shot needs more of them than a dark one. In shots with
# 20 photons in the brightest pixel the solution without negative values turns the noise into single
# bright pixels, and empties those between: after 25 iterations 25 and 34 % of two scenes' pixels are
# missed, after 40 33 and 41 %. Noise alone falls as slowly from the 19th iteration on.
SPARSE_SETTINGS = {"further": 40, "noise_fall": 2e-3}


def make_method(name: str, **settings: Any) -> AnyMethod:
    """Make a recovery method by its short name, with settings of its own where given.

    Parameters
    ----------
    name : str
        ``"auto"`` (``"surfaces"`` where a shot is of surfaces, otherwise ``"tv"``; with settings
        always ``"tv"``, whose they are), ``"tv"``, ``"l1"``, ``"wavelet"``, ``"linear"``,
        ``"adjoint"``, ``"surfaces"``, ``"pnp"``, ``"red"``, or one of another package
        (`tofclip.plugins.METHODS`).
    **settings
        Passed on, such as ``iterations`` and ``weight`` of the iterative methods, or ``denoiser``, by
        name too, together with its own; None stands for the method's own, and texts are read.
        Methods with a denoiser pass iterations and weight on to the total variation that they
        begin at.

    Raises
    ------
    InputError
        There is no such method, or it has no such setting.

    Examples
    --------
    >>> make_method("tv", iterations=100, weight=None).iterations
    100
    >>> make_method("pnp", denoiser="nlm", patch_px=7, iterations=20).denoiser.patch_px
    7
    """
    given = {setting: value for setting, value in settings.items() if value is not None}
    if name == DEFAULT_METHOD and given:
        name = "tv"
    known = list_settings(METHODS[name])
    if name == "l1" and "iterations" not in given:
        given = {**SPARSE_SETTINGS, **given}
    further = {one: given.pop(one) for one in [*given] if one not in known}
    denoiser, others = given.get("denoiser"), dict[str, Any]()
    if isinstance(denoiser, str):
        others = list_settings(DENOISERS[denoiser])
        own = {one: further.pop(one) for one in others if one in further}
        given["denoiser"] = DENOISERS.make(denoiser, own)
    if "start" in known and further and further.keys() <= {"iterations", "weight"}:
        given["start"], further = METHODS.make("tv", further), {}
    return METHODS.make(name, given | further, others)


@dataclass(frozen=True)
class RecoveryPlan:
    """A recovery that was checked and can be run: of a `shot` by a `method`, each frame at the
    shear that the `focus` says, on a `device`: measurements are put there, and frames fetched
    from there. What precedes the recovery is done in NumPy.
    """

    shot: Shot
    method: AnyMethod
    focus: Focus
    device: ComputeDevice

    @property
    def work(self) -> int:
        """Frame iterations that will be reported at most."""
        frames = self.shot.streak.counts.shape[0]
        fitting = 0 if self.shot.camera.sweep is not None else count_registration_iterations()
        return int(fitting + self.focus.work(frames) + self.method.work(frames))

    @property
    def memory_bytes(self) -> int:
        """About how many bytes this takes at its peak, beside what the process has already. Shots of 64 x
        64 to 172 x 140 pixels took 0.7 to 1.2 of it.
        """
        camera, (rows, columns) = self.shot.camera, self.shot.streak.counts.shape
        pixels = camera.image_shape[0] * camera.image_shape[1]
        copies = FRAMES_COPIES
        copies += SURFACES_COPIES if isinstance(self.method, SurfaceRecovery) else 0
        copies += FITTING_COPIES if camera.sweep is None else 0
        frames = copies * rows * pixels * np.dtype(np.float32).itemsize
        measured = rows * columns * (np.dtype(np.float32).itemsize + np.dtype(bool).itemsize)
        beside = (OPERATOR_BYTES * camera.views + BLOCKS_BYTES * thread_count()) * pixels
        return int(frames + measured + beside + COMPILED_BYTES)

    def run(self, progress: Progress = ignore_progress) -> Frames:
        """Recover every frame, as `recover` does; `progress` is called with the number of frame
        iterations just done, `work` of them at most.
        """
        started = time.perf_counter()
        shot, method = self.shot.fit_camera(progress), self.method
        if isinstance(method, SurfaceRecovery):
            found = self._recover_surfaces(shot, method, progress)
            seconds = time.perf_counter() - started
            pace = {"seconds": seconds, "frames_per_second": found.times.size / seconds}
        else:
            found = self._recover_frames(shot, method, self.focus, progress)
            pace = {"seconds": time.perf_counter() - started}
        return replace(found, figures={**found.figures, **pace})

    def _recover_frames(
        self, shot: Shot, method: Method, focus: Focus, progress: Progress
    ) -> Frames:
        """Recover the frames of a shot whose camera is known."""
        streak, clipping = shot.streak, find_clipping_level(shot.streak.counts)
        measurement = measure(streak.counts, streak.saturated, shot.camera)
        found = recover_measurement(
            method,
            shot.camera,
            shot.times,
            measurement,
            describe_noise(streak, measurement) if method.has_prior else None,
            focus,
            self.device,
            clip_from_below(streak, clipping),
            progress,
        )
        of_shot = {
            "method": method.name,
            "focus": str(focus),
            "device": str(self.device),
            **count_defects(streak, clipping),
        }
        return replace(
            found,
            figures={**found.figures, **of_shot},
            attachments=streak.attachments,
            provenance={**streak.provenance, **found.provenance},
        )

    def _recover_surfaces(self, shot: Shot, method: SurfaceRecovery, progress: Progress) -> Frames:
        """Recover frames, quickly, and then the surfaces in them; or better frames where there are none."""
        why = None
        if method.otherwise is not None and RELAY_WALL in shot.streak.attachments:
            why = "the light is that of a relay wall"
        elif method.otherwise is not None and self.focus != DEFAULT_FOCUS:
            why = "frames at a given focus are asked for"
        if why is None:
            focus = DepthLockedFocus() if shot.camera.lenslet_pitch > 0 else self.focus
            coarse = shot.merge_rows(count_needless_rows(shot))
            start = self._recover_frames(coarse, method.start, focus, progress)
            try:
                found = method.recover_surfaces(coarse.streak, start, progress, shot.calibrated_px)
            except InputError as fault:
                if method.otherwise is None:
                    raise
                # without what a message advises whoever asked for surfaces
                why = re.split("[:;] (?:this shot|choose)", str(fault))[0]
            else:
                # a sweep is that of the shot's own rows
                camera = found.camera.replace(sweep=shot.camera.sweep)
                assert found.returns is not None
                return replace(found, camera=camera, returns=replace(found.returns, camera=camera))
        assert method.otherwise is not None
        found = self._recover_frames(shot, method.otherwise, self.focus, progress)
        return replace(found, figures={**found.figures, "why_no_surfaces": why})

    def add_provenance(self, frames: Frames, *inputs: str | Path) -> Frames:
        """Return `frames` of `run` that say how they came about; `inputs` are files that the result
        depends on, whose hashes are noted.
        """
        used = self.method
        if isinstance(used, SurfaceRecovery) and used.otherwise is not None:
            found = "why_no_surfaces" not in frames.figures
            used = replace(used, otherwise=None) if found else used.otherwise
        settings = {
            "verb": "recover",
            # a class by its name, not by where the code has it today
            "method": re.sub(r"<class '[\w.]*?(\w+)'>", r"\1", repr(used)),
            "focus": str(self.focus),
            "time_zero_s": self.shot.camera.time_zero,
        }
        past = collect_provenance(settings, *inputs) | {"earlier": dict(frames.provenance)}
        return replace(frames, provenance=past)


def plan_recovery(
    shot: Shot,
    method: str | AnyMethod = DEFAULT_METHOD,
    focus: str | Focus = DEFAULT_FOCUS,
    device: str = "cpu",
) -> RecoveryPlan:
    """Check, before any work is done, that a shot can be recovered as asked.

    Parameters
    ----------
    shot : Shot
        Of `open_shot`.
    method : str or Method
        A name that `make_method` knows, or a configured `tofclip.solvers` method.
    focus : str or Focus
        As `parse_focus` reads it, or `FixedFocus`, `DepthLockedFocus` or `SharpestFocus`.
    device : str
        See `tofclip.arrays.parse_device`.

    Raises
    ------
    CalibrationError
        The camera does not know enough for this focus.
    InputError
        There is no such method, focus or name of a device.
    MissingDependencyError
        There is no such device.
    """
    chosen = parse_focus(focus) if isinstance(focus, str) else focus
    chosen.check_camera(shot.camera)
    solver = make_method(method) if isinstance(method, str) else method
    return RecoveryPlan(shot, solver, chosen, parse_device(device))


def recover(
    streak: Streak,
    camera: Camera | None = None,
    method: str | AnyMethod = DEFAULT_METHOD,
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
        A name that `tofclip.recovery.make_method` knows, a configured method of `tofclip.solvers`,
        or a `SurfaceRecovery`. By default ``"auto"``: surfaces where the shot is of surfaces, whose
        frames are a rendering of them; otherwise frames by total variation. Figure ``"method"`` of
        the frames says which, and ``"why_no_surfaces"`` why.
    progress : callable
        Called with the number of frame iterations just done.
    focus : Focus, optional
        `FixedFocus` (the default, at shear 0), `DepthLockedFocus` or `SharpestFocus` of
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

    Examples
    --------
    >>> import numpy as np
    >>> import tofclip
    >>> from tofclip.camera.model import SkewSweep
    >>> centres, angles = np.array([20.0, 60.0, 100.0]), np.array([-0.4, 0.0, 0.4])
    >>> sweep = SkewSweep(centres, np.zeros(3), np.zeros(3))
    >>> camera = tofclip.Camera(centres, angles, (16, 16), 121, sweep=sweep)
    >>> counts = np.zeros((40, 121), np.float32)
    >>> counts[20] = camera.operator()(np.eye(16, dtype=np.float32))
    >>> streak = tofclip.Streak(counts, row_times=np.arange(40) * 20e-12)
    >>> frames = tofclip.recover(streak, camera, method="linear")
    >>> frames.values.shape, int(frames.values.sum(axis=(1, 2)).argmax())
    ((40, 16, 16), 20)
    """
    require_type(streak, Streak, "recover takes a Streak, see tofclip.read_streak")
    shot = open_shot(streak, camera)
    return plan_recovery(shot, method, focus or DEFAULT_FOCUS, device).run(progress)


def recover_measurement(
    method: Method,
    camera: Camera,
    times: FloatArray,
    measurement: Measurement,
    noise: MeasurementNoise | None,
    focus: Focus = DEFAULT_FOCUS,
    device: ComputeDevice = CPU,
    data_term: DataTermMaker = LeastSquares,
    progress: Progress = ignore_progress,
) -> Frames:
    """Recover frames from rectified measurements (columns, frames) at `times`, s, with the figures by
    which their returns are judged where the `noise` of the measurements is known.
    """
    solving = time.perf_counter()
    segments = focus.plan_segments(camera, times, measurement=measurement, progress=progress)
    dazzled = None if noise is None else find_dazzled(measurement, noise)
    used = measurement.valid if dazzled is None else measurement.valid & ~dazzled
    with device.activate():
        on_device = Measurement(device.put(measurement.values), device.put(used))
        fitted = method.with_data_term(data_term)
        result = recover_segments(fitted, camera, on_device, segments, progress)
        values = to_numpy(result.frames)
        if dazzled is not None and dazzled.any():
            values = recover_glints(values, method, camera, measurement, segments, dazzled, device)
        solved = time.perf_counter()
        # measured with the frames where they were recovered: nothing is fetched twice
        residual = compute_segments_residual(camera, result.frames, on_device, segments)
    figures: dict[str, Scalar] = {
        "iterations": result.iterations,
        "stopped_because": result.stop_reason,
        "relative_residual": residual,
        "frames_per_second": times.size / (solved - solving - result.setup_seconds),
        "setup_seconds": result.setup_seconds,
        **({} if noise is None else list_noise_figures(noise, measurement, used, residual)),
    }
    if np.isfinite(result.duality_gap):
        figures["duality_gap"] = result.duality_gap
    return Frames(
        values=values,
        times=times,
        camera=camera,
        shears=np.repeat([one.shear for one in segments], [one.size for one in segments]),
        figures=figures,
        provenance={"objective": result.objective.tolist()},
        measured=np.where(used, measurement.values, np.float32(np.nan)),
    )


def recover_segments(
    method: Method,
    camera: Camera,
    measurement: Measurement,
    segments: Sequence[FrameSegment],
    progress: Progress = ignore_progress,
) -> Result:
    """Recover all frames, of arrays of any library that the method takes, each segment with the
    operator of its own shear.

    A prior's weight is relative to the brightest of the frames it is given. For segments to be
    treated alike, it is made relative to what a surface like the shot's brightest would send back
    from each segment's range. Memory: the frames, and one operator at a time.
    """
    if len(segments) == 1:
        operator = camera.operator(segments[0].shear)
        return method.recover(operator, measurement.values, measurement.valid, progress)
    peaks = np.array([_find_peak(camera, measurement, segment) for segment in segments])
    expected = np.array([segment.brightness for segment in segments])
    # the shot's brightest surface, as each segment's range would show it
    scale = (np.maximum(peaks, 0) / expected).max() * expected
    frames = zeros((measurement.values.shape[1], *camera.image_shape), measurement.values)
    results = []
    for segment, peak, bright in zip(segments, peaks, scale, strict=True):
        if peak <= 0:
            progress(method.work(segment.size))  # dark: nothing to recover
            continue
        part, operator = measurement.select(segment.frames), camera.operator(segment.shear)
        weighted = method.scale_weight(float(bright / peak))
        result = weighted.recover(operator, part.values, part.valid, progress)
        frames[segment.frames, ...] = result.frames
        results.append(replace(result, frames=frames[segment.frames, ...]))
    return _join_results(frames, results)


def _find_peak(camera: Camera, measurement: Measurement, segment: FrameSegment) -> float:
    """Largest value of F'f over a segment's valid measurements."""
    operator = camera.operator(segment.shear)
    part = measurement.select(segment.frames)
    xp = namespace(part.values, part.valid)
    measurements = xp.where(part.valid, part.values, 0.0)
    blocks = split_blocks(measurements.shape[1], frames_per_block(operator, measurements))
    return max(float(xp.max(operator.adjoint(measurements[:, block]))) for block in blocks)


def _join_results(frames: Array, results: list[Result]) -> Result:
    """Join what is known about the segments, as about a method's own blocks."""
    setup_seconds = sum(one.setup_seconds for one in results)
    if not results[0].objective.size:
        return Result(frames, setup_seconds=setup_seconds)
    histories = [
        IterationHistory(one.objective, False, one.duality_gap * one.objective[-1])
        for one in results
    ]
    reasons = {one.stop_reason for one in results}
    reason = "iterations done" if "iterations done" in reasons else results[0].stop_reason
    joined = Result.from_blocks(frames, histories, setup_seconds)
    return replace(joined, stop_reason=reason)


def recover_glints(
    frames: Float32Array,
    method: Method,
    camera: Camera,
    measurement: Measurement,
    segments: Sequence[FrameSegment],
    dazzled: BoolArray,
    device: ComputeDevice,
) -> Float32Array:
    """Return frames recovered without dazzled measurements, with the pixels that only these see."""
    complete = frames.copy()
    for segment in segments:
        own = np.arange(dazzled.shape[1])[segment.frames]
        some = own[dazzled[:, own].any(axis=0)]
        if not some.size:
            continue
        operator, part = camera.operator(segment.shear), measurement.select(some)
        whole = method.recover(operator, device.put(part.values), device.put(part.valid))
        glints = find_glints(operator, dazzled[:, some])
        complete[some] = np.where(glints, to_numpy(whole.frames), complete[some])
    return complete


def compute_segments_residual(
    camera: Camera, frames: Array, measurement: Measurement, segments: Sequence[FrameSegment]
) -> float:
    """Return ``|F h - f| / |f|`` over all valid measurements, each frame with its own operator."""
    sums = []
    for segment in segments:
        part, operator = measurement.select(segment.frames), camera.operator(segment.shear)
        sums.append(sum_residual(operator, frames[segment.frames, ...], part.values, part.valid))
    misfit, energy = np.sum(sums, axis=0)
    return float(np.sqrt(misfit / energy))
