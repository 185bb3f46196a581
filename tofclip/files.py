"""Files of any format: written whole or not at all, known again by their content, and read for no
more than they hold; and messages about packages that are missing.

A damaged or malicious file of a few kilobytes may claim terabytes: every reader holds the sizes that
a file states against the bytes that it has, before any memory is taken for them.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import glob
import hashlib
import importlib
import io
import math
import os
import secrets
import shutil
import stat
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import unquote

from tofclip.errors import (
    FileFormatError,
    InputError,
    StorageError,
    TofclipError,
    explain_import,
    require,
)

if TYPE_CHECKING:
    import h5py


OWN_PACKAGES = ("tofclip", "nlos", "devices", "apps")

# What to install for a module whose distribution has another name.
DISTRIBUTIONS = {
    "cupy": "cupy-cuda12x",
    "cv2": "opencv-python-headless",
    "PIL": "pillow",
    "pywt": "pywavelets",
    "skimage": "scikit-image",
    "usb": "pyusb",
}


def describe_missing_package(fault: ImportError) -> str | None:
    """Return which package is missing and what to install, None where a module of ours is."""
    module = (fault.name or "").partition(".")[0]
    if not module or module in OWN_PACKAGES:
        return None
    distribution = DISTRIBUTIONS.get(module, module.replace("_", "-"))
    if isinstance(fault, ModuleNotFoundError):
        return f"the package '{distribution}' is missing: pip install {distribution}"
    return f"the package '{distribution}' does not load on this machine: {fault}"


def import_file_reader(name: str, install: str) -> Any:
    """Import a package that reads a kind of file; pip is asked to `install` it."""
    with explain_import(f"this file needs {name}: pip install '{install}'"):
        return importlib.import_module(name)


def import_open3d() -> Any:
    """Import Open3D with the libusb of libusb-package: Open3D is linked against one, which bare
    machines lack and its wheel does not bring.
    """
    try:
        libusb = importlib.import_module("libusb_package").get_library_path()
        # Symbols that the process has already are not looked for in the system's folders.
        ctypes.CDLL(str(libusb), mode=ctypes.RTLD_GLOBAL)
    except (ImportError, OSError):
        pass  # the system may have its own
    with explain_import("Open3D does not load on this machine: pip install open3d"):
        return importlib.import_module("open3d")


# Largest array that a file may make of much less: what deflate packs a thousandfold is zeros.
MAX_UNPACKED_BYTES = 1 << 31
# Arrays that take at least one byte of so many in their file may be larger: the file is large, too.
USUAL_COMPRESSION = 8
MEMORY_FRACTION = 0.5  # of the computer's memory, the most that one array of a file may take
ARRAY_LIMIT_VARIABLE = "TOFCLIP_MAX_ARRAY_GIB"  # states the largest array in place of these limits
MAX_COMPRESSION = 1032  # of deflate; other compressions are not believed to do better
MAX_CHUNK_BYTES = 1 << 26  # of an HDF5 dataset: unpacked whole, however little of it is wanted
# Of larger files, size, time of change and so many first bytes stand for the content.
MAX_HASHED_BYTES = 1 << 24
MAX_TOML_BYTES = 1 << 20  # of a file that a person writes
MIN_FREE_BYTES = 4096  # a disk with less, a block of most file systems, is full
DISK_IS_FULL = "the disk is full; free some space or choose another folder"
MAX_MESSAGE_LENGTH = 200  # of another library's message that is part of ours


class BoundedFile(io.BufferedReader):
    """A file, open for reading, that is never asked for more than it has. Python takes the memory
    for all bytes that are asked for before it reads them, and decoders ask for as many as a damaged
    header says.
    """

    def __init__(self, path: str | Path) -> None:
        super().__init__(io.FileIO(path))
        self._size = os.fstat(self.fileno()).st_size

    def read(self, size: int | None = -1, /) -> bytes:
        """Return `size` bytes, fewer at the end of the file; all that are left by default."""
        left = max(0, self._size - self.tell())
        return super().read(left if size is None or size < 0 else min(size, left))


def find_array_limit(stored: int = 0) -> int:
    """Return the size, bytes, above which an array that takes `stored` bytes of its file is not read."""
    wanted = os.environ.get(ARRAY_LIMIT_VARIABLE)
    if wanted:
        with contextlib.suppress(ValueError, OverflowError):
            if (limit := int(float(wanted) * (1 << 30))) > 0:
                return limit
        raise InputError(f"{ARRAY_LIMIT_VARIABLE} must be a positive number, got '{wanted}'")
    limit = max(MAX_UNPACKED_BYTES, USUAL_COMPRESSION * stored)
    with contextlib.suppress(ValueError, OSError, AttributeError):  # a system that does not say
        memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
        limit = min(limit, int(MEMORY_FRACTION * memory))
    return limit


def _require_array_limit(path: str | Path, name: str, claimed: int, stored: int) -> None:
    if claimed > (limit := find_array_limit(min(stored, os.path.getsize(path)))):
        problem = f"'{name}' claims {claimed} bytes, more than the {limit} that are read"
        remedy = f"if you trust the file, set {ARRAY_LIMIT_VARIABLE}={-(-claimed >> 30)}"
        raise FileFormatError(path, f"{problem}; {remedy}")


def require_bounded_size(
    path: str | Path, name: str, claimed: int, stored: int, compressed: bool = False
) -> None:
    """Refuse an array whose values would take `claimed` bytes of memory, more than its `stored` bytes
    can hold (at most the file's size is believed), or more than is read at all.
    """
    _require_array_limit(path, name, claimed, stored)
    if claimed > min(stored, os.path.getsize(path)) * (MAX_COMPRESSION if compressed else 1):
        problem = f"'{name}' claims {claimed} bytes, which the file cannot hold"
        raise FileFormatError(path, f"is truncated or damaged: {problem}")


def iterate_members(
    group: h5py.Group, visited: set[int]
) -> Iterator[tuple[str, h5py.Dataset | h5py.Group | None]]:
    """Yield names and members of an HDF5 group; None for a link to elsewhere, and for an object
    whose address is among those `visited`. A file of a few kilobytes may hold a group that holds
    itself many times over: whoever walks through groups in groups hands on one set of visited
    addresses.
    """
    import h5py

    visited.add(h5py.h5o.get_info(group.id).addr)
    for name in group:
        item = None
        if isinstance(group.get(name, getlink=True), h5py.HardLink):
            item = group[name]
            address = h5py.h5o.get_info(item.id).addr
            item = None if address in visited else item
            visited.add(address)
        yield name, item


def require_bounded_dataset(
    dataset: h5py.Dataset, origin: str | Path, at_once: int | None = None, objects: bool = False
) -> None:
    """Refuse a dataset whose values are not in its own file, or claim more than the file can hold.
    `at_once`: how many of its values are read at once; by default all. `objects`: values may be
    references.
    """
    name, dtype = dataset.name.lstrip("/"), dataset.dtype
    if dataset.is_virtual or dataset.external:
        raise FileFormatError(origin, f"'{name}' lies in other files, which are not read")
    if (dtype.hasobject and not objects) or dataset.shape is None:
        raise FileFormatError(origin, f"'{name}' does not hold numbers of a fixed size")
    claimed = math.prod(dataset.shape) * dtype.itemsize
    wanted = claimed if at_once is None else at_once * dtype.itemsize
    chunk = math.prod(dataset.chunks or ()) * dtype.itemsize
    stored = dataset.id.get_storage_size()
    _require_array_limit(origin, name, wanted, stored)
    if chunk > max(claimed, MAX_CHUNK_BYTES):
        raise FileFormatError(origin, f"is damaged: a chunk of '{name}' claims {chunk} bytes")
    if stored > os.path.getsize(origin) or claimed > MAX_COMPRESSION * stored:
        problem = f"'{name}' claims {claimed} bytes, which the file cannot hold"
        raise FileFormatError(origin, f"is damaged: {problem}")


PICTURE_SUFFIXES = (".png", ".pdf", ".svg")


def require_suffix(path: str | Path, *suffixes: str) -> None:
    """Refuse to write to a name that says another format than the file will have."""
    require(
        Path(path).suffix.lower() in suffixes,
        f"{path}: the name must end in {' or '.join(suffixes)}",
    )


def compute_sha256(path: str | Path) -> str:
    """Hexadecimal SHA-256 of a file."""
    with translate_read_errors(path), open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def identify_file(file: Path) -> str:
    """Say by what a file's content is known again: its hash, or see `MAX_HASHED_BYTES`."""
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
        raise StorageError(f"{target}: cannot be written: {explain_os_error(fault)}") from fault
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
            reason = explain_os_error(fault)
        elif _is_full(target.parent):
            reason = DISK_IS_FULL
        elif isinstance(fault, OSError):
            reason = format_error_line(fault)
        else:
            raise
        raise StorageError(f"{target}: cannot be written: {reason}") from fault
    finally:
        temporary.unlink(missing_ok=True)


def require_apart(outputs: Iterable[str | Path], inputs: Iterable[str | Path | None]) -> None:
    """Refuse outputs that are inputs too: they would be overwritten, or taken for results.

    They are compared as the file system knows them, so that a link or another spelling of a name
    makes no difference. What does not exist yet is no input. Inputs are files, folders with the files
    in them, patterns of `glob`, and addresses, of which only those of ``file://`` name a file.
    """
    existing = {_identify_entry(Path(one)): Path(one) for one in outputs}
    existing.pop(None, None)
    if not existing:
        return
    for path in _iterate_inputs(inputs):
        out = existing.get(_identify_entry(path))
        if out is not None:
            what = "folder" if out.is_dir() else "name"
            raise InputError(
                f"{out}: is an input too; choose another {what}, so that it is not overwritten"
            )


def _iterate_inputs(inputs: Iterable[str | Path | None]) -> Iterator[Path]:
    """Yield the files and folders that inputs name, and the files of these folders."""
    for one in inputs:
        scheme, is_address, place = str(one or "").partition("://")
        if one is None or (is_address and scheme.lower() != "file"):
            continue
        name = unquote(place.partition("?")[0]) if is_address else str(one)
        is_pattern = glob.has_magic(name) and not os.path.lexists(name)
        for path in map(Path, glob.iglob(name, recursive=True) if is_pattern else [name]):
            yield path
            with contextlib.suppress(OSError):  # no folder, or one that cannot be read
                yield from (inner for inner in path.iterdir() if not inner.is_dir())


def _identify_entry(path: Path) -> tuple[int, int] | None:
    """Return by what the file system knows a file or a folder; None where there is none."""
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_dev, found.st_ino


def remove_temporary_files(targets: Iterable[Path]) -> None:
    """Remove the temporary files of writers of `targets` that were killed before `atomic_path`
    could. A writer that is still at work would fail.
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
    """Turn the operating system's refusals to read `path` into `StorageError`; refuse a pipe or a
    device before it is opened, which may wait for ever or never end.
    """
    try:
        if _is_endless(path):
            raise StorageError(f"{path}: is a pipe or a device; save what it gives to a file first")
        yield
    except FileNotFoundError as fault:
        raise StorageError(f"{path}: no such file") from fault
    except IsADirectoryError as fault:
        raise StorageError(f"{path}: is a folder, a file is needed") from fault
    except PermissionError as fault:
        raise StorageError(f"{path}: reading is not permitted") from fault


@contextlib.contextmanager
def guard(path: str | Path, problem: str = "is truncated or damaged") -> Iterator[None]:
    """Read a file of unknown origin: whatever its decoder stumbles over, it is the file that is
    damaged (`problem`); what the system refuses is translated as by `translate_read_errors`.
    """
    with translate_read_errors(path):
        try:
            yield
        except (TofclipError, FileNotFoundError, IsADirectoryError, PermissionError):
            raise
        except MemoryError as fault:
            raise StorageError(f"{path}: does not fit into this computer's memory") from fault
        except Exception as fault:
            raise FileFormatError(path, f"{problem} ({format_error_line(fault)})") from fault


def read_toml(path: str | Path, what: str) -> dict[str, Any]:
    """Read a TOML file; `what` it is of, such as "settings", for the message where it is none."""
    import tomllib

    with translate_read_errors(path), open(path, "rb") as opened:
        data = opened.read(MAX_TOML_BYTES + 1)  # one byte more shows that there is more
    if len(data) > MAX_TOML_BYTES:
        raise FileFormatError(path, f"is larger than any TOML file of {what}")
    try:
        return tomllib.loads(data.decode())
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as fault:
        raise FileFormatError(path, f"is not a TOML file of {what} ({fault})") from fault


def suggest_name(name: str, known: Iterable[str]) -> str:
    """Say which of the known names a wrong one may stand for, or all of them."""
    import difflib

    known = list(known)
    like = difflib.get_close_matches(name, known, 1)
    return f"did you mean '{like[0]}'?" if like else f"known are {', '.join(known)}"


def _is_endless(path: str | Path) -> bool:
    with contextlib.suppress(OSError):  # opening it will say
        mode = os.stat(path).st_mode
        return not (stat.S_ISREG(mode) or stat.S_ISDIR(mode))
    return False


def _create_temporary_file(target: Path) -> Path:
    """Create an empty file beside `target`, with the permissions that any new file has. `tempfile`
    would make it private, and asking for the process's umask means changing it, which other threads
    that create files meanwhile would see.
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


def explain_os_error(fault: OSError) -> str:
    """Return why the system refuses to write, and what to do about it."""
    if fault.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
        return DISK_IS_FULL
    reasons: dict[type[OSError], str] = {
        FileNotFoundError: "the folder does not exist; create it first",
        NotADirectoryError: "its folder is a file",
        IsADirectoryError: "it is a folder; name a file",
        PermissionError: "writing is not permitted there",
    }
    return reasons.get(type(fault)) or fault.strerror or format_error_line(fault)


def format_error_line(fault: BaseException) -> str:
    """Return an exception's message without line breaks, cut where long, or its name."""
    text = " ".join(str(fault).split()) or type(fault).__name__
    return text if len(text) <= MAX_MESSAGE_LENGTH else f"{text[:MAX_MESSAGE_LENGTH]} ..."
