"""Films as MP4, through OpenCV."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tofclip.errors import MissingDependencyError, StorageError
from tofclip.files import atomic_path

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


class FilmWriter:
    """A film that is being written.

    Parameters
    ----------
    path : Path
    rate : float
        Pictures per second.
    """

    def __init__(self, path: Path, rate: float) -> None:
        self._path, self._rate, self._cv2 = path, rate, import_opencv()
        self._writer: Any = None

    def add(self, pixels: NDArray[np.uint8]) -> None:
        """Append a picture (rows, columns, 3), red first; all are of one size."""
        if self._writer is None:
            code = self._cv2.VideoWriter_fourcc(*CODEC)
            self._writer = self._cv2.VideoWriter(
                str(self._path), code, self._rate, (pixels.shape[1], pixels.shape[0])
            )
            if not self._writer.isOpened():
                raise StorageError(
                    f"{self._path}: this machine's OpenCV writes no {CODEC} films; write pictures"
                )
        self._writer.write(pixels[..., ::-1])

    def close(self) -> None:
        """Write what is left."""
        if self._writer is not None:
            self._writer.release()


@contextmanager
def open_film(out: Path, rate: float) -> Iterator[FilmWriter]:
    """Yield a film to add pictures to; the file appears whole or not at all.

    Parameters
    ----------
    out : Path
    rate : float
        Pictures per second.

    Yields
    ------
    FilmWriter
    """
    with atomic_path(out) as temporary:
        film = FilmWriter(temporary, rate)
        try:
            yield film
        finally:
            film.close()
