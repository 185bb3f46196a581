"""Shot after shot to cloud after cloud, with what does not change from shot to shot worked out
once.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tofclip.arrays import FloatArray
from tofclip.camera import Camera, Measurement, Rectifier
from tofclip.errors import ShapeError
from tofclip.lidar import Detection, PointCloud, point_cloud
from tofclip.lidar.pulse_tables import TraceBins, Traces
from tofclip.lidar.search import ReturnSearch
from tofclip.lidar.signal_rows import RowBlock, SignalRowFinder
from tofclip.recovery import Focus, open_shot
from tofclip.recovery.focus import DEFAULT_FOCUS
from tofclip.sequences.cache import get_cached_camera, prepare_inverse
from tofclip.sequences.following import WarmStartedRecovery
from tofclip.shots import Returns, Streak
from tofclip.solvers import LinearInverse, ProximalMethod
from tofclip.solvers.direct import InverseTraces, order_by_patch


class SummedShot(NamedTuple):
    """What a look at all rows of a shot brings."""

    sums: NDArray[np.float32]  # (columns, instants and some), see `SignalRowFinder.bins`
    dark: float  # dark level, counts


class RangingPipeline:
    """Makes clouds of shots of one camera, by the linear inverse or by a method with a prior.

    A prior (l1) begins at the pictures of the shot before and takes its shots in order
    (`tofclip.sequences.following`). The linear inverse needs no iterations and knows nothing of the
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
        detection: Detection | None = None,
    ) -> None:
        focus.check_camera(camera)
        self.method = LinearInverse() if method is None else method
        self.method_name = self.method.name
        # Rows with light are told by the filter matched to the operator, whatever recovers them.
        inverse = self.method if isinstance(self.method, LinearInverse) else LinearInverse()
        self.camera = camera
        self.times = np.asarray(row_times, dtype=np.float64) - camera.time_zero
        self.rectifier = Rectifier(camera, self.times.size)
        # The focus is one that does not look at the shot, so that an empty one does for the plan.
        nothing = Measurement(np.empty((0, 0), np.float32), np.empty((0, 0), bool))
        pieces = focus.plan_segments(camera, self.times, nothing)
        cached = get_cached_camera(camera)
        alive, self.pixels = ~camera.dead_columns, order_by_patch(camera.image_shape)
        operators = [cached.operator(piece.shear) for piece in pieces]
        self.places = [
            RowBlock(
                piece.frames, InverseTraces(prepare_inverse(inverse, operator, alive), self.pixels)
            )
            for piece, operator in zip(pieces, operators, strict=True)
        ]
        self._warm_start: WarmStartedRecovery | None = None
        if isinstance(self.method, ProximalMethod):
            rows = [piece.frames for piece in pieces]
            places = list(zip(rows, operators, strict=True))
            self._warm_start = WarmStartedRecovery(self.method, places, alive)
        shears = np.repeat([piece.shear for piece in pieces], [piece.size for piece in pieces])
        self._search = ReturnSearch(camera, self.times, detection, shears=shears)
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

    def find_returns(self, measurements: NDArray[np.float32]) -> Returns:
        """Find the returns in one shot's rectified measurements, (columns, rows)."""
        return self.search(self.recover(measurements))

    def recover(self, measurements: NDArray[np.float32]) -> Traces:
        """Do what a shot, (columns, rows), rectified, needs as a whole before its pixels are
        recovered, a few at a time, as they are asked for.
        """
        expected = self.camera.slit_width_px, self.times.size
        if measurements.shape != expected:
            raise ShapeError("measurements", expected, measurements.shape)
        bins = self._lit.bins(self._lit.sum_measurements(measurements))
        # by rows, which is how measurements lie in memory
        return self._recover_bins(np.take(measurements.T, bins.numbers, axis=0).T, bins)

    def _recover_bins(self, measurements: NDArray[np.float32], bins: TraceBins) -> Traces:
        """Recover from measurements (columns, bins)."""
        if self._warm_start is not None:
            return self._warm_start.recover(measurements, bins)
        return _ShotTraces(self, measurements, bins)

    def rectify(self, shot: Streak) -> SummedShot:
        """Look at all rows of a shot once: their sums over a pulse's length, rectified."""
        return SummedShot(*self._lit.sum_streak(shot.counts, self.rectifier))

    def recover_shot(self, shot: Streak, rectified: SummedShot) -> Traces:
        """As `recover`, rectifying the rows with light and no others; `rectified` is overwritten."""
        bins = self._lit.bins(rectified.sums)
        measurements = self.rectifier.rectify_rows(shot.counts, rectified.dark, bins.numbers)
        return self._recover_bins(measurements, bins)

    def search(self, found: Traces) -> Returns:
        """Find the returns in what `recover` returned."""
        return self._search.find_returns(found)

    def cloud(self, measurements: NDArray[np.float32]) -> PointCloud:
        """Make the cloud of one shot's rectified measurements, (columns, rows)."""
        return point_cloud(self.find_returns(measurements))


class _ShotTraces:
    """Traces of a shot, recovered as they are asked for; see `tofclip.lidar.pulse_tables.Traces`."""

    def __init__(
        self, pipeline: RangingPipeline, measurements: NDArray[np.float32], bins: TraceBins
    ) -> None:
        self.pixels, self.bins = pipeline.pixels, bins
        self._parts: list[tuple[InverseTraces, slice, NDArray[np.float32]]] = []
        for place in pipeline.places:
            first, last = np.searchsorted(bins.numbers, [place.rows.start, place.rows.stop])
            if first < last:
                held = slice(first, last)
                weights = place.inverse.inverse.weights(measurements[:, held])
                self._parts.append((place.inverse, held, weights))

    def fill(self, piece: slice, traces: NDArray[np.float32]) -> None:
        """Write the traces (n, bins) of some pixels, recovered now."""
        for inverse, held, weights in self._parts:
            inverse.fill(weights, piece, traces, held)


def build_cloud_path(folder: Path, number: int, suffix: str) -> Path:
    """Return where cloud `number` of a sequence is kept."""
    return folder / f"cloud_{number:06d}{suffix}"
