"""What makes clouds of shots, chosen by what a shot is."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Protocol

from tofclip.camera import Camera
from tofclip.errors import InputError
from tofclip.lidar.photons import PhotonCube
from tofclip.plugins import METHODS
from tofclip.recovery import Focus, SharpestFocus, SurfaceRecovery
from tofclip.recovery.focus import DEFAULT_FOCUS
from tofclip.sequences.counting import PhotonPipeline
from tofclip.sequences.following import SurfacePipeline
from tofclip.sequences.ranger import RangingPipeline
from tofclip.shots import Returns, Streak
from tofclip.solvers import LinearInverse, ProximalMethod

LiveShot = Streak | PhotonCube


class CloudPipeline(Protocol):
    """What makes clouds of shots of one camera: `RangingPipeline` and `SurfacePipeline` of streak
    images, `PhotonPipeline` of histograms.
    """

    camera: Camera
    method_name: str

    @property
    def in_order(self) -> bool:
        """Whether what comes out of a shot depends on those before it."""

    def rectify(self, shot: Any) -> Any:
        """Do what can be done before anything is recovered; what comes out is for `recover_shot`."""

    def recover_shot(self, shot: Any, rectified: Any) -> Any:
        """Do what a shot needs as a whole; what comes out is for `search`."""

    def search(self, found: Any) -> Returns:
        """Find the returns in what `recover_shot` returned."""


def make_pipeline(
    shot: LiveShot,
    camera: Path | Camera | None = None,
    time_zero: float | None = None,
    focus: Focus = DEFAULT_FOCUS,
    method: str | LinearInverse | ProximalMethod | None = None,
) -> CloudPipeline:
    """Prepare for shots like this one: `PhotonPipeline` for histograms of a picture; of streak images
    `SurfacePipeline` by method "surfaces", else `RangingPipeline`.

    Parameters
    ----------
    shot : Streak or PhotonCube
        The first of all.
    camera : Path or Camera, optional
        By default the one that the shot carries; of histograms, `Camera.pinhole`.
    time_zero : float, optional
        Reading of the time axis at which light of range 0 would arrive, s; the camera's by default.
    focus : Focus
        One that needs no look at the shot: ``FixedFocus`` or ``DepthLockedFocus``.
    method : str, LinearInverse or ProximalMethod, optional
        Of streak images alone: ``"l1"``, the default, ``"tv"``, ``"linear"``, ``"surfaces"``, or another name of
        `tofclip.plugins.METHODS` that stands for one with a prior.

    Raises
    ------
    InputError
        No such method or focus, a method for histograms, or a streak image without a camera.
    """
    if isinstance(focus, SharpestFocus):
        raise InputError("a stream has one focus for all shots: depth-locked or fixed:S")
    if isinstance(shot, PhotonCube):
        if method is not None:
            raise InputError(
                "histograms of a picture are ranged by their photons alone: leave out the method"
            )
        return PhotonPipeline.for_shot(shot, camera, time_zero)
    wanted = "l1" if method is None else method
    chosen = METHODS.make(wanted, {}) if isinstance(wanted, str) else wanted
    if not isinstance(chosen, LinearInverse | ProximalMethod | SurfaceRecovery):
        raise InputError(
            "a stream's method is linear, surfaces or one with a prior such as l1 or tv, "
            f"not '{method}'"
        )
    if isinstance(chosen, SurfaceRecovery):  # each surface is recovered at the shear of its range
        return SurfacePipeline.for_shot(shot, camera, time_zero)
    return RangingPipeline.for_shot(shot, camera, focus, time_zero, chosen)
