"""From frames of a camera that looks at the relay wall to a capture: taking off the ways between
wall and camera.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from nlos.capture import Capture
from nlos.kernels import shift_signals
from tofclip.arrays import require_numpy, to_numpy
from tofclip.errors import InputError, ShapeError, require_type
from tofclip.shots import Frames
from tofclip.storage import Record
from tofclip.units import SPEED_OF_LIGHT

ATTACHMENT_NAME = "relay_wall"
STEP_TOLERANCE = 1e-3
"""Steps of a time axis may differ from their mean by this fraction; over 1000 bins that stays below
one bin.
"""


def extract_wall_capture(frames: Frames) -> Capture:
    """Do what `Capture.from_frames` describes."""
    require_type(frames, Frames, "a capture is made of Frames, see tofclip.recover")
    record = frames.attachments.get(ATTACHMENT_NAME)
    if record is None or record.kind != ATTACHMENT_NAME:
        raise InputError(
            "these frames carry no relay wall: recover them from a streak image converted with its wall's geometry"
        )
    wall = record.array("wall", np.float64, 3, "m")
    camera = record.array("camera", np.float64, 1, "m")
    laser = record.array("laser", np.float64, 1, "m")
    bin_width = _require_even_bin_width(frames)
    seen = _cut_wall_window(frames.values, record, wall.shape)
    delay = record.number("receive_delay_bins")
    return Capture(
        signal=unwarp_signal(seen, wall, camera, laser, bin_width),
        wall=wall,
        laser=laser,
        bin_width=bin_width,
        start=SPEED_OF_LIGHT * (float(frames.times[0]) + delay * bin_width),
        provenance=frames.provenance,
    )


def unwarp_signal(
    signal: Any, wall: Any, camera: Any, laser: Any, bin_width: float
) -> NDArray[np.float32]:
    """Shift every wall point's signal earlier by ``(|r_p - camera| - |laser - camera|) / c``.

    Afterwards light of one path laser spot -> hidden point -> wall point stands in the same bin for
    all wall points. Between bins the signal is interpolated linearly; before the first and after
    the last bin it is 0.

    `signal` (t, ...): as the camera saw it; fetched from wherever it is; `wall` (..., 3): wall
    points, m; the signal of a point with NaN becomes 0; `camera, laser` (3,): position of the
    camera and of the laser spot on the wall, m; `bin_width`: duration of a time bin, s. Returns (t,
    ...).
    """
    signal, wall = (
        np.asarray(to_numpy(signal), dtype=np.float32),
        np.asarray(wall, dtype=np.float64),
    )
    camera, laser = np.asarray(camera, dtype=np.float64), np.asarray(laser, dtype=np.float64)
    if signal.shape[1:] != wall.shape[:-1] or wall.shape[-1:] != (3,):
        raise ShapeError("wall", (*signal.shape[1:], 3), wall.shape)
    for name, place in (("camera", camera), ("laser", laser)):
        if place.shape != (3,) or not np.all(np.isfinite(place)):
            raise InputError(f"the {name} position must be three finite numbers, got {place}")
    return_leg = np.linalg.norm(wall - camera, axis=-1) - np.linalg.norm(laser - camera)
    delay_bins = return_leg / (SPEED_OF_LIGHT * bin_width)
    # A shift by the whole record reads nothing but zeros.
    delay_bins = np.nan_to_num(delay_bins, nan=signal.shape[0] + 1.0)
    flat = np.ascontiguousarray(signal.reshape(signal.shape[0], -1))
    shifted: NDArray[np.float32] = shift_signals(flat, delay_bins.ravel()).reshape(signal.shape)
    return shifted


def remove_device_legs(capture: Capture, source: Any, camera: Any) -> Capture:
    """Take the ways device -> laser spot and wall point -> camera off a capture that still holds
    them.

    Every wall point's signal is moved earlier by ``(|r_L - source| + |r_p - camera|) / c``, by
    linear interpolation; the part that is common to all goes into the start.

    `capture`: its bins stand for the whole way source -> laser spot -> hidden point -> wall point
    -> camera; `source, camera` (3,): position of the laser device and of the camera, m.
    """
    source, camera = np.asarray(source, dtype=np.float64), np.asarray(camera, dtype=np.float64)
    for name, place in (("source", source), ("camera", camera)):
        if place.shape != (3,) or not np.all(np.isfinite(place)):
            raise InputError(f"the {name} position must be three finite numbers, got {place}")
    require_numpy("unwarping", capture.signal)
    legs = np.linalg.norm(capture.laser - source, axis=-1) + np.linalg.norm(
        capture.wall - camera, axis=-1
    )
    # shifts from the shortest leg on cut off as little of the record as possible
    common = float(legs[capture.valid].min())
    delay_bins = np.nan_to_num((legs - common) / capture.axis.spacing, nan=capture.axis.bins + 1.0)
    flat = np.ascontiguousarray(capture.signal.reshape(capture.axis.bins, -1))
    signal = shift_signals(np.nan_to_num(flat), delay_bins.ravel()).reshape(capture.signal.shape)
    start = capture.start - common
    return Capture(
        signal, capture.wall, capture.laser, capture.bin_width, start, capture.provenance
    )


def _require_even_bin_width(frames: Frames) -> float:
    bin_width = frames.bin_width
    steps = np.diff(frames.times)
    if np.max(np.abs(steps - bin_width)) > STEP_TOLERANCE * bin_width:
        raise InputError(
            f"the frames are {steps.min():.3e} to {steps.max():.3e} s apart; imaging around a corner needs evenly "
            "spaced ones: recover with one `bin_width`"
        )
    return bin_width


def _cut_wall_window(
    values: NDArray[np.float32], record: Record, wall_shape: tuple[int, ...]
) -> NDArray[np.float32]:
    row, column = int(record.number("row_offset")), int(record.number("column_offset"))
    rows, columns = wall_shape[:2]
    fits = (
        row >= 0
        and column >= 0
        and row + rows <= values.shape[1]
        and column + columns <= values.shape[2]
    )
    if not fits:
        raise InputError(
            f"a wall of {rows} x {columns} points from pixel ({row}, {column}) on does not fit into frames of "
            f"{values.shape[1]} x {values.shape[2]} pixels"
        )
    return values[:, row : row + rows, column : column + columns]
