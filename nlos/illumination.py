"""The parts of a capture that one illumination made, which of laser spots and wall points to take
for lasers, a band in which no voxel sees an echo of the record, and whether the wall is sampled
finely enough for it.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace

import numpy as np

from nlos.band import Band, VirtualPulse
from nlos.capture import Capture, TimeAxis, measure_extent
from nlos.phasor.to_depths_compiled import LaserSource
from nlos.phasor.transfer import SphericalWaves
from nlos.volume import Grid
from tofclip.arrays import FloatArray, IndexArray

# Of the wall's width: nearer to each other, a laser spot and a wall point are one.
SAME_SPOT_FRACTION = 1e-6


@dataclass(frozen=True, eq=False)
class IlluminationGroup:
    """Wall points whose light started at one laser spot, or at each point itself."""

    # (3,), m; None for a confocal scan, in which the way out is the way back
    laser: FloatArray | None
    indices: IndexArray  # (n,), which of the capture's valid points

    @property
    def legs(self) -> int:
        """How often the field's wave runs between wall and voxel: 1, or 2 if confocal."""
        return 2 if self.laser is None else 1


def is_confocal(capture: Capture) -> bool:
    """Whether every wall point is its own laser spot, but for rounding."""
    if len(capture.lasers) != len(capture.points) or len(capture.points) == 1:
        return False
    apart = float(np.abs(capture.lasers - capture.points).max())
    return apart <= SAME_SPOT_FRACTION * measure_extent(capture)


def swap_roles(capture: Capture) -> Capture:
    """Take laser spots for wall points and wall points for laser spots."""
    lasers = np.broadcast_to(capture.laser, capture.wall.shape)
    return replace(capture, wall=lasers, laser=capture.wall)


def choose_roles(capture: Capture) -> Capture:
    """Return the capture, or its roles swapped where laser spots are more than wall points: a wave
    is imaged for every spot, which of a scanning laser before few detectors are the detectors.
    """
    if len(capture.lasers) == 1 or is_confocal(capture):
        return capture
    fewer = _count_places(capture.points) < _count_places(capture.lasers)
    return swap_roles(capture) if fewer else capture


def _count_places(spots: FloatArray) -> int:
    """Count the different spots among those given (n, 3), but for chance: by one number each."""
    return int(np.unique(spots @ np.array([1.0, np.sqrt(2), np.pi])).size)


def group_by_illumination(capture: Capture) -> list[IlluminationGroup]:
    """Sort the valid wall points of a capture by laser spot."""
    everyone = np.arange(len(capture.points))
    if len(capture.lasers) == 1:
        return [IlluminationGroup(capture.lasers[0], everyone)]
    if is_confocal(capture):
        return [IlluminationGroup(None, everyone)]
    # Sorted by columns: rows as a whole take ten times as long.
    order = np.lexsort(capture.lasers.T[::-1])
    sorted_spots = capture.lasers[order]
    begins = np.flatnonzero(np.any(np.diff(sorted_spots, axis=0, prepend=np.nan) != 0, axis=1))
    return [
        IlluminationGroup(sorted_spots[begin], np.sort(members))
        for begin, members in zip(begins, np.split(order, begins[1:]), strict=True)
    ]


def build_waves(group: IlluminationGroup, band: Band, continued: bool) -> SphericalWaves:
    """Return a group's waves between wall and voxels; `continued` as of `SphericalWaves`."""
    k = group.legs * band.wavenumbers
    step = float(k[1] - k[0]) if k.size > 1 else 1.0
    return SphericalWaves(float(k[0]), step, k.size, continued)


def build_source(group: IlluminationGroup, band: Band) -> LaserSource:
    """Return what shines on the scene in one illumination group."""
    return LaserSource(group.laser, band.wavenumbers, band.strength)


def choose_unaliased_band(capture: Capture, grid: Grid, pulse: VirtualPulse) -> Band:
    """Return the pulse's band over a period so long that every voxel sees the record once, or
    silence: evenly spaced frequencies repeat a signal with their period.
    """
    outward, back = find_leg_bounds(capture.lasers, grid), find_leg_bounds(capture.points, grid)
    return choose_band_for_paths(capture.axis, pulse, outward[0] + back[0], outward[1] + back[1])


def choose_band_for_paths(
    axis: TimeAxis, pulse: VirtualPulse, shortest: float, longest: float
) -> Band:
    """Return the band whose period holds a record once for paths of these lengths, m."""
    tail = Band(pulse, axis).tail_bins * axis.spacing
    # no image of the record, a period earlier or later, may be reached by a path of the grid
    period = max(longest - (axis.start - tail), axis.paths[-1] + tail - shortest)
    bins = max(axis.bins, int(np.ceil(period / axis.spacing)) - 2 * Band(pulse, axis).tail_bins)
    return Band(pulse, TimeAxis(bins, axis.bin_width, axis.start))


def find_leg_bounds(ends: FloatArray, grid: Grid) -> tuple[float, float]:
    """Shortest and longest distance between any of some points (n, 3) and any voxel, m."""
    axes = (grid.x, grid.y, grid.z)
    low, high = (np.array([axis[end] for axis in axes]) for end in (0, -1))
    # distance from a point to the box: zero along axes within it
    outside = np.maximum(np.maximum(low - ends, ends - high), 0)
    # the farthest corner lies at the farther end of every axis
    across = np.maximum(np.abs(ends - low), np.abs(high - ends))
    return float(np.linalg.norm(outside, axis=1).min()), float(np.linalg.norm(across, axis=1).max())


class AliasingWarning(UserWarning):
    """Wall points lie so far apart that false images of bright things may appear beside them."""


def describe_aliasing(capture: Capture, band: Band) -> str | None:
    """Say why false images may appear, or None: neighbouring wall points are more than half the
    band's shortest wavelength apart, a quarter where the path grows on both legs.
    """
    shortest = 2 * np.pi / float(band.wavenumbers[-1])
    finest = shortest / 4 if is_confocal(capture) else shortest / 2
    # A wall drawn exactly at the limit must not be warned of for a rounding error.
    if not (np.isfinite(capture.spacing) and capture.spacing > finest * (1 + 1e-6)):
        return None
    return (
        f"wall points {capture.spacing:.3g} m apart are too coarse for waves of {shortest:.3g} m, the shortest of "
        f"the virtual pulse: false images may appear; use points at most {finest:.3g} m apart, or a wavelength "
        f"{capture.spacing / finest:.2g} times longer"
    )


def warn_of_aliasing(capture: Capture, band: Band) -> None:
    """Give what `describe_aliasing` says as an `AliasingWarning`."""
    if text := describe_aliasing(capture, band):
        warnings.warn(text, AliasingWarning, stacklevel=2)
