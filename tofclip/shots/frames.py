"""Recovered transient frames: one picture per instant."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofclip.arrays import Array, namespace
from tofclip.camera import Camera
from tofclip.errors import InputError, ShapeError
from tofclip.records import (
    Storable,
    stored_array,
    stored_attachments,
    stored_attributes,
    stored_child,
    stored_provenance,
)
from tofclip.storage import Record, Scalar


@dataclass(frozen=True)
class Frames(Storable):
    """A transient cube with its axes and the camera that saw it.

    Parameters
    ----------
    values : (time, y, x) array
        Brightness in counts, float32, y pointing down. Of any library: what is done with the frames
        is done there, if it can be, and what can be done in NumPy only says so. Files hold NumPy's.
    times : (time,) array
        Time of flight of each frame, s, strictly increasing: the camera's time zero is already
        taken off.
    camera : Camera
        The camera, with the gains and the sweep that were used for this shot.
    figures : mapping
        Scalars of the recovery, such as ``relative_residual``.
    attachments : mapping of str to Record
        What travelled along with the streak image.
    provenance : mapping
        How they came about.
    shears : (time,) array, optional
        Shear at which each frame was recovered, pixels per view step; 0 everywhere by default.
    """

    RECORD_KIND = "frames"

    values: Array = field(metadata=stored_array("count", "time", "y", "x", dtype=np.float32))
    times: NDArray[np.float64] = field(metadata=stored_array("s", "time"))
    camera: Camera = field(metadata=stored_child(Camera.from_record, "camera"))
    figures: Mapping[str, Scalar] = field(default_factory=dict, metadata=stored_attributes())
    attachments: Mapping[str, Record] = field(default_factory=dict, metadata=stored_attachments())
    provenance: Mapping[str, Any] = field(default_factory=dict, metadata=stored_provenance())
    shears: NDArray[np.float64] = field(
        default_factory=lambda: np.empty(0), metadata=stored_array("px", "time", optional=True)
    )

    def __post_init__(self) -> None:
        times = np.asarray(self.times, dtype=np.float64)
        object.__setattr__(self, "times", times)
        expected = (times.size, *self.camera.image_shape)
        if self.values.shape != expected:
            raise ShapeError("frames", f"(time, y, x) = {expected}", tuple(self.values.shape))
        if times.size == 0 or not np.all(np.isfinite(times)) or np.any(np.diff(times) <= 0):
            raise InputError("frame times must be finite and increase")
        shears = np.asarray(self.shears, dtype=np.float64)
        object.__setattr__(self, "shears", shears if shears.size else np.zeros(times.size))
        if self.shears.shape != times.shape or not np.all(np.isfinite(self.shears)):
            raise ShapeError("the frames' shears", f"{times.shape}, finite", self.shears.shape)
        xp = namespace(self.values)
        if not xp.all(xp.isfinite(self.values)):
            raise InputError("frames must not hold NaN or infinity")

    @property
    def bin_width(self) -> float:
        """Mean time between frames, s."""
        if self.times.size == 1:
            raise InputError("a single frame has no bin width")
        return float((self.times[-1] - self.times[0]) / (self.times.size - 1))
