"""The exception tree is part of the public contract."""

from __future__ import annotations

import inspect
from pathlib import Path

import pytest

from tofclip import errors

TREE = {
    "TofclipError": (Exception,),
    "InputError": (errors.TofclipError, ValueError),
    "ShapeError": (errors.InputError,),
    "CalibrationError": (errors.InputError,),
    "MissingTimeAxisError": (errors.InputError,),
    "FileFormatError": (errors.TofclipError, ValueError),
    "StorageError": (errors.TofclipError, OSError),
    "MissingDependencyError": (errors.TofclipError, ImportError),
    "DeviceError": (errors.TofclipError, OSError),
    "UsbBackendError": (errors.DeviceError,),
    "DeviceNotFoundError": (errors.DeviceError,),
    "DevicePermissionError": (errors.DeviceError,),
    "DeviceBusyError": (errors.DeviceError,),
    "DeviceTimeoutError": (errors.DeviceError, TimeoutError),
    "DeviceStalledError": (errors.DeviceError,),
    "DeviceDisconnectedError": (errors.DeviceError,),
    "TransferOverflowError": (errors.DeviceError,),
    "BufferOverflowError": (errors.DeviceError,),
    "ProtocolError": (errors.DeviceError,),
}


def test_the_tree() -> None:
    defined = {
        name
        for name, item in vars(errors).items()
        if inspect.isclass(item) and issubclass(item, Exception)
    }
    assert defined == set(TREE)
    assert {name: getattr(errors, name).__bases__ for name in TREE} == TREE


@pytest.mark.parametrize("name", TREE)
def test_the_docstring_draws_every_class(name: str) -> None:
    assert name in (errors.__doc__ or "")


def test_messages_say_what_and_where() -> None:
    assert (
        str(errors.ShapeError("frames", (2, 3), (3, 2)))
        == "frames must have shape (2, 3), got (3, 2)"
    )
    fault = errors.FileFormatError("shot.tif", "is empty")
    assert str(fault) == "shot.tif: is empty"
    assert fault.path == Path("shot.tif")
