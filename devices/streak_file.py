"""Streak images in files (ITEX, HPD-TA's TIFF) as sources of one frame, next to the cameras that
took them.
"""

from __future__ import annotations

import numpy as np

from devices.ledger import Ledger, Stats
from devices.source import READ_TIMEOUT_S, Batch, Info, Source
from devices.uri import Uri
from tofclip.errors import InputError
from tofclip.io import read_streak
from tofclip.shots import Streak
from tofclip.storage import Field, Record


class StreakFile(Source):
    """One frame, and the time axis that its file brings."""

    def __init__(self, streak: Streak) -> None:
        self._streak = streak
        frame = np.zeros(1, [("number", "<i8"), ("counts", "<f4", streak.counts.shape)])
        frame["counts"] = streak.counts
        self._frame = frame
        self._closed = False
        self.seek(0)

    @property
    def info(self) -> Info:
        rows, columns = self._streak.counts.shape
        known = self._streak.metadata
        name = known.get("Camera/CameraName", "")
        details = {
            "rows": rows,
            "columns": columns,
            "camera": name,
            "date": known.get("Application/Date", ""),
        }
        return Info("streak image in a file", known.get("Camera/SerialNumber", ""), details)

    @property
    def calibration(self) -> Record | None:
        """Time of each row in s, where the file has one."""
        if self._streak.row_times is None:
            return None
        return Record(
            "streak_calibration", {"row_times": Field(self._streak.row_times, "s", ("row",))}
        )

    @property
    def stats(self) -> Stats:
        return self._ledger.stats

    @property
    def is_seekable(self) -> bool:
        return True

    def read(self, timeout: float = READ_TIMEOUT_S) -> Batch | None:
        """Return the frame, then None; `timeout` does not matter."""
        if self._closed or self._ledger.stats.unread == 0:
            return None
        self._ledger.deliver(1, 0)
        return Batch(self._frame)

    def seek(self, record: int) -> None:
        if record not in (0, 1):
            raise InputError(f"a picture is one record, there is no number {record}")
        self._ledger = Ledger()
        self._ledger.receive(1)
        self._ledger.deliver(record, 0)

    def close(self) -> None:
        self._closed = True


def open_streak_file(uri: Uri) -> StreakFile:
    """Open ``file://shot.img`` or ``file://shot.tif``."""
    uri.reject_unknown()
    return StreakFile(read_streak(uri.location))
