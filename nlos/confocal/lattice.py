"""Wall points that fill an evenly spaced lattice on a plane, in whatever order they were scanned."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nlos.geometry import FloatArray
from nlos.plane import evenly_spaced, step

OFF_LATTICE = 0.02
"""Points may be off the lattice by this fraction of its step."""


@dataclass(frozen=True, eq=False)
class Lattice:
    """The product of two evenly spaced axes on a plane of constant z.

    Parameters
    ----------
    x, y : (n,) array
        Increasing coordinates, m; at least 2 of each.
    z : float
        The plane, m.
    order : (points,) int array
        Sorts the points into rows of growing y, each of growing x.
    """

    x: FloatArray
    y: FloatArray
    z: float
    order: NDArray[np.intp]

    @classmethod
    def of(cls, points: FloatArray) -> Lattice | None:
        """Find the lattice that points (n, 3) fill, each place once; None where they do not."""
        x, y = (_levels(points[:, i]) for i in (0, 1))
        if x.size * y.size != len(points) or min(x.size, y.size) < 2:
            return None
        if not (evenly_spaced(x) and evenly_spaced(y)):
            return None
        column, row = (np.rint((points[:, i] - a[0]) / step(a)).astype(np.intp) for i, a in ((0, x), (1, y)))
        place = row * x.size + column
        order = np.argsort(place, kind="stable")
        filled = np.array_equal(place[order], np.arange(len(points)))
        flat = np.ptp(points[:, 2]) <= OFF_LATTICE * min(step(x), step(y))
        return cls(x, y, float(points[:, 2].mean()), order) if filled and flat else None

    @property
    def steps(self) -> tuple[float, float]:
        """Distance of neighbouring points along y and x, m."""
        return step(self.y), step(self.x)

    def row(self, y: FloatArray) -> FloatArray:
        """Fractional row at coordinates y, m."""
        return np.asarray((y - self.y[0]) / step(self.y))

    def column(self, x: FloatArray) -> FloatArray:
        """Fractional column at coordinates x, m."""
        return np.asarray((x - self.x[0]) / step(self.x))


def _levels(values: FloatArray) -> FloatArray:
    """Distinct coordinates: the means of runs that lie much closer together than the runs do."""
    ordered = np.sort(values)
    gaps = np.diff(ordered)
    if gaps.size == 0 or gaps.max() == 0:
        return ordered[:1]
    starts = np.flatnonzero(np.concatenate([[True], gaps > 2 * OFF_LATTICE * gaps.max()]))
    means: FloatArray = np.add.reduceat(ordered, starts) / np.diff(np.append(starts, ordered.size))
    return means
