"""Packages of others by the names that they are imported and installed by, for messages about
missing ones.
"""

from __future__ import annotations

import ctypes
import importlib
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

from tofclip.errors import MissingDependencyError

OWN_PACKAGES = ("tofclip", "nlos", "devices", "apps")

DISTRIBUTIONS: Mapping[str, str] = MappingProxyType(
    {
        "array_api_compat": "array-api-compat",
        "cupy": "cupy-cuda12x",
        "cv2": "opencv-python-headless",
        "lazy_loader": "lazy-loader",
        "libusb_package": "libusb-package",
        "PIL": "pillow",
        "pywt": "pywavelets",
        "skimage": "scikit-image",
        "sklearn": "scikit-learn",
        "tomli_w": "tomli-w",
        "usb": "pyusb",
    }
)
"""What to install for a module whose distribution has another name."""


def describe_missing_package(fault: ImportError) -> str | None:
    """Return which package is missing and what to install, None where a module of ours is missing.

    `fault`: as it was raised by an import.

    Examples
    --------
    >>> describe_missing_package(ModuleNotFoundError("No module named 'usb'", name="usb.core"))
    "the package 'pyusb' is missing: pip install pyusb"
    """
    module = (fault.name or "").partition(".")[0]
    if not module or module in OWN_PACKAGES:
        return None
    distribution = DISTRIBUTIONS.get(module, module)
    if isinstance(fault, ModuleNotFoundError):
        return f"the package '{distribution}' is missing: pip install {distribution}"
    return f"the package '{distribution}' does not load on this machine: {fault}"


def import_file_reader(name: str, install: str) -> Any:
    """Import a package that reads a kind of file.

    `name`: of the module; `install`: what pip is asked for.
    """
    try:
        return importlib.import_module(name)
    except (ImportError, OSError) as fault:
        raise MissingDependencyError(
            f"this file needs {name}: pip install '{install}' ({fault})"
        ) from fault


def import_open3d() -> Any:
    """Import Open3D with the libusb of libusb-package: Open3D is linked against one, which bare
    machines lack and its wheel does not bring.
    """
    try:
        libusb = importlib.import_module("libusb_package").get_library_path()
        # Symbols that the process has already are not looked for in the system's folders.
        ctypes.CDLL(str(libusb), mode=ctypes.RTLD_GLOBAL)
    except (ImportError, OSError):
        pass  # the system may have its own
    try:
        return importlib.import_module("open3d")
    except (ImportError, OSError) as fault:
        raise MissingDependencyError(
            f"Open3D does not load on this machine ({fault}): pip install open3d"
        ) from fault
