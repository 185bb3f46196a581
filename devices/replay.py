"""Recordings as sources: the same pieces through the same codec, so the same records, bit for bit."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterator
from pathlib import Path
from time import monotonic, sleep
from typing import Any, NamedTuple

from devices.ledger import Ledger
from devices.recording.blocks import BlockKind
from devices.recording.reader import Block, Damage, Ending, Recording
from devices.source import READ_TIMEOUT_S, Batch, DecodedSource, Info
from devices.uri import Uri
from tofclip.errors import DeviceTimeoutError, FileFormatError, InputError
from tofclip.storage import Record

NS_PER_S = 1_000_000_000
MAX_PAUSE_S = 10.0
"""Longest pause between two pieces that is replayed: where the computer's clock was set while it
recorded, the times of the pieces may be years apart.
"""


class _Checkpoint(NamedTuple):
    """What the decoder and the accounts were when a block began."""

    state: Any
    delivered: int
    malformed: int


class ReplaySource(DecodedSource):
    """A recording played back. It never drops anything: the reader sets the pace, unless the
    recording does.

    The accounts are those of the playback. After `seek` they are as if everything before had been
    read.

    Memory: one piece and its records; 100 bytes for each piece of the recording.

    `is_paced`: let as much time pass between two pieces as there was when they were recorded, but
    at most `MAX_PAUSE_S`.
    """

    def __init__(self, path: Path, is_paced: bool = False) -> None:
        self._recording = Recording(path)
        super().__init__(self._recording.codec, Ledger())
        self._info = self._recording.info
        self._is_paced = is_paced
        self._is_complete = False
        self._blocks = list(self._list_blocks())
        self._next = self._skip = 0
        self._last_due: tuple[float, int] | None = None
        self._checkpoints = [
            _Checkpoint(self.codec.start, 0, 0)
        ]  # of every block up to the furthest that was read
        self._seek_to(0)

    @property
    def info(self) -> Info:
        return self._info

    @property
    def calibration(self) -> Record | None:
        return self._recording.head.children.get("calibration")

    @property
    def is_complete(self) -> bool:
        return self._is_complete

    @property
    def is_seekable(self) -> bool:
        return True

    def read(self, timeout: float = READ_TIMEOUT_S) -> Batch | None:
        if self._next >= len(self._blocks):
            return None
        block = self._blocks[self._next]
        if self._is_paced:
            self._wait_until_due(block, timeout)
        batch = self._decode_next()
        if not self._skip:
            return batch
        skipped, self._skip = self._skip, 0
        return Batch(batch.records[skipped:], batch.first + skipped)

    def seek(self, record: int) -> None:
        if record < 0:
            raise InputError(f"records are numbered from 0, got {record}")
        tap = self.tap
        self.tap = None  # what is stepped over is not read
        try:
            nearest = bisect_right(self._checkpoints, record, key=lambda mark: mark.delivered) - 1
            self._seek_to(nearest)
            while (
                self._next < len(self._blocks) and self._checkpoints[self._next].delivered <= record
            ):
                self._decode_next()
        finally:
            self.tap = tap
        reached = self._checkpoints[self._next].delivered
        if record > reached:
            raise InputError(
                f"{self._recording.path} has only {reached} records, no record {record}"
            )
        if record < reached:
            self._seek_to(self._next - 1)
            self._skip = record - self._checkpoints[self._next].delivered

    def close(self) -> None:
        self._next = len(self._blocks)
        self._recording.close()

    def _decode_next(self) -> Batch:
        """Decode the next block and note how things are behind it."""
        batch = self._decode_piece(self._recording.blocks.read_piece(self._blocks[self._next]))
        self._next += 1
        if self._next == len(self._checkpoints):
            self._checkpoints.append(
                _Checkpoint(self._state, self.stats.delivered, self.stats.malformed)
            )
        return batch

    def _seek_to(self, number: int) -> None:
        """Make the next block the one with that number, as if all before it had been read."""
        self._next, self._skip = number, 0
        self._state, delivered, malformed = self._checkpoints[number]
        self._ledger = Ledger()
        self._ledger.receive(sum(block.header.records for block in self._blocks))
        self._ledger.deliver(delivered, malformed)
        self._last_due = None

    def _list_blocks(self) -> Iterator[Block]:
        for entry in self._recording.blocks:
            if isinstance(entry, Damage):
                if entry.is_cut:
                    return  # the program that recorded was killed; all before it is whole
                raise FileFormatError(
                    self._recording.path,
                    f"is damaged at byte {entry.position}; tofclip devices repair makes a sound copy",
                )
            if entry.header.kind is BlockKind.PIECE:
                yield entry
            elif entry.header.kind is BlockKind.END:
                payload = self._recording.blocks.read_payload(entry)
                self._is_complete = Ending.from_json(payload, self._recording.path).is_complete

    def _wait_until_due(self, block: Block, timeout: float) -> None:
        """Wait until a block is due, `timeout` seconds at most; DeviceTimeoutError if it is not
        then.
        """
        now = monotonic()
        due = now
        if self._last_due is not None:
            pause = (block.header.time_ns - self._last_due[1]) / NS_PER_S
            due = self._last_due[0] + min(max(pause, 0.0), MAX_PAUSE_S)
        sleep(max(0.0, min(due - now, timeout)))
        if due - now > timeout:
            raise DeviceTimeoutError(
                f"the next piece of {self._recording.path} is due in {due - now - timeout:.3g} s"
            )
        self._last_due = due, block.header.time_ns


def open_recording(uri: Uri) -> ReplaySource:
    """Open ``file://PATH?pace=fast``, or ``pace=realtime``."""
    uri.reject_unknown("pace")
    return ReplaySource(Path(uri.location), uri.choice("pace", "fast", "realtime") == "realtime")
