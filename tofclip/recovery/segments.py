"""Recovering frames segment by segment, each with the operator of its own shear."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tofclip.arrays import Array, ComputeDevice, namespace, to_numpy, zeros
from tofclip.camera import Camera, Measurement
from tofclip.camera.measurement import find_glints
from tofclip.operators import LinearOperator
from tofclip.recovery.focus import FrameSegment
from tofclip.solvers import (
    Method,
    Progress,
    ProximalMethod,
    Result,
    ignore_progress,
    relative_residual,
)
from tofclip.solvers.loops import frames_per_block
from tofclip.threads import split_blocks


def recover_segments(
    method: Method,
    camera: Camera,
    measurement: Measurement,
    segments: Sequence[FrameSegment],
    progress: Progress = ignore_progress,
) -> Result:
    """Recover all frames, each segment with the operator of its own shear.

    A prior's weight is relative to the brightest of the frames it is given. For segments to be
    treated alike, it is made relative to what a surface like the shot's brightest would send back
    from each segment's range.

    `measurement`: its arrays may be of any library that the method takes; the frames are where they
    are; `segments`: all frames, in order; `progress`: called with the number of frame iterations
    just done. Returns frames (frames, rows, columns).

    Memory: the frames, and one operator at a time.
    """
    if len(segments) == 1:
        operator = camera.operator(segments[0].shear)
        return method.recover(operator, measurement.values, measurement.valid, progress)
    peaks = np.array(
        [
            _find_backprojection_peak(
                camera.operator(segment.shear), _slice_measurement(measurement, segment)
            )
            for segment in segments
        ]
    )
    expected = np.array([segment.brightness for segment in segments])
    # the shot's brightest surface, as each segment's range would show it
    scale = (np.maximum(peaks, 0) / expected).max() * expected
    frames = zeros((measurement.values.shape[1], *camera.image_shape), measurement.values)
    results = []
    for segment, peak, bright in zip(segments, peaks, scale, strict=True):
        if peak <= 0:
            progress(method.work(segment.size))  # dark: nothing to recover
            continue
        part = _slice_measurement(measurement, segment)
        weighted = (
            # a prior's weight is relative to the brightest frame of what the solver is given
            replace(method, weight=method.weight * bright / peak)
            if isinstance(method, ProximalMethod)
            else method
        )
        result = weighted.recover(camera.operator(segment.shear), part.values, part.valid, progress)
        frames[segment.frames, ...] = result.frames
        results.append(replace(result, frames=frames[segment.frames, ...]))
    return _join_results(frames, results)


def recover_glints(
    frames: NDArray[np.float32],
    method: Method,
    camera: Camera,
    measurement: Measurement,
    segments: Sequence[FrameSegment],
    dazzled: NDArray[np.bool_],
    device: ComputeDevice,
) -> NDArray[np.float32]:
    """Return the frames with the pixels that dazzled measurements alone see.

    `frames` (frames, rows, columns): recovered without the dazzled measurements; `measurement`:
    NumPy arrays; `dazzled` (readings, frames); `device`: where the method runs. Returns (frames,
    rows, columns).
    """
    complete = frames.copy()
    for segment in segments:
        own = np.arange(dazzled.shape[1])[segment.frames]
        some = own[dazzled[:, own].any(axis=0)]
        if not some.size:
            continue
        operator = camera.operator(segment.shear)
        whole = method.recover(
            operator,
            device.put(np.ascontiguousarray(measurement.values[:, some])),
            device.put(np.ascontiguousarray(measurement.valid[:, some])),
        )
        glints = find_glints(operator, dazzled[:, some])
        complete[some] = np.where(glints, to_numpy(whole.frames), complete[some])
    return complete


def compute_segments_residual(
    camera: Camera, frames: Array, measurement: Measurement, segments: Sequence[FrameSegment]
) -> float:
    """Return ``|F h - f| / |f|`` over all valid measurements, each frame with its own operator.

    `frames` (frames, rows, columns): recovered; `segments`: without gaps; each has its shear.
    Returns 0 is a perfect fit.
    """
    misfit = energy = 0.0
    for segment in segments:
        part = _slice_measurement(measurement, segment)
        xp = namespace(part.values)
        own = float(xp.sum(_zero_invalid(part) ** 2, dtype=xp.float64))
        if own > 0:
            operator = camera.operator(segment.shear)
            misfit += (
                own
                * relative_residual(operator, frames[segment.frames, ...], part.values, part.valid)
                ** 2
            )
            energy += own
    return float(np.sqrt(misfit / energy))


def _slice_measurement(measurement: Measurement, segment: FrameSegment) -> Measurement:
    columns = segment.frames
    return Measurement(measurement.values[:, columns], measurement.valid[:, columns])


def _zero_invalid(part: Measurement) -> Array:
    """Return the measurements, zero where they are not valid."""
    return namespace(part.values, part.valid).where(part.valid, part.values, 0.0)


def _find_backprojection_peak(operator: LinearOperator, part: Measurement) -> float:
    """Return the largest value of F'f over the valid measurements."""
    xp, measurements = namespace(part.values), _zero_invalid(part)
    blocks = split_blocks(measurements.shape[1], frames_per_block(operator, measurements))
    return max(float(xp.max(operator.adjoint(measurements[:, block]))) for block in blocks)


def _join_results(frames: Array, results: list[Result]) -> Result:
    """Join what is known about the segments; those that stopped early count with their last
    objective.
    """
    longest = max(result.objective.size for result in results)
    objective = np.zeros(longest)
    for result in results:
        if result.objective.size:
            # a segment that ended early keeps its last objective
            objective += np.pad(result.objective, (0, longest - result.objective.size), "edge")
    reasons = {result.stop_reason for result in results}
    return Result(
        frames,
        max(result.iterations for result in results),
        objective,
        "iteration limit" if "iteration limit" in reasons else results[0].stop_reason,
        sum(result.setup_seconds for result in results),
        _join_gaps(results),
    )


def _join_gaps(results: list[Result]) -> float:
    """The duality gap of all segments as a fraction of all their objectives; NaN where one has none."""
    last = [result.objective[-1] if result.objective.size else np.nan for result in results]
    excess = sum(result.duality_gap * value for result, value in zip(results, last, strict=True))
    return float(excess / sum(last)) if sum(last) > 0 else float("nan")
