"""Shot after shot to cloud after cloud: what does not change from shot to shot is worked out once, and
pictures of a method with a prior, or surfaces, begin at what the last shot showed.

From one shot to the next little changes but the noise. Iterations that begin at the last shot's
pictures need a few steps where those that begin in darkness need forty. Operators and inverted matrices
of a camera are made once in a process; operators are known by what they project: two shots whose files
carry the same camera share its own.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property, lru_cache, partial
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import DTypeLike

from tofclip.arrays import BoolArray, Float32Array, FloatArray
from tofclip.camera import Camera, Rectifier
from tofclip.errors import require_shape
from tofclip.lidar import PointCloud, point_cloud
from tofclip.lidar.pulse import PictureTraces, TraceBins, Traces
from tofclip.lidar.search import ReturnSearch, keep_probable
from tofclip.lidar.signal_rows import RowBlock, SignalRowFinder
from tofclip.operators import LinearOperator, LineProjection
from tofclip.recovery import (
    DepthLockedFocus,
    Focus,
    Shot,
    SurfaceRecovery,
    open_shot,
    plan_recovery,
)
from tofclip.recovery.defects import estimate_noise
from tofclip.recovery.shot import DEFAULT_FOCUS, count_needless_rows
from tofclip.recovery.surfaces.fit import SurfaceFit, fit_surfaces, follow_surfaces
from tofclip.recovery.surfaces.returns import list_returns
from tofclip.sequences.counting import StillSum
from tofclip.shots import Returns, Streak
from tofclip.solvers import LinearInverse, PreparedInverse, ProximalMethod, Sparse
from tofclip.solvers.direct import InverseTraces, order_by_patch

__all__ = ["RangingPipeline", "build_cloud_path"]

# Of each shot but the first, which has the method's own number. Of a moving scene's points, with 300
# photons in the brightest pixel, 17 % are false after 4, 9 % after 8, 5 % after 12 (the linear
# inverse: 27 %), and 3 % after 16, in half as much time again.
WARM_ITERATIONS = 12
# Of a piece of the streak image that is averaged as far as nothing changes in it: rows in widths of
# the pulse, and columns. Smaller ones have too few photons to show a change.
STILL_WIDTHS, STILL_COLUMNS = 2.0, 4

# Frames at more shears than that make the further operators anew. Twice as many operators, so that
# one whose inverse is kept is kept as well.
MAX_CACHED_INVERSES, MAX_CACHED_OPERATORS = 16, 32

_inverse_lock = Lock()


class _CachedCamera(Camera):
    """A camera that is equal to others that project alike, with which it shares operators. Memory:
    for each of the operators 16 bytes for each of ``views * rows * columns * 2`` entries.
    """

    @cached_property
    def _projection(self) -> tuple[Any, ...]:
        lines = self.centres_px, self.angles, self.gains, self.view_positions
        return self.image_shape, self.slit_width_px, *(one.tobytes() for one in lines)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _CachedCamera) and self._projection == other._projection

    def __hash__(self) -> int:
        return hash(self._projection)

    def operator(self, shear: float = 0.0, dtype: DTypeLike = np.float32) -> LineProjection:
        """Return F(d), see `Camera.operator`; the same object for the same arguments."""
        return _make_operator(self, float(shear), np.dtype(dtype).str)


@lru_cache(maxsize=MAX_CACHED_OPERATORS)
def _make_operator(camera: _CachedCamera, shear: float, dtype: str) -> LineProjection:
    return Camera.operator(camera, shear, dtype)


def get_cached_camera(camera: Camera) -> Camera:
    """Return the camera with the operators that this process has kept of its content."""
    return _CachedCamera(**{one.name: getattr(camera, one.name) for one in fields(camera)})


@dataclass(frozen=True, repr=False)
class CachedInverse(LinearInverse):
    """The linear inverse, whose Gram matrices are inverted once for each operator of a camera that
    `get_cached_camera` returned; another one is not found again. The 16 used last are kept.
    """

    def __repr__(self) -> str:
        return repr(LinearInverse(self.damping))  # results say what was done, not what was kept

    def prepare(self, operator: LinearOperator, alive: BoolArray | None = None) -> PreparedInverse:
        """Do as `LinearInverse.prepare`; the same object for the same arguments."""
        known = np.ones(operator.shape_out, bool) if alive is None else alive
        with _inverse_lock:  # threads that ask at the same time wait for a single preparation
            return _prepare(self.damping, operator, known.tobytes())


@lru_cache(maxsize=MAX_CACHED_INVERSES)
def _prepare(damping: float, operator: Any, alive: bytes) -> PreparedInverse:
    return LinearInverse(damping).prepare(operator, np.frombuffer(alive, bool))


class WarmStartedRecovery:
    """Recovers the rows of a shot that hold light, beginning at the same rows of the shot before.

    Shots are taken one after the other, each with all cores: what comes out of a shot depends on
    those before it, and only on them. The method's iterations are the first shot's. `places`: rows,
    and the operator of their shear; slit columns that are not `alive` are never trusted.
    """

    def __init__(
        self,
        method: ProximalMethod,
        places: Sequence[tuple[slice, LinearOperator]],
        alive: BoolArray,
    ) -> None:
        self.method, self._places, self._alive = method, places, alive
        # so few iterations end before the gap is looked at
        self._warm = replace(method, iterations=WARM_ITERATIONS, gap=0.0)
        self._rows = np.zeros(0, np.int64)
        self._pictures = np.zeros((0, *places[0][1].shape_in), np.float32)

    def recover(self, measurements: Float32Array, bins: TraceBins) -> PictureTraces:
        """Recover some rows of a shot from their rectified measurements (columns, bins); those of
        which one stands for several are dark, and stay so.
        """
        lit = bins.bin_weights == 1
        rows = bins.numbers[lit]
        seen = np.ascontiguousarray(measurements[:, lit])
        found = np.zeros((rows.size, *self._pictures.shape[1:]), np.float32)
        shared, here, before = np.intersect1d(rows, self._rows, True, return_indices=True)
        found[here] = self._pictures[before]
        for place, operator in self._places:
            own = slice(*np.searchsorted(rows, [place.start, place.stop]))
            if own.start < own.stop:
                part, alive = seen[:, own], self._alive[:, np.newaxis]
                valid = None if alive.all() else np.repeat(alive, part.shape[1], axis=1)
                # of rows that were dark before nothing is known: as many iterations as at first
                known = np.isin(rows[own], shared).any()
                method, start = (self._warm, found[own]) if known else (self.method, None)
                found[own] = method.recover(operator, part, valid, start=start).frames
        self._rows, self._pictures = rows, found
        pictures = np.zeros((bins.numbers.size, *found.shape[1:]), np.float32)
        pictures[lit] = found
        return PictureTraces(pictures, bins)


class SurfacePipeline:
    """Makes clouds of shots of one camera by method "surfaces".

    The first shot has its surfaces found. Each further one begins at the surfaces, brightnesses and
    state of the instrument of the shot before, and needs a step on them and twenty iterations. Where
    they no longer explain the shot, as when something moves, it begins at what `RangingPipeline` shows
    by method l1, which follows pictures. Shots are taken in order.

    Memory: as `SurfaceRecovery` and `RangingPipeline`.
    """

    in_order, method_name = True, SurfaceRecovery.name

    def __init__(self, shot: Shot, method: SurfaceRecovery | None = None) -> None:
        self.method = SurfaceRecovery() if method is None else method
        self.camera = shot.camera
        # rows of a stream are added up like the first shot's: surfaces are followed from shot to shot
        self._rows_in_one, self._opened = count_needless_rows(shot), shot
        self.searches = 0  # for surfaces, in a shot that those of the one before do not explain
        self._fit: SurfaceFit | None = None
        self._lock = Lock()
        self._focus = DepthLockedFocus() if self.camera.lenslet_pitch > 0 else DEFAULT_FOCUS
        self._quick: RangingPipeline | None = None

    @classmethod
    def for_shot(
        cls,
        shot: Streak,
        camera: Path | Camera | None = None,
        time_zero: float | None = None,
        method: SurfaceRecovery | None = None,
    ) -> SurfacePipeline:
        """Prepare for shots like this one; see `RangingPipeline.for_shot`."""
        return cls(open_shot(shot, camera, time_zero).fit_camera(), method)

    def rectify(self, shot: Streak) -> Streak:
        """Do nothing: surfaces explain the raw image."""
        return shot

    def recover(self, shot: Streak) -> SurfaceFit:
        """Fit the surfaces of a shot."""
        opened = replace(self._opened, streak=shot).merge_rows(self._rows_in_one)
        shot = opened.streak
        with self._lock:
            if self._fit is not None:
                look = partial(self._look, opened)
                self._fit = follow_surfaces(self._fit, shot, self.method.weight, look)
            if self._fit is None:
                self.searches += 1
                start = plan_recovery(opened, self.method.start, self._focus).run()
                weight, iterations = self.method.weight, self.method.iterations
                self._fit = fit_surfaces(shot, start, weight, iterations)
            return self._fit

    def _look(self, opened: Shot) -> tuple[Returns, Float32Array]:
        """Return what l1 shows of a shot: its returns, and the light of each pixel."""
        self.searches += 1
        shot = opened.streak
        if self._quick is None:
            camera = opened.camera.replace(range_calibration=None)
            self._quick = RangingPipeline(camera, shot.times, Sparse(), self._focus)
        seen = self._quick.recover(self._quick.rectify(shot))
        assert isinstance(seen, PictureTraces)
        return self._quick.search(seen), seen.pictures.sum(axis=0)

    def search(self, found: SurfaceFit) -> Returns:
        """List the returns of what `recover` returned."""
        calibrated_px = self._opened.calibrated_px
        returns = keep_probable(list_returns(found, self.method.detection, calibrated_px))
        # a sweep is that of the shot's own rows
        return replace(returns, camera=returns.camera.replace(sweep=self.camera.sweep))


class StillAverage:
    """Averages streak images with those before, piece by piece, as far as nothing changes there: a shot
    of few photons sees as far as one of many, and what moves stays sharp.

    `first`: counts (rows, columns), which know the noise; `pulse_rows`: rows of a pulse's width;
    `most`: shots that are averaged at most. Memory: three such images.
    """

    def __init__(self, first: Float32Array, pulse_rows: float, most: int) -> None:
        self._dark, floor, self._gain = estimate_noise(first)
        # photons, and as many besides as would scatter like a dark measurement
        self._offset = (floor / self._gain) ** 2
        height, width = self._sides = max(round(STILL_WIDTHS * pulse_rows), 1), STILL_COLUMNS
        down, across = (-(-n // side) for n, side in zip(first.shape, self._sides, strict=True))
        self._sum = StillSum(down * across, height * width, height * width, most)

    def add(self, counts: Float32Array) -> Float32Array:
        """Return the average of the newest image with those before."""
        (rows, columns), (height, width) = counts.shape, self._sides
        padded = np.pad(
            (counts - self._dark) / self._gain + self._offset,
            [(0, -rows % height), (0, -columns % width)],
        )
        pieces = padded.reshape(-(-rows // height), height, -(-columns // width), width)
        pieces = pieces.swapaxes(1, 2)
        still = self._sum.add(pieces.reshape(-1, height * width).astype(np.float32))
        mean = self._sum.average(still).reshape(pieces.shape).swapaxes(1, 2).reshape(padded.shape)
        inside = mean[:rows, :columns]
        return np.asarray((inside - self._offset) * self._gain + self._dark, np.float32)


class ChangedPipeline:
    """Makes clouds of streak images whose counts are changed first, as by `StillAverage`."""

    def __init__(
        self,
        pipeline: RangingPipeline | SurfacePipeline,
        changes: Sequence[Callable[[Float32Array], Float32Array]],
        in_order: bool,
    ) -> None:
        self._rectify, self._changes, self.in_order = pipeline.rectify, changes, in_order
        self.camera, self.method_name = pipeline.camera, pipeline.method_name
        self.recover: Callable[[Any], Any] = pipeline.recover
        self.search: Callable[[Any], Returns] = pipeline.search

    def change(self, shot: Streak) -> Streak:
        """Return a shot with the counts that are recovered."""
        for change in self._changes:
            shot = replace(shot, counts=change(shot.counts))
        return shot

    def rectify(self, shot: Streak) -> Any:
        """Change a shot, and do what can be done before anything is recovered."""
        return self._rectify(self.change(shot))


class RangingPipeline:
    """Makes clouds of shots of one camera, by the linear inverse or by a method with a prior.

    A prior (l1) begins at the pictures of the shot before and takes its shots in order
    (`tofclip.sequences.ranger`). The linear inverse needs no iterations and knows nothing of the
    shots before; it draws streaks ("rays") around bright objects.

    Sweep, operators, inverted Gram matrices and filters are worked out once. No transient cube is
    made: pixels are recovered a few at a time, and their returns are sought at once
    (`tofclip.solvers.direct`). Rows that hold no light are left out, but for a sample that tells
    background and noise (`tofclip.lidar.signal_rows`).

    `camera`: with its sweep; `row_times` (rows,): instant of each row, s; `method`: the linear
    inverse by default; `focus`: one that needs no look at the shot: `FixedFocus` or
    `DepthLockedFocus`.

    Memory: two (columns, columns) matrices for each shear, and for a shot as much again as its
    measurements; with a prior, four times the pictures of all rows that hold light.
    """

    def __init__(
        self,
        camera: Camera,
        row_times: FloatArray,
        method: LinearInverse | ProximalMethod | None = None,
        focus: Focus = DEFAULT_FOCUS,
    ) -> None:
        focus.check_camera(camera)
        self.method = LinearInverse() if method is None else method
        self.method_name = self.method.name
        # Rows with light are told by the filter matched to the operator, whatever recovers them.
        own = self.method if isinstance(self.method, LinearInverse) else LinearInverse()
        inverse = CachedInverse(own.damping)
        self.camera = camera
        self.times = np.asarray(row_times, dtype=np.float64) - camera.time_zero
        self.rectifier = Rectifier(camera, self.times.size)
        pieces = focus.plan_segments(camera, self.times)
        cached = get_cached_camera(camera)
        alive, self.pixels = ~camera.dead_columns, order_by_patch(camera.image_shape)
        operators = [cached.operator(piece.shear) for piece in pieces]
        self.places = [
            RowBlock(piece.frames, InverseTraces(inverse.prepare(operator, alive), self.pixels))
            for piece, operator in zip(pieces, operators, strict=True)
        ]
        self._warm_start: WarmStartedRecovery | None = None
        if isinstance(self.method, ProximalMethod):
            rows = [piece.frames for piece in pieces]
            places = list(zip(rows, operators, strict=True))
            self._warm_start = WarmStartedRecovery(self.method, places, alive)
        shears = np.repeat([piece.shear for piece in pieces], [piece.size for piece in pieces])
        self._search = ReturnSearch(camera, self.times, shears=shears)
        # mean duration of a row: the sweep is nearly even
        row = float(self.times[-1] - self.times[0]) / (self.times.size - 1)
        limit, width = self._search.detection.signal_to_noise, self._search.pulse.fwhm / row
        self._lit = SignalRowFinder(self.places, width, limit, self._search.reach_bins)

    @classmethod
    def for_shot(
        cls,
        shot: Streak,
        camera: Path | Camera | None = None,
        focus: Focus = DEFAULT_FOCUS,
        time_zero: float | None = None,
        method: LinearInverse | ProximalMethod | None = None,
    ) -> RangingPipeline:
        """Prepare for shots like this one, which has a time axis; a sweep that is not known is found
        from it. Camera and time zero, s, are by default those that the shot carries.
        """
        opened = open_shot(shot, camera, time_zero)
        focus.check_camera(opened.camera)
        return cls(opened.fit_camera().camera, shot.times, method, focus)

    @property
    def in_order(self) -> bool:
        """Whether what comes out of a shot depends on those before it."""
        return self._warm_start is not None

    def rectify(self, shot: Streak) -> Float32Array:
        """Return a shot's measurements, (columns, rows)."""
        return self.rectifier.rectify(shot.counts)

    def recover(self, measurements: Float32Array) -> Traces:
        """Do what a shot, (columns, rows), rectified, needs as a whole before its pixels are
        recovered, a few at a time, as they are asked for.
        """
        expected = self.camera.slit_width_px, self.times.size
        require_shape("measurements", expected, measurements.shape)
        bins = self._lit.bins(measurements)
        # by rows, which is how measurements lie in memory
        held = np.take(measurements.T, bins.numbers, axis=0).T
        if self._warm_start is not None:
            return self._warm_start.recover(held, bins)
        return _ShotTraces(self, held, bins)

    def search(self, found: Traces) -> Returns:
        """Find the returns in what `recover` returned."""
        return self._search.find_returns(found)

    def find_returns(self, measurements: Float32Array) -> Returns:
        """Find the returns in one shot's rectified measurements, (columns, rows)."""
        return self.search(self.recover(measurements))

    def cloud(self, measurements: Float32Array) -> PointCloud:
        """Make the cloud of one shot's rectified measurements, (columns, rows)."""
        return point_cloud(self.find_returns(measurements))


class _ShotTraces:
    """Traces of a shot, recovered as they are asked for; see `tofclip.lidar.pulse.Traces`."""

    def __init__(
        self, pipeline: RangingPipeline, measurements: Float32Array, bins: TraceBins
    ) -> None:
        self.pixels, self.bins = pipeline.pixels, bins
        self._parts: list[tuple[InverseTraces, slice, Float32Array]] = []
        for place in pipeline.places:
            first, last = np.searchsorted(bins.numbers, [place.rows.start, place.rows.stop])
            if first < last:
                held = slice(first, last)
                weights = place.inverse.inverse.weights(measurements[:, held])
                self._parts.append((place.inverse, held, weights))

    def fill(self, piece: slice, traces: Float32Array) -> None:
        """Write the traces (n, bins) of some pixels, recovered now."""
        for inverse, held, weights in self._parts:
            inverse.fill(weights, piece, traces, held)


def build_cloud_path(folder: Path, number: int, suffix: str) -> Path:
    """Return where cloud `number` of a sequence is kept."""
    return folder / f"cloud_{number:06d}{suffix}"
