"""NumPy archives (``.npz``) of unknown origin, with every entry checked as it is taken out."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofclip.errors import FileFormatError
from tofclip.storage import format_error_line, translate_read_errors


class Archive:
    """The arrays of an ``.npz`` file; pickled objects are never loaded.

    Parameters
    ----------
    path : path-like

    Raises
    ------
    StorageError, FileFormatError
        The file cannot be read, is truncated, or is not a NumPy archive.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self._entries = self._load()

    def _load(self) -> Mapping[str, Any]:
        # A missing file is reported as such before the decoder turns it into a damaged one.
        with translate_read_errors(self.path):
            self.path.stat()
        try:
            with np.load(self.path, allow_pickle=False) as archive:
                return dict(archive)
        except (
            Exception
        ) as fault:  # whatever the decoder stumbles over, it is the file that is damaged
            raise FileFormatError(
                self.path, f"is a truncated or damaged NumPy archive ({format_error_line(fault)})"
            ) from fault

    def __contains__(self, name: str) -> bool:
        return name in self._entries

    def array(self, name: str, *shape: int | None) -> NDArray[Any]:
        """Return entry `name`, a numeric array of `shape`; None stands for any length but zero."""
        if name not in self:
            raise FileFormatError(self.path, f"has no field '{name}', which is needed here")
        found = np.asarray(self._entries[name])
        fits = len(shape) == found.ndim and all(
            n > 0 and wanted in (None, n) for wanted, n in zip(shape, found.shape, strict=True)
        )
        if not fits or found.dtype.kind not in "uif":
            wanted = "(" + ", ".join("any" if n is None else str(n) for n in shape) + ")"
            raise FileFormatError(
                self.path,
                f"field '{name}' must be numbers of shape {wanted}, found {found.dtype} of {found.shape}",
            )
        return found

    def finite_array(self, name: str, *shape: int | None) -> NDArray[np.float64]:
        """Return entry `name` in float64, refusing NaN and infinity; arguments as in `array`."""
        found = self.array(name, *shape).astype(np.float64)
        if not np.all(np.isfinite(found)):
            raise FileFormatError(self.path, f"field '{name}' must not hold NaN or infinity")
        return found

    def text(self, name: str) -> str:
        """Return entry `name`, a single string."""
        found = np.asarray(self._entries.get(name, 0))
        if found.ndim != 0 or found.dtype.kind != "U":
            raise FileFormatError(
                self.path, f"field '{name}' must be a string, found {found.dtype} of {found.shape}"
            )
        return str(found)

    def scalars(self) -> dict[str, str]:
        """Return every single number or string as text, by name."""
        return {
            name: str(value)
            for name, value in self._entries.items()
            if isinstance(value, np.ndarray) and value.ndim == 0
        }
