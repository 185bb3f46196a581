"""What is done to a capture before it is imaged: cutting the record, putting bins together, gating
the wall's glare, all where its signal lives; and taking pairs of a laser spot and a wall point for
confocal ones at their midpoint.

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
from numpy.linalg import norm

from nlos.capture import Capture, measure_extent
from nlos.illumination import is_confocal
from nlos.method import PhasorMethod, PhasorPlan, PlannedGeometry, Progress
from nlos.volume import Grid, Volume
from tofclip.arrays import AnyArray, Float32Array, FloatArray, IndexArray, is_numpy, namespace
from tofclip.errors import InputError, require
from tofclip.threads import split_blocks


def crop_capture(capture: Capture, nearest: float, farthest: float) -> Capture:
    """Keep the bins that hold paths from `nearest` to `farthest`, m."""
    paths = capture.axis.paths
    kept = np.flatnonzero((paths >= nearest) & (paths <= farthest))
    if kept.size < 2:
        raise InputError(
            f"fewer than two bins hold paths from {nearest:.4g} to {farthest:.4g} m; the record runs from "
            f"{paths[0]:.4g} to {paths[-1]:.4g} m"
        )
    bins = slice(int(kept[0]), int(kept[-1]) + 1)
    return replace(capture, signal=capture.signal[bins, ...], start=float(paths[bins.start]))


def rebin_capture(capture: Capture, factor: int) -> Capture:
    """Add up every `factor` neighbouring bins, less what is left over; counts stay counts. Path per
    bin of about the distance of neighbouring wall points loses nothing.
    """
    bins = capture.axis.bins // factor if factor >= 1 else 0
    if bins < 2:
        raise InputError(
            f"{capture.axis.bins} bins cannot be put together by {factor}; at least two must be left"
        )
    xp = namespace(capture.signal)
    kept = capture.signal[: bins * factor, ...]
    kept = xp.reshape(kept, (bins, factor, *kept.shape[1:]))
    # A bin stands for its middle.
    start = capture.start + (factor - 1) / 2 * capture.axis.spacing
    bin_width = factor * capture.bin_width
    return replace(capture, signal=xp.sum(kept, axis=1), bin_width=bin_width, start=start)


def remove_first_bounce(capture: Capture, margin: float, ramp: float = 0.0) -> Capture:
    """Set to 0 what arrives straight from the laser spot, after the path ``|r_L - r_p|``, and up to
    `margin` m later: the instrument's response and what the wall sends on. Signals then rise over
    `ramp` m, as a raised cosine; a sharp edge would show as a plane at half the margin.
    """
    for name, value in (("margin after the first bounce", margin), ("ramp after it", ramp)):
        require(0 <= value < np.inf, f"the {name} must be 0 m or more, got {value}")
    direct = norm(capture.wall - capture.laser, axis=-1)
    paths = capture.axis.paths.reshape(-1, *[1] * direct.ndim)
    late = paths - (direct + margin)
    early = capture.device.put(late <= 0)
    signal = namespace(capture.signal).where(early, 0.0, capture.signal)
    if ramp > 0:
        rising = (1 - np.cos(np.pi * np.clip(np.nan_to_num(late) / ramp, 0, 1))) / 2
        signal = signal * capture.device.put(rising.astype(np.float32))
    return replace(capture, signal=signal)


def flip_capture(capture: Capture, axis: str) -> Capture:
    """Mirror a capture's coordinates along an axis, and with them the picture."""
    require(axis in ("x", "y"), f"a capture is mirrored along x or y, not along '{axis}'")
    sign = np.ones(3)
    sign["xy".index(axis)] = -1.0
    return replace(capture, wall=capture.wall * sign, laser=capture.laser * sign)


def fade_record_end(capture: Capture, length: float) -> Capture:
    """Let signals fade out over a path of `length`, m, by a raised cosine: where light still comes
    at the record's end, that would show as a plane.
    """
    require(0 < length < np.inf, f"the record's end must fade over more than 0 m, got {length}")
    paths = capture.axis.paths
    weight = (1 - np.cos(np.pi * np.clip((paths[-1] - paths) / length, 0, 1))) / 2
    shape = (-1, *[1] * (capture.wall.ndim - 1))
    signal = capture.signal * capture.device.put(weight.reshape(shape).astype(np.float32))
    return replace(capture, signal=signal)


# Of the wall's width: a laser spot so near to its wall point makes a confocal pair as it is.
NEAR_LASER_FRACTION = 0.03
# So does one as near as this, if that is less than this fraction of the wall's width.
NEAR_LASER_M, MAX_NEAR_LASER_FRACTION = 0.02, 0.1
# Of the wall's width: pairs farther apart are no confocal ones, whatever is done.
MAX_OFFSET_FRACTION = 0.3
# Of the distance of neighbouring pairs, the root mean square error of the path. The shortest wave
# that a confocal scan carries is six of these distances: a phase of 0.1 rad.
MAX_PATH_ERROR_FRACTION = 0.1
# Wall widths before the wall, where hidden things may be.
SAMPLED_DEPTHS = (0.4, 0.7, 1.0)
# Wall widths beside the wall's middle.
SAMPLED_SIDES = (-0.4, 0.0, 0.4)
# Pairs whose errors are looked at.
MAX_SAMPLED_PAIRS = 500
# Pairs whose signals are read together.
PAIRS_PER_BLOCK = 256
# A bin and a weight; where they take more than this together, they are found again every time.
BYTES_PER_READING, MAX_KEPT_BYTES = 12, 1 << 28


def join_near_lasers(capture: Capture) -> Capture:
    """Take pairs of near laser spots and wall points for confocal ones at their midpoint: at
    distance R paths err by at most ``d^2 / (4 R)``, d apart; wider pairs are read at the path by
    way of the same points, see the module. The same capture where that errs too much or all are
    confocal.
    """
    return MidpointJoin(capture).join(capture)


class MidpointJoin:
    """What `join_near_lasers` does, made ready for captures of one geometry."""

    def __init__(self, capture: Capture) -> None:
        self._geometry = PlannedGeometry(capture)
        self._middle: FloatArray | None = None
        self._blocks: list[slice] = []  # of pairs whose signals are read at other paths
        self._kept: list[Readings] = []
        if capture.laser.ndim == 1 or is_confocal(capture) or len(capture.points) == 1:
            return
        extent = measure_extent(capture)
        apart = float(np.linalg.norm(capture.lasers - capture.points, axis=1).max())
        near = min(NEAR_LASER_M, MAX_NEAR_LASER_FRACTION * extent)
        middle = (capture.wall + capture.laser) / 2
        if apart <= max(NEAR_LASER_FRACTION * extent, near):
            self._middle = middle
            return
        if apart > MAX_OFFSET_FRACTION * extent or not is_numpy(capture.signal):
            return
        spacing = replace(capture, wall=middle, laser=middle).spacing
        if _find_path_error(capture) > MAX_PATH_ERROR_FRACTION * spacing:
            return
        self._middle, self._places = middle, np.flatnonzero(capture.valid)
        _, self._squared, self._along = _find_offsets(capture, slice(None))
        self._blocks = list(split_blocks(len(self._places), PAIRS_PER_BLOCK))
        if len(self._places) * capture.axis.bins * BYTES_PER_READING <= MAX_KEPT_BYTES:
            self._kept = [self._find_bins(some) for some in self._blocks]

    def join(self, capture: Capture) -> Capture:
        """Return a capture with its pairs at their midpoints, or itself; see `join_near_lasers`."""
        self._geometry.require_same(capture)
        if self._middle is None:
            return capture
        signal = self._read(capture.signal) if self._blocks else capture.signal
        return replace(capture, wall=self._middle, laser=self._middle, signal=signal)

    def _read(self, signal: AnyArray) -> Float32Array:
        """Return signals (t, ...) read at their pairs' paths, linear between bins; 0 outside."""
        read = np.zeros(signal.shape, np.float32)
        flat, recorded = (one.reshape(len(signal), -1) for one in (read, signal))
        for number, some in enumerate(self._blocks):
            before, weight = self._kept[number] if self._kept else self._find_bins(some)
            own = self._places[some]
            # Two bins of silence for what lies outside.
            block = np.concatenate([recorded[:, own], np.zeros((2, own.size), recorded.dtype)])
            first, second = block.take(before), block.take(before + own.size)
            flat[:, own] = first + weight * (second - first)
        return read

    def _find_bins(self, some: slice) -> Readings:
        """Find the bin before each reading, as a place in (t, n) signals, and the weight of the
        next.
        """
        axis = self._geometry.axis
        confocal = np.maximum(axis.paths, 0)[:, np.newaxis]
        paths = _path_of(confocal, self._squared[some], self._along[some])
        bins = (paths - axis.start) / axis.spacing
        before = np.clip(bins.astype(np.intp), 0, axis.bins - 2)
        weight = (bins - before).astype(np.float32)
        # What was not recorded is read from a row of zeros behind the last bin.
        before[(bins < 0) | (bins > axis.bins - 1)] = axis.bins
        return before * before.shape[1] + np.arange(before.shape[1]), weight


Readings = tuple[IndexArray, Float32Array]


class MidpointImaging(PhasorMethod):
    """A method that images captures whose pairs are joined by `join_near_lasers`."""

    def __init__(self, method: PhasorMethod) -> None:
        self.method = method

    def plan(self, capture: Capture, grid: Grid) -> PhasorPlan:
        join = MidpointJoin(capture)
        joined = join.join(capture)
        plan = self.method.plan(joined, grid)
        return plan if joined is capture else _MidpointPlan(capture, grid, join, plan)


class _MidpointPlan(PhasorPlan):
    """A plan for joined pairs, for captures as they come."""

    def __init__(
        self, capture: Capture, grid: Grid, join: MidpointJoin, joined: PhasorPlan
    ) -> None:
        super().__init__(capture, grid)
        self.join, self.joined = join, joined
        self.cost, self.memory_bytes = joined.cost, joined.memory_bytes

    def _field(self, capture: Capture, progress: Progress) -> Volume:
        return self.joined.field(self.join.join(capture), progress)


def _sample_space(points: FloatArray) -> FloatArray:
    """Places (n, 3) before a wall where hidden things may be, m."""
    low, high = points.min(axis=0), points.max(axis=0)
    middle, extent = (low + high) / 2, float((high - low).max())
    z, y, x = np.meshgrid(
        high[2] + extent * np.array(SAMPLED_DEPTHS),
        middle[1] + extent * np.array(SAMPLED_SIDES),
        middle[0] + extent * np.array(SAMPLED_SIDES),
        indexing="ij",
    )
    return np.stack([x, y, z], axis=-1).reshape(-1, 3)


def _find_offsets(capture: Capture, some: slice) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Midpoints (n, 3) of pairs, and the squares of half their offset, and of its part along the
    directions to hidden things on average, m^2.
    """
    middle = (capture.points[some] + capture.lasers[some]) / 2
    half = capture.lasers[some] - middle
    along = np.zeros(len(middle))
    places = _sample_space(capture.points)
    for place in places:
        direction = place - middle
        direction /= norm(direction, axis=1, keepdims=True)
        along += np.sum(half * direction, axis=1) ** 2 / len(places)
    return middle, np.sum(half**2, axis=1), along


def _find_path_error(capture: Capture) -> float:
    """Root mean square error of the path of joined pairs, m."""
    step = -(-len(capture.points) // MAX_SAMPLED_PAIRS)
    some = slice(step // 2, None, step)
    middle, squared, along = _find_offsets(capture, some)
    errors = []
    for place in _sample_space(capture.points):
        outward, back, middle_leg = (
            norm(place - spots, axis=1)
            for spots in (capture.lasers[some], capture.points[some], middle)
        )
        errors.append(_path_of(2 * middle_leg, squared, along) - outward - back)
    return float(np.sqrt(np.mean(np.square(errors))))


def _path_of(confocal: FloatArray, squared: Any, along: Any) -> FloatArray:
    """Path by way of a pair of the points that a confocal pair sees at a path, m."""
    total = 4 * squared + confocal**2
    root = np.sqrt(np.maximum(total**2 - 16 * along * confocal**2, 0))
    return np.sqrt((total + root) / 2)
