"""Recover a shot piece by piece, each with the operator of its own shear."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofclip.camera import Camera, Measurement
from tofclip.operators import LinearOperator
from tofclip.reconstruct.focus import Piece
from tofclip.recovery import Method, Progress, Result, relative_residual, silent
from tofclip.recovery.iterative import ProximalMethod
from tofclip.threads import blocks

Array = NDArray[Any]


def recover_pieces(
    method: Method, camera: Camera, measurement: Measurement, pieces: Sequence[Piece], progress: Progress = silent
) -> Result:
    """Recover all frames.

    A prior's weight is relative to the brightest of the frames it is given. For pieces to be treated alike, it is
    made relative to what a surface like the shot's brightest would send back from each piece's range.

    Parameters
    ----------
    method : Method
    camera : Camera
    measurement : Measurement
    pieces : sequence of Piece
        All frames, in order.
    progress : callable
        Called with the number of frame iterations just done.

    Notes
    -----
    Memory: the frames, and one operator at a time.
    """
    if len(pieces) == 1:
        operator = camera.operator(pieces[0].shear)
        return method.recover(operator, measurement.readings, measurement.good, progress)
    peaks = np.array([_peak(camera.operator(piece.shear), _part(measurement, piece)) for piece in pieces])
    expected = np.array([piece.brightness for piece in pieces])
    scale = (np.maximum(peaks, 0) / expected).max() * expected
    frames = np.zeros((measurement.readings.shape[1], *camera.image_shape), np.float32)
    results = []
    for piece, peak, bright in zip(pieces, peaks, scale, strict=True):
        if peak <= 0:
            progress(method.work(piece.size))  # dark: nothing to recover
            continue
        part = _part(measurement, piece)
        weighted = (
            replace(method, weight=method.weight * bright / peak) if isinstance(method, ProximalMethod) else method
        )
        result = weighted.recover(camera.operator(piece.shear), part.readings, part.good, progress)
        frames[piece.frames] = result.frames
        results.append(replace(result, frames=frames[piece.frames]))
    return _joined(frames, results)


def residual_of_pieces(camera: Camera, frames: Array, measurement: Measurement, pieces: Sequence[Piece]) -> float:
    """``|F h - f| / |f|`` over all good readings, each frame with its own operator."""
    misfit = energy = 0.0
    for piece in pieces:
        part = _part(measurement, piece)
        own = float(np.sum((part.readings * part.good) ** 2, dtype=np.float64))
        if own > 0:
            operator = camera.operator(piece.shear)
            misfit += own * relative_residual(operator, frames[piece.frames], part.readings, part.good) ** 2
            energy += own
    return float(np.sqrt(misfit / energy))


def _part(measurement: Measurement, piece: Piece) -> Measurement:
    columns = piece.frames
    return Measurement(
        np.ascontiguousarray(measurement.readings[:, columns]), np.ascontiguousarray(measurement.good[:, columns])
    )


def _peak(operator: LinearOperator, part: Measurement) -> float:
    """Largest value of F'f over the good readings."""
    readings = part.readings * part.good
    return max(float(operator.adjoint(readings[:, block]).max()) for block in blocks(readings.shape[1]))


def _joined(frames: Array, results: list[Result]) -> Result:
    """Join what is known about the pieces; those that stopped early count with their last objective."""
    longest = max(result.objective.size for result in results)
    objective = np.zeros(longest)
    for result in results:
        if result.objective.size:
            objective += np.pad(result.objective, (0, longest - result.objective.size), "edge")
    reasons = {result.stopped_because for result in results}
    return Result(
        frames,
        max(result.iterations for result in results),
        objective,
        "iteration limit" if "iteration limit" in reasons else results[0].stopped_because,
        sum(result.setup_seconds for result in results),
    )
