"""Many streak images in one HDF5 file, written and read one at a time."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tofclip.camera import Camera
from tofclip.errors import FileFormatError, InputError, ShapeError
from tofclip.shots.streak import Streak
from tofclip.storage import atomic_path, translate_read_errors


class StreakStack:
    """A sequence of streak images in an HDF5 file: dataset ``counts`` (shot, time, column),
    ``row_times`` (time) in s.

    Any program can write such a file. Only the shot that is asked for is in memory.

    Parameters
    ----------
    path : path-like

    Raises
    ------
    FileFormatError, StorageError
        No HDF5 file, or one without these datasets.
    """

    def __init__(self, path: str | Path) -> None:
        import h5py

        self.path = Path(path)
        with translate_read_errors(path):
            open(path, "rb").close()
        try:
            with h5py.File(path, "r") as file:
                self._shape = tuple(int(n) for n in file["counts"].shape)
                self.row_times: NDArray[np.float64] | None = (
                    np.asarray(file["row_times"], dtype=np.float64) if "row_times" in file else None
                )
        except (OSError, KeyError, RuntimeError, AttributeError) as fault:
            raise FileFormatError(
                path, "is no stack of streak images: it needs a dataset 'counts'"
            ) from fault
        if len(self._shape) != 3 or 0 in self._shape:
            raise FileFormatError(
                path, f"'counts' must be (shot, time, column), found {self._shape}"
            )

    def __len__(self) -> int:
        return self._shape[0]

    def read_shot(self, number: int, camera: Camera | None = None) -> Streak:
        """Read one shot, from 0.

        Parameters
        ----------
        number : int
        camera : Camera, optional

        Returns
        -------
        Streak

        Raises
        ------
        InputError
            There is no shot of that number.
        FileFormatError
            The shot is damaged.
        """
        import h5py

        if not 0 <= number < len(self):
            raise InputError(f"{self.path} holds shots 0..{len(self) - 1}, not {number}")
        try:
            with h5py.File(self.path, "r") as file:
                counts = np.asarray(file["counts"][number], dtype=np.float32)
        except (OSError, RuntimeError) as fault:
            raise FileFormatError(self.path, f"shot {number} is damaged") from fault
        return Streak(counts, self.row_times, camera=camera, source=f"{self.path} shot {number}")

    def __iter__(self) -> Iterator[Streak]:
        for number in range(len(self)):
            yield self.read_shot(number)


def save_stack(shots: Iterable[Streak], path: str | Path) -> int:
    """Write shots to one file, whole or not at all; return how many. All have the first one's shape
    and time axis.

    Parameters
    ----------
    shots : iterable of Streak
        Taken one at a time.
    path : str or Path

    Returns
    -------
    int

    Raises
    ------
    ShapeError
        A shot has another shape than the first.
    InputError
        There is no shot.
    """
    import h5py

    number = 0
    with atomic_path(path) as temporary, h5py.File(temporary, "w") as file:
        for shot in shots:
            if number == 0:
                shape = shot.counts.shape
                options = {
                    "maxshape": (None, *shape),
                    "chunks": (1, *shape),
                    "compression": "gzip",
                    "shuffle": True,
                }
                stored = file.create_dataset("counts", (0, *shape), np.float32, **options)
                if shot.row_times is not None:
                    file.create_dataset("row_times", data=shot.row_times).attrs["units"] = "s"
            if shot.counts.shape != shape:
                raise ShapeError(f"shot {number} of a stack", shape, shot.counts.shape)
            stored.resize(number + 1, axis=0)
            stored[number] = shot.counts
            number += 1
        if number == 0:
            raise InputError(f"{path}: there is no shot to write")
    return number
