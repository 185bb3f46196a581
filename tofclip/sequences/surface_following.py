"""Shot after shot by its surfaces, each beginning at those of the shot before."""

from __future__ import annotations

from pathlib import Path
from threading import Lock

from tofclip.camera import Camera, Rectifier
from tofclip.recovery import DepthLockedFocus, Shot, SurfaceRecovery, open_shot, plan_recovery
from tofclip.recovery.focus import DEFAULT_FOCUS
from tofclip.recovery.surfaces.fit import SurfaceFit, fit_surfaces, follow_surfaces
from tofclip.recovery.surfaces.returns import list_returns
from tofclip.shots import Returns, Streak


class SurfacePipeline:
    """Makes clouds of shots of one camera by method "surfaces".

    The first shot has its surfaces found. Each further one begins at the surfaces, brightnesses and
    state of the instrument of the shot before, and needs a step on them and twenty iterations. Where
    they no longer explain the shot, as when something has come in, surfaces are found anew. Shots
    are taken in order.

    `shot`: opened, its sweep known.

    Memory: as `SurfaceRecovery`; nothing is kept of the shots before but the last fit.
    """

    in_order = True

    def __init__(self, shot: Shot, method: SurfaceRecovery | None = None) -> None:
        self.method = SurfaceRecovery() if method is None else method
        self.camera, self._centre_error_px = shot.camera, shot.centre_error_px
        self.rectifier = Rectifier(shot.camera, shot.times.size)
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
        """Prepare for shots like this one; a sweep that is not known is found from it.

        `shot`: with a time axis; `camera`: defaults to the one that the shot carries; `time_zero`:
        reading of the time axis at which light of range 0 would arrive, s; the camera's by default.
        """
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
