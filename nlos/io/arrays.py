"""Named arrays of HDF5 and MATLAB files, taken out with the same checks as those of NumPy archives."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from tofclip.arrays import AnyArray, FloatArray
from tofclip.errors import FileFormatError
from tofclip.files import require_bounded_dataset, translate_read_errors
from tofclip.io.archive import Archive, ArchiveEntry, Entries, list_mat_entries
from tofclip.storage import HDF5_SIGNATURE

# Of a v7.3 file, before the HDF5 data begin.
MATLAB_HEADER_BYTES = 512


class NamedArrays(Archive):
    """Named arrays of a file in the orders and units that captures come in."""

    def fault(self, problem: str) -> FileFormatError:
        """What is wrong with the file."""
        return FileFormatError(self.path, problem)

    def read_numbers(self, name: str) -> AnyArray:
        """Return entry `name`, numbers of any shape but an empty one."""
        return self.array(name, *[None] * self._count_axes(name))

    def read_time_last(self, name: str) -> AnyArray:
        """Return signals (rows, columns, t); refuse rows and columns, two equal axes, after time."""
        signal = self.array(name, None, None, None)
        if signal.shape[1] == signal.shape[2] < signal.shape[0]:
            raise self.fault(
                f"{name} of shape {signal.shape} begins with time; put time last: "
                f"permute({name}, [2 3 1])"
            )
        return signal

    def read_coordinates(self, name: str) -> FloatArray:
        """Return entry `name`, an array (..., 3) of coordinates; NaN is allowed."""
        dimensions = max(1, self._count_axes(name))
        return self.array(name, *[None] * (dimensions - 1), 3).astype(np.float64)

    def number(self, name: str, absent: float | None = None) -> float:
        """Return a single finite number, whatever its axes of length 1; `absent` without it."""
        if absent is not None and name not in self:
            return absent
        return float(self.finite_array(name, *[1] * self._count_axes(name)).squeeze())

    def flag(self, name: str) -> bool:
        """Whether entry `name` is there and true."""
        return name in self and bool(np.all(self.read(name)))

    def _count_axes(self, name: str) -> int:
        return len(self.describe(name).shape)


def read_hdf5(path: str | Path) -> NamedArrays:
    """List all arrays of an HDF5 file; groups become names with dots."""
    return NamedArrays(path, partial(_list_hdf5_entries, matlab=False))


def read_matlab(path: str | Path) -> NamedArrays:
    """List the numeric variables of a .mat file, version 5 to 7.3, structs by dotted names, in
    MATLAB's order of axes, without those of length 1.
    """
    with translate_read_errors(path), open(path, "rb") as file:
        start = file.read(MATLAB_HEADER_BYTES + len(HDF5_SIGNATURE))
    if start[MATLAB_HEADER_BYTES:] == HDF5_SIGNATURE:
        return NamedArrays(path, partial(_list_hdf5_entries, matlab=True))
    return NamedArrays(path, _list_mat_entries)


def _list_hdf5_entries(path: Path, matlab: bool) -> Entries:
    import h5py

    entries: dict[str, ArchiveEntry] = {}

    def note(name: str, item: Any) -> None:
        if not isinstance(item, h5py.Dataset) or name.startswith("#refs#"):
            return
        if item.shape is None or item.dtype.kind not in "uifbSO":
            return
        # Texts of variable length, references and MATLAB's cells are no numbers: never read.
        if not item.dtype.hasobject:
            require_bounded_dataset(item, path)
        shape = tuple(n for n in item.shape[::-1] if n != 1) if matlab else item.shape
        entry = ArchiveEntry(shape, item.dtype, partial(_load_hdf5, path, name, matlab))
        entries[name.replace("/", ".")] = entry

    with h5py.File(path, "r") as file:
        file.visititems(note)  # which follows no links
    return entries


def _load_hdf5(path: Path, name: str, matlab: bool) -> AnyArray:
    import h5py

    with h5py.File(path, "r") as file:
        values = np.asarray(file[name][()])
    return np.squeeze(values.T) if matlab else values


def _squeeze(entry: ArchiveEntry) -> ArchiveEntry:
    shape = tuple(n for n in entry.shape if n != 1)
    return ArchiveEntry(shape, entry.dtype, lambda: np.squeeze(entry.load()))


def _list_mat_entries(path: Path) -> Entries:
    return {name: _squeeze(entry) for name, entry in list_mat_entries(path).items()}
