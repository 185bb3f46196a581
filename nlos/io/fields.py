"""Named arrays of HDF5 and MATLAB files, taken out with the same checks as those of NumPy archives."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofclip.errors import FileFormatError
from tofclip.io.archive import Archive
from tofclip.storage import HDF5_SIGNATURE, format_error_line, translate_read_errors

MATLAB_HEADER_BYTES = 512
"""Of a v7.3 file, before the HDF5 data begin."""

MAX_FIELD_BYTES = 8 << 30
"""Larger arrays are refused before they are read."""


class NamedArrays(Archive):
    """Named arrays with the file that they come from; see `Archive` for how they are taken out.

    Parameters
    ----------
    path : path-like
    entries : mapping of str to array, optional
        Defaults to what the file, then a NumPy archive, holds.
    """

    def __init__(self, path: str | Path, entries: Mapping[str, Any] | None = None) -> None:
        self._given = entries
        super().__init__(path)

    def _load(self) -> Mapping[str, Any]:
        return super()._load() if self._given is None else self._given

    @property
    def names(self) -> set[str]:
        """Names of all entries."""
        return set(self._entries)

    def read_numbers(self, name: str) -> NDArray[Any]:
        """Return entry `name`, numbers of any shape but an empty one."""
        return self.array(name, *[None] * np.ndim(self._entries.get(name, 0)))

    def read_coordinates(self, name: str) -> NDArray[np.float64]:
        """Return entry `name`, an array (..., 3) of coordinates; NaN is allowed."""
        dimensions = max(1, np.ndim(self._entries.get(name, 0)))
        return self.array(name, *[None] * (dimensions - 1), 3).astype(np.float64)

    def number(self, name: str) -> float:
        """Return entry `name`, a single finite number with or without axes of length 1."""
        return float(self.finite_array(name, *[1] * np.ndim(self._entries.get(name, 0))).squeeze())

    def flag(self, name: str) -> bool:
        """Whether entry `name` is there and true."""
        return name in self and bool(np.all(self._entries[name]))


def read_hdf5(path: str | Path) -> NamedArrays:
    """Read all arrays of an HDF5 file; groups become names with dots.

    Raises
    ------
    StorageError, FileFormatError
        The file cannot be read, is damaged, or an array is larger than 8 GiB.
    """
    return NamedArrays(path, _read_entries(path, _read_hdf5_entries, False))


def read_matlab(path: str | Path) -> NamedArrays:
    """Read all numeric variables of a .mat file of any version, without axes of length 1; structs
    become dotted names.

    Axes are in MATLAB's order, whatever the version.

    Raises
    ------
    StorageError, FileFormatError
        The file cannot be read, is damaged, or an array is larger than 8 GiB.
    """
    if _is_hdf5(path):
        return NamedArrays(path, _read_entries(path, _read_hdf5_entries, True))
    return NamedArrays(path, _read_entries(path, _read_scipy_entries))


def is_matlab(path: str | Path) -> bool:
    """Whether a file begins like one of MATLAB's, version 5 to 7.3."""
    return _read_start(path, 6) == b"MATLAB"


def _read_entries(path: str | Path, load: Any, *arguments: Any) -> Mapping[str, Any]:
    with translate_read_errors(path):
        try:
            found: Mapping[str, Any] = load(path, *arguments)
        except (FileNotFoundError, IsADirectoryError, PermissionError, FileFormatError):
            raise
        except (
            Exception
        ) as fault:  # whatever the decoder stumbles over, it is the file that is damaged
            raise FileFormatError(
                path, f"is truncated or damaged ({format_error_line(fault)})"
            ) from fault
    return found


def _read_hdf5_entries(path: str | Path, matlab: bool) -> dict[str, Any]:
    import h5py

    entries: dict[str, Any] = {}

    def take(name: str, item: Any) -> None:
        if not isinstance(item, h5py.Dataset) or name.startswith("#refs#"):
            return
        if item.shape is None or item.dtype.kind not in "uifbSO":
            return
        if item.size * item.dtype.itemsize > MAX_FIELD_BYTES:
            raise FileFormatError(
                path, f"field '{name}' holds {item.nbytes / 2**30:.1f} GiB, more than can be read"
            )
        values = item[()]
        entries[name.replace("/", ".")] = np.squeeze(values.T) if matlab else values

    with h5py.File(path, "r") as file:
        file.visititems(take)
    return entries


def _read_scipy_entries(path: str | Path) -> dict[str, Any]:
    from scipy.io import loadmat

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        loaded = loadmat(path, simplify_cells=True)
    entries: dict[str, Any] = {}
    for name, value in loaded.items():
        if isinstance(value, dict):
            entries.update({f"{name}.{inner}": np.asarray(part) for inner, part in value.items()})
        elif not name.startswith("__"):
            entries[name] = np.asarray(value)
    return entries


def _is_hdf5(path: str | Path) -> bool:
    return (
        _read_start(path, MATLAB_HEADER_BYTES + len(HDF5_SIGNATURE))[MATLAB_HEADER_BYTES:]
        == HDF5_SIGNATURE
    )


def _read_start(path: str | Path, count: int) -> bytes:
    with translate_read_errors(path), open(path, "rb") as file:
        return file.read(count)
