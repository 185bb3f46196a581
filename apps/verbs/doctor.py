"""`tofclip doctor`: what this machine has of what the program can use."""

from __future__ import annotations

import importlib.metadata as metadata
import os
import platform
import re
import shutil
from collections.abc import Callable, Iterator
from importlib import import_module
from pathlib import Path

import typer

from apps.options import JSON
from apps.progress import show_activity
from apps.report import report
from tofclip.files import describe_missing_package
from tofclip.version import __version__

NEEDED = ("numpy", "scipy", "numba", "h5py", "tifffile", "matplotlib", "PIL", "skimage", "viser")
"""Modules without which verbs stop; the others bring single formats, filters and windows."""
EXTRA = re.compile(r"extra == ['\"](\w+)")
NOT_FOR_VERBS = {"test", "lint", "docs", "all"}
EXIT_BROKEN, GIB = 1, 1 << 30


def doctor(as_json: bool = JSON) -> None:
    """Say what this installation has: packages, GPU, USB, compiled loops, graphics, disk and memory.

    Optional packages that are missing are listed with the command that installs them. The exit
    status is 1 if a package that nearly every verb needs is missing or does not load.

    Example: tofclip doctor
    """
    with show_activity("looking around"):
        faults = [*_find_faults()]
        packages = dict(_list_packages())
        figures = {
            "tofclip": __version__,
            "python": platform.python_version(),
            "system": f"{platform.system()} {platform.release()} {platform.machine()}",
            "gpu": _ask(_find_gpu),
            "usb": _ask(_find_usb),
            "compiled_loops": _ask(_find_cache),
            "graphics": _ask(_find_graphics),
            "disk_free_gib": shutil.disk_usage(Path.cwd()).free / GIB,
            "memory_gib": os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / GIB,
        }
    lists = {
        "packages": [f"{name} {found}" for name, found in packages.items() if "pip" not in found],
        "missing": [f"{name}: {found}" for name, found in packages.items() if "pip" in found],
        "faults": faults,
    }
    report({**figures, **(lists if as_json else {})}, as_json)
    for name, lines in {} if as_json else lists.items():
        print(f"{name}:", *(lines or ["none"]), sep="\n  ")
    if faults:
        raise typer.Exit(EXIT_BROKEN)


def _ask(question: Callable[[], str]) -> str:
    """Answer, or say why there is none: a broken library, of any exception, is what one looks for."""
    try:
        return question()
    except Exception as fault:
        return " ".join(str(fault).split()) or type(fault).__name__


def _find_faults() -> Iterator[str]:
    for name in NEEDED:
        try:
            import_module(name)
        except Exception as fault:
            said = describe_missing_package(fault) if isinstance(fault, ImportError) else None
            yield said or f"{name} does not load: {fault}"


def _list_packages() -> Iterator[tuple[str, str]]:
    """Yield each package that the program can use, with its version or the command that installs it."""
    from packaging.requirements import Requirement

    for one in map(Requirement, metadata.requires("tofclip") or ()):
        extra = (EXTRA.findall(str(one.marker)) or [""])[0]
        if extra in NOT_FOR_VERBS or (one.marker and not one.marker.evaluate({"extra": extra})):
            continue
        try:
            yield one.name, metadata.version(one.name)
        except metadata.PackageNotFoundError:
            wanted = f"'tofclip[{extra}]'" if extra else one.name
            yield one.name, f"pip install {wanted}"


def _find_gpu() -> str:
    from tofclip.arrays import parse_device

    return str(parse_device("auto")).replace("cpu", "none through CuPy or PyTorch")


def _find_usb() -> str:
    from devices import discover
    from devices.usb import system_backend

    system_backend()
    found = [f"{one.uri} {one.note}" for one in discover()]
    return f"libusb loads; {', '.join(found) or 'no instruments are connected'}"


def _find_cache() -> str:
    from tofclip.operators.kernels import project_onto_lines

    place = project_onto_lines.stats.cache_path or "nowhere"
    note = "writable" if os.access(place, os.W_OK) else "name a writable folder in NUMBA_CACHE_DIR"
    warm = any(Path(place).glob("*.nbi"))
    return f"{place}, {note}, {'warm' if warm else 'cold: tofclip warm-up fills it'}"


def _find_graphics() -> str:
    from apps.viewer.still import DISPLAY_VARIABLES, has_working_graphics

    drawn = "PyVista draws" if has_working_graphics() else "PyVista cannot draw, --png can"
    shown = any(map(os.environ.get, DISPLAY_VARIABLES)) or platform.system() != "Linux"
    return f"{drawn}; {'a' if shown else 'no'} display for view --desktop"
