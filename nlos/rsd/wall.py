"""Recognising a planar wall of evenly spaced points, in whatever order they are listed."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nlos.plane import EVENNESS_TOLERANCE, Plane
from tofclip.errors import InputError

FloatArray = NDArray[np.float64]

SAME_COORDINATE_FRACTION = 0.02
"""Coordinates nearer to each other than this fraction of the widest gap are one."""


@dataclass(frozen=True, eq=False)
class WallLattice:
    """Wall points above the places of an even lattice, at whatever depth; some places may stay
    empty.

    Parameters
    ----------
    x, y : (n,) array
        Coordinates of the places, m.
    row, column : (points,) int array
        Place of every wall point.
    """

    x: FloatArray
    y: FloatArray
    row: NDArray[np.intp]
    column: NDArray[np.intp]

    @classmethod
    def of(cls, points: FloatArray, evenness: float = EVENNESS_TOLERANCE) -> WallLattice:
        """Find the lattice that wall points (n, 3) stand above; they may be off it by a fraction of
        its step.

        Parameters
        ----------
        points : (n, 3) float64 array
            Metres.
        evenness : float
            How far off its place a point may be, in steps of the lattice.

        Returns
        -------
        WallLattice

        Raises
        ------
        InputError
            There is none, or two points stand in one place.
        """
        x, column = _fit_lattice_axis(points[:, 0], "x", evenness)
        y, row = _fit_lattice_axis(points[:, 1], "y", evenness)
        places = row * x.size + column
        # Points are mostly listed in order, which tells without sorting that none stands twice.
        if not np.all(np.diff(places) > 0) and not np.all(np.diff(np.sort(places)) > 0):
            raise InputError(
                "two wall points stand in one place; use the hybrid method, which takes them as they are"
            )
        return cls(x, y, row, column)

    @property
    def shape(self) -> tuple[int, int]:
        """Places along (y, x)."""
        return self.y.size, self.x.size

    @cached_property
    def is_complete(self) -> bool:
        """Whether the points are all places in C order."""
        places = self.row * self.x.size + self.column
        return places.size == self.x.size * self.y.size and bool(np.all(np.diff(places) == 1))

    @cached_property
    def point_numbers(self) -> NDArray[np.intp]:
        """Number of the wall point in every place, in C order; one too many where none stands."""
        occupants = np.full(self.x.size * self.y.size, self.row.size)
        occupants[self.row * self.x.size + self.column] = np.arange(self.row.size)
        return occupants

    def place(self, samples: NDArray[Any]) -> NDArray[Any]:
        """Put phasors (points, frequencies), or signals (points, t), into their places, shape (y,
        x, ...); places without a point are 0.
        """
        if self.is_complete:
            return samples.reshape(*self.shape, -1)
        values = np.zeros((*self.shape, samples.shape[1]), samples.dtype)
        values[self.row, self.column] = samples
        return values


@dataclass(frozen=True, eq=False)
class PlanarWall:
    """Wall points as a lattice of a plane; places where no point is known stay dark.

    Parameters
    ----------
    plane : Plane
    lattice : WallLattice
    """

    plane: Plane
    lattice: WallLattice

    @classmethod
    def of(cls, points: FloatArray, evenness: float = EVENNESS_TOLERANCE) -> PlanarWall:
        """Find the lattice that wall points (n, 3) stand on; they may be off it by a fraction of
        its step.

        Parameters
        ----------
        points : (n, 3) float64 array
            Metres.
        evenness : float
            How far off its place a point may be, in steps of the lattice.

        Returns
        -------
        PlanarWall

        Raises
        ------
        InputError
            They stand on none, or not on a plane z = const.
        """
        lattice = WallLattice.of(points, evenness)
        plane = Plane(lattice.x, lattice.y, float(points[:, 2].mean()))
        relief = float(np.ptp(points[:, 2]))
        if relief > 2 * evenness * min(plane.steps):
            raise InputError(
                f"the wall is not a plane z = const: it is {relief:.3g} m deep; use the hybrid method, which carries "
                "its signals onto one"
            )
        return cls(plane, lattice)


def _fit_lattice_axis(
    coordinates: FloatArray, name: str, evenness: float
) -> tuple[FloatArray, NDArray[np.intp]]:
    """Even axis that all coordinates lie on, and the place of each."""
    ordered = np.sort(coordinates)
    gaps = np.diff(ordered)
    # Points of one column differ by far less than columns, even where some columns between are
    # missing.
    apart = gaps[gaps > SAME_COORDINATE_FRACTION * gaps.max(initial=0)]
    if apart.size == 0:
        raise InputError(f"the wall's points need at least two different {name}")
    steps = round(float((ordered[-1] - ordered[0]) / np.median(apart)))
    axis = np.linspace(ordered[0], ordered[-1], steps + 1)
    place = np.rint((coordinates - axis[0]) / (axis[1] - axis[0])).astype(np.intp)
    if np.max(np.abs(coordinates - axis[place])) > evenness * (axis[1] - axis[0]):
        raise InputError(
            f"the wall's points are not evenly spaced along {name}; use the hybrid method, which takes them as they are"
        )
    return axis, place
