"""Libraries other than NumPy that the tests of portable imaging put captures into.

Where there is a graphics processor, ``TOFCLIP_TEST_DEVICES=cuda pytest tests/nlos -k portable``
tests it as well.
"""

from __future__ import annotations

import os
from typing import Any

import numpy as np
import pytest

from tofclip.arrays import ComputeDevice, parse_device, to_numpy

LIBRARIES = ("torch", "array_api_strict", *os.environ.get("TOFCLIP_TEST_DEVICES", "").split())


def find_device(library: str) -> ComputeDevice:
    """Return a library's processor, or the device of that name; skip the test where the library is
    not installed.
    """
    if library == "array_api_strict":
        return ComputeDevice.of(pytest.importorskip(library).asarray([0.0]))
    if library != "torch":
        return parse_device(library)
    pytest.importorskip(library).set_num_threads(
        1
    )  # waking others up takes longer than what there is to do
    return parse_device("torch:cpu")


def relative_error(found: Any, expected: np.ndarray) -> float:
    return float(np.linalg.norm(to_numpy(found) - expected) / np.linalg.norm(expected))
