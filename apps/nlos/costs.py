"""What imaging a capture would take: memory per method, estimated before anything is allocated."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from nlos import Capture, Grid
    from nlos.method import Reconstructor

SUM_BYTES, MAGNITUDE_BYTES = 8, 4
"""Per voxel: a complex64 sum, and its float32 magnitude."""

LAPLACIAN_COPIES = 4
"""Volumes in float32 that the filtered back-projection holds beside its sum."""

COPIES = 2
"""Signals and spectra are held before and after they are transformed."""


def memory_of(imaging: Reconstructor, capture: Capture, grid: Grid) -> int:
    """Estimate the most bytes that a method's arrays hold at a time, the volume included and the capture not.

    Good to about a factor of two; `tofclip nlos compare` measures.
    """
    from nlos import Backprojection, FilteredBackprojection, FKMigration, LightCone
    from nlos.backprojection import TABLE_BYTES
    from nlos.confocal.scan import BYTES_PER_SAMPLE

    volume = grid.size * (SUM_BYTES + MAGNITUDE_BYTES)
    if isinstance(imaging, LightCone | FKMigration):
        return volume + 8 * len(capture.points) * capture.axis.bins * BYTES_PER_SAMPLE
    if isinstance(imaging, FilteredBackprojection):
        signals = min(TABLE_BYTES, SUM_BYTES * len(capture.points) * capture.axis.bins)
        return volume + LAPLACIAN_COPIES * MAGNITUDE_BYTES * grid.size + COPIES * signals
    if isinstance(imaging, Backprojection):
        return volume + COPIES * TABLE_BYTES
    return volume + MAGNITUDE_BYTES * capture.axis.bins * capture.valid.size + COPIES * _spectra(imaging, capture, grid)


def _spectra(imaging: Reconstructor, capture: Capture, grid: Grid) -> int:
    """Bytes of a field on a plane and of its plane waves, at all frequencies of the pulse."""
    from nlos import Hybrid
    from nlos.exposure import exposures, unfolded_band
    from nlos.rsd.diffraction import WAVE_BYTES, Diffraction
    from nlos.rsd.planar import waves_of
    from nlos.rsd.wall import PlanarWall

    part = exposures(capture)[0]
    band = unfolded_band(capture, grid, imaging.pulse)  # type: ignore[attr-defined]
    if isinstance(imaging, Hybrid):
        plane = imaging.virtual_plane(capture, grid)
    else:
        plane = PlanarWall.of(capture.points[part.members]).plane
    waves = waves_of(part, band, isinstance(imaging, Hybrid))
    way = Diffraction(plane, grid, waves, imaging.tolerance)  # type: ignore[attr-defined]
    count = len(way.plane_waves.lateral) + plane.shape[0] * plane.shape[1] + len(capture.points)
    return int(count * way.waves.count * WAVE_BYTES)
