"""Films as MP4, through OpenCV."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from struct import Struct
from typing import TYPE_CHECKING, Any

from tofclip.errors import MissingDependencyError, StorageError
from tofclip.files import DISK_IS_FULL, atomic_path

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

CODEC = "vp09"  # free of licences, and every browser plays it


def import_opencv() -> Any:
    """Import OpenCV, or say where it is to be had."""
    try:
        import cv2
    except ImportError as fault:
        raise MissingDependencyError("films need OpenCV: pip install 'tofclip[film]'") from fault
    return cv2


BOX_HEADER, LONG_LENGTH = Struct(">I4s"), Struct(">Q")
"""Length and kind of a box of an MP4 file, ISO/IEC 14496-12."""


class FilmWriter:
    """A film that is being written. `rate`: pictures per second."""

    def __init__(self, path: Path, rate: float) -> None:
        self.path, self._rate, self._cv2 = path, rate, import_opencv()
        self._writer: Any = None

    def add(self, pixels: NDArray[np.uint8]) -> None:
        """Append a picture (rows, columns, 3), red first; all are of one size."""
        if self._writer is None:
            code = self._cv2.VideoWriter_fourcc(*CODEC)
            self._writer = self._cv2.VideoWriter(
                str(self.path), code, self._rate, (pixels.shape[1], pixels.shape[0])
            )
            if not self._writer.isOpened():
                raise StorageError(
                    f"no film can be begun: the disk is full, or this machine's OpenCV has no {CODEC}: write pictures"
                )
        self._writer.write(pixels[..., ::-1])

    def close(self) -> None:
        """Write what is left."""
        if self._writer is not None:
            self._writer.release()


@contextmanager
def open_film(out: Path, rate: float) -> Iterator[FilmWriter]:
    """Yield a film to add pictures to; the file appears whole or not at all. `rate`: pictures per
    second.
    """
    with atomic_path(out) as temporary:
        film = FilmWriter(temporary, rate)
        try:
            yield film
        finally:
            film.close()
        if not is_whole_film(temporary):  # OpenCV says nothing of what it could not write
            raise StorageError(f"{out}: cannot be written: {DISK_IS_FULL}")


def is_whole_film(path: Path) -> bool:
    """Whether an MP4 file has all that it says: its index, which is written last, and every box."""
    size, place, kinds = path.stat().st_size, 0, set()
    with open(path, "rb") as file:
        while place + BOX_HEADER.size <= size:
            file.seek(place)
            length, kind = BOX_HEADER.unpack(file.read(BOX_HEADER.size))
            if length == 1:  # longer than 32 bits tell: the length follows
                (length,) = LONG_LENGTH.unpack(file.read(LONG_LENGTH.size).ljust(8, b"\0"))
            if length < BOX_HEADER.size:
                return False
            kinds.add(kind)
            place += length
    return place == size and b"moov" in kinds
