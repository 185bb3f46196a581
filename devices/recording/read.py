"""Recordings, sound and damaged ones, as sources: the same pieces through the same codec, so the
same records, bit for bit.

They are a row of blocks: pieces of a stream that carry their own length, number and checksums. All
numbers are little-endian::

    magic  recording  number  kind  gap  time_ns  records  length  payload's  header's  payload
                                                                   CRC-32     CRC-32
    8 B    8 B        8 B     2 B   2 B  8 B      8 B      8 B     4 B        4 B       length B

``recording`` is a random number that all blocks of a file share, so that a block of one recording
inside a piece of another is not mistaken. ``number`` counts the blocks from 0.

Version 0.1.0 wrote a shorter header without these two (`LEGACY_MAGIC`).
"""

from __future__ import annotations

import contextlib
import enum
import json
import os
import struct
import tempfile
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from time import monotonic, sleep
from typing import Any

import h5py

from devices.address import Options, Uri, option
from devices.registry import build_codec
from devices.source import READ_TIMEOUT_S, Batch, Closing, Codec, Gap, Info, Piece, SeekableSource
from tofclip.errors import DeviceTimeoutError, FileFormatError, InputError, StorageError
from tofclip.files import guard, translate_read_errors
from tofclip.storage import HDF5_SIGNATURE, Record

MAGIC = b"\x89ToFrec\n"
LEGACY_MAGIC = b"TFcB"
MAX_PAYLOAD_BYTES = 1 << 28  # No block is larger; a length beyond it is damage
_LAYOUT = struct.Struct("<8sQQHHqQQI")
_LEGACY_LAYOUT = struct.Struct("<4sHHqQQI")
_CHECKSUM_BYTES = 4
HEADER_BYTES = _LAYOUT.size + _CHECKSUM_BYTES
LEGACY_HEADER_BYTES = _LEGACY_LAYOUT.size + _CHECKSUM_BYTES


class BlockKind(enum.IntEnum):
    """What a block's payload is."""

    HEAD = 1  # An HDF5 record: all that was known before the first piece
    PIECE = 2  # Whole records as they came from the instrument
    END = 3  # JSON: the accounts, written when the recording was ended in order


@dataclass(frozen=True)
class Block:
    """What stands before a payload, and where that is."""

    kind: BlockKind
    gap: Gap  # what is missing before it
    time_ns: int  # when it was recorded, in ns since 1970, by this computer's clock
    records: int
    length: int  # bytes of the payload
    checksum: int  # CRC-32 of the payload
    # number of the block in its recording, from 0; -1 in recordings of version 0.1.0
    number: int = 0
    recording: int = 0  # the random number that the blocks of a recording share
    position: int = 0  # of the header, in the file

    @property
    def is_legacy(self) -> bool:
        return self.number < 0

    @property
    def payload_position(self) -> int:
        return self.position + (LEGACY_HEADER_BYTES if self.is_legacy else HEADER_BYTES)

    @property
    def end(self) -> int:
        return self.payload_position + self.length

    def pack(self) -> bytes:
        own = (self.kind, self.gap, self.time_ns, self.records, self.length, self.checksum)
        front = _LAYOUT.pack(MAGIC, self.recording, self.number, *own)
        return front + struct.pack("<I", zlib.crc32(front))

    @classmethod
    def unpack(cls, data: bytes, position: int = 0) -> Block | None:
        """Read a header from the first bytes of `data`; None if they are not a sound one."""
        is_legacy = data[: len(LEGACY_MAGIC)] == LEGACY_MAGIC
        layout = _LEGACY_LAYOUT if is_legacy else _LAYOUT
        front = data[: layout.size]
        own = data[layout.size : layout.size + _CHECKSUM_BYTES]
        if len(own) != _CHECKSUM_BYTES or not (is_legacy or data.startswith(MAGIC)):
            return None
        # a header that passes by chance is one in 2^32: the search for blocks may rely on it
        if zlib.crc32(front) != int.from_bytes(own, "little"):
            return None
        _, *names, kind, gap, time_ns, records, length, checksum = layout.unpack(front)
        recording, number = names or (0, -1)
        if kind not in set(BlockKind) or gap not in set(Gap) or length > MAX_PAYLOAD_BYTES:
            return None
        sizes = records, length, checksum
        return cls(BlockKind(kind), Gap(gap), time_ns, *sizes, number, recording, position)


RECORD_KIND = "recording"
RECORDING_SUFFIXES = (".h5", ".hdf5")
SEARCH_BYTES = 1 << 20  # Bytes in which the next sound block is searched at once


@dataclass(frozen=True)
class Damage:
    """A stretch of a recording that is not what was written."""

    position: int  # bytes of the file
    length: int  # bytes of the file
    # it is the beginning of a last block that was never finished: a program was killed in the
    # middle of writing it, or the file was truncated
    is_cut: bool = False


class BlockReader:
    """Blocks in anything that holds bytes; damage between them is stepped over and reported. The
    first sound header decides which recording, and of which version, this is. Memory: one block.
    """

    def __init__(self, path: Path, fetch: Callable[[int, int], bytes], length: int) -> None:
        self.path = path
        self.length = length
        self._fetch = fetch
        self._first: Block | None = None
        begins = [(self._search(0, magic), magic) for magic in (MAGIC, LEGACY_MAGIC)]
        begin, self._magic = min(begins)
        self._first = self._read_header(begin)
        # Version 0.1.0 put an HDF5 file's beginning before.
        self._begin = begin if self._first is not None and self._first.is_legacy else 0

    def __iter__(self) -> Iterator[Block | Damage]:
        """Yield every block with a sound header, and the damage between; payloads are not read."""
        position = self._begin
        while position < self.length:
            block = self._read_header(position) if self._first else None
            if block is not None:
                yield block
                position = block.end
                continue
            found = self._search(position + 1, self._magic) if self._first else self.length
            yield Damage(
                position, found - position, found == self.length and self._is_cut(position)
            )
            position = found

    def read_payload(self, block: Block) -> bytes:
        data = self._fetch(block.payload_position, block.length)
        if len(data) != block.length or zlib.crc32(data) != block.checksum:
            raise FileFormatError(
                self.path,
                f"the block at byte {block.position} is damaged; tofclip devices repair leaves it out",
            )
        return data

    def _read_header(self, position: int) -> Block | None:
        """Read a header of this recording; None if its payload would not lie within the file."""
        block = Block.unpack(self._fetch(position, HEADER_BYTES), position)
        return block if block and block.end <= self.length and self._belongs(block) else None

    def _belongs(self, block: Block) -> bool:
        first = self._first or block
        return (block.recording, block.is_legacy) == (first.recording, first.is_legacy)

    def _is_cut(self, position: int) -> bool:
        """Whether what is left of the file is the beginning of a block."""
        data = self._fetch(position, HEADER_BYTES)
        if self.length - position < HEADER_BYTES:
            return data.startswith(MAGIC[: len(data)])
        block = Block.unpack(data)
        return block is not None and self._first is not None and self._belongs(block)

    def _search(self, position: int, magic: bytes) -> int:
        """Return where the next sound header of this recording begins, or the end."""
        while position < self.length:
            # Overlaps the next stretch, so that a magic across the border is found.
            stretch = self._fetch(position, SEARCH_BYTES + len(magic) - 1)
            at = stretch.find(magic)
            while at >= 0:
                if self._read_header(position + at) is not None:
                    return position + at
                at = stretch.find(magic, at + 1)
            position += SEARCH_BYTES
        return self.length


@dataclass(frozen=True)
class Ending:
    """What a recording says at its end."""

    stats: dict[str, int]  # the accounts, by name
    fault: str  # what ended it if it was not meant to end
    # nothing of what was recorded is missing. False for ever in a copy of a damaged or truncated
    # recording
    is_complete: bool

    def to_json(self) -> bytes:
        known = {"stats": self.stats, "fault": self.fault, "complete": self.is_complete}
        return json.dumps(known).encode()

    @classmethod
    def from_json(cls, payload: bytes, path: Path) -> Ending:
        with guard(path, "has accounts that cannot be read"):
            known = json.loads(payload)
            stats = {str(name): int(value) for name, value in known["stats"].items()}
            return cls(stats, str(known["fault"]), bool(known.get("complete", True)))


class Recording(Closing):
    """A recording, open for reading; it may still be written, or its program have been killed."""

    def __init__(self, path: Path) -> None:
        self.path = path
        with translate_read_errors(path):
            self._file = open(path, "rb", buffering=0)  # noqa: SIM115 - closed by `close`
        self.blocks = BlockReader(path, self._read_bytes, os.fstat(self._file.fileno()).st_size)
        try:
            self.head = self._read_head()
            """What was known before the first piece."""
        except BaseException:
            self.close()
            raise

    @property
    def codec(self) -> Codec:
        """The codec that its bytes need."""
        with guard(self.path, "names a codec that this program does not know"):
            settings = json.loads(str(self.head.attribute("codec_settings")))
            try:
                return build_codec(str(self.head.attribute("codec")), settings)
            except InputError as fault:
                raise ValueError(fault) from fault

    @property
    def info(self) -> Info:
        with guard(self.path, "does not describe its instrument"):
            known = json.loads(str(self.head.attribute("info")))
            return Info(known.pop("instrument"), known.pop("serial"), known)

    def close(self) -> None:
        self._file.close()

    def _read_head(self) -> Record:
        """Return the first undamaged description of the instrument."""
        for entry in self.blocks:
            if isinstance(entry, Block) and entry.kind is BlockKind.HEAD:
                with contextlib.suppress(FileFormatError):
                    payload = self.blocks.read_payload(entry)
                    break
        else:
            raise FileFormatError(
                self.path, "is not a recording, or every copy of its head is damaged"
            )
        with tempfile.TemporaryDirectory() as folder:
            copy = Path(folder, self.path.name)
            copy.write_bytes(payload)  # HDF5 reads files, not bytes
            known = Record.load(copy, RECORD_KIND)
        return replace(known, fields={}, origin=str(self.path))

    def _read_bytes(self, position: int, length: int) -> bytes:
        """Read `length` bytes from `position` on, fewer at the end of the file: what one reading gives,
        because no block reaches the two gigabytes that the system reads at once.
        """
        try:
            self._file.seek(position)
            return self._file.read(length)
        except OSError as fault:
            raise StorageError(f"{self.path}: cannot be read: {fault.strerror}") from fault


def read_head_if_recording(path: Path) -> Record | None:
    """Return what a recording says about its instrument, None for any other file."""
    with translate_read_errors(path), open(path, "rb") as file:
        start = file.read(len(HDF5_SIGNATURE))
    if start == HDF5_SIGNATURE:
        kind: Any = b""
        with contextlib.suppress(OSError), h5py.File(path, "r", locking=False) as opened:
            kind = opened.attrs.get("kind", b"")
        if not isinstance(kind, bytes) or kind != RECORD_KIND.encode():
            return None
    elif path.suffix.lower() not in RECORDING_SUFFIXES:
        return None
    with contextlib.suppress(FileFormatError), Recording(path) as recording:
        return recording.head
    return None


NS_PER_S = 1_000_000_000
# Longest pause between two pieces that is replayed: where the computer's clock was set while it
# recorded, the times of the pieces may be years apart
MAX_PAUSE_S = 10.0


class ReplaySource(SeekableSource):
    """A recording played back. It never drops anything: the reader sets the pace, unless the
    recording does.

    Memory: one piece and its records; 100 bytes for each piece of the recording.

    `is_paced`: let as much time pass between two pieces as there was when they were recorded, but
    at most `MAX_PAUSE_S`.
    """

    def __init__(self, path: Path, is_paced: bool = False) -> None:
        self._recording = recording = Recording(path)
        codec, self.info, self._is_paced = recording.codec, recording.info, is_paced
        self.calibration = recording.head.children.get("calibration")
        self.is_complete = False
        self._blocks = list(self._list_blocks())
        self._last_due: tuple[float, int] | None = None
        records = sum(block.records for block in self._blocks)
        super().__init__(codec, path, len(self._blocks), records)

    def read(self, timeout: float = READ_TIMEOUT_S) -> Batch | None:
        if self._is_paced and self._next < self._pieces:
            self._wait_until_due(self._blocks[self._next], timeout)
        return super().read(timeout)

    def close(self) -> None:
        super().close()
        self._recording.close()

    def _read_piece(self, number: int) -> Piece:
        block = self._blocks[number]
        data = self._recording.blocks.read_payload(block)
        return Piece(data, block.records, block.gap)

    def _go_to(self, number: int) -> None:
        super()._go_to(number)
        self._last_due = None

    def _list_blocks(self) -> Iterator[Block]:
        path, blocks = self._recording.path, self._recording.blocks
        for entry in blocks:
            if isinstance(entry, Damage):
                if entry.is_cut:
                    return  # the program that recorded was killed; all before it is whole
                raise FileFormatError(
                    path,
                    f"is damaged at byte {entry.position}; tofclip devices repair makes a sound copy",
                )
            if entry.kind is BlockKind.PIECE:
                yield entry
            elif entry.kind is BlockKind.END:
                ending = Ending.from_json(blocks.read_payload(entry), path)
                self.is_complete = ending.is_complete

    def _wait_until_due(self, block: Block, timeout: float) -> None:
        """Wait until a block is due; DeviceTimeoutError where that is later than `timeout`."""
        due = now = monotonic()
        if self._last_due is not None:
            pause = (block.time_ns - self._last_due[1]) / NS_PER_S
            due = self._last_due[0] + min(max(pause, 0.0), MAX_PAUSE_S)
        sleep(max(0.0, min(due - now, timeout)))
        if due - now > timeout:
            raise DeviceTimeoutError(
                f"the next piece of {self._name} is due in {due - now - timeout:.3g} s"
            )
        self._last_due = due, block.time_ns


@dataclass(frozen=True)
class ReplayOptions(Options):
    """Values of a recording's address."""

    pace: str = option("", choices=("fast", "realtime"))


def open_recording(uri: Uri) -> ReplaySource:
    """Open ``file://PATH?pace=fast``, or ``pace=realtime``."""
    is_paced = ReplayOptions.from_uri(uri).pace == "realtime"
    return ReplaySource(Path(uri.location), is_paced)
