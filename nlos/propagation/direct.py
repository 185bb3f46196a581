"""From points to points at the band's frequencies: every one's spherical wave, summed."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nlos.method import Progress, ignore_progress
from nlos.plane import Plane
from nlos.propagation.kernels import FREQUENCY_STEPS, TARGET_LANES, add_spherical_waves
from tofclip.threads import run_blocks

FloatArray = NDArray[np.float64]

LANE_GROUPS_PER_BLOCK = 4
"""Groups of targets per piece of work."""


def propagate_direct(
    points: FloatArray,
    phasors: NDArray[np.complex64],
    plane: Plane,
    wavenumbers: FloatArray,
    progress: Progress = ignore_progress,
) -> NDArray[np.complex64]:
    """Return ``sum_p P_k(r_p) * exp(1j * k * |r_v - r_p|) / |r_v - r_p|`` on a plane, (y, x,
    frequencies) complex64.

    See `sum_spherical_waves`.

    Parameters
    ----------
    points : (n, 3) float64 array
        Wall points, m.
    phasors : (n, frequencies) complex64 array
    plane : Plane
    wavenumbers : (frequencies,) float64 array
        rad/m.
    progress : callable
        Called with the number of plane points times frequencies just done.

    Returns
    -------
    (y, x, frequencies) complex64 array
    """
    return sum_spherical_waves(
        plane.points.reshape(-1, 3), points, phasors, wavenumbers, progress
    ).reshape(*plane.shape, -1)


def sum_spherical_waves(
    targets: FloatArray,
    sources: FloatArray,
    phasors: NDArray[np.complex64],
    wavenumbers: FloatArray,
    progress: Progress = ignore_progress,
) -> NDArray[np.complex64]:
    """Return ``sum_s P_k(s) * exp(1j * k * |t - s|) / |t - s|`` at every target t, in float32.

    Good to 1e-5 for points of any place and order; one complex product per pair of points and
    frequency. Memory for the result and a copy of the phasors.

    Parameters
    ----------
    targets, sources : (m, 3), (n, 3) array
        m.
    phasors : (n, frequencies) complex64 array
    wavenumbers : (frequencies,) array
        Evenly spaced, rad/m.
    progress : callable, optional
        Called with the number of values just done.

    Returns
    -------
    (m, frequencies) complex64 array
    """
    frequencies = wavenumbers.size
    padded = -(-frequencies // FREQUENCY_STEPS) * FREQUENCY_STEPS
    parts = np.zeros((len(sources), 2 * padded), np.float32)
    parts[:, : 2 * frequencies] = np.ascontiguousarray(phasors, np.complex64).view(np.float32)
    # Distances are what counts: near the middle of both, float32 coordinates have most digits.
    middle = (sources.mean(axis=0) + targets.mean(axis=0)) / 2
    groups = -(-len(targets) // TARGET_LANES)
    lanes = np.resize((targets - middle).astype(np.float32), (groups * TARGET_LANES, 3)).reshape(
        groups, TARGET_LANES, 3
    )
    emitters = (sources - middle).astype(np.float32)
    field = np.empty((groups, TARGET_LANES, frequencies), np.complex64)
    step = wavenumbers[1] - wavenumbers[0] if frequencies > 1 else 0.0
    turns, turns_on = np.float32(wavenumbers[0] / (2 * np.pi)), np.float32(step / (2 * np.pi))

    def process_block(some: slice) -> None:
        for group in range(some.start, some.stop):
            sums = np.zeros(padded * 2 * TARGET_LANES, np.float32)
            add_spherical_waves(
                emitters, parts, np.ascontiguousarray(lanes[group].T).ravel(), turns, turns_on, sums
            )
            real, imaginary = np.moveaxis(sums.reshape(padded, 2, TARGET_LANES)[:frequencies], 1, 0)
            field[group].real, field[group].imag = real.T, imaginary.T
        progress(
            (min(some.stop * TARGET_LANES, len(targets)) - some.start * TARGET_LANES) * frequencies
        )

    run_blocks(process_block, groups, size=LANE_GROUPS_PER_BLOCK)
    return field.reshape(-1, frequencies)[: len(targets)]
