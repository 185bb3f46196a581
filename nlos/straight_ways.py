"""The straight ways from wall points to voxels, and where they cross a plane between the two.

What a virtual plane carries to a voxel comes from about these crossings: elsewhere the phases of
both parts of the way turn, and their sum cancels.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nlos.geometry import Grid
from nlos.plane import VirtualPlane

MIN_WALL_FRACTION, WALL_FRACTION_PER_DIGIT = 0.1, 0.2
"""Of the longest way, what a window about wall points holds at least, and how much more for each
digit of the tolerance: where the plane stands close to the wall, crossings are wide beside their
distance. Measured; errors of 1e-2 and 1e-3 ask for 0.5 and 0.7.
"""


@dataclass(frozen=True)
class StraightWays:
    """How far across straight ways lead before and behind a virtual plane.

    Parameters
    ----------
    wall_to_plane, plane_to_voxels : float
        Along the plane, at most, m; with room about the crossings.
    rim : (float, float)
        Width along y and x of the plane's rim, where less than half of the field is left, m.
    first_depth : float
        z of the nearest voxels, m.
    """

    wall_to_plane: float
    plane_to_voxels: float
    rim: tuple[float, float]
    first_depth: float

    @classmethod
    def find(
        cls, points: NDArray[np.float64], plane: VirtualPlane, grid: Grid, tolerance: float
    ) -> StraightWays | None:
        """Find the straight ways between wall points and voxels through a plane.

        Parameters
        ----------
        points : (n, 3) float64 array
            Of the wall, m.
        plane : VirtualPlane
            In front of them.
        grid : Grid
        tolerance : float
            Relative error allowed.

        Returns
        -------
        StraightWays or None
            None where voxels lie before the plane: no straight way to these crosses it.
        """
        first, last = float(grid.z[0]), float(grid.z[-1])
        if first <= plane.z:
            return None
        low, high = points.min(axis=0), points.max(axis=0)
        longest = np.hypot(
            max(grid.x[-1] - low[0], high[0] - grid.x[0]),
            max(grid.y[-1] - low[1], high[1] - grid.y[0]),
        )
        # Ways to the nearest voxels from the hindmost points cross the plane latest, those to the
        # farthest voxels from the foremost points soonest.
        before = (plane.z - low[2]) / (first - low[2])
        behind = (last - plane.z) / (last - high[2])
        room = MIN_WALL_FRACTION + WALL_FRACTION_PER_DIGIT * np.log10(1 / tolerance)
        fade_y, fade_x = plane.fade
        return cls(
            float(max(before, room) * longest),
            float(behind * longest),
            (fade_y / 2, fade_x / 2),
            first,
        )
