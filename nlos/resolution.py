"""How wide a point becomes: the limit that diffraction sets for a wall, and what a volume shows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.linalg import norm

from nlos.band import VirtualPulse
from nlos.capture import Capture, select_lasers
from nlos.volume import Volume
from tofclip.arrays import AnyArray, FloatArray
from tofclip.errors import InputError

# Places along each axis at which the ideal image is computed.
PROFILE_SAMPLES = 401
# They extend this number of times the width that a small aperture would have, to either side.
PROFILE_EXTENT_WIDTHS = 4.0
HALF_MAXIMUM = 0.5
# More wall points than this, evenly picked, change no width.
MAX_WALL_POINTS = 4096


@dataclass(frozen=True)
class PeakWidths:
    """Full widths at half maximum of a point's magnitude, m."""

    # NaN where the magnitude does not fall to half on both sides
    x: float
    y: float
    z: float


def compute_diffraction_limit(capture: Capture, point: Any, pulse: VirtualPulse) -> PeakWidths:
    """Width of the image of a point that a noiseless, infinitely fast instrument would give.

    It is that of ``|sum_p d_p^-3 s(L_p(r) - L_p(r_0))|`` about the point r_0, with s the virtual
    pulse, ``L_p(r) = |r_L - r| + |r - r_p|`` and ``d_p = |r_0 - r_p|``: light falls with the square
    of the distance, and the way back divides by it once more. For a small wall of width W at
    distance z and one laser this is 1.2 * wavelength * z / W across, half of it for a confocal
    scan, and half the envelope's width in depth.

    `capture`: for its wall and laser; `point` (3,): m. Returns full widths at half maximum along x,
    y and z, m.
    """
    point = np.asarray(point, dtype=np.float64)
    if point.shape != (3,) or not np.all(np.isfinite(point)):
        raise InputError(f"a point needs three finite coordinates, got {point}")
    return PeakWidths(*(_compute_ideal_width(capture, point, axis, pulse) for axis in range(3)))


def measure_point_spread(volume: Volume, point: Any | None = None) -> PeakWidths:
    """Widths of a volume's peak, the voxel nearest to `point` (3,) or the brightest, along x, y and
    z; voxels of at most a quarter of them.
    """
    z, y, x = volume.grid.find_nearest(volume.find_brightest() if point is None else point)
    magnitude = volume.magnitude
    lines = (
        (volume.grid.x, magnitude[z, y, :], x),
        (volume.grid.y, magnitude[z, :, x], y),
        (volume.grid.z, magnitude[:, y, x], z),
    )
    return PeakWidths(*(measure_fwhm(axis, line, peak) for axis, line, peak in lines))


def measure_fwhm(axis: FloatArray, values: AnyArray, peak: int) -> float:
    """Full width at half of ``values[peak]`` along an axis (n,), m; NaN where one side stays
    higher.
    """
    level = HALF_MAXIMUM * float(values[peak])
    below = np.flatnonzero(values < level)
    left, right = below[below < peak], below[below > peak]
    if not left.size or not right.size:
        return float("nan")
    ends = []
    for outer, inner in ((left[-1], left[-1] + 1), (right[0], right[0] - 1)):
        weight = (level - values[outer]) / (values[inner] - values[outer])
        ends.append(float(axis[outer] + weight * (axis[inner] - axis[outer])))
    return abs(ends[1] - ends[0])


def _compute_ideal_width(
    capture: Capture, point: FloatArray, axis: int, pulse: VirtualPulse
) -> float:
    # every n-th point spans the same aperture
    some = slice(None, None, max(1, len(capture.points) // MAX_WALL_POINTS))
    wall = capture.points[some]
    lasers = select_lasers(capture, some)
    distance = float(norm(wall - point, axis=1).mean())
    extent = float(np.ptp(wall, axis=0).max())
    # the order of the diffraction limit, wavelength * distance / aperture
    narrow = pulse.wavelength * max(1.0, distance / max(extent, 1e-9))
    places = np.linspace(-PROFILE_EXTENT_WIDTHS, PROFILE_EXTENT_WIDTHS, PROFILE_SAMPLES) * narrow
    start = _compute_path_lengths(wall, lasers, point)
    weights = norm(wall - point, axis=1) ** -3.0
    field = np.empty(PROFILE_SAMPLES, np.complex128)
    for i, place in enumerate(places):
        moved = point.copy()
        moved[axis] += place
        detour = _compute_path_lengths(wall, lasers, moved) - start
        envelope = np.exp(-(detour**2) / (2 * pulse.sigma**2))
        field[i] = np.sum(weights * envelope * np.exp(1j * pulse.wavenumber * detour))
    return measure_fwhm(places, np.abs(field), PROFILE_SAMPLES // 2)


def _compute_path_lengths(wall: FloatArray, lasers: FloatArray, point: FloatArray) -> FloatArray:
    legs = (norm(ends - point, axis=1) for ends in (lasers, wall))
    return sum(legs)
