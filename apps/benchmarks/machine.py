"""What figures were measured on, without the name of any machine or person."""

from __future__ import annotations

import importlib
import importlib.metadata
import os
import platform
from pathlib import Path
from typing import Any

from tofclip import __version__
from tofclip.threads import thread_count

LIBRARIES = ("numpy", "scipy", "numba", "pyfftw", "h5py", "scikit-image")


def describe_machine() -> dict[str, Any]:
    """Return processor, cores, memory, devices and versions."""
    return {
        "processor": read_processor(),
        "cores": thread_count(),
        "memory_gib": read_memory_gib(),
        "system": f"{platform.system()} {platform.machine()}",
        "devices": find_devices(),
        "load": read_load(),
        "python": platform.python_version(),
        "tofclip": __version__,
        "libraries": {name: importlib.metadata.version(name) for name in LIBRARIES},
    }


def read_processor() -> str:
    """Return the model of the processor, as the system calls it."""
    known = Path("/proc/cpuinfo")
    if known.is_file():
        for line in known.read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def read_memory_gib() -> float | None:
    """Return the memory of the machine; None where the system does not report it."""
    try:
        return round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / (1 << 30), 1)
    except (AttributeError, ValueError, OSError):
        return None


def read_load() -> float | None:
    """Return how many other processes wanted a core, on average over the last minute; None where it
    is not reported.
    """
    try:
        return round(os.getloadavg()[0], 1)
    except (AttributeError, OSError):
        return None


def find_devices() -> list[str]:
    """Return what arrays can be computed on: the processor, and what CuPy finds beside it."""
    try:
        cupy: Any = importlib.import_module("cupy")
        runtime = cupy.cuda.runtime
        numbers = range(runtime.getDeviceCount())
        return [
            "cpu",
            *(f"cuda:{n} {runtime.getDeviceProperties(n)['name'].decode()}" for n in numbers),
        ]
    except Exception:  # no CuPy, no driver, no device: all the same here
        return ["cpu"]
