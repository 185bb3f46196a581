"""Every exception that this software raises on purpose.

::

    TofclipError
    +-- InputError              (ValueError)   the caller passed something unusable
    |   +-- ShapeError                         an array has the wrong shape
    |   +-- CalibrationError                   a camera disagrees with its data or with itself
    |   +-- MissingTimeAxisError               a streak image does not say how long a row lasts
    +-- FileFormatError         (ValueError)   a file is damaged, incomplete or of another format
    +-- StorageError            (OSError)      a file could not be read or written: disk full, no permission
    +-- MissingDependencyError  (ImportError)  an optional library is not usable on this machine

A message is one line that says what was wrong and what to do about it. The command line prints it and exits with
status 2.
"""

from __future__ import annotations

from pathlib import Path

__all__ = [
    "CalibrationError",
    "FileFormatError",
    "InputError",
    "MissingDependencyError",
    "MissingTimeAxisError",
    "ShapeError",
    "StorageError",
    "TofclipError",
]


class TofclipError(Exception):
    """Root of the exception tree."""


class InputError(TofclipError, ValueError):
    """The caller passed a value that cannot be used."""


class ShapeError(InputError):
    """An array does not have the shape that was asked for."""

    def __init__(self, what: str, expected: object, got: object) -> None:
        super().__init__(f"{what} must have shape {expected}, got {got}")


class CalibrationError(InputError):
    """A camera's numbers disagree with each other or with the data they should describe."""


class MissingTimeAxisError(InputError):
    """A streak image carries no time axis and none was given."""


class FileFormatError(TofclipError, ValueError):
    """A file is damaged, incomplete or of another format than expected.

    Parameters
    ----------
    path : path-like
        The offending file.
    problem : str
        What was found and what was expected, as one clause.
    """

    def __init__(self, path: str | Path, problem: str) -> None:
        super().__init__(f"{path}: {problem}")
        self.path = Path(path)


class StorageError(TofclipError, OSError):
    """A file could not be read or written."""


class MissingDependencyError(TofclipError, ImportError):
    """An optional library is absent or does not load on this machine."""
