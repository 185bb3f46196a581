"""Recognising a planar wall of evenly spaced points, in whatever order they are listed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nlos.plane import EVENNESS, Plane
from tofclip.errors import InputError

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class PlanarWall:
    """Wall points as a lattice of a plane; places where no point is known stay dark.

    Parameters
    ----------
    plane : Plane
    row, column : (points,) int array
        Place of every wall point.
    """

    plane: Plane
    row: NDArray[np.intp]
    column: NDArray[np.intp]

    @classmethod
    def of(cls, points: FloatArray) -> PlanarWall:
        """Find the lattice that wall points (n, 3) stand on.

        Raises
        ------
        InputError
            They stand on none, or not on a plane z = const.
        """
        x, column = _lattice(points[:, 0], "x")
        y, row = _lattice(points[:, 1], "y")
        depth = float(points[:, 2].mean())
        relief = float(np.ptp(points[:, 2]))
        finest = min(float(x[1] - x[0]), float(y[1] - y[0]))
        if relief > 2 * EVENNESS * finest:
            raise InputError(
                f"the wall is not a plane z = const: it is {relief:.3g} m deep; use the hybrid method, which carries "
                "its signals onto one"
            )
        return cls(Plane(x, y, depth), row, column)

    def field(self, phasors: NDArray[np.complex64]) -> NDArray[np.complex64]:
        """Put phasors (points, frequencies) into their places, shape (y, x, frequencies)."""
        values = np.zeros((*self.plane.shape, phasors.shape[1]), np.complex64)
        values[self.row, self.column] = phasors
        return values


def _lattice(coordinates: FloatArray, name: str) -> tuple[FloatArray, NDArray[np.intp]]:
    """Even axis that all coordinates lie on, and the place of each."""
    ordered = np.sort(coordinates)
    gaps = np.diff(ordered)
    steps = int(np.count_nonzero(gaps > gaps.max() / 2)) if gaps.size else 0
    if steps == 0:
        raise InputError(f"the wall's points need at least two different {name}")
    axis = np.linspace(ordered[0], ordered[-1], steps + 1)
    place = np.rint((coordinates - axis[0]) / (axis[1] - axis[0])).astype(np.intp)
    if np.max(np.abs(coordinates - axis[place])) > EVENNESS * (axis[1] - axis[0]):
        raise InputError(
            f"the wall's points are not evenly spaced along {name}; use the hybrid method, which takes them as they are"
        )
    return axis, place
