"""Hidden scenes in time: `nlos.TransientImaging` shows one while the laser's flash passes through it,
and `DepthAverage` a moving one, averaged over more captures the farther away it lies.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nlos.capture import Capture
from nlos.illumination import (
    choose_band_for_paths,
    find_leg_bounds,
    group_by_illumination,
    warn_of_aliasing,
)
from nlos.method import (
    Progress,
    ignore_progress,
    require_imageable,
    require_memory,
    require_numpy_signal,
)
from nlos.phasor.arrays import ArrayLibrary
from nlos.phasor.plan import Hybrid, PlanarRSD, plan_groups, require_even_grid
from nlos.phasor.propagate import Backend
from nlos.phasor.to_depths import DepthPropagator
from nlos.volume import AXES, Grid, Volume
from tofclip.arrays import Array, ComplexArray, Float32Array, FloatArray
from tofclip.errors import InputError, ShapeError, require
from tofclip.storage import Storable, stored_array, stored_mapping, stored_part
from tofclip.threads import limit_blas_threads, run_blocks, split_blocks
from tofclip.units import SPEED_OF_LIGHT

# The share of a depth's voxels that change least tells the noise, as no moving thing fills the rest;
# squares of noise are exponentially distributed, and this share of them is taken for changes.
QUIET_SHARE, FALSE_CHANGES = 0.1, 0.004
CHANGE_RATIO = float(np.log(FALSE_CHANGES) / np.log(1 - QUIET_SHARE))


class DepthAverage:
    """A running mean of fields on a grid, over up to `captures` at the last depth and in proportion
    to the distance from `wall`, z in m: far light is noisier, and a moving thing stays longer
    within its wider image there. Of the earlier captures voxels take those that agree with the
    newest within their noise: what moves would cancel.

    Nam et al., Nat. Commun. 12, 6526 (2021).
    """

    def __init__(self, grid: Grid, wall: float, captures: int) -> None:
        require(captures >= 1, f"an average is over 1 capture or more, got {captures}")
        depth = np.maximum(grid.z - wall, 0)
        farthest = max(float(depth[-1]), np.finfo(float).tiny)
        most = np.maximum(np.rint(captures * depth / farthest), 1)
        self.windows: NDArray[np.int_] = most.astype(int)  # (z,), captures averaged at most
        self._earlier: deque[Array] = deque(maxlen=captures - 1)  # the latest first

    def add(self, field: Volume) -> Volume:
        """Take a new capture's complex field; return the average's brightness, float32."""
        newest = field.values
        total, count = newest.copy(), np.ones(newest.shape, np.float32)
        for number, earlier in enumerate(self._earlier, 1):
            far = slice(int(np.searchsorted(self.windows, number, "right")), None)
            changes = np.abs(newest[far] - earlier[far]) ** 2
            # every other voxel is enough
            quiet = np.quantile(changes[:, ::2, ::2], QUIET_SHARE, axis=(1, 2), keepdims=True)
            is_same = changes <= CHANGE_RATIO * quiet
            total[far] += earlier[far] * is_same
            count[far] += is_same
        self._earlier.appendleft(newest)
        return Volume(np.abs(total) / count, field.grid, field.provenance)


# Instants of one depth in memory at once.
INSTANTS_PER_BLOCK = 32
# Instants of a time gate per sigma of the envelope: exact to single precision.
SAMPLES_PER_SIGMA = 2
NO_DELAY = np.zeros(2)

FieldCallback = Callable[[int, slice, ComplexArray], None]
"""Takes the index of a depth, some instants, and the field (instants, y, x) there."""


@dataclass(frozen=True, eq=False)
class TransientVideo(Storable):
    """Brightness of a hidden scene at several instants.

    Parameters
    ----------
    values : (t, z, y, x) or (t, y, x) array
        float32; without z it is the brightest along every line of sight in z.
    times : (t,) array
        Seconds since the laser's flash left its spot on the wall.
    grid : Grid
    provenance : mapping
        How it came about.

    Raises
    ------
    ShapeError
        Values, times and grid disagree.
    """

    RECORD_KIND = "transient video"

    values: Float32Array = field(
        metadata=stored_array(
            dtype=np.float32, layout=lambda axes: ("time", *AXES[len(AXES) + 1 - axes :])
        )
    )
    times: FloatArray = field(metadata=stored_array("s", "time", name="time"))
    grid: Grid = field(metadata=stored_part(Grid))
    provenance: Mapping[str, Any] = stored_mapping("provenance")

    def __post_init__(self) -> None:
        scene = self.grid.shape
        if self.values.shape not in ((self.times.size, *scene), (self.times.size, *scene[1:])):
            wanted = f"(t, [z,] y, x) of {self.times.size} x {scene}"
            raise ShapeError("a transient video", wanted, self.values.shape)

    def save_film(self, path: str | Path) -> None:
        """Draw the front view at every instant into a GIF ``path``, with axes in metres."""
        from nlos.picture import save_film

        save_film(self, path)


@dataclass(frozen=True)
class TransientImaging:
    """Pictures of the hidden scene at given instants, and through a time gate.

    ``u(r, t) = | sum_k exp(1j * k * c * t) * sum_p P_k(r_p) * exp(1j * k * |r_p - r|) / |r_p - r|
    |``, t the time since the flash left its spot on the wall: a hidden thing lights up when the
    flash reaches it, at ``|r_L - r| / c``, and the image of `method` is what every voxel shows at
    just that time. Light that met several hidden things shows later at the last of them.

    Needs one laser spot. Memory beyond the result: some 40 bytes per plane wave and frequency and
    thread, and 32 instants of one depth.

    Liu et al., "Non-line-of-sight imaging using phasor-field virtual wave optics", Nature 572,
    620-623 (2019), transient camera; Liu, Bauer, Velten, Nat. Commun. 11, 1645 (2020).
    """

    method: PlanarRSD | Hybrid

    def video(
        self, capture: Capture, grid: Grid, times: ArrayLike, progress: Progress = ignore_progress
    ) -> TransientVideo:
        """Image the whole scene at every instant.

        Parameters
        ----------
        times : (t,) array
            Seconds since the flash left its spot on the wall.
        progress : callable, optional
            Called with the number of voxels just done, each once for all instants.

        Returns
        -------
        TransientVideo
            (t, z, y, x) float32.

        Raises
        ------
        InputError
            The method cannot image such a capture on the grid, or the video is larger than 8 GiB.
        """
        instants = _validate_times(times)
        what = f"{instants.size} instants of {grid.size} voxels"
        require_memory(4 * instants.size * grid.size, what, "ask for fewer, or for front views")
        values = np.empty((instants.size, *grid.shape), np.float32)

        def accumulate(depth: int, some: slice, seen: ComplexArray) -> None:
            values[some, depth] = np.abs(seen)

        self._stream_fields(capture, grid, instants, accumulate, progress)
        return TransientVideo(values, instants, grid, self._build_provenance(capture))

    def front_views(
        self, capture: Capture, grid: Grid, times: ArrayLike, progress: Progress = ignore_progress
    ) -> TransientVideo:
        """As `video`, but keep the brightest of every line of sight in z, (t, y, x), and memory for no
        more than that.
        """
        from threading import Lock

        instants, joining = _validate_times(times), Lock()
        values = np.zeros((instants.size, *grid.shape[1:]), np.float32)

        def accumulate(_: int, some: slice, seen: ComplexArray) -> None:
            brightness = np.abs(seen)
            # depths are imaged by several threads, and each may be the brightest
            with joining:
                np.maximum(values[some], brightness, out=values[some])

        self._stream_fields(capture, grid, instants, accumulate, progress)
        return TransientVideo(values, instants, grid, self._build_provenance(capture))

    def image_gate(
        self,
        capture: Capture,
        grid: Grid,
        opens: float,
        closes: float,
        progress: Progress = ignore_progress,
    ) -> Volume:
        """Image what lights up while a gate is open: ``sqrt(int |u|^2 c dt / (sqrt(pi) * sigma))``, sigma that
        of the pulse, float32.

        A lone point whose flash passes within the gate is as bright as in the image of the method;
        one that lights up at another time is dark.

        Parameters
        ----------
        capture, grid, progress
            As of `video`.
        opens, closes : float
            Seconds since the flash left its spot on the wall; `InputError` unless it opens first.
        """
        if not (np.isfinite(opens) and np.isfinite(closes) and opens < closes):
            raise InputError(f"a gate must open before it closes, got {opens} and {closes} s")
        width, sigma = SPEED_OF_LIGHT * (closes - opens), self.method.pulse.sigma
        count = int(np.ceil(SAMPLES_PER_SIGMA * width / sigma))
        instants = opens + (closes - opens) * (np.arange(count) + 0.5) / count
        weight = width / count / (np.sqrt(np.pi) * sigma)
        energy = np.zeros(grid.shape, np.float32)

        def accumulate(depth: int, _: slice, seen: ComplexArray) -> None:
            energy[depth] += np.float32(weight) * np.sum(seen.real**2 + seen.imag**2, axis=0)

        self._stream_fields(capture, grid, instants, accumulate, progress)
        gate = {"gate_opens_s": opens, "gate_closes_s": closes}
        return Volume(np.sqrt(energy), grid, self._build_provenance(capture, **gate))

    def _stream_fields(
        self,
        capture: Capture,
        grid: Grid,
        instants: FloatArray,
        use: FieldCallback,
        progress: Progress,
    ) -> None:
        """Hand the field of every depth to `use`, some instants at a time; depths run side by side."""
        # A band in which no voxel sees an echo of the record at any of the instants.
        nearest, farthest = find_leg_bounds(capture.points, grid)
        earliest, latest = SPEED_OF_LIGHT * instants.min(), SPEED_OF_LIGHT * instants.max()
        ends = earliest + nearest, latest + farthest
        band = choose_band_for_paths(capture.axis, self.method.pulse, *ends)
        require_numpy_signal("imaging in time", capture)
        spots = group_by_illumination(capture)
        if len(spots) > 1 or spots[0].laser is None:
            raise InputError(
                "pictures in time need one laser spot, whose flash passes through the scene; a scan of spots has none"
            )
        require_imageable(capture, grid)
        require_even_grid(grid)
        (group,) = plan_groups(self.method, capture, grid, band, Backend(band, capture))
        warn_of_aliasing(capture, band)
        depths = DepthPropagator(group.plane_to_depths, ArrayLibrary())
        spectrum = depths.to_waves(group.wall_to_plane(capture, ignore_progress, group.group))
        turns = np.exp(1j * SPEED_OF_LIGHT * np.outer(band.wavenumbers, instants))
        turns = turns.astype(np.complex64)

        def process_block(planes: slice) -> None:
            for depth in range(planes.start, planes.stop):
                nodes = depths.transfer_nodes(float(grid.z[depth]), NO_DELAY)[np.newaxis]
                arrived = spectrum * depths.transfer(nodes)
                for some in split_blocks(instants.size, INSTANTS_PER_BLOCK):
                    use(depth, some, depths.to_images(arrived @ turns[:, some])[0])
                progress(grid.shape[1] * grid.shape[2])

        with limit_blas_threads():
            run_blocks(process_block, grid.z.size, size=1)

    def _build_provenance(self, capture: Capture, **more: float) -> Mapping[str, Any]:
        settings = {
            "method": f"transient imaging by {type(self.method).__name__}",
            "wavelength_m": self.method.wavelength,
            "cycles": self.method.cycles,
            "tolerance": self.method.tolerance,
            **more,
        }
        return {**capture.provenance, "imaging": settings}


def _validate_times(times: ArrayLike) -> FloatArray:
    instants = np.asarray(times, dtype=np.float64)
    if instants.ndim != 1 or instants.size == 0:
        raise ShapeError("the instants of a video", "(t,) with t >= 1", instants.shape)
    require(np.all(np.isfinite(instants)), "the instants of a video must be finite")
    return instants
