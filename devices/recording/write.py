"""Writing recordings: blocks are appended to a file that is locked and never rewritten."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import secrets
import tempfile
import zlib
from pathlib import Path
from time import monotonic, monotonic_ns, time_ns
from typing import Any

from devices.recording.read import HEADER_BYTES, Block, BlockKind, Ending
from devices.source import Codec, Gap, Info, Piece, Stats
from tofclip.errors import InputError, StorageError, require
from tofclip.files import explain_os_error
from tofclip.storage import Record

try:
    import fcntl
except ImportError:  # Windows: there, nothing keeps a second recorder away
    fcntl = None  # type: ignore[assignment]

HEAD_INTERVAL_BYTES = 64 << 20  # Payload after which the head is written once more
SECTOR_BYTES = 4096

_EXISTS = "exists already; choose another name, or replace it (`overwrite=True`)"
CHECK_INTERVAL_S = 0.25  # Seconds after which the writer looks whether its file is still there


def make_head(
    codec: Codec, info: Info, calibration: Record | None, provenance: dict[str, Any]
) -> Record:
    """Describe an instrument for `RecordingWriter`: all of a recording that is known before the first
    piece. `provenance`, how it came about, is any JSON-serialisable tree.
    """
    attributes = {
        "codec": codec.name,
        "codec_settings": json.dumps(dict(codec.settings)),
        "info": json.dumps(info.as_dict()),
    }
    children = {} if calibration is None else {"calibration": calibration}
    return Record("recording", {}, attributes, children, provenance)


class RecordingWriter:
    """A recording under way.

    What `add` was given is in the file when it returns: a killed program loses nothing of it, and
    nothing waits for more to come. The system may take longer to bring it to the disk: only
    `close` waits for that.

    `path`: locked until `close`, so that no second recorder writes to it; `head`: made by
    `make_head`; `overwrite`: replace a file that exists.
    """

    def __init__(self, path: Path, head: Record, overwrite: bool = False) -> None:
        self.bytes_written = 0
        """Payload of the pieces so far."""
        self._path = path
        self._recording = secrets.randbits(64)
        self._number = 0
        self._end = 0
        self._bytes_since_head = 0
        # Times by a clock that is never set, so that a replay at the recording's pace never waits
        # for a day that did not pass.
        self._clock_offset_ns = time_ns() - monotonic_ns()
        self._checked_at = monotonic()
        self._head = _render_head(head)
        try:
            with contextlib.ExitStack() as stack:
                self._file, temporary = _create_file(path, overwrite, stack)
                self._append(BlockKind.HEAD, self._head)
                self._append(BlockKind.HEAD, self._head)
                _publish(temporary, path, overwrite)
        except StorageError:
            raise
        except OSError as fault:
            raise self._explain(fault) from fault
        self._inode = os.fstat(self._file).st_ino

    def add(self, piece: Piece) -> None:
        self._append(BlockKind.PIECE, piece.data, piece.records, piece.gap)
        self.bytes_written += len(piece.data)
        self._bytes_since_head += len(piece.data)
        if self._bytes_since_head >= max(HEAD_INTERVAL_BYTES, 100 * len(self._head)):
            self._append(BlockKind.HEAD, self._head)
            self._bytes_since_head = 0
        self.check()

    def check(self) -> None:
        """Look now and then whether the file is still there."""
        if monotonic() < self._checked_at + CHECK_INTERVAL_S:
            return
        self._checked_at = monotonic()
        inode = -1
        with contextlib.suppress(OSError):
            inode = os.stat(self._path).st_ino
        if inode != self._inode:
            raise StorageError(
                f"{self._path}: was removed or replaced while it was being recorded; record again"
            )

    def finish(self, stats: Stats, fault: str = "", is_complete: bool = True) -> None:
        """Append the accounts. `fault`: what ended the recording if it was not meant to end;
        `is_complete`: false where something of it is known to be missing: a copy of a damaged
        recording.
        """
        with contextlib.suppress(StorageError):  # a full disk may still have room for the accounts
            self._append(BlockKind.HEAD, self._head)
        self._append(BlockKind.END, Ending(stats.as_dict(), fault, is_complete).to_json())

    def close(self) -> None:
        """Hand everything to the disk, unlock and close; closing twice is fine."""
        if self._file < 0:
            return
        try:
            os.fsync(self._file)
        except OSError as fault:
            raise self._explain(fault) from fault
        finally:
            os.close(self._file)
            self._file = -1

    def _append(
        self, kind: BlockKind, payload: bytes, records: int = 0, gap: Gap = Gap.NONE
    ) -> None:
        """Append a block, whole or not at all."""
        now = monotonic_ns() + self._clock_offset_ns
        sizes = records, len(payload), zlib.crc32(payload)
        block = Block(kind, gap, now, *sizes, self._number, self._recording)
        end = self._end
        try:
            for part in (block.pack(), payload):
                rest = memoryview(part)
                while rest:  # a signal, or a disk that is nearly full, makes short writes
                    written = os.pwrite(self._file, rest, end)
                    end += written
                    rest = rest[written:]
        except OSError as fault:
            with contextlib.suppress(OSError):
                os.ftruncate(self._file, self._end)
            raise self._explain(fault) from fault
        self._end = end
        self._number += 1

    def _explain(self, fault: OSError) -> StorageError:
        safe = "; what was recorded so far is safe" if self.bytes_written else ""
        return StorageError(f"{self._path}: cannot be written: {explain_os_error(fault)}{safe}")


def _render_head(head: Record) -> bytes:
    """Return a record as the bytes of an HDF5 file."""
    with tempfile.TemporaryDirectory() as folder:
        image = Path(folder, "head.h5")
        head.save(image)
        content = image.read_bytes()
    # Filled up to whole sectors, so that a lost one never costs two copies. HDF5 reads on as far as
    # its own length says.
    sectors = -(-(len(content) + HEADER_BYTES) // SECTOR_BYTES)
    return content.ljust(sectors * SECTOR_BYTES - HEADER_BYTES, b"\0")


def _create_file(path: Path, overwrite: bool, stack: contextlib.ExitStack) -> tuple[int, Path]:
    """Create and lock a file beside `path`, which gets its name when the head is in it. The lock on
    a file that exists already is held as long, so that of two recorders one is refused.
    """
    old = _lock_existing(path)
    if old is not None:
        stack.callback(os.close, old)
        require(overwrite, f"{path}: {_EXISTS}")
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(8)}")
    # 0o666, less what the user's umask takes away.
    file = os.open(temporary, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o666)
    stack.callback(temporary.unlink, missing_ok=True)
    stack.push(lambda kind, *_: os.close(file) if kind is not None else None)
    _lock(file, path)
    return file, temporary


def _lock_existing(path: Path) -> int | None:
    """Open and lock the file at `path`; None if there is none."""
    while True:
        with contextlib.ExitStack() as opened:
            try:
                file = os.open(path, os.O_RDONLY)
            except FileNotFoundError:
                return None
            opened.callback(os.close, file)
            _lock(file, path)
            with contextlib.suppress(FileNotFoundError):
                if os.path.samestat(os.stat(path), os.fstat(file)):
                    opened.pop_all()
                    return file
        # Somebody replaced it meanwhile.


def _lock(file: int, path: Path) -> None:
    if fcntl is None:
        return
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as fault:
        if fault.errno in (errno.EWOULDBLOCK, errno.EACCES):
            raise StorageError(
                f"{path}: is being written by another recorder; stop that, or choose another name"
            ) from fault
        # A file system without locks: nothing keeps a second recorder away.


def _publish(temporary: Path, path: Path, overwrite: bool) -> None:
    """Give the file its name; without `overwrite` never in place of another."""
    try:
        if not overwrite:
            os.link(temporary, path)
    except FileExistsError:
        raise InputError(f"{path}: {_EXISTS}") from None
    except OSError:  # a file system without links
        overwrite = True
    if overwrite:
        os.replace(temporary, path)
