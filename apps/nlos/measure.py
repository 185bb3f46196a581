"""What a method costs, and how good its image is."""

from __future__ import annotations

import contextlib
import ctypes
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from apps.nlos.imaging import image_capture
from apps.progress import show_activity
from nlos import Grid

if TYPE_CHECKING:
    from apps.nlos.truth import HiddenTruth
    from nlos import Capture, Grid, Method, Volume

WARM_UP_VOXELS = 8
TRUTH_RADIUS_M = 0.04
"""m; light so close to a hidden thing counts as its own, if voxels are not larger."""


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
        return {
            "seconds": self.seconds,
            "peak_mib": None if self.peak_bytes is None else self.peak_bytes / 2**20,
        }


def measure_imaging(name: str, imaging: Method, capture: Capture, grid: Grid) -> MeasuredVolume:
    """Image the hidden scene, and measure time and memory.

    A few voxels are imaged first, so that loading the compiled loops is not counted.

    Returns seconds, and bytes where the system reports them.
    """
    few = slice(WARM_UP_VOXELS)
    with show_activity(f"{name}: loading its loops"):
        imaging.reconstruct(capture, Grid(grid.x[few], grid.y[few], grid.z[:1]))
    before = _reset_peak_memory()
    started = time.perf_counter()
    volume = image_capture(name, imaging.plan(capture, grid), capture)
    seconds = time.perf_counter() - started
    peak = _read_process_memory("VmHWM")
    return MeasuredVolume(
        volume, seconds, None if before is None or peak is None else max(0, peak - before)
    )


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


def measure_sharpness(volume: Volume) -> float:
    """How far the light of the front view is gathered: 1 where it is even, the number of pixels
    where one has it all.

    ``pixels * sum(I^2) / sum(I)^2``: the first sharpness of R. A. Muller and A. Buffington, J. Opt.
    Soc. Am. 64, 1200 (1974), made free of scale. It compares images of one scene on one grid; it
    does not separate right from wrong.
    """
    front = volume.maximum_projection().brightness.astype(np.float64)
    total = float(front.sum())
    return front.size * float(np.sum(front**2)) / total**2 if total > 0 else float("nan")


def compare_with_truth(volume: Volume, truth: HiddenTruth) -> dict[str, Any]:
    """Fraction of the energy near hidden things, and how much brighter voxels are there than
    elsewhere.

    Returns ``energy_near_truth``, ``contrast_to_truth`` and ``truth_reach_m``, the distance that
    counts as near.
    """
    axes = (volume.grid.x, volume.grid.y, volume.grid.z)
    # coarse voxels may have no centre within the radius
    reach = max([TRUTH_RADIUS_M, *(float(axis[1] - axis[0]) for axis in axes if axis.size > 1)])
    near, magnitude = truth.mask_near(volume.grid, reach), volume.magnitude.astype(np.float64)
    energy = float(np.sum(magnitude**2))
    around, elsewhere = (
        float(magnitude[some].mean()) if some.any() else float("nan") for some in (near, ~near)
    )
    return {
        "energy_near_truth": float(np.sum(magnitude[near] ** 2)) / energy
        if energy > 0
        else float("nan"),
        "contrast_to_truth": around / elsewhere if elsewhere > 0 else float("nan"),
        "truth_reach_m": reach,
    }
