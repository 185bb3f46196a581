"""Shot after shot, each beginning at what the last one showed: pictures of a method with a prior, or
surfaces.

From one shot to the next little changes but the noise. Iterations that begin at the last shot's
pictures need a few steps where those that begin in darkness need forty.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from threading import Lock

import numpy as np
from numpy.typing import NDArray

from tofclip.camera import Camera
from tofclip.lidar.pulse_tables import PictureTraces, TraceBins
from tofclip.operators import LinearOperator
from tofclip.recovery import DepthLockedFocus, Shot, SurfaceRecovery, open_shot, plan_recovery
from tofclip.recovery.focus import DEFAULT_FOCUS
from tofclip.recovery.surfaces.fit import SurfaceFit, fit_surfaces, follow_surfaces, list_returns
from tofclip.shots import Returns, Streak
from tofclip.solvers import ProximalMethod

# Of each shot but the first, which has the method's own number. Of a moving scene's points, with 300
# photons in the brightest pixel, 17 % are false after 4, 9 % after 8, 5 % after 12 (the linear
# inverse: 27 %), and 3 % after 16, in half as much time again.
WARM_ITERATIONS = 12


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
        alive: NDArray[np.bool_],
        iterations: int = WARM_ITERATIONS,
    ) -> None:
        self.method, self._places, self._alive = method, places, alive
        # so few iterations end before the gap is looked at
        self._warm = replace(method, iterations=iterations, gap=0.0)
        self._rows = np.zeros(0, np.int64)
        self._pictures = np.zeros((0, *places[0][1].shape_in), np.float32)

    def recover(self, measurements: NDArray[np.float32], bins: TraceBins) -> PictureTraces:
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
                known = bool(np.isin(rows[own], shared).any())
                found[own] = self._recover_place(operator, seen[:, own], found[own], known)
        self._rows, self._pictures = rows, found
        pictures = np.zeros((bins.numbers.size, *found.shape[1:]), np.float32)
        pictures[lit] = found
        return PictureTraces(pictures, bins)

    def _recover_place(
        self,
        operator: LinearOperator,
        seen: NDArray[np.float32],
        start: NDArray[np.float32],
        known: bool,
    ) -> NDArray[np.float32]:
        """Recover rows of one shear, beginning at `start` where some of them are `known`."""
        valid = None if self._alive.all() else np.repeat(self._alive[:, None], seen.shape[1], 1)
        if known:
            frames = self._warm.recover(operator, seen, valid, start=start).frames
        else:
            frames = self.method.recover(operator, seen, valid).frames
        return np.asarray(frames, np.float32)


class SurfacePipeline:
    """Makes clouds of shots of one camera by method "surfaces".

    The first shot has its surfaces found. Each further one begins at the surfaces, brightnesses and
    state of the instrument of the shot before, and needs a step on them and twenty iterations. Where
    they no longer explain the shot, as when something has come in, surfaces are found anew. Shots
    are taken in order.

    Memory: as `SurfaceRecovery`; nothing is kept of the shots before but the last fit.
    """

    in_order, method_name = True, SurfaceRecovery.name

    def __init__(self, shot: Shot, method: SurfaceRecovery | None = None) -> None:
        self.method = SurfaceRecovery() if method is None else method
        self.camera, self._centre_error_px = shot.camera, shot.centre_error_px
        self.searches = 0
        self._fit: SurfaceFit | None = None
        self._lock = Lock()

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

    def rectify(self, shot: Streak) -> None:
        """Do nothing: surfaces explain the raw image."""

    def recover_shot(self, shot: Streak, rectified: None) -> SurfaceFit:
        """Fit the surfaces of a shot."""
        with self._lock:
            if self._fit is not None:
                self._fit = follow_surfaces(self._fit, shot, self.method.weight)
            if self._fit is None:
                self.searches += 1
                opened = Shot(shot, self.camera, self._centre_error_px)
                focus = DepthLockedFocus() if self.camera.lenslet_pitch > 0 else DEFAULT_FOCUS
                start = plan_recovery(opened, self.method.start, focus).run()
                weight, iterations = self.method.weight, self.method.iterations
                self._fit = fit_surfaces(shot, start, weight, iterations)
            return self._fit

    def search(self, found: SurfaceFit) -> Returns:
        """List the returns of what `recover_shot` returned."""
        return list_returns(found, self.method.detection, self._centre_error_px)
