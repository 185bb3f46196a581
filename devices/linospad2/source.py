"""LinoSPAD2's recordings as a source of time stamps."""

from __future__ import annotations

import os
from bisect import bisect_right
from pathlib import Path

from devices.codec import as_bytes
from devices.ledger import Ledger
from devices.linospad2.calibration import make_calibration_record
from devices.linospad2.codec import LinoSpad2Codec
from devices.linospad2.sidecar import read_sidecar
from devices.ring import Piece
from devices.source import READ_TIMEOUT_S, Batch, DecodedSource, Info
from devices.uri import Uri
from tofclip.errors import FileFormatError, InputError
from tofclip.files import translate_read_errors
from tofclip.storage import Record

LIMITATION = "LinoSPAD2's USB commands are not public: its recordings are read, no board is driven"
PIECE_BYTES = 1 << 20
"""Bytes that are read and decoded at once, or one cycle where that is longer."""


class LinoSpad2File(DecodedSource):
    """A recording, with the TOML file beside it that says how to read it
    (`devices.linospad2.sidecar`).

    Opening counts the time stamps of the whole recording, which takes about a second for two
    gigabytes. After `seek` the accounts are as if everything before had been read.

    Memory: one piece of 1 MiB, or one cycle, and what it decodes to; 16 bytes for each piece of the
    recording.
    """

    codec: LinoSpad2Codec

    def __init__(self, path: str | Path) -> None:
        self._path, self._sidecar = Path(path), read_sidecar(path)
        codec = self._sidecar.codec
        super().__init__(codec, Ledger())
        with translate_read_errors(path):
            self._file = open(path, "rb")  # noqa: SIM115 - closed by `close`
        size = os.fstat(self._file.fileno()).st_size
        if size < codec.cycle_bytes:
            self._file.close()
            raise FileFormatError(path, f"holds {size} bytes; one cycle takes {codec.cycle_bytes}")
        self._is_cut_off = size % codec.cycle_bytes > 0
        self._cycles = max(1, PIECE_BYTES // codec.cycle_bytes)
        self._pieces = -(-(size // codec.cycle_bytes) // self._cycles)
        # The file has no index: one pass at the start lets the accounts and seek know every number.
        self._good, self._malformed = self._count_records()
        self._next = self._skip = 0
        self._seek_to(0)

    @property
    def info(self) -> Info:
        return Info(
            "LinoSPAD2 recording",
            self._sidecar.board,
            {"limits": LIMITATION, **self.codec.settings},
        )

    @property
    def calibration(self) -> Record:
        camera = (
            None if self._sidecar.camera is None else Record.load(self._sidecar.camera, "camera")
        )
        return make_calibration_record(
            self._sidecar.calibration, self._sidecar.laser_period, camera
        )

    @property
    def is_seekable(self) -> bool:
        return True

    def read(self, timeout: float = READ_TIMEOUT_S) -> Batch | None:
        """Return the next batch at once; `timeout` does not matter."""
        if self._file.closed or self._next == self._pieces:
            return None
        data = self._read_piece(self._next)
        batch = self._decode_piece(Piece(data, self.codec.count_records(as_bytes(data))))
        self._next += 1
        skipped, self._skip = self._skip, 0
        return Batch(batch.records[skipped:], batch.first + skipped)

    def seek(self, record: int) -> None:
        if not 0 <= record <= self._good[-1]:
            raise InputError(
                f"{self._path} holds {self._good[-1]} records, there is no number {record}"
            )
        self._seek_to(min(bisect_right(self._good, record) - 1, self._pieces))
        self._skip = record - self._good[self._next]

    def close(self) -> None:
        self._file.close()

    def _read_piece(self, number: int) -> bytes:
        length = self._cycles * self.codec.cycle_bytes
        self._file.seek(number * length)
        data = self._file.read(length)
        return data[: self.codec.count_complete_bytes(as_bytes(data))]

    def _count_records(self) -> tuple[list[int], list[int]]:
        """Return how many good and malformed time stamps there are before each piece, and
        altogether.
        """
        good, malformed = [0], [0]
        for number in range(self._pieces):
            data = as_bytes(self._read_piece(number))
            kept = self.codec.count_valid(data)
            good.append(good[-1] + kept)
            malformed.append(malformed[-1] + self.codec.count_records(data) - kept)
        return good, malformed

    def _seek_to(self, number: int) -> None:
        """Make the next piece the one with that number, as if all before it had been read."""
        self._next, self._skip, self._state = number, 0, number * self._cycles
        self._ledger = Ledger()
        self._ledger.receive(self._good[-1] + self._malformed[-1])
        self._ledger.deliver(self._good[number], self._malformed[number])
        # The last cycle is incomplete; it counts as one record that cannot be read.
        if self._is_cut_off:
            self._ledger.truncate()


def open_recording(uri: Uri) -> LinoSpad2File:
    """Open ``linospad2://run.dat`` or ``file://run.dat``."""
    uri.reject_unknown()
    if not uri.location:
        raise InputError(f"'{uri.text}': name a recording; {LIMITATION}")
    return LinoSpad2File(uri.location)
