"""What light-cone transform and f-k migration need of a capture: its lattice, and its signals from path 0 on."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nlos.capture import Capture
from nlos.geometry import FloatArray, Grid
from nlos.kernels import shift_signals
from nlos.method import VOXEL_BYTES, Plan, Progress, require_imageable, require_numpy_signal
from nlos.plane import PlanarWall, Plane, axis_step
from nlos.volume import Volume
from tofclip.errors import InputError

LATTICE_TOLERANCE = 0.02
"""Points may be off the lattice by this fraction of its step."""

MEMORY_LIMIT_BYTES = 4 << 30
"""Larger transforms are refused before anything is allocated."""

BYTES_PER_SAMPLE = 12
"""Of the padded box (2 rows, 2 columns, 2 bins): two half spectra in complex64, and the signals and what is cut out of
the result besides."""

WHOLE_BIN_TOLERANCE = 1e-3
"""A start that lies this close to a whole bin, in bins, is taken for one."""


@dataclass(frozen=True, eq=False)
class ConfocalScan:
    """Signals on a lattice of wall points; where a point is missing, it is dark."""

    # (y, x, t), what every wall point saw; bin i stands for the distance ``i * spacing`` from it
    signal: NDArray[np.float32]
    plane: Plane  # the wall points
    spacing: float  # distance per bin, m: half the path

    @classmethod
    def of(cls, capture: Capture, grid: Grid) -> ConfocalScan:
        """Sort a capture onto its lattice, from distance 0 as far as any voxel of the grid is from
        any wall point.

        `capture`: confocal, its wall points on a lattice of a plane; `grid`: says how far the
        signals are needed. Returns signals (y, x, t) float32; a bin is half as long as the
        capture's, because it counts distance, not path.
        """
        wall = PlanarWall.of(capture.points, LATTICE_TOLERANCE)
        traces = _shift_to_distance_zero(capture, _count_useful_bins(capture, wall.plane, grid))
        return cls(wall.lattice.place(traces), wall.plane, capture.axis.spacing / 2)

    def correct_falloff(self, falloff: float) -> NDArray[np.float32]:
        """Undo the loss of brightness with distance d by the factor d^falloff; the farthest bin
        keeps its scale.
        """
        relative = np.arange(self.signal.shape[2], dtype=np.float32) / (self.signal.shape[2] - 1)
        return np.asarray(self.signal * relative**falloff, dtype=np.float32)


class ConfocalPlan(Plan):
    """Imaging by transforms of the whole scan at once, ready for captures of one geometry.

    Parameters
    ----------
    capture : Capture
        A confocal scan of a lattice on a plane z = const.
    grid : Grid
        Up to half a wall beyond the wall's edges.
    compute : callable
        From a scan and the grid to the values (z, y, x).
    settings : mapping
        What a volume reports of how it was imaged.

    Raises
    ------
    InputError
        There is no such lattice, the grid reaches too far, or memory does not suffice.
    """

    def __init__(
        self,
        capture: Capture,
        grid: Grid,
        compute: Callable[[ConfocalScan, Grid], NDArray[np.float32]],
        settings: Mapping[str, Any],
    ) -> None:
        require_numpy_signal("a light-cone transform or f-k migration", capture)
        require_imageable(capture, grid)
        try:
            wall = PlanarWall.of(capture.points, LATTICE_TOLERANCE)
        except InputError as problem:
            raise InputError(f"a lattice of points on a plane is needed: {problem}") from problem
        super().__init__(capture, grid)
        _require_confocal(capture, wall.plane)
        _require_extent(wall.plane, grid)
        self._memory_bytes = _require_memory(capture, wall.plane) + grid.size * VOXEL_BYTES
        self._compute, self.settings = compute, dict(settings)

    @property
    def memory_bytes(self) -> int:
        return self._memory_bytes

    def _image(self, capture: Capture, progress: Progress) -> Volume:
        image = self._compute(ConfocalScan.of(capture, self.grid), self.grid)
        progress(self.grid.size)
        return Volume(image, self.grid, {**capture.provenance, "imaging": self.settings})


def find_padded_length(count: int) -> int:
    """At least twice as many samples: an even number that Fourier transforms are quick with."""
    from scipy.fft import next_fast_len

    return 2 * int(next_fast_len(count))


def interpolate_axis(
    values: NDArray[np.float32], position: FloatArray, axis: int
) -> NDArray[np.float32]:
    """Read an axis at fractional positions by linear interpolation; it is periodic.

    `values`: any shape; `position` (n,): in steps of the axis. Returns as `values`, with n places
    along the axis.
    """
    below = np.floor(position).astype(np.intp)
    weight = (position - below).astype(np.float32)
    weight = weight.reshape([-1 if i == axis else 1 for i in range(values.ndim)])
    count = values.shape[axis]
    # the lattice is padded, so that a period's seam lies outside the image
    lower, upper = (np.take(values, index % count, axis) for index in (below, below + 1))
    return np.asarray(lower + weight * (upper - lower))


def resample_to_grid(
    values: NDArray[np.float32], scan: ConfocalScan, grid: Grid, depth_position: FloatArray
) -> NDArray[np.float32]:
    """Read an image (y, x, depth) on the padded lattice at the voxels of a grid, shape (z, y, x).

    `values` (y, x, depth); `scan`: its plane gives the lattice's first point and steps, m;
    `depth_position` (z,): the grid's planes in steps of the third axis. Returns (z, y, x).
    """
    image = interpolate_axis(values, depth_position, 2)
    row, column = (
        (wanted - axis[0]) / axis_step(axis)
        for wanted, axis in ((grid.y, scan.plane.y), (grid.x, scan.plane.x))
    )
    return np.ascontiguousarray(
        np.moveaxis(interpolate_axis(interpolate_axis(image, column, 1), row, 0), 2, 0)
    )


def _require_confocal(capture: Capture, plane: Plane) -> None:
    if len(capture.lasers) != len(capture.points):
        raise InputError(
            "a confocal scan is needed, where every wall point is its own laser spot; use another method"
        )
    apart = float(np.abs(capture.lasers - capture.points).max())
    if apart > LATTICE_TOLERANCE * min(plane.steps):
        raise InputError(
            f"a confocal scan is needed, but lasers are up to {apart:.3g} m from their wall points; "
            "use another method"
        )


def _require_extent(plane: Plane, grid: Grid) -> None:
    for name, axis, wanted in (("x", plane.x, grid.x), ("y", plane.y, grid.y)):
        # The transforms pad the wall to twice its width: what lies farther out would come in again
        # on the other side.
        margin = (axis[-1] - axis[0]) / 2
        low, high = axis[0] - margin, axis[-1] + margin
        if wanted[0] < low or wanted[-1] > high:
            raise InputError(
                f"the grid's {name} runs from {wanted[0]:.3g} to {wanted[-1]:.3g} m, but this method sees only from "
                f"{low:.3g} to {high:.3g} m, half a wall beyond the wall"
            )


def _require_memory(capture: Capture, plane: Plane) -> int:
    """Return what the transforms take, bytes; refuse more than `MEMORY_LIMIT_BYTES`."""
    places = plane.x.size * plane.y.size
    bins = capture.axis.bins + max(0, int(capture.start / capture.axis.spacing))
    needed = 8 * places * bins * BYTES_PER_SAMPLE
    if needed > MEMORY_LIMIT_BYTES:
        raise InputError(
            f"{places} wall points with {bins} bins need {needed / 2**30:.1f} GiB, more than the "
            f"{MEMORY_LIMIT_BYTES >> 30} GiB allowed: put time bins together or leave wall points out"
        )
    return needed


def _count_useful_bins(capture: Capture, plane: Plane, grid: Grid) -> int:
    """Bins from path 0 to the end of the record, or as far as light of the grid can come from."""
    across = [
        max(
            abs(voxel - point) for voxel in (wanted[0], wanted[-1]) for point in (axis[0], axis[-1])
        )
        for axis, wanted in ((plane.x, grid.x), (plane.y, grid.y))
    ]
    farthest = float(np.hypot(np.hypot(*across), grid.z[-1] - plane.z))
    recorded = int(np.ceil(capture.axis.paths[-1] / capture.axis.spacing)) + 1
    return max(2, min(recorded, int(np.ceil(2 * farthest / capture.axis.spacing)) + 2))


def _shift_to_distance_zero(capture: Capture, bins: int) -> NDArray[np.float32]:
    """Signals (points, bins) whose bin 0 is path 0: moved by whole bins where that suffices, else
    interpolated.
    """
    delay = capture.start / capture.axis.spacing
    whole = round(delay)
    traces = capture.traces()
    if abs(delay - whole) > WHOLE_BIN_TOLERANCE:
        by_bin = np.ascontiguousarray(traces.T)
        traces = np.ascontiguousarray(shift_signals(by_bin, np.full(len(traces), whole - delay)).T)
    moved = np.zeros((len(traces), bins), np.float32)
    first, last = max(0, whole), min(bins, whole + traces.shape[1])
    if first < last:
        moved[:, first:last] = traces[:, first - whole : last - whole]
    return moved
