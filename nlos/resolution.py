"""How wide a point becomes: the limit that diffraction sets for a wall, and what a volume shows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nlos.band import VirtualPulse
from nlos.capture import Capture
from nlos.geometry import FloatArray
from nlos.volume import Volume
from tofclip.errors import InputError

SAMPLES = 401
"""Places along each axis at which the ideal image is computed."""

REACH = 4.0
"""They extend so many times the width that a small aperture would have, to either side."""

HALF = 0.5
WALL_POINTS = 4096
"""More wall points than this, evenly picked, change no width."""


@dataclass(frozen=True)
class Widths:
    """Full widths at half maximum of a point's magnitude, m.

    Parameters
    ----------
    x, y, z : float
        NaN where the magnitude does not fall to half on both sides.
    """

    x: float
    y: float
    z: float


def diffraction_limit(capture: Capture, point: Any, pulse: VirtualPulse) -> Widths:
    """Width of the image of a point that a noiseless, infinitely fast instrument would give.

    It is that of ``|sum_p d_p^-3 s(L_p(r) - L_p(r_0))|`` about the point r_0, with s the virtual pulse, ``L_p(r) =
    |r_L - r| + |r - r_p|`` and ``d_p = |r_0 - r_p|``: light falls with the square of the distance, and the way back
    divides by it once more. For a small wall of width W at distance z and one laser this is 1.2 * wavelength * z / W
    across, half of it for a confocal scan, and half the envelope's width in depth.

    Parameters
    ----------
    capture : Capture
        For its wall and laser.
    point : (3,) array
        m.
    pulse : VirtualPulse
    """
    point = np.asarray(point, dtype=np.float64)
    if point.shape != (3,) or not np.all(np.isfinite(point)):
        raise InputError(f"a point needs three finite coordinates, got {point}")
    return Widths(*(_ideal_width(capture, point, axis, pulse) for axis in range(3)))


def point_spread(volume: Volume, point: Any | None = None) -> Widths:
    """Widths of a volume's peak, along the lines x, y and z through it.

    Parameters
    ----------
    volume : Volume
        A quarter of the width per voxel, or finer.
    point : (3,) array, optional
        The voxel nearest to it is taken for the peak; defaults to the brightest.
    """
    z, y, x = volume.grid.nearest(volume.brightest() if point is None else point)
    magnitude = volume.magnitude
    lines = (
        (volume.grid.x, magnitude[z, y, :], x),
        (volume.grid.y, magnitude[z, :, x], y),
        (volume.grid.z, magnitude[:, y, x], z),
    )
    return Widths(*(width_at_half(axis, line, peak) for axis, line, peak in lines))


def width_at_half(axis: FloatArray, values: NDArray[Any], peak: int) -> float:
    """Full width at half of ``values[peak]``, by linear interpolation; NaN if one side does not fall so far."""
    level = HALF * float(values[peak])
    below = np.flatnonzero(values < level)
    left, right = below[below < peak], below[below > peak]
    if not left.size or not right.size:
        return float("nan")
    ends = [_crossing(axis, values, int(outer), inward, level) for outer, inward in ((left[-1], 1), (right[0], -1))]
    return abs(ends[1] - ends[0])


def _crossing(axis: FloatArray, values: NDArray[Any], outer: int, inward: int, level: float) -> float:
    inner = outer + inward
    share = (level - values[outer]) / (values[inner] - values[outer])
    return float(axis[outer] + share * (axis[inner] - axis[outer]))


def _ideal_width(capture: Capture, point: FloatArray, axis: int, pulse: VirtualPulse) -> float:
    some = slice(None, None, max(1, len(capture.points) // WALL_POINTS))
    wall = capture.points[some]
    lasers = capture.lasers if len(capture.lasers) == 1 else capture.lasers[some]
    distance = float(np.linalg.norm(wall - point, axis=1).mean())
    extent = float(np.ptp(wall, axis=0).max())
    narrow = pulse.wavelength * max(1.0, distance / max(extent, 1e-9))
    places = np.linspace(-REACH, REACH, SAMPLES) * narrow
    start = _paths(wall, lasers, point)
    weights = np.linalg.norm(wall - point, axis=1) ** -3.0
    field = np.empty(SAMPLES, np.complex128)
    for i, place in enumerate(places):
        moved = point.copy()
        moved[axis] += place
        detour = _paths(wall, lasers, moved) - start
        field[i] = np.sum(weights * _pulse(detour, pulse))
    return width_at_half(places, np.abs(field), SAMPLES // 2)


def _paths(wall: FloatArray, lasers: FloatArray, point: FloatArray) -> FloatArray:
    lengths: FloatArray = np.linalg.norm(lasers - point, axis=1) + np.linalg.norm(wall - point, axis=1)
    return lengths


def _pulse(detour: FloatArray, pulse: VirtualPulse) -> NDArray[np.complex128]:
    return np.asarray(np.exp(-(detour**2) / (2 * pulse.sigma**2) + 1j * pulse.wavenumber * detour))
