"""Streak images in files: one, whichever program wrote it, or a stack of many in one file."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from tofclip.arrays import FloatArray
from tofclip.errors import (
    FileFormatError,
    require,
    require_path,
    require_shape,
)
from tofclip.files import atomic_path, guard, require_bounded_dataset, translate_read_errors
from tofclip.io.hamamatsu import SIGNATURE as ITEX_SIGNATURE
from tofclip.io.hamamatsu import StreakFile, open_itex, open_tiff
from tofclip.io.lift import open_lift
from tofclip.plugins import READERS, Reader, read_by_signature
from tofclip.shots import Streak
from tofclip.storage import HDF5_SIGNATURE, Record, collect_provenance, read_outline


@contextlib.contextmanager
def _open_own(path: str | Path) -> Iterator[StreakFile]:
    """Open a streak image of our own, HDF5."""
    yield partial(read_outline, path), partial(Streak.load, path)


def _make_reader(
    open_file: Callable[[str | Path], AbstractContextManager[StreakFile]], *signatures: bytes
) -> Reader:
    def read(path: Path) -> Streak:
        with open_file(path) as (_, read_opened):
            return read_opened()

    def describe(path: Path) -> Record:
        with open_file(path) as (outline, _):
            return outline()

    read.__doc__ = open_file.__doc__  # `tofclip plugins` shows it
    return Reader(signatures, read, describe)


TIFF = _make_reader(open_tiff, b"II*\0", b"MM\0*")
LIFT = _make_reader(open_lift, b"PK\x03\x04")
OWN = _make_reader(_open_own, HDF5_SIGNATURE)
ITEX = _make_reader(open_itex, ITEX_SIGNATURE)


def read_streak(path: str | Path, bin_width: float | None = None) -> Streak:
    """Read a streak image: rows are instants, columns are slit pixels.

    The format is recognised by content: a TIFF of Hamamatsu's HPD-TA with its text and time axis,
    the same program's ITEX (``.img``), any other grey TIFF (no time axis), a LIFT archive
    (``.npz``) with its camera, a streak image of our own (HDF5), or what a package offers a reader
    of (`tofclip.plugins`).

    Parameters
    ----------
    path : path-like
    bin_width : float, optional
        Duration of a row, s. Overrides the file's own time axis: rows are then evenly spaced, the
        first at 0.

    Returns
    -------
    Streak
        Raw counts as the file has them: no background or offset is taken off. `Streak.times` raises
        `MissingTimeAxisError` where neither the file nor `bin_width` gives a time axis.

    Raises
    ------
    StorageError
        The file is absent or may not be read.
    FileFormatError
        It is empty, truncated, damaged or of another format.
    InputError
        Its pixels hold NaN, are all zero, all saturated, or negative where counts cannot be.
    """
    require_path(path)
    streak: Streak = read_by_signature(
        READERS, path, lambda reader: reader.read(Path(path)), "streak image"
    )
    if bin_width is not None:
        streak = streak.with_bin_width(bin_width)
    history = collect_provenance({"bin_width_s": bin_width}, path)
    if streak.provenance:
        # A file of our own brings its history, which must not be lost under the new entry.
        history["earlier"] = dict(streak.provenance)
    return replace(streak, provenance=history)


def outline_streak_file(path: str | Path) -> Record:
    """Describe the streak image in a file without reading its pixels, as `read_outline` does."""

    def describe(reader: Reader) -> Record:
        made = reader.describe
        return made(Path(path)) if made else reader.read(Path(path)).to_record()

    outline = read_by_signature(READERS, path, describe, "streak image")
    if outline.provenance:
        return outline
    return replace(outline, provenance=collect_provenance({"bin_width_s": None}, path))


class StreakStack:
    """A sequence of streak images in an HDF5 file, `path`: dataset ``counts`` (shot, time,
    column), ``row_times`` (time) in s. Any program can write such a file. Only the shot that is
    asked for is in memory. `FileFormatError` or `StorageError` for no HDF5 file, or one without
    these datasets.
    """

    @staticmethod
    def is_one(path: str | Path) -> bool:
        """Return whether an HDF5 file holds a stack: ``counts`` with an axis more than an image."""
        import h5py

        refusals = OSError, KeyError, RuntimeError
        with (
            contextlib.suppress(*refusals),
            translate_read_errors(path),
            h5py.File(path, "r") as file,
        ):
            is_own = isinstance(file.get("counts", getlink=True), h5py.HardLink)
            counts = file["counts"] if is_own else None
            return isinstance(counts, h5py.Dataset) and counts.ndim == 3 and counts.size > 0
        return False

    def __init__(self, path: str | Path) -> None:
        import h5py

        self.path = Path(path)
        self.row_times: FloatArray | None = None
        with guard(path, "is not a stack of streak images"), h5py.File(path, "r") as file:
            for name in ("counts", "row_times"):
                if name in file and not isinstance(file.get(name, getlink=True), h5py.HardLink):
                    raise FileFormatError(path, f"'{name}' cannot be read: links are not followed")
            counts = file.get("counts")
            if not isinstance(counts, h5py.Dataset) or counts.ndim != 3 or counts.size == 0:
                raise FileFormatError(
                    path, "is not a stack of streak images: it needs 'counts' (shot, time, column)"
                )
            self._shape = tuple(int(n) for n in counts.shape)
            require_bounded_dataset(counts, path, at_once=math.prod(self._shape[1:]))
            if "row_times" in file:
                require_bounded_dataset(file["row_times"], path)
                self.row_times = np.asarray(file["row_times"], dtype=np.float64)

    def __len__(self) -> int:
        return self._shape[0]

    def read_shot(self, number: int) -> Streak:
        """Read one shot, counted from 0; `InputError` where there is none of that number."""
        import h5py

        require(
            0 <= number < len(self), f"{self.path} holds shots 0..{len(self) - 1}, not {number}"
        )
        with guard(self.path, f"shot {number} is damaged"), h5py.File(self.path, "r") as file:
            counts = np.asarray(file["counts"][number], dtype=np.float32)
        return Streak(counts, self.row_times, source=f"{self.path} shot {number}")

    def __iter__(self) -> Iterator[Streak]:
        for number in range(len(self)):
            yield self.read_shot(number)


def save_stack(shots: Iterable[Streak], path: str | Path) -> int:
    """Write shots to one file, `path`, whole or not at all; return how many. All have the first one's shape
    and time axis; `ShapeError` where one has not, `InputError` where there is no shot. They are taken one at a time.
    """
    import h5py

    number = 0
    with atomic_path(path) as temporary, h5py.File(temporary, "w") as file:
        for shot in shots:
            if number == 0:
                shape = shot.counts.shape
                options = {"maxshape": (None, *shape), "chunks": (1, *shape), "shuffle": True}
                options["compression"] = "gzip"
                stored = file.create_dataset("counts", (0, *shape), np.float32, **options)
                if shot.row_times is not None:
                    file.create_dataset("row_times", data=shot.row_times).attrs["units"] = "s"
            require_shape(f"shot {number} of a stack", shape, shot.counts.shape)
            stored.resize(number + 1, axis=0)
            stored[number] = shot.counts
            number += 1
        require(number != 0, f"{path}: there is no shot to write")
    return number
