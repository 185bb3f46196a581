"""Recover a shot piece by piece, each with the operator of its own shear."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from tofclip.arrays import Array, namespace, zeros
from tofclip.camera import Camera, Measurement
from tofclip.operators import LinearOperator
from tofclip.recovery.focus import FrameSegment
from tofclip.solvers import Method, Progress, Result, ignore_progress, relative_residual
from tofclip.solvers.fista import ProximalMethod
from tofclip.solvers.loops import frames_per_block
from tofclip.threads import split_blocks


def recover_segments(
    method: Method,
    camera: Camera,
    measurement: Measurement,
    pieces: Sequence[FrameSegment],
    progress: Progress = ignore_progress,
) -> Result:
    """Recover all frames.

    A prior's weight is relative to the brightest of the frames it is given. For pieces to be
    treated alike, it is made relative to what a surface like the shot's brightest would send back
    from each piece's range.

    Parameters
    ----------
    method : Method
    camera : Camera
    measurement : Measurement
        Its arrays may be of any library that the method takes; the frames are where they are.
    plan_segments : sequence of Piece
        All frames, in order.
    progress : callable
        Called with the number of frame iterations just done.

    Returns
    -------
    Result
        Frames (frames, rows, columns).

    Notes
    -----
    Memory: the frames, and one operator at a time.
    """
    if len(pieces) == 1:
        operator = camera.operator(pieces[0].shear)
        return method.recover(operator, measurement.measurements, measurement.valid, progress)
    peaks = np.array(
        [
            _find_backprojection_peak(
                camera.operator(piece.shear), _slice_measurement(measurement, piece)
            )
            for piece in pieces
        ]
    )
    expected = np.array([piece.brightness for piece in pieces])
    scale = (np.maximum(peaks, 0) / expected).max() * expected
    frames = zeros(
        (measurement.measurements.shape[1], *camera.image_shape), measurement.measurements
    )
    results = []
    for piece, peak, bright in zip(pieces, peaks, scale, strict=True):
        if peak <= 0:
            progress(method.work(piece.size))  # dark: nothing to recover
            continue
        part = _slice_measurement(measurement, piece)
        weighted = (
            replace(method, weight=method.weight * bright / peak)
            if isinstance(method, ProximalMethod)
            else method
        )
        result = weighted.recover(
            camera.operator(piece.shear), part.measurements, part.valid, progress
        )
        frames[piece.frames, ...] = result.frames
        results.append(replace(result, frames=frames[piece.frames, ...]))
    return _join_results(frames, results)


def compute_segments_residual(
    camera: Camera, frames: Array, measurement: Measurement, pieces: Sequence[FrameSegment]
) -> float:
    """``|F h - f| / |f|`` over all good measurements, each frame with its own operator.

    Parameters
    ----------
    camera : Camera
    frames : (frames, rows, columns) array
        Recovered.
    measurement : Measurement
    pieces : sequence of FrameSegment
        Without gaps; each has its shear.

    Returns
    -------
    float
        0 is a perfect fit.
    """
    misfit = energy = 0.0
    for piece in pieces:
        part = _slice_measurement(measurement, piece)
        xp = namespace(part.measurements)
        own = float(xp.sum(_zero_invalid(part) ** 2, dtype=xp.float64))
        if own > 0:
            operator = camera.operator(piece.shear)
            misfit += (
                own
                * relative_residual(
                    operator, frames[piece.frames, ...], part.measurements, part.valid
                )
                ** 2
            )
            energy += own
    return float(np.sqrt(misfit / energy))


def _slice_measurement(measurement: Measurement, piece: FrameSegment) -> Measurement:
    columns = piece.frames
    return Measurement(measurement.measurements[:, columns], measurement.valid[:, columns])


def _zero_invalid(part: Measurement) -> Array:
    """The measurements, zero where they are not good."""
    return namespace(part.measurements, part.valid).where(part.valid, part.measurements, 0.0)


def _find_backprojection_peak(operator: LinearOperator, part: Measurement) -> float:
    """Largest value of F'f over the good measurements."""
    xp, measurements = namespace(part.measurements), _zero_invalid(part)
    pieces = split_blocks(measurements.shape[1], frames_per_block(operator, measurements))
    return max(float(xp.max(operator.adjoint(measurements[:, piece]))) for piece in pieces)


def _join_results(frames: Array, results: list[Result]) -> Result:
    """Join what is known about the pieces; those that stopped early count with their last
    objective.
    """
    longest = max(result.objective.size for result in results)
    objective = np.zeros(longest)
    for result in results:
        if result.objective.size:
            objective += np.pad(result.objective, (0, longest - result.objective.size), "edge")
    reasons = {result.stop_reason for result in results}
    return Result(
        frames,
        max(result.iterations for result in results),
        objective,
        "iteration limit" if "iteration limit" in reasons else results[0].stop_reason,
        sum(result.setup_seconds for result in results),
    )
