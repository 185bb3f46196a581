"""Pairs of a laser spot and a wall point as confocal ones at their midpoint.

Light by way of a hidden point at distance R from the midpoint of a pair, in direction u, takes the
path L of an ellipse with foci h before and behind the midpoint,

    R = sqrt((L^2 / 4 - h^2) / (1 - 4 (h.u)^2 / L^2)),

and by way of a confocal pair 2 R. What seismology calls normal moveout reads every record at L
instead of 2 R. The direction is not known; its mean over the space before the wall takes its place.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nlos.capture import Capture
from nlos.geometry import FloatArray, Grid
from nlos.illumination_groups import is_confocal
from nlos.method import PhasorMethod, PhasorPlan, Progress
from nlos.volume import Volume
from tofclip.arrays import is_numpy
from tofclip.threads import split_blocks

NEAR_LASER_FRACTION = 0.03
"""Of the wall's width: a laser spot so near to its wall point makes a confocal pair as it is."""

NEAR_LASER_M, MAX_NEAR_LASER_FRACTION = 0.02, 0.1
"""So does one as near as this, if that is less than this fraction of the wall's width."""

MAX_OFFSET_FRACTION = 0.3
"""Of the wall's width: pairs farther apart are no confocal ones, whatever is done."""

MAX_PATH_ERROR_FRACTION = 0.1
"""Of the distance of neighbouring pairs, the root mean square error of the path. The shortest wave
that a confocal scan carries is six of these distances: a phase of 0.1 rad."""

SAMPLED_DEPTHS = (0.4, 0.7, 1.0)
"""Wall widths before the wall, where hidden things may be."""

SAMPLED_PLACES = (-0.4, 0.0, 0.4)
"""Wall widths beside the wall's middle."""

MAX_SAMPLED_PAIRS = 500
"""Pairs whose errors are looked at."""

PAIRS_PER_BLOCK = 256
"""Pairs whose signals are read together."""


def join_near_lasers(capture: Capture) -> Capture:
    """Take pairs of a laser spot and a wall point close by for confocal ones at their midpoint.

    The path by way of a point at distance R then errs by at most ``d^2 / (4 R)``, d the distance of
    the two: 0.1 mm for 15 mm and half a metre. Where pairs are farther apart, signals are read at
    the path that leads by way of the same points; see the module.

    Parameters
    ----------
    capture : Capture

    Returns
    -------
    Capture
        The same one where pairs are so far apart that the path would err too much, or all are
        confocal already.
    """
    if capture.laser.ndim == 1 or is_confocal(capture) or len(capture.points) == 1:
        return capture
    extent = float(np.ptp(capture.points, axis=0).max())
    apart = float(np.linalg.norm(capture.lasers - capture.points, axis=1).max())
    near = min(NEAR_LASER_M, MAX_NEAR_LASER_FRACTION * extent)
    middle = (capture.wall + capture.laser) / 2
    if apart <= max(NEAR_LASER_FRACTION * extent, near):
        return replace(capture, wall=middle, laser=middle)
    if apart > MAX_OFFSET_FRACTION * extent or not is_numpy(capture.signal):
        return capture
    joined = replace(capture, wall=middle, laser=middle)
    if _find_path_error(capture) > MAX_PATH_ERROR_FRACTION * joined.spacing:
        return capture
    return replace(joined, signal=_apply_moveout(capture))


class MidpointImaging(PhasorMethod):
    """A method that images captures whose pairs are joined by `join_near_lasers`, for captures as
    they come.

    Parameters
    ----------
    method : PhasorMethod
    """

    def __init__(self, method: PhasorMethod) -> None:
        self.method = method

    def plan(self, capture: Capture, grid: Grid) -> PhasorPlan:
        """Make the method ready for captures like `capture` on `grid`; see `Method.plan`.

        Parameters
        ----------
        capture : Capture
        grid : Grid

        Returns
        -------
        PhasorPlan

        Raises
        ------
        InputError
            The method cannot image such a capture on the grid.
        """
        joined = join_near_lasers(capture)
        plan = self.method.plan(joined, grid)
        return plan if joined is capture else _MidpointPlan(capture, grid, plan)


class _MidpointPlan(PhasorPlan):
    """A plan for joined pairs, for captures as they come."""

    def __init__(self, capture: Capture, grid: Grid, joined: PhasorPlan) -> None:
        super().__init__(capture, grid)
        self.joined = joined

    @property
    def cost(self) -> int:
        return self.joined.cost

    @property
    def memory_bytes(self) -> int:
        return self.joined.memory_bytes

    def _field(self, capture: Capture, progress: Progress) -> Volume:
        return self.joined.field(join_near_lasers(capture), progress)


def _sample_space(points: FloatArray) -> FloatArray:
    """Places (n, 3) before a wall where hidden things may be, m."""
    low, high = points.min(axis=0), points.max(axis=0)
    middle, extent = (low + high) / 2, float((high - low).max())
    z, y, x = np.meshgrid(
        high[2] + extent * np.array(SAMPLED_DEPTHS),
        middle[1] + extent * np.array(SAMPLED_PLACES),
        middle[0] + extent * np.array(SAMPLED_PLACES),
        indexing="ij",
    )
    return np.stack([x, y, z], axis=-1).reshape(-1, 3)


def _find_offsets(capture: Capture, some: slice) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Midpoints (n, 3) of some pairs, and of each the squares of half its laser's offset and of
    that offset's part along the directions to hidden things, on average, m^2.
    """
    middle = (capture.points[some] + capture.lasers[some]) / 2
    half = capture.lasers[some] - middle
    along = np.zeros(len(middle))
    places = _sample_space(capture.points)
    for place in places:
        direction = place - middle
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        along += np.sum(half * direction, axis=1) ** 2 / len(places)
    return middle, np.sum(half**2, axis=1), along


def _find_path_error(capture: Capture) -> float:
    """Root mean square error of the path of joined pairs, m."""
    step = -(-len(capture.points) // MAX_SAMPLED_PAIRS)
    some = slice(step // 2, None, step)
    middle, squared, along = _find_offsets(capture, some)
    errors = []
    for place in _sample_space(capture.points):
        outward, back, way = (
            np.linalg.norm(place - spots, axis=1)
            for spots in (capture.lasers[some], capture.points[some], middle)
        )
        errors.append(_path_of(2 * way, squared, along) - outward - back)
    return float(np.sqrt(np.mean(np.square(errors))))


def _path_of(confocal: FloatArray, squared: Any, along: Any) -> FloatArray:
    """Path by way of a pair of the points that a confocal pair sees at a path, m."""
    total = 4 * squared + confocal**2
    root = np.sqrt(np.maximum(total**2 - 16 * along * confocal**2, 0))
    return np.asarray(np.sqrt((total + root) / 2))


def _apply_moveout(capture: Capture) -> NDArray[np.float32]:
    """Read every valid signal at the path of its pair; linear between bins, (t, ...)."""
    _, squared, along = _find_offsets(capture, slice(None))
    axis, places = capture.axis, np.flatnonzero(capture.valid)
    signal = np.zeros(capture.signal.shape, np.float32)
    flat, recorded = (one.reshape(axis.bins, -1) for one in (signal, capture.signal))
    confocal = np.maximum(axis.paths, 0)[:, np.newaxis]
    for some in split_blocks(len(places), PAIRS_PER_BLOCK):
        own = places[some]
        bins = (_path_of(confocal, squared[some], along[some]) - axis.start) / axis.spacing
        before = np.clip(bins.astype(np.int64), 0, axis.bins - 2)
        weight = (bins - before).astype(np.float32)
        first, second = recorded[before, own], recorded[before + 1, own]
        inside = (bins >= 0) & (bins <= axis.bins - 1)
        flat[:, own] = np.where(inside, first + weight * (second - first), 0)
    return signal
