"""What a file may ask for: sizes that a file states are held against the bytes that it has, before
any memory is taken for them.

A damaged or malicious file of a few kilobytes may claim terabytes. Every reader asks here first.
"""

from __future__ import annotations

import io
import math
import os
from pathlib import Path
from typing import TYPE_CHECKING

from tofclip.errors import FileFormatError

if TYPE_CHECKING:
    import h5py

MAX_ARRAY_BYTES = 1 << 35
"""Largest array that is read from a file, 32 GiB; of a computer with less memory, its memory."""

MAX_COMPRESSION = 1032
"""Deflate makes at most this number of bytes of one; other compressions are not believed to do better."""

MAX_CHUNK_BYTES = 1 << 26
"""A chunk of an HDF5 dataset is unpacked whole, however little of it is wanted."""


class BoundedFile(io.BufferedReader):
    """A file, open for reading, that is never asked for more than it has.

    Python takes the memory for all bytes that are asked for before it reads them, and decoders ask
    for as many as a damaged header says.

    Parameters
    ----------
    path : path-like
    """

    def __init__(self, path: str | Path) -> None:
        super().__init__(io.FileIO(path))
        self._size = os.fstat(self.fileno()).st_size

    def read(self, size: int | None = -1, /) -> bytes:
        """Return `size` bytes, fewer at the end of the file; all that are left by default."""
        left = max(0, self._size - self.tell())
        return super().read(left if size is None or size < 0 else min(size, left))


def find_array_limit() -> int:
    """Return the size, bytes, above which no array of a file is read on this computer."""
    try:
        memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (ValueError, OSError, AttributeError):  # a system that does not say
        memory = MAX_ARRAY_BYTES
    return min(MAX_ARRAY_BYTES, memory)


def require_bounded_size(
    path: str | Path, name: str, claimed: int, stored: int, compressed: bool = False
) -> None:
    """Refuse an array that claims more than its file can hold, or more than is read at all.

    Parameters
    ----------
    path : path-like
        The file.
    name : str
        Of the array, for the message.
    claimed : int
        Bytes that its values would take in memory.
    stored : int
        Bytes that it takes in the file; where the file itself says so, at most the file's size is
        believed.
    compressed : bool
        Whether these are compressed bytes.

    Raises
    ------
    FileFormatError
    """
    limit = find_array_limit()
    if claimed > limit:
        raise FileFormatError(
            path, f"'{name}' claims {claimed} bytes, more than the {limit} that are read"
        )
    if claimed > min(stored, os.path.getsize(path)) * (MAX_COMPRESSION if compressed else 1):
        raise FileFormatError(
            path,
            f"is truncated or damaged: '{name}' claims {claimed} bytes, which the file cannot hold",
        )


def require_own_member(group: h5py.Group, name: str, origin: str | Path) -> None:
    """Refuse a member of an HDF5 group that is a link, be it within the file or out of it.

    Parameters
    ----------
    group : h5py.Group
    name : str
    origin : path-like
        The file that it is in.

    Raises
    ------
    FileFormatError
    """
    import h5py

    if not isinstance(group.get(name, getlink=True), h5py.HardLink):
        raise FileFormatError(origin, f"'{name}' cannot be read: links are not followed")


def require_bounded_dataset(
    dataset: h5py.Dataset, origin: str | Path, at_once: int | None = None
) -> None:
    """Refuse a dataset whose values are not in its own file, or claim more than the file can hold.

    Parameters
    ----------
    dataset : h5py.Dataset
    origin : path-like
        The file that it is in.
    at_once : int, optional
        How many of its values are read at once; by default all.

    Raises
    ------
    FileFormatError
    """
    name, dtype = dataset.name.lstrip("/"), dataset.dtype
    if dataset.is_virtual or dataset.external:
        raise FileFormatError(origin, f"'{name}' lies in other files, which are not read")
    if dtype.hasobject or dataset.shape is None:
        raise FileFormatError(origin, f"'{name}' does not hold numbers of a fixed size")
    claimed = math.prod(dataset.shape) * dtype.itemsize
    wanted = claimed if at_once is None else at_once * dtype.itemsize
    chunk = math.prod(dataset.chunks or ()) * dtype.itemsize
    stored, limit = dataset.id.get_storage_size(), find_array_limit()
    if wanted > limit or chunk > max(claimed, MAX_CHUNK_BYTES):
        raise FileFormatError(
            origin,
            f"'{name}' claims {max(wanted, chunk)} bytes, more than the {limit} that are read",
        )
    if stored > os.path.getsize(origin) or claimed > MAX_COMPRESSION * stored:
        raise FileFormatError(
            origin, f"is damaged: '{name}' claims {claimed} bytes, which the file cannot hold"
        )
