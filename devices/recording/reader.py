"""Reading recordings, sound and damaged ones, of this version and of 0.1.0."""

from __future__ import annotations

import contextlib
import json
import os
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Self

import h5py

from devices.codec import Codec
from devices.recording.blocks import HEADER_BYTES, LEGACY_MAGIC, MAGIC, BlockHeader, BlockKind
from devices.registry import build_codec
from devices.ring import Piece
from devices.source import Info
from tofclip.errors import FileFormatError, InputError, StorageError
from tofclip.files import format_error_line, translate_read_errors
from tofclip.storage import HDF5_SIGNATURE, Record

RECORD_KIND = "recording"
RECORDING_SUFFIXES = (".h5", ".hdf5")
SEARCH_BYTES = 1 << 20
"""Bytes in which the next sound block is searched at once."""


@dataclass(frozen=True)
class Damage:
    """A stretch of a recording that is not what was written."""

    position: int  # bytes of the file
    length: int  # bytes of the file
    # it is the beginning of a last block that was never finished: a program was killed in the
    # middle of writing it, or the file was truncated
    is_cut: bool = False


@dataclass(frozen=True)
class Block:
    """A block with a sound header."""

    position: int  # of its header, in the file
    header: BlockHeader

    @property
    def payload_position(self) -> int:
        """Position of its payload."""
        return self.position + self.header.header_bytes

    @property
    def end(self) -> int:
        """Position behind it."""
        return self.payload_position + self.header.length


class BlockReader:
    """Blocks in anything that holds bytes; damage between them is stepped over and reported.

    The first sound header decides which recording, and which version of the format, this is;
    blocks of any other are not looked at. Memory: one block.

    `path`: for messages; `fetch`: takes position and length, returns these bytes, fewer at the end;
    `length`: bytes there are.
    """

    def __init__(self, path: Path, fetch: Callable[[int, int], bytes], length: int) -> None:
        self.path = path
        self.length = length
        self._fetch = fetch

    def __iter__(self) -> Iterator[Block | Damage]:
        """Yield every block with a sound header, and the damage between them; payloads are not
        looked at.
        """
        first = self._first_header
        position = 0
        if first is not None and first.is_legacy:
            position = self._find_header(0)  # version 0.1.0 put an HDF5 file's beginning before
        while position < self.length:
            header = self._read_header(position)
            if header is None:
                found = self._find_header(position + 1)
                is_cut = found == self.length and self._is_cut(position)
                yield Damage(position, found - position, is_cut)
                position = found
            else:
                block = Block(position, header)
                yield block
                position = block.end

    def read_payload(self, block: Block) -> bytes:
        """Return a block's payload."""
        data = self._fetch(block.payload_position, block.header.length)
        if not block.header.matches(data):
            raise FileFormatError(
                self.path,
                f"the block at byte {block.position} is damaged; tofclip devices repair leaves it out",
            )
        return data

    def read_piece(self, block: Block) -> Piece:
        """Return the piece of the stream that a block holds; raises as `read_payload`."""
        return Piece(self.read_payload(block), block.header.records, block.header.gap)

    def find_head(self) -> Block | None:
        """Return the first undamaged description of the instrument, None if there is none."""
        for entry in self:
            if isinstance(entry, Block) and entry.header.kind is BlockKind.HEAD:
                with contextlib.suppress(FileFormatError):
                    self.read_payload(entry)
                    return entry
        return None

    @cached_property
    def _first_header(self) -> BlockHeader | None:
        """The first sound header of either version."""
        found = [self._search(0, magic, lambda header: True) for magic in (MAGIC, LEGACY_MAGIC)]
        first = min(found)
        return self._parse_header(first) if first < self.length else None

    def _parse_header(self, position: int) -> BlockHeader | None:
        """Read a header, or None if there is none or its payload would not lie within the file."""
        header = BlockHeader.unpack(self._fetch(position, HEADER_BYTES))
        if header is None or position + header.header_bytes + header.length > self.length:
            return None
        return header

    def _read_header(self, position: int) -> BlockHeader | None:
        """Read a header of this recording, None where there is none."""
        header = self._parse_header(position)
        return header if header is not None and self._belongs(header) else None

    def _is_cut(self, position: int) -> bool:
        """Whether what is left of the file is the beginning of a block."""
        data = self._fetch(position, HEADER_BYTES)
        if self.length - position < HEADER_BYTES:
            return data.startswith(MAGIC[: len(data)])
        header = BlockHeader.unpack(data)
        return header is not None and self._belongs(header)

    def _belongs(self, header: BlockHeader) -> bool:
        first = self._first_header
        return (
            first is not None
            and header.recording == first.recording
            and header.is_legacy == first.is_legacy
        )

    def _find_header(self, position: int) -> int:
        """Return where the next sound header of this recording begins, or the end."""
        first = self._first_header
        magic = LEGACY_MAGIC if first is not None and first.is_legacy else MAGIC
        return self._search(position, magic, self._belongs)

    def _search(self, position: int, magic: bytes, accept: Callable[[BlockHeader], bool]) -> int:
        while position < self.length:
            # Overlaps the next stretch, so that a magic across the border is found.
            stretch = self._fetch(position, SEARCH_BYTES + len(magic) - 1)
            at = stretch.find(magic)
            while at >= 0:
                header = self._parse_header(position + at)
                if header is not None and accept(header):
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
        """Return the payload of an END block."""
        known = {"stats": self.stats, "fault": self.fault, "complete": self.is_complete}
        return json.dumps(known).encode()

    @classmethod
    def from_json(cls, payload: bytes, path: Path) -> Ending:
        """Read the payload of an END block.

        `path`: for the message.
        """
        try:
            known = json.loads(payload)
            stats = {str(name): int(value) for name, value in known["stats"].items()}
            return cls(stats, str(known["fault"]), bool(known.get("complete", True)))
        except (ValueError, TypeError, KeyError, AttributeError) as fault:
            raise FileFormatError(path, "has accounts that cannot be read") from fault


class Recording:
    """A recording, open for reading; also one that is still being written, or whose program was
    killed.
    """

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
        return build_codec_from_head(self.head, self.path)

    @property
    def info(self) -> Info:
        """What was known about the instrument."""
        try:
            known = json.loads(str(self.head.attribute("info")))
            return Info(known.pop("instrument"), known.pop("serial"), known)
        except (KeyError, TypeError, AttributeError, json.JSONDecodeError) as fault:
            raise FileFormatError(self.path, "does not describe its instrument") from fault

    def close(self) -> None:
        """Close the file; closing twice is fine."""
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _read_head(self) -> Record:
        head = self.blocks.find_head()
        if head is None:
            raise FileFormatError(
                self.path, "is not a recording, or every copy of its head is damaged"
            )
        return parse_head(self.blocks.read_payload(head), self.path)

    def _read_bytes(self, position: int, length: int) -> bytes:
        return read_at(self._file.fileno(), position, length, self.path)


def read_at(file: int, position: int, length: int, path: Path) -> bytes:
    """Read `length` bytes from `position` on, fewer at the end of the file.

    `file`: descriptor; `position, length`: bytes; `path`: for the message.
    """
    pieces: list[bytes] = []
    while length > 0:
        try:
            piece = os.pread(file, length, position)
        except OSError as fault:
            raise StorageError(f"{path}: cannot be read: {fault.strerror}") from fault
        if not piece:
            break
        pieces.append(piece)
        position += len(piece)
        length -= len(piece)
    return pieces[0] if len(pieces) == 1 else b"".join(pieces)


def read_head_if_recording(path: Path) -> Record | None:
    """Return what a recording says about its instrument, None for any other file; its pieces are
    not read.
    """
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


def parse_head(image: bytes, path: Path) -> Record:
    """Read the record that the payload of a HEAD block, an HDF5 file, holds.

    `path`: of the recording.
    """
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder, path.name)
        # HDF5 reads files rather than bytes.
        copy.write_bytes(image)
        head = Record.load(copy, RECORD_KIND)
    return Record(head.kind, {}, head.attributes, head.children, head.provenance, str(path))


def build_codec_from_head(head: Record, path: Path) -> Codec:
    """Build the codec that a recording's head names.

    `path`: for the message.
    """
    try:
        settings = json.loads(str(head.attribute("codec_settings")))
        return build_codec(str(head.attribute("codec")), settings)
    except (InputError, json.JSONDecodeError, TypeError) as fault:
        raise FileFormatError(
            path, f"names a codec that this program does not know ({format_error_line(fault)})"
        ) from fault
