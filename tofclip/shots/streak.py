"""A raw streak image: rows are instants, columns are slit pixels."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofclip.camera import Camera
from tofclip.errors import InputError, MissingTimeAxisError, ShapeError
from tofclip.records import (
    Storable,
    stored_array,
    stored_attachments,
    stored_child,
    stored_origin,
    stored_provenance,
    stored_texts,
)
from tofclip.storage import Record

MAX_BIN_WIDTH_S = 1e-3
"""s; the slowest sweeps of streak cameras last milliseconds in all."""


@dataclass(frozen=True)
class Streak(Storable):
    """A streak image with whatever its file said about it.

    Parameters
    ----------
    counts : (rows, columns) array
        Sensor measurements, kept as float32. May hold negative values (background already subtracted).
    row_times : (rows,) array or None
        Instant of each row, s, strictly increasing, not necessarily evenly. None where the file has
        no time axis.
    saturated : (rows, columns) bool array or None
        Pixels that reached the sensor's limit.
    metadata : mapping of str to str
        The file's own text, key by key.
    camera : Camera or None
        The camera that took it, where the file carries one.
    attachments : mapping of str to Record
        Further records that belong to the shot and travel on to its frames unchanged, such as a
        relay wall.
    source : str
        Where it came from, for messages.
    provenance : mapping
        How it came about.

    Raises
    ------
    InputError
        Not a 2D array, empty, holding NaN or infinity, all zero, or with a time axis that does not
        increase.
    """

    RECORD_KIND = "streak"

    counts: NDArray[np.float32] = field(
        metadata=stored_array("count", "time", "column", dtype=np.float32)
    )
    row_times: NDArray[np.float64] | None = field(
        default=None, metadata=stored_array("s", "time", optional=True)
    )
    saturated: NDArray[np.bool_] | None = field(
        default=None, metadata=stored_array("", "time", "column", dtype=bool, optional=True)
    )
    metadata: Mapping[str, str] = field(default_factory=dict, metadata=stored_texts())
    camera: Camera | None = field(
        default=None, metadata=stored_child(Camera.from_record, optional=True)
    )
    attachments: Mapping[str, Record] = field(default_factory=dict, metadata=stored_attachments())
    source: str = field(default="streak image", metadata=stored_origin())
    provenance: Mapping[str, Any] = field(default_factory=dict, metadata=stored_provenance())

    def __post_init__(self) -> None:
        with np.errstate(
            over="ignore"
        ):  # too large for float32 becomes infinite, which is refused below
            counts = np.ascontiguousarray(self.counts, dtype=np.float32)
        object.__setattr__(self, "counts", counts)
        if counts.ndim != 2 or counts.size == 0:
            raise ShapeError(f"{self.source}: a streak image", "(rows, columns)", counts.shape)
        bad = counts.size - int(np.count_nonzero(np.isfinite(counts)))
        if bad:
            raise InputError(
                f"{self.source}: {bad} pixels are NaN or infinite; replace them or mark them as saturated"
            )
        if not np.any(counts):
            raise InputError(f"{self.source}: every pixel is zero; was the shutter closed?")
        if self.saturated is not None and self.saturated.shape != counts.shape:
            raise ShapeError("saturated", counts.shape, self.saturated.shape)
        if self.row_times is not None:
            object.__setattr__(self, "row_times", self._check_times(self.row_times))

    def _check_times(self, times: Any) -> NDArray[np.float64]:
        checked = np.asarray(times, dtype=np.float64)
        if checked.shape != (self.counts.shape[0],):
            raise ShapeError(
                f"{self.source}: the time axis", (self.counts.shape[0],), checked.shape
            )
        if not np.all(np.isfinite(checked)) or np.any(np.diff(checked) <= 0):
            raise InputError(f"{self.source}: the time axis must be finite and increase row by row")
        return checked

    @property
    def times(self) -> NDArray[np.float64]:
        """Instant of each row, s; raises `MissingTimeAxisError` where none is known."""
        if self.row_times is None:
            raise MissingTimeAxisError(
                f"{self.source} has no time axis: give the duration of a row (--bin-width-ps, or bin_width in seconds)"
            )
        return self.row_times

    def with_bin_width(self, bin_width: float) -> Streak:
        """Return the same picture with evenly spaced rows of `bin_width` seconds, the first at 0."""
        if not (np.isfinite(bin_width) and bin_width > 0):
            raise InputError(f"bin width must be a positive number of seconds, got {bin_width}")
        if bin_width > MAX_BIN_WIDTH_S:
            raise InputError(
                f"a row of {bin_width:.3g} s is longer than any sweep; --bin-width-ps is in picoseconds"
            )
        return replace(
            self, row_times=np.arange(self.counts.shape[0], dtype=np.float64) * float(bin_width)
        )
