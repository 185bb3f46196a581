"""Reading recordings, sound and damaged ones."""

from __future__ import annotations

import contextlib
import json
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import h5py
import numpy as np

from devices.codec import Codec
from devices.recording.appendable_file import DATASET_NAME
from devices.recording.blocks import HEADER_BYTES, MAGIC, BlockHeader, BlockKind
from devices.registry import build_codec
from devices.ring import Piece
from devices.source import Info
from tofclip.errors import FileFormatError, InputError
from tofclip.storage import Record, format_error_line, translate_read_errors

RECORD_KIND = "recording"
SEARCH_BYTES = 1 << 20
"""Bytes in which the next sound block is searched at once."""


@dataclass(frozen=True)
class Damage:
    """A stretch of a recording that is not what was written.

    Parameters
    ----------
    position, length : int
        Bytes of dataset ``raw``.
    """

    position: int
    length: int


@dataclass(frozen=True)
class Block:
    """A sound block.

    Parameters
    ----------
    position : int
        Of its header, in dataset ``raw``.
    header : BlockHeader
    """

    position: int
    header: BlockHeader

    @property
    def end(self) -> int:
        """Position behind it."""
        return self.position + HEADER_BYTES + self.header.length


class BlockReader:
    """Blocks in anything that holds bytes; damage between them is stepped over and told.

    Memory: one block.

    Parameters
    ----------
    path : Path
        For messages.
    fetch : callable
        Takes position and length, returns these bytes, fewer at the end.
    length : int
    """

    def __init__(self, path: Path, fetch: Callable[[int, int], bytes], length: int) -> None:
        self.path, self.length, self._fetch = path, length, fetch

    def __iter__(self) -> Iterator[Block | Damage]:
        """Yield every block with a sound header, and what lies between them; payloads are not
        looked at.
        """
        position = 0
        while position < self.length:
            header = self._read_header(position)
            if header is None:
                found = self._find_header(position + 1)
                yield Damage(position, found - position)
                position = found
            else:
                block = Block(position, header)
                yield block
                position = block.end

    def read_payload(self, block: Block) -> bytes:
        """Return a block's payload.

        Raises
        ------
        FileFormatError
            It is not what was written.
        """
        data = self._fetch(block.position + HEADER_BYTES, block.header.length)
        if not block.header.matches(data):
            raise FileFormatError(
                self.path,
                f"the block at byte {block.position} is damaged; tofclip devices repair leaves it out",
            )
        return data

    def read_piece(self, block: Block) -> Piece:
        """Return the piece of the stream that a block holds."""
        return Piece(self.read_payload(block), block.header.records, block.header.gap)

    def _read_header(self, position: int) -> BlockHeader | None:
        """Read a header, or None if there is none or its payload would not lie within the file."""
        header = BlockHeader.unpack(self._fetch(position, HEADER_BYTES))
        if header is None or position + HEADER_BYTES + header.length > self.length:
            return None
        return header

    def _find_header(self, position: int) -> int:
        """Return where the next sound header begins, or the end."""
        while position < self.length:
            stretch = self._fetch(position, SEARCH_BYTES + len(MAGIC) - 1)
            at = stretch.find(MAGIC)
            while at >= 0:
                if self._read_header(position + at) is not None:
                    return position + at
                at = stretch.find(MAGIC, at + 1)
            position += SEARCH_BYTES
        return self.length


class Recording:
    """A recording, open for reading; also one that is still being written, or whose program was
    killed.

    Parameters
    ----------
    path : Path

    Raises
    ------
    StorageError, FileFormatError
        FileFormatError where the file is no recording; `devices.recording.check.repair` may know
        better.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        with translate_read_errors(path), open(path, "rb"):
            pass
        with self._translate_errors():
            self._file = h5py.File(path, "r", locking=False)
            raw = self._file.get(DATASET_NAME)
        if not isinstance(raw, h5py.Dataset) or raw.ndim != 1 or raw.dtype != np.uint8:
            raise FileFormatError(path, "is an HDF5 file, but no recording")
        self._raw = raw
        self.blocks = BlockReader(path, self._read_bytes, raw.shape[0])
        self.head = self._read_head()
        """What was known before the first piece."""

    @property
    def codec(self) -> Codec:
        """The codec that its bytes need."""
        return build_codec_from_head(self.head, self.path)

    @property
    def info(self) -> Info:
        """What was known about the instrument."""
        with self._translate_errors():
            known = json.loads(str(self.head.attribute("info")))
            return Info(known.pop("instrument"), known.pop("serial"), known)

    def close(self) -> None:
        """Close the file; closing twice is fine."""
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _read_head(self) -> Record:
        first = next(iter(self.blocks), None)
        if not isinstance(first, Block) or first.header.kind is not BlockKind.HEAD:
            raise FileFormatError(
                self.path, "its first block is damaged; tofclip devices repair may help"
            )
        return parse_head(self.blocks.read_payload(first), self.path)

    def _read_bytes(self, position: int, length: int) -> bytes:
        with self._translate_errors():
            return bytes(self._raw[position : position + length].tobytes())

    @contextlib.contextmanager
    def _translate_errors(self) -> Iterator[None]:
        try:
            yield
        except (OSError, RuntimeError, KeyError, TypeError, json.JSONDecodeError) as fault:
            raise FileFormatError(
                self.path, f"is no recording, or a damaged one ({format_error_line(fault)})"
            ) from fault


def read_head_if_recording(path: Path) -> Record | None:
    """Return what a recording says about its instrument, None for any other HDF5 file; its bytes
    are not read.
    """
    with contextlib.suppress(OSError), h5py.File(path, "r", locking=False) as file:
        if file.attrs.get("kind", b"") == RECORD_KIND.encode():
            with Recording(path) as recording:
                return recording.head
    return None


def parse_head(image: bytes, path: Path) -> Record:
    """Read the record in the HDF5 image that a HEAD block holds."""
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder, path.name)
        copy.write_bytes(image)
        head = Record.load(copy, RECORD_KIND)
    return Record(head.kind, {}, head.attributes, head.children, head.provenance, str(path))


def build_codec_from_head(head: Record, path: Path) -> Codec:
    """Build the codec that a recording's head names."""
    try:
        settings = json.loads(str(head.attribute("codec_settings")))
        return build_codec(str(head.attribute("codec")), settings)
    except (InputError, json.JSONDecodeError, TypeError) as fault:
        raise FileFormatError(
            path, f"names a codec that this program does not know ({format_error_line(fault)})"
        ) from fault
