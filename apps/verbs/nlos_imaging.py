"""What the verbs around corners share: captures on disk, and captures imaged as settings ask, under
a bar and with a watch on time and memory.
"""

from __future__ import annotations

import contextlib
import ctypes
import sys
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from apps.options import arg, find_key
from apps.progress import show_activity, show_progress
from apps.report import build_provenance
from nlos.settings import METHODS, METHODS_BY_SPEED, Settings, list_taken
from tofclip.errors import InputError

if TYPE_CHECKING:
    from nlos import Capture, Grid, Method, Plan, Volume
    from nlos.imaging import PreparedImaging
    from tofclip.arrays import ComputeDevice

PORTABLE_METHODS = METHODS_BY_SPEED
"""They compute wherever the signal is; the others have compiled loops only."""

CAPTURE = arg("CAPTURE", "Recovered frames of a relay wall, or a capture.", read=True)

PULSE_SETTINGS = {"wavelength", "cycles"}
CAPTURE_SUFFIXES = (".h5", ".hdf5", ".npz", ".mat")
GEOMETRY_FILE = "geometry.toml"
"""Makes a folder of renderings one capture; see `nlos.io`."""

WARM_UP_VOXELS = 8


@dataclass(frozen=True)
class ImagingSettings(Settings):
    """Settings of imaging where the verb does not let a method be named."""

    method: str | None = None
    set: list[str] | None = None


Imaging = TypeVar("Imaging", bound=Settings)


def is_capture_folder(source: Path) -> bool:
    """Whether a path names a folder, and one that is not itself a capture."""
    return source.is_dir() and not (source / GEOMETRY_FILE).is_file()


def list_captures(folder: Path) -> list[Path]:
    """List the captures of a folder: files that may hold one, and folders of renderings."""
    found = sorted(
        path
        for path in folder.iterdir()
        if not path.name.startswith(".")
        and (path.suffix.lower() in CAPTURE_SUFFIXES or (path / GEOMETRY_FILE).is_file())
    )
    if not found:
        raise InputError(
            f"{folder}: no capture is in there ({', '.join(CAPTURE_SUFFIXES)}, or folders of renderings)"
        )
    names: dict[str, Path] = {}
    for path in found:
        other = names.setdefault(path.stem, path)
        if other is not path:
            raise InputError(
                f"{folder}: {other.name} and {path.name} would have results of one name; rename one"
            )
    return found


def add_provenance(volume: Volume, source: Path, settings: dict[str, object]) -> Volume:
    """Record in a volume's provenance which file it was made of, and how."""
    return replace(volume, provenance=build_provenance(settings, source, earlier=volume.provenance))


def parse_method_names(text: str) -> tuple[str, ...]:
    """Split a list of methods at its commas, refusing unknown names and repetitions."""
    names = tuple(name.strip() for name in text.split(","))
    for name in names:
        if name not in METHODS:
            raise InputError(f"unknown method '{name}'; choose from {', '.join(METHODS)}")
    if len(set(names)) < len(names):
        raise InputError(f"a method is named twice in '{text}'")
    return names


def choose_methods(method: str | None, usual: Sequence[str]) -> Sequence[str]:
    """Return the methods that may image a capture: the one that is named, or the usual ones."""
    names = usual if method is None else parse_method_names(method)
    if method is not None and len(names) > 1:
        one = f"one method images a stream or a capture, got '{method}'"
        raise InputError(f"{one}; nlos compare takes several")
    return names


def require_valid_settings(settings: Settings, methods: Sequence[str]) -> None:
    """Refuse settings that no capture could make sense of, and those that none of the methods takes,
    before any capture is read.
    """
    for name in sorted(_list_own_settings(METHODS.own) - _list_own_settings(methods)):
        if getattr(settings, name) is not None:
            by = ", ".join(one for one in METHODS.own if name in list_taken(one))
            raise InputError(
                f"{find_key(type(settings), name)} is a setting of {by} and changes nothing for "
                f"{', '.join(methods)}; leave it out"
            )
    if settings.flip not in (None, "x", "y"):
        raise InputError(f"flip is x or y, got '{settings.flip}'")
    if settings.wavelength is None:
        settings = replace(settings, wavelength=1.0)
    for name in methods:
        settings.make_method(name)


def _list_own_settings(methods: Iterable[str]) -> set[str]:
    return {name for one in methods for name in list_taken(one)} - PULSE_SETTINGS


def show_settings(found: Imaging, methods: Sequence[str]) -> Imaging:
    """Return the settings as they are written beside a result: what the methods' classes take where
    nothing is given is named, and what none of the methods takes is left out.
    """
    made: dict[str, Any] = {
        name: getattr(found.make_method(one), name, getattr(found, name))
        for one in methods
        for name in _list_own_settings([one])
    }
    shown: dict[str, Any] = dict.fromkeys(_list_own_settings(METHODS.own))
    return replace(found, **shown | made)


def prepare_imaging(
    recorded: Capture, wanted: Imaging, device: ComputeDevice | None = None
) -> PreparedImaging[Imaging]:
    """Do what `nlos.imaging.prepare_imaging` does, under a progress bar."""
    from nlos import imaging

    with show_activity("finding settings"):
        wanted = imaging.complete_settings(recorded, wanted)
    prepared = imaging.prepare_imaging(recorded, wanted, device, image_capture)
    _warn_of_given_wavelength(prepared.capture, prepared.settings)
    return prepared


def _warn_of_given_wavelength(capture: Capture, found: Settings) -> None:
    """Warn of false images; a wavelength that was found was so with the wall's sampling in mind."""
    from nlos.band import Band, VirtualPulse
    from nlos.illumination import describe_aliasing

    wavelength, taken = found.wavelength, list_taken(found.method or METHODS_BY_SPEED[0])
    if wavelength is None or "wavelength" in found.reasons or "wavelength" not in taken:
        return
    band = Band(VirtualPulse(wavelength, found.cycles), capture.axis)
    if text := describe_aliasing(capture, band):
        print(f"tofclip: warning: {text}", file=sys.stderr)


def image_capture(title: str, plan: Plan, capture: Capture) -> Volume:
    """Image the hidden scene under a progress bar that counts look-ups or voxels, whichever the
    plan does.
    """
    with show_progress(title, plan.cost) as advance:
        return plan.image(capture, advance)


@dataclass(frozen=True, eq=False)
class MeasuredVolume:
    """A volume and what it cost."""

    volume: Volume
    seconds: float  # wall-clock time of the imaging, without compiling
    # most memory that the program took at a time beyond what it had before; None where the system
    # does not show
    peak_bytes: int | None

    @property
    def costs(self) -> dict[str, float | None]:
        """Time and memory by the names that reports use."""
        peak = None if self.peak_bytes is None else self.peak_bytes / 2**20
        return {"seconds": self.seconds, "peak_mib": peak}


def measure_imaging(name: str, imaging: Method, capture: Capture, grid: Grid) -> MeasuredVolume:
    """Image the hidden scene, and measure time and memory.

    A few voxels are imaged first, so that loading the compiled loops is not counted.
    """
    from nlos import Grid

    few = slice(WARM_UP_VOXELS)
    with show_activity(f"{name}: loading its loops"):
        imaging.reconstruct(capture, Grid(grid.x[few], grid.y[few], grid.z[:1]))
    before = _reset_peak_memory()
    started = time.perf_counter()
    volume = image_capture(name, imaging.plan(capture, grid), capture)
    seconds = time.perf_counter() - started
    peak = _read_process_memory("VmHWM")
    known = before is not None and peak is not None
    return MeasuredVolume(volume, seconds, max(0, (peak or 0) - (before or 0)) if known else None)


def _reset_peak_memory() -> int | None:
    """Let the system forget the most memory that this program ever took; return what it takes now,
    bytes.
    """
    # The C library keeps what was given back for later; what is taken from there again would not be
    # seen.
    with contextlib.suppress(AttributeError, OSError):
        ctypes.CDLL(None).malloc_trim(0)
    try:
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")  # Linux only: see proc(5)
    except OSError:
        return None
    return _read_process_memory("VmRSS")


def _read_process_memory(entry: str) -> int | None:
    """Return an entry of Linux's account of this program's memory, bytes."""
    try:
        lines = Path("/proc/self/status").read_text(encoding="ascii", errors="replace").splitlines()
    except OSError:
        return None
    found = next((line for line in lines if line.startswith(f"{entry}:")), None)
    return None if found is None else int(found.split()[1]) * 1024
