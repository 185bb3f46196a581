"""Places beside NumPy that tests put arrays into.

Where there is a graphics processor, ``TOFCLIP_TEST_DEVICES=cuda pytest -k "portable or contracts"``
tries it as well.
"""

import os

import numpy as np
import pytest

from tofclip.arrays import ComputeDevice, parse_device

DEVICE_NAMES = ("array_api_strict", "torch", *os.environ.get("TOFCLIP_TEST_DEVICES", "").split())


FETCHED = []
"""Sizes of what was fetched from a device of array-api-strict, which mixes with no other and gives NumPy
nothing, as a graphics processor does: what stays behind on the processor, or is fetched in passing,
ends in an error.
"""


def fetch(array):
    FETCHED.append(array.size)
    return np.asarray(array.to_device(array.__array_namespace__().Device("CPU_DEVICE")))


def find_device(name):
    """Return a library's processor, or the device of that name; skip the test where the library is
    not installed.
    """
    if name == "numpy":
        return ComputeDevice()
    if name == "array_api_strict":
        strict = pytest.importorskip(name, reason="only where it is installed")
        # Fetched as CuPy's arrays are.
        type(strict.asarray(0)).get = fetch
        return ComputeDevice(name, strict.Device("device1"))
    if name != "torch":
        return parse_device(name)
    library = pytest.importorskip(name, reason="PyTorch is optional")
    library.set_num_threads(1)  # waking others up takes longer than what there is to do
    return parse_device("torch:cpu")
