"""What imaging a capture would take: memory per method, estimated before anything is allocated."""

from __future__ import annotations

from typing import TYPE_CHECKING

from nlos import Backprojection, FilteredBackprojection, FKMigration, Hybrid, LightCone
from nlos.backprojection import TABLE_BYTES
from nlos.confocal.scan import BYTES_PER_SAMPLE
from nlos.illumination_groups import choose_unaliased_band, group_by_illumination
from nlos.rsd.diffraction import BYTES_PER_WAVE, DiffractionPlan
from nlos.rsd.planar import build_waves
from nlos.rsd.wall import PlanarWall

if TYPE_CHECKING:
    from nlos import Capture, Grid
    from nlos.method import Reconstructor

SUM_BYTES, MAGNITUDE_BYTES = 8, 4
"""Per voxel: a complex64 sum, and its float32 magnitude."""

LAPLACIAN_COPIES = 4
"""Volumes in float32 that the filtered back-projection holds beside its sum."""

TRANSFORM_COPIES = 2
"""Signals and spectra are held before and after they are transformed."""


def estimate_memory(imaging: Reconstructor, capture: Capture, grid: Grid) -> int:
    """Estimate the most bytes that a method's arrays hold at a time, the volume included and the
    capture not.

    Good to about a factor of two; `tofclip nlos compare` measures.

    Parameters
    ----------
    imaging : Reconstructor
    capture : Capture
    grid : Grid

    Returns
    -------
    int
        Bytes.
    """
    volume = grid.size * (SUM_BYTES + MAGNITUDE_BYTES)
    if isinstance(imaging, LightCone | FKMigration):
        return volume + 8 * len(capture.points) * capture.axis.bins * BYTES_PER_SAMPLE
    if isinstance(imaging, FilteredBackprojection):
        signals = min(TABLE_BYTES, SUM_BYTES * len(capture.points) * capture.axis.bins)
        return volume + LAPLACIAN_COPIES * MAGNITUDE_BYTES * grid.size + TRANSFORM_COPIES * signals
    if isinstance(imaging, Backprojection):
        return volume + TRANSFORM_COPIES * TABLE_BYTES
    return (
        volume
        + MAGNITUDE_BYTES * capture.axis.bins * capture.valid.size
        + TRANSFORM_COPIES * _estimate_spectra_bytes(imaging, capture, grid)
    )


def _estimate_spectra_bytes(imaging: Reconstructor, capture: Capture, grid: Grid) -> int:
    """Bytes of a field on a plane and of its plane waves, at all frequencies of the pulse."""
    group = group_by_illumination(capture)[0]
    band = choose_unaliased_band(capture, grid, imaging.pulse)  # type: ignore[attr-defined]
    if isinstance(imaging, Hybrid):
        plane = imaging.virtual_plane(capture, grid)
    else:
        plane = PlanarWall.of(capture.points[group.indices]).plane
    waves = build_waves(group, band, isinstance(imaging, Hybrid))
    plan = DiffractionPlan(plane, grid, waves, imaging.tolerance)  # type: ignore[attr-defined]
    count = (
        len(plan.plane_waves.lateral_wavenumbers)
        + plane.shape[0] * plane.shape[1]
        + len(capture.points)
    )
    return int(count * plan.waves.count * BYTES_PER_WAVE)
