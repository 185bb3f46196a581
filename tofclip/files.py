"""Files of any format: written whole or not at all, known again by their content, and read for no
more than they hold.

A damaged or malicious file of a few kilobytes may claim terabytes: every reader holds the sizes that
a file states against the bytes that it has, before any memory is taken for them.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import io
import math
import os
import secrets
import shutil
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from tofclip.errors import FileFormatError, StorageError, TofclipError

if TYPE_CHECKING:
    import h5py

MAX_ARRAY_BYTES = 1 << 35
"""Largest array that is read from a file, 32 GiB; of a computer with less memory, its memory."""

MAX_COMPRESSION = 1032
"""Deflate makes at most this number of bytes of one; other compressions are not believed to do better."""

MAX_CHUNK_BYTES = 1 << 26
"""A chunk of an HDF5 dataset is unpacked whole, however little of it is wanted."""

MAX_HASHED_BYTES = 1 << 24
"""Of larger files, size, time of change and the first bytes, this number of them, stand for the content."""

MIN_FREE_BYTES = 4096
"""A disk with less, a block of most file systems, is full."""

DISK_IS_FULL = "the disk is full; free some space or choose another folder"

MAX_MESSAGE_LENGTH = 200
"""Of another library's message that is part of ours."""


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


def compute_sha256(path: str | Path) -> str:
    """Hexadecimal SHA-256 of a file."""
    with translate_read_errors(path), open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def identify_file(file: Path) -> str:
    """Say by what a file's content is known again: its hash, or for a large one what
    `MAX_HASHED_BYTES` says.

    Raises
    ------
    StorageError
        It cannot be read.
    """
    with translate_read_errors(file):
        state = file.stat()
        if state.st_size <= MAX_HASHED_BYTES:
            return compute_sha256(file)
        with open(file, "rb") as opened:
            start = hashlib.sha256(opened.read(MAX_HASHED_BYTES)).hexdigest()
    return f"{state.st_size} bytes, {state.st_mtime_ns} ns, {start}"


@contextlib.contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """Yield a temporary name beside `path` and rename it to `path` when the block ends well.

    On any exception, Ctrl-C included, the temporary file is removed and `path` stays as it was.
    Problems of the file system become `StorageError`. The contents are on the disk before the name
    is: after a loss of power, a file that is there is complete.
    """
    target = Path(path)
    try:
        temporary = _create_temporary_file(target)
    except OSError as fault:
        raise StorageError(f"{target}: cannot be written: {_explain_os_error(fault)}") from fault
    try:
        yield temporary
        _flush_to_disk(temporary)
        os.replace(temporary, target)
        with contextlib.suppress(OSError):  # not every system can flush a folder
            _flush_to_disk(target.parent)
    except TofclipError:
        raise
    except Exception as fault:
        # Writers of other libraries have errors of their own, or OSErrors without a number, for a
        # disk that is full; as long as the temporary file is there, it still is.
        if isinstance(fault, OSError) and fault.errno is not None:
            reason = _explain_os_error(fault)
        elif _is_full(target.parent):
            reason = DISK_IS_FULL
        elif isinstance(fault, OSError):
            reason = format_error_line(fault)
        else:
            raise
        raise StorageError(f"{target}: cannot be written: {reason}") from fault
    finally:
        temporary.unlink(missing_ok=True)


def remove_temporary_files(targets: Iterable[Path]) -> None:
    """Remove the temporary files of writers of `targets` that were killed before `atomic_path`
    could.

    Only when these targets are not written any more: a writer whose temporary file is gone fails.
    """
    wanted: dict[Path, set[str]] = {}
    for target in targets:
        wanted.setdefault(target.parent, set()).add(target.name)
    for folder, names in wanted.items():
        with contextlib.suppress(OSError):
            for entry in os.scandir(folder):
                target_name = Path(entry.name).stem[1:].rpartition(".")[0]
                if entry.name.startswith(".") and target_name in names:
                    Path(entry.path).unlink(missing_ok=True)


@contextlib.contextmanager
def translate_read_errors(path: str | Path) -> Iterator[None]:
    """Turn the operating system's refusals to read `path` into `StorageError`."""
    try:
        yield
    except FileNotFoundError as fault:
        raise StorageError(f"{path}: no such file") from fault
    except IsADirectoryError as fault:
        raise StorageError(f"{path}: is a folder, a file is needed") from fault
    except PermissionError as fault:
        raise StorageError(f"{path}: reading is not permitted") from fault


def _create_temporary_file(target: Path) -> Path:
    """Create an empty file beside `target`, with the permissions that any new file has.

    `tempfile` would make it private, and asking for the process's umask means changing it, which
    other threads that create files meanwhile would see.
    """
    while True:
        path = target.with_name(f".{target.name}.{secrets.token_hex(4)}{target.suffix}")
        with contextlib.suppress(FileExistsError):
            os.close(os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
            return path


def _flush_to_disk(path: Path) -> None:
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _is_full(folder: Path) -> bool:
    with contextlib.suppress(OSError):
        return shutil.disk_usage(folder).free < MIN_FREE_BYTES
    return False


def _explain_os_error(fault: OSError) -> str:
    if fault.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
        return DISK_IS_FULL
    if isinstance(fault, FileNotFoundError):
        return "the folder does not exist; create it first"
    if isinstance(fault, NotADirectoryError):
        return "its folder is a file"
    if isinstance(fault, IsADirectoryError):
        return "it is a folder; name a file"
    if isinstance(fault, PermissionError):
        return "writing is not permitted there"
    return format_error_line(fault)


def format_error_line(fault: BaseException) -> str:
    """Return an exception's message without line breaks, cut where it repeats a whole file, or its
    name where it has none.
    """
    text = " ".join(str(fault).split()) or type(fault).__name__
    return text if len(text) <= MAX_MESSAGE_LENGTH else f"{text[:MAX_MESSAGE_LENGTH]} ..."
