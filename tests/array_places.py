"""Places beside NumPy that tests put arrays into.

Where there is a graphics processor, ``TOFCLIP_TEST_DEVICES=cuda pytest -k "portable or contracts"``
tries it as well.
"""

import os

import pytest

from tofclip.arrays import ComputeDevice, parse_device

DEVICE_NAMES = ("array_api_strict", "torch", *os.environ.get("TOFCLIP_TEST_DEVICES", "").split())


def find_device(name):
    """Return a library's processor, or the device of that name; skip the test where the library is
    not installed.
    """
    if name == "numpy":
        return ComputeDevice()
    if name == "array_api_strict":
        return ComputeDevice.of(
            pytest.importorskip(name, reason="only where it is installed").asarray([0.0])
        )
    if name != "torch":
        return parse_device(name)
    library = pytest.importorskip(name, reason="PyTorch is optional")
    library.set_num_threads(1)  # waking others up takes longer than what there is to do
    return parse_device("torch:cpu")
