"""LinoSPAD2's recordings as a source of time stamps."""

from __future__ import annotations

import os
from pathlib import Path

from devices.codec import as_bytes
from devices.ledger import Ledger
from devices.linospad2.sidecar import Sidecar, read_sidecar
from devices.linospad2.simulation import calibration_record
from devices.source import PATIENCE, Batch, Info, Source
from devices.statistics import Stats
from devices.uri import Uri
from tofclip.errors import FileFormatError, InputError
from tofclip.storage import Record, reading

LIMITS = "LinoSPAD2's USB commands are not public: its recordings are read, no board is driven"
PIECE = 1 << 22
"""Bytes that are read and decoded at once, or one cycle where that is longer."""


class LinoSpad2File(Source):
    """A recording, with the TOML file beside it that says how to read it (`devices.linospad2.sidecar`).

    Memory: one piece of 4 MiB, or one cycle, and what it decodes to.

    Parameters
    ----------
    path : path-like

    Raises
    ------
    StorageError
        The recording or its TOML file is absent or may not be read.
    FileFormatError
        The TOML file is damaged, or there is not one whole cycle.
    """

    def __init__(self, path: str | Path) -> None:
        self._path, self._sidecar = Path(path), read_sidecar(path)
        self.codec = self._sidecar.codec
        self._ledger = Ledger()
        with reading(path):
            self._file = open(path, "rb")  # noqa: SIM115 - closed by `close`
            self._size = os.fstat(self._file.fileno()).st_size
        if self._size < self.codec.cycle_bytes:
            self._file.close()
            raise FileFormatError(path, f"holds {self._size} bytes; one cycle takes {self.codec.cycle_bytes}")
        self._piece = max(1, PIECE // self.codec.cycle_bytes) * self.codec.cycle_bytes
        self._record, self._skip = 0, 0

    @property
    def sidecar(self) -> Sidecar:
        """How the recording is read."""
        return self._sidecar

    @property
    def info(self) -> Info:
        return Info("LinoSPAD2 recording", self._sidecar.board, {"limits": LIMITS, **self.codec.settings})

    @property
    def calibration(self) -> Record:
        camera = None if self._sidecar.camera is None else Record.load(self._sidecar.camera, "camera")
        return calibration_record(self._sidecar.calibration, self._sidecar.laser_period, camera)

    @property
    def stats(self) -> Stats:
        return self._ledger.stats

    @property
    def is_seekable(self) -> bool:
        return True

    def read(self, timeout: float = PATIENCE) -> Batch | None:
        """Return the next batch at once; `timeout` does not matter."""
        if self._file.closed:
            return None
        cycles = self._file.tell() // self.codec.cycle_bytes
        data = as_bytes(self._file.read(self._piece))
        whole = self.codec.whole(data)
        if whole < len(data):
            self._ledger.break_off()  # the recording ends in the middle of a cycle
        if whole == 0:
            return None
        found = self.codec.decode(data[:whole], cycles)
        records, self._skip = found.records[self._skip :], 0
        self._ledger.arrive(len(records) + found.malformed)
        self._ledger.settle(len(records), found.malformed)
        first, self._record = self._record, self._record + len(records)
        return Batch(records, first)

    def seek(self, record: int) -> None:
        """Go to time stamp number `record`; everything before it is counted, which takes a second per gigabyte."""
        if record < 0:
            raise InputError(f"a recording begins with record 0, there is no {record}")
        first, place = 0, 0
        while place < self._size - self.codec.cycle_bytes + 1:
            self._file.seek(place)
            data = as_bytes(self._file.read(self._piece))
            data = data[: self.codec.whole(data)]
            kept = len(self.codec.decode(data, 0).records)
            if record < first + kept:
                break
            first, place = first + kept, place + len(data)
        if record > first and place >= self._size - self.codec.cycle_bytes + 1:
            raise InputError(f"{self._path} holds {first} records, there is no number {record}")
        self._file.seek(place)
        self._record, self._skip = record, record - first

    def close(self) -> None:
        self._file.close()


def open_recording(uri: Uri) -> LinoSpad2File:
    """Open ``linospad2://run.dat`` or ``file://run.dat``."""
    uri.only()
    if not uri.place:
        raise InputError(f"'{uri.text}': name a recording; {LIMITS}")
    return LinoSpad2File(uri.place)
