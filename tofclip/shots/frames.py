"""Recovered transient frames: one picture per instant."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofclip.arrays import Array, namespace, to_numpy
from tofclip.camera import Camera
from tofclip.errors import InputError, ShapeError
from tofclip.storage import Field, Record, Scalar


@dataclass(frozen=True)
class Frames:
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

    values: Array
    times: NDArray[np.float64]
    camera: Camera
    figures: Mapping[str, Scalar] = field(default_factory=dict)
    attachments: Mapping[str, Record] = field(default_factory=dict)
    provenance: Mapping[str, Any] = field(default_factory=dict)
    shears: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))

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

    def to_record(self) -> Record:
        """Return everything that has to be stored."""
        return Record(
            "frames",
            {
                "values": Field(to_numpy(self.values), "count", ("time", "y", "x")),
                "times": Field(self.times, "s", ("time",)),
                "shears": Field(self.shears, "px", ("time",)),
            },
            self.figures,
            {**self.attachments, "camera": self.camera.to_record()},
            self.provenance,
        )

    @classmethod
    def from_record(cls, record: Record) -> Frames:
        """Rebuild frames from what was stored."""
        return cls(
            values=record.array("values", np.float32, 3, "count"),
            times=record.array("times", np.float64, 1, "s"),
            camera=Camera.from_record(record.child("camera", "camera")),
            shears=record.array("shears", np.float64, 1, "px")
            if "shears" in record.fields
            else np.empty(0),
            figures=record.attributes,
            attachments={k: v for k, v in record.children.items() if k != "camera"},
            provenance=record.provenance,
        )

    def save(self, path: str | Path) -> None:
        """Write the frames, their camera and attachments to one HDF5 file, whole or not at all."""
        self.to_record().save(path)

    @classmethod
    def load(cls, path: str | Path) -> Frames:
        """Read frames that `save` wrote."""
        return cls.from_record(Record.load(path, "frames"))
