"""An HDF5 file whose last dataset grows by appending, without HDF5 writing a single byte while it
does.

HDF5 cannot be killed while it writes (its metadata are spread over the file) and crashes the
process when the disk is full. But all that says how long a contiguous dataset is are a few numbers
in its object header, and how long the file is, one number in the superblock. So HDF5 makes the file
once, with the dataset at its end; from then on bytes are appended, and then the numbers and the
checksums behind them are overwritten (HDF5 file format specification, II.A and IV.A.1). Each of the
two lies within one page of memory, which the system writes whole or not at all when the process is
killed. At every moment the file is one that any HDF5 program opens.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import h5py

from devices.recording.checksum import lookup3
from tofclip.errors import StorageError
from tofclip.storage import Record, atomic_path

DATASET_NAME = "raw"
PAGE_BYTES = 4096

_END_OF_FILE_OFFSET, _SUPERBLOCK_CHECKSUM_OFFSET = 28, 44
_DATASPACE_MESSAGE, _LAYOUT_MESSAGE = 0x01, 0x08


class _ObjectHeader(NamedTuple):
    """Where a dataset's object header keeps what changes: positions in the file."""

    start: int
    checksum: int
    lengths: tuple[int, ...]
    address: int


class AppendableFile:
    """The file, open for appending.

    Parameters
    ----------
    path : Path
        Replaced if it exists, once everything that is known beforehand has been written.
    head : Record
        What is known beforehand.
    begin : callable
        Takes the file as it is with `head` in it; returns the first bytes of the dataset.

    Raises
    ------
    StorageError
        The disk is full, the folder is missing or writing is not allowed.
    """

    def __init__(self, path: Path, head: Record, begin: Callable[[bytes], bytes]) -> None:
        self._path = path
        with atomic_path(path) as temporary:
            head.save(temporary)
            self._header = _add_dataset(temporary)
            image = temporary.read_bytes()
            self._begin = self._end = self._committed = -(-len(image) // PAGE_BYTES) * PAGE_BYTES
            self._file = os.open(temporary, os.O_RDWR)
            self.append(begin(image))
            self.commit()

    @property
    def length(self) -> int:
        """Bytes of the dataset that a reader sees."""
        return self._committed - self._begin

    def append(self, *pieces: bytes) -> None:
        """Append bytes to the dataset, all or none; readers see them after `commit`."""
        end = self._end
        for piece in pieces:
            rest = memoryview(piece)
            while rest:
                try:
                    written = os.pwrite(self._file, rest, end)
                except OSError as fault:
                    raise StorageError(
                        f"{self._path}: cannot be written: {fault.strerror}; what was recorded so far is safe"
                    ) from fault
                end += written
                rest = rest[written:]
        self._end = end

    def commit(self) -> None:
        """Let readers see all that was appended. What they saw before stays as it is whatever
        happens now.
        """
        if self._end == self._committed:
            return
        self._overwrite(0, _SUPERBLOCK_CHECKSUM_OFFSET, {_END_OF_FILE_OFFSET: self._end})
        length = self._end - self._begin
        changes = dict.fromkeys(self._header.lengths, length) | {self._header.address: self._begin}
        self._overwrite(self._header.start, self._header.checksum, changes)
        self._committed = self._end

    def close(self) -> None:
        """Hand everything to the disk and close; closing twice is fine."""
        if self._file < 0:
            return
        try:
            self.commit()
            os.fsync(self._file)
        finally:
            os.close(self._file)
            self._file = -1

    def _overwrite(self, start: int, checksum: int, changes: dict[int, int]) -> None:
        """Change numbers of 64 bits in a checksummed part of the file, with a single write."""
        part = bytearray(os.pread(self._file, checksum - start, start))
        for position, value in changes.items():
            struct.pack_into("<Q", part, position - start, value)
        os.pwrite(self._file, part + struct.pack("<I", lookup3(bytes(part))), start)


def _add_dataset(path: Path) -> _ObjectHeader:
    """Add the dataset to a file and find what has to be overwritten to let it grow."""
    # Aligned like this, no object header of ours lies across two pages.
    with h5py.File(
        path,
        "r+",
        libver=("v110", "v110"),
        alignment_threshold=1,
        alignment_interval=PAGE_BYTES // 8,
    ) as file:
        dataset = file.create_dataset(DATASET_NAME, shape=(1,), dtype="u1")
        dataset[0] = 0
        for name, value in {"units": "", "axes": "byte"}.items():
            length = h5py.string_dtype("utf-8", max(1, len(value)))
            dataset.attrs.create(name, value.encode(), dtype=length)
        start = h5py.h5o.get_info(dataset.id).addr
    content = path.read_bytes()
    header = _parse_header(content, start)
    if start // PAGE_BYTES != header.checksum // PAGE_BYTES:
        raise StorageError(
            f"{path}: HDF5 laid out the file in an unforeseen way; please report its version"
        )
    return header


def _parse_header(content: bytes, start: int) -> _ObjectHeader:
    """Find the numbers in a version 2 object header."""
    flags = content[start + 5]
    width = 1 << (flags & 3)
    begin = start + 6 + (16 if flags & 0x20 else 0) + (4 if flags & 0x10 else 0)
    end = begin + width + int.from_bytes(content[begin : begin + width], "little")
    found = dict(_iterate_messages(content, begin + width, end, prefix=6 if flags & 4 else 4))
    space, layout = found[_DATASPACE_MESSAGE], found[_LAYOUT_MESSAGE]
    longest = (space + 12,) if content[space + 2] & 1 else ()
    return _ObjectHeader(start, end, (space + 4, *longest, layout + 10), layout + 2)


def _iterate_messages(content: bytes, at: int, end: int, prefix: int) -> Iterator[tuple[int, int]]:
    """Yield type and position of every message in an object header."""
    while at + prefix <= end:
        yield content[at], at + prefix
        at += prefix + int.from_bytes(content[at + 1 : at + 3], "little")
