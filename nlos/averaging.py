"""Hidden volumes of a moving scene, averaged over more captures the farther away they lie."""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

from nlos.geometry import Grid
from nlos.volume import Volume
from tofclip.arrays import Array
from tofclip.errors import InputError


class DepthAverage:
    """A running mean of fields, over a number of captures that grows with depth.

    Light of a hidden thing falls with the fourth power of its distance, so that what is far is
    noisy, and what is resolved grows with the distance, so that a moving thing stays as long within
    its own image: captures are averaged in proportion to the distance from the wall. Nam et al.,
    "Low-latency time-of-flight non-line-of-sight imaging at 5 frames per second", Nat. Commun. 12,
    6526 (2021).

    `grid`: of the fields; `wall`: z from which depths count, m; `captures`: how many are averaged
    at the last depth; nearer by at least the newest alone.
    """

    def __init__(self, grid: Grid, wall: float, captures: int) -> None:
        if captures < 1:
            raise InputError(f"an average is over 1 capture or more, got {captures}")
        depth = np.maximum(grid.z - wall, 0)
        farthest = max(float(depth[-1]), np.finfo(float).tiny)
        self._windows = np.maximum(np.rint(captures * depth / farthest), 1).astype(int)
        self._latest: deque[Array] = deque(maxlen=captures)

    @property
    def windows(self) -> NDArray[np.int_]:
        """Captures that are averaged at every depth, (z,)."""
        return self._windows

    def add(self, field: Volume) -> Volume:
        """Take the field of a new capture, and return the image of the average.

        `field`: complex, as of `PhasorPlan.field`. Returns brightness, real and not negative,
        float32. Of a stream's first captures it holds those that there are.
        """
        self._latest.append(field.values)
        newest_first = list(self._latest)[::-1]
        brightness = np.empty(field.values.shape, np.float32)
        # Windows grow with depth: each is a block of depths.
        begins = np.flatnonzero(np.diff(self._windows, prepend=0))
        for begin, end in zip(begins, [*begins[1:], len(self._windows)], strict=True):
            some = newest_first[: self._windows[begin]]
            total = some[0][begin:end]
            for other in some[1:]:
                total = total + other[begin:end]
            brightness[begin:end] = np.abs(total) / len(some)
        return Volume(brightness, field.grid, field.provenance)
