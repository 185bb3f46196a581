"""Every exception that this software raises on purpose.

::

    TofclipError
    +-- InputError (ValueError): ShapeError, CalibrationError, MissingTimeAxisError
    +-- FileFormatError (ValueError)
    +-- StorageError (OSError)
    +-- MissingDependencyError (ImportError)
    +-- DeviceError (OSError): UsbBackendError, DeviceNotFoundError, DevicePermissionError,
          DeviceBusyError, DeviceTimeoutError (TimeoutError), DeviceStalledError,
          DeviceDisconnectedError, TransferOverflowError, BufferOverflowError, ProtocolError

A message is one line that says what was wrong and what to do about it. An argument that would help is
named as in Python, in backquotes (`bin_width`); the command line puts its option in that place
(``--bin-width-ps``), prints the line and exits with status 2.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager
from math import inf
from os import PathLike
from pathlib import Path


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
    """A file is damaged, incomplete or of another format than expected. `path`: the offending file;
    `problem`: what was found and what was expected, as one clause.
    """

    def __init__(self, path: str | Path, problem: str) -> None:
        # What was found in a file may hold line breaks; a message is one line.
        super().__init__(f"{path}: {' '.join(problem.split())}")
        self.path = Path(path)


class StorageError(TofclipError, OSError):
    """A file could not be read or written: the disk is full, there is no permission."""


class MissingDependencyError(TofclipError, ImportError):
    """An optional library is absent or does not load on this machine."""


class DeviceError(TofclipError, OSError):
    """An instrument, or the way to it, does not do what it should."""


class UsbBackendError(DeviceError):
    """The library that talks to the USB, libusb, is absent or does not load."""


class DeviceNotFoundError(DeviceError):
    """No instrument of that kind and serial number is connected."""


class DevicePermissionError(DeviceError):
    """The operating system does not let this user talk to the instrument."""


class DeviceBusyError(DeviceError):
    """Another program holds the instrument."""


class DeviceTimeoutError(DeviceError, TimeoutError):
    """The instrument sent nothing in the time allowed."""


class DeviceStalledError(DeviceError):
    """An endpoint stalled, and stalled again after its halt was cleared."""


class DeviceDisconnectedError(DeviceError):
    """The instrument was unplugged, or its connection broke, and it did not come back in time."""


class TransferOverflowError(DeviceError):
    """The instrument sent more than was asked for; the whole transfer is lost."""


class BufferOverflowError(DeviceError):
    """Records came faster than they were read, and the buffer's policy is to fail."""


class ProtocolError(DeviceError):
    """The instrument said something that its protocol does not allow."""


@contextmanager
def explain_import(need: str) -> Iterator[None]:
    """Say what is needed, and how one gets it, where a library does not load within."""
    try:
        yield
    except (ImportError, OSError) as fault:
        raise MissingDependencyError(f"{need} ({' '.join(str(fault).split())})") from fault


def require(holds: object, problem: str) -> None:
    """Refuse what the caller passed, with a `problem`, unless a condition holds."""
    if not holds:
        raise InputError(problem)


def require_consistent(conditions: Iterable[tuple[object, str]]) -> None:
    """Refuse a calibration of which a condition does not hold, with what is said of that one."""
    for holds, problem in conditions:
        if not holds:
            raise CalibrationError(problem)


def require_known(what: str, name: str, known: Collection[str]) -> None:
    """Refuse a name that is none of those known."""
    require(name in known, f"unknown {what} '{name}'; choose one of {', '.join(known)}")


def require_shape(what: str, expected: tuple[object, ...], got: tuple[int, ...]) -> None:
    """Refuse an array of another shape than the one that is needed."""
    if got != expected:
        raise ShapeError(what, tuple(expected), tuple(got))


def require_axes(what: str, axes: str, shape: tuple[int, ...]) -> None:
    """Refuse an array that has not these axes, such as ``"rows, columns"``."""
    if len(shape) != axes.count(",") + 1:
        raise ShapeError(what, f"({axes})", tuple(shape))


def require_type(value: object, wanted: type | tuple[type, ...], use: str) -> None:
    """Refuse an argument of another type than the one that is needed. `use`: what needs it and how
    one comes by it, such as ``"recover takes a Streak, see read_streak"``.
    """
    if not isinstance(value, wanted):
        raise InputError(f"{use}, not a {type(value).__name__}")


def require_positive(name: str, value: float, of: str = "number") -> None:
    """Refuse a number that is not above 0, or not finite; `of`: what it is, with its unit."""
    if not 0 < value < inf:
        raise InputError(f"{name} must be a positive {of}, got {value}")


def require_path(path: object) -> None:
    """Refuse what is not the name of a file: Python would take a number for a file that is open."""
    require_type(path, (str, PathLike), "a file is given by its name")
