"""Files of any format: writing that is all or nothing, and clear words when the system refuses."""

from __future__ import annotations

import contextlib
import errno
import os
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path

from tofclip.errors import StorageError

SIGNATURE = b"\x89HDF\r\n\x1a\n"
"""The first bytes of every HDF5 file."""


@contextlib.contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """Yield a temporary name beside `path` and rename it to `path` when the block ends well.

    On any exception, Ctrl-C included, the temporary file is removed and `path` stays as it was. Problems of the file
    system become `StorageError`.
    """
    target = Path(path)
    try:
        handle, name = tempfile.mkstemp(prefix=f".{target.name}.", suffix=target.suffix, dir=target.parent or ".")
        os.close(handle)
    except OSError as fault:
        raise StorageError(f"{target}: cannot be written: {_reason(fault)}") from fault
    temporary = Path(name)
    try:
        yield temporary
        os.chmod(temporary, 0o666 & ~_umask())
        os.replace(temporary, target)
    except OSError as fault:
        if isinstance(fault, StorageError):
            raise
        raise StorageError(f"{target}: cannot be written: {_reason(fault)}") from fault
    finally:
        temporary.unlink(missing_ok=True)


def remove_leftovers(targets: Iterable[Path]) -> None:
    """Remove the temporary files of writers of `targets` that were killed before `atomic_path` could.

    Only when nobody writes these targets any more: a writer whose temporary file is gone fails.
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
def reading(path: str | Path) -> Iterator[None]:
    """Turn the operating system's refusals to read `path` into `StorageError`."""
    try:
        yield
    except FileNotFoundError as fault:
        raise StorageError(f"{path}: no such file") from fault
    except IsADirectoryError as fault:
        raise StorageError(f"{path}: is a folder, a file is needed") from fault
    except PermissionError as fault:
        raise StorageError(f"{path}: reading is not permitted") from fault


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


def _reason(fault: OSError) -> str:
    if fault.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
        return "the disk is full; free some space or choose another folder with --out"
    if isinstance(fault, FileNotFoundError):
        return "the folder does not exist; create it first"
    if isinstance(fault, NotADirectoryError):
        return "its folder is a file"
    if isinstance(fault, IsADirectoryError):
        return "it is a folder; name a file"
    if isinstance(fault, PermissionError):
        return "writing is not permitted there"
    return one_line(fault)


def one_line(fault: BaseException) -> str:
    """Return an exception's message without line breaks, or its name where it has none."""
    return " ".join(str(fault).split()) or type(fault).__name__
