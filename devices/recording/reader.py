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
from devices.recording.blocks import HEADER_BYTES, MAGIC, BlockHeader, Kind
from devices.recording.growing import DATASET
from devices.registry import codec_named
from devices.ring import Piece
from devices.source import Info
from tofclip.errors import FileFormatError, InputError
from tofclip.storage import Record, one_line, reading

KIND = "recording"
STRETCH = 1 << 20
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
        """Yield every block with a sound header, and what lies between them; payloads are not looked at."""
        position = 0
        while position < self.length:
            header = self._header(position)
            if header is None:
                found = self._next_header(position + 1)
                yield Damage(position, found - position)
                position = found
            else:
                block = Block(position, header)
                yield block
                position = block.end

    def payload(self, block: Block) -> bytes:
        """Return a block's payload.

        Raises
        ------
        FileFormatError
            It is not what was written.
        """
        data = self._fetch(block.position + HEADER_BYTES, block.header.length)
        if not block.header.fits(data):
            raise FileFormatError(
                self.path, f"the block at byte {block.position} is damaged; tofclip devices repair leaves it out"
            )
        return data

    def piece(self, block: Block) -> Piece:
        """Return the piece of the stream that a block holds."""
        return Piece(self.payload(block), block.header.records, block.header.gap)

    def _header(self, position: int) -> BlockHeader | None:
        """Read a header, or None if there is none or its payload would not lie within the file."""
        header = BlockHeader.unpacked(self._fetch(position, HEADER_BYTES))
        if header is None or position + HEADER_BYTES + header.length > self.length:
            return None
        return header

    def _next_header(self, position: int) -> int:
        """Return where the next sound header begins, or the end."""
        while position < self.length:
            stretch = self._fetch(position, STRETCH + len(MAGIC) - 1)
            at = stretch.find(MAGIC)
            while at >= 0:
                if self._header(position + at) is not None:
                    return position + at
                at = stretch.find(MAGIC, at + 1)
            position += STRETCH
        return self.length


class Recording:
    """A recording, open for reading; also one that is still being written, or whose program was killed.

    Parameters
    ----------
    path : Path

    Raises
    ------
    StorageError, FileFormatError
        FileFormatError where the file is no recording; `devices.recording.check.repair` may know better.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        with reading(path), open(path, "rb"):
            pass
        with self._damage_named():
            self._file = h5py.File(path, "r", locking=False)
            raw = self._file.get(DATASET)
        if not isinstance(raw, h5py.Dataset) or raw.ndim != 1 or raw.dtype != np.uint8:
            raise FileFormatError(path, "is an HDF5 file, but no recording")
        self._raw = raw
        self.blocks = BlockReader(path, self._bytes, raw.shape[0])
        self.head = self._head()
        """What was known before the first piece."""

    @property
    def codec(self) -> Codec:
        """The codec that its bytes need."""
        return codec_of(self.head, self.path)

    @property
    def info(self) -> Info:
        """What was known about the instrument."""
        with self._damage_named():
            known = json.loads(str(self.head.attribute("info")))
            return Info(known.pop("instrument"), known.pop("serial"), known)

    def close(self) -> None:
        """Close the file; closing twice is fine."""
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _head(self) -> Record:
        first = next(iter(self.blocks), None)
        if not isinstance(first, Block) or first.header.kind is not Kind.HEAD:
            raise FileFormatError(self.path, "its first block is damaged; tofclip devices repair may help")
        return head_in(self.blocks.payload(first), self.path)

    def _bytes(self, position: int, length: int) -> bytes:
        with self._damage_named():
            return bytes(self._raw[position : position + length].tobytes())

    @contextlib.contextmanager
    def _damage_named(self) -> Iterator[None]:
        try:
            yield
        except (OSError, RuntimeError, KeyError, TypeError, json.JSONDecodeError) as fault:
            raise FileFormatError(self.path, f"is no recording, or a damaged one ({one_line(fault)})") from fault


def head_if_recording(path: Path) -> Record | None:
    """Return what a recording says about its instrument, None for any other HDF5 file; its bytes are not read."""
    with contextlib.suppress(OSError), h5py.File(path, "r", locking=False) as file:
        if file.attrs.get("kind", b"") == KIND.encode():
            with Recording(path) as recording:
                return recording.head
    return None


def head_in(image: bytes, path: Path) -> Record:
    """Read the record in the HDF5 image that a HEAD block holds."""
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder, path.name)
        copy.write_bytes(image)
        head = Record.load(copy, KIND)
    return Record(head.kind, {}, head.attributes, head.children, head.provenance, str(path))


def codec_of(head: Record, path: Path) -> Codec:
    """Build the codec that a recording's head names."""
    try:
        settings = json.loads(str(head.attribute("codec_settings")))
        return codec_named(str(head.attribute("codec")), settings)
    except (InputError, json.JSONDecodeError, TypeError) as fault:
        raise FileFormatError(path, f"names a codec that this program does not know ({one_line(fault)})") from fault
