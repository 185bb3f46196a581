"""Streak images to frames and frames to point clouds: how one is made, the jobs of many, and the sweeps
over settings.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

from tofclip.arrays import CPU, parse_device
from tofclip.errors import InputError, require, require_known
from tofclip.files import compute_sha256
from tofclip.lidar import PointCloud, Returns, depth, point_cloud
from tofclip.lidar.cloud import save_organised
from tofclip.recovery import (
    RecoveryPlan,
    SurfaceRecovery,
    make_method,
    open_shot,
    parse_focus,
    plan_recovery,
)
from tofclip.recovery.plan import DEFAULT_METHOD
from tofclip.sequences.inputs import Shot
from tofclip.sequences.jobs import Job, list_jobs
from tofclip.sequences.ranger import CachedInverse, get_cached_camera
from tofclip.shots import RETURN_CHOICES, Frames, Streak
from tofclip.solvers import LinearInverse, Method
from tofclip.units import SPEED_OF_LIGHT

FRAMES_SUFFIX = ".h5"


@dataclass(frozen=True)
class RecoverySettings:
    """How a shot becomes frames.

    Parameters
    ----------
    method : str
        A name that `tofclip.recovery.make_method` knows.
    iterations, weight : int and float, optional
        Of the method; its own by default.
    focus : str
        As `tofclip.recovery.parse_focus` reads it.
    camera : Path, optional
        By default each shot carries its own.
    time_zero : float, optional
        Reading of the time axis at which light of range 0 would arrive, s; the camera's by default.
    device : str
        Where, by a name that `tofclip.arrays.parse_device` knows; each worker of a cluster looks
        for it anew.
    own : mapping of str to str
        Further settings of the method, as `tofclip.recovery.make_method` takes them.

    Raises
    ------
    InputError
        No such method or focus, or the method has no such settings.
    """

    method: str = DEFAULT_METHOD
    iterations: int | None = None
    weight: float | None = None
    focus: str = "fixed:0"
    camera: Path | None = None
    time_zero: float | None = None
    device: str = "cpu"
    own: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        # Made once and thrown away, so that a wrong setting is reported before any shot is read.
        self.build_solver()
        parse_focus(self.focus)

    def build_solver(self) -> Method | SurfaceRecovery:
        """Return the method with its settings."""
        known = {"iterations": self.iterations, "weight": self.weight, **self.own}
        return make_method(self.method, **known)

    def plan(self, streak: Streak) -> RecoveryPlan:
        """Check a shot against the camera, before any work is done."""
        shot = open_shot(streak, self.camera, self.time_zero)
        return plan_recovery(shot, self.build_solver(), self.focus, self.device)

    def jobs(self, shots: Mapping[str, Shot], folder: Path) -> list[Job]:
        """Return one job for each of the shots, which writes its frames into `folder`.

        The folder is made, and locked for these settings (`lock_output_folder`); `InputError` where
        it belongs to others, or a shot bears the name of a result.
        """
        # Workers have another working directory.
        here = self if self.camera is None else replace(self, camera=self.camera.resolve())
        return list_jobs(
            folder,
            FRAMES_SUFFIX,
            self.settings() | {"bin_width": next(iter(shots.values())).bin_width},
            {name: shot.path for name, shot in shots.items()},
            lambda name, result: partial(recover_shot, here, shots[name], result),
            [self.camera],
        )

    def settings(self) -> dict[str, Any]:
        """Return what a result depends on besides the shot."""
        # The content counts, not the name: a camera calibrated anew gives other frames.
        camera = None if self.camera is None else compute_sha256(self.camera)
        device = normalise_device(self.device)
        known = {**asdict(self), **self.own, "own": None, "camera": camera, "device": device}
        return {"verb": "recover", **known}


def normalise_device(device: str) -> str | None:
    """Return the device as a setting that results depend on; the CPU is left out, as in
    older folders.
    """
    return None if device == str(CPU) else device


def recover_shot(recovery: RecoverySettings, shot: Shot, result: Path) -> None:
    """Read a shot, recover it, write its frames; operators are made once in a process. Memory: the
    shot, its measurements and mask, and the frames twice while they are written.
    """
    plan = recovery.plan(shot())
    if plan.shot.camera.sweep is not None:  # otherwise it is fitted to the shot, another for each
        known = replace(plan.shot, camera=get_cached_camera(plan.shot.camera))
        plan = replace(plan, shot=known)
        if isinstance(plan.method, LinearInverse):
            plan = replace(plan, method=CachedInverse(plan.method.damping))
    plan.add_provenance(plan.run()).save(result)


# Settings that can be swept, and what their values are.
PARAMETER_TYPES = {"method": str, "iterations": int, "weight": float, "focus": str}


def expand_sweep(
    recovery: RecoverySettings, values: Mapping[str, Sequence[str]]
) -> dict[str, RecoverySettings]:
    """Return a recovery for every combination of `values` of ``method``, ``iterations``,
    ``weight`` and ``focus``, by a name that can be a folder's; `recovery` has the settings that
    are not swept. `InputError` for no such setting or value, or a combination that does not
    exist, such as iterations of ``linear``.
    """
    unknown = [name for name in values if name not in PARAMETER_TYPES]
    if unknown:
        raise InputError(f"'{unknown[0]}' cannot be swept; take {', '.join(PARAMETER_TYPES)}")
    found = {}
    for chosen in product(*values.values()):
        named = dict(zip(values, chosen, strict=True))
        try:
            settings = {name: PARAMETER_TYPES[name](value) for name, value in named.items()}
        except ValueError as fault:
            raise InputError(f"sweep: {fault}") from fault
        label = ",".join(f"{name}={value}" for name, value in named.items())
        # The new object checks the combination, so that none is refused after hours of others.
        found[label] = replace(recovery, **settings)
    return found


DEPTH_IMAGE_SUFFIX = ".exr"


@dataclass(frozen=True)
class CloudSettings:
    """How frames become a cloud.

    Parameters
    ----------
    drop_outliers : bool
        Leave out points far from their neighbours.
    voxel : float, optional
        One point for each cube of this side, m; all points by default.
    device : str
        Where returns are looked for, by a name that `tofclip.arrays.parse_device` knows.
    returns : str
        Which return of a pixel: ``"first"``, ``"strongest"``, ``"last"`` or ``"all"``.
    organised : bool
        Files have a place for every pixel of the picture, see `tofclip.lidar.cloud`.
    false_alarm : float, optional
        See `tofclip.depth`.

    Raises
    ------
    InputError
        An organised cloud is to have all returns, or one point for each of some cubes.
    """

    drop_outliers: bool = False
    voxel: float | None = None
    device: str = "cpu"
    returns: str = "all"
    organised: bool = False
    false_alarm: float | None = None

    def __post_init__(self) -> None:
        require_known("return", self.returns, RETURN_CHOICES)
        require(
            not self.organised or self.returns != "all",
            "an organised cloud has one point for a pixel: choose the first, strongest or last "
            "return",
        )
        require(
            not self.organised or self.voxel is None,
            "an organised cloud keeps its pixels: leave the side of voxels out",
        )

    def make_cloud(self, frames: Frames, origin: str) -> tuple[PointCloud, Returns]:
        """Find each pixel's returns, where the frames carry none, and place them in space;
        `InputError` where there is none, which names their `origin`.
        """
        from tofclip.lidar.processing import downsample_cloud, find_outliers

        device = parse_device(self.device)
        with device.activate():
            there = frames
            if frames.returns is None:
                there = replace(frames, values=device.put(frames.values))
            returns = depth(there, false_alarm=self.false_alarm)
        if len(returns) == 0:
            raise InputError(f"{origin}: {_explain_empty_cloud(frames)}")
        returns = returns.select(self.returns)
        if self.drop_outliers:
            returns = returns[~find_outliers(point_cloud(returns))]
        cloud = replace(point_cloud(returns), provenance=frames.provenance)
        return (cloud if self.voxel is None else downsample_cloud(cloud, self.voxel)), returns

    def jobs(self, frames: Mapping[str, Path], folder: Path, suffix: str) -> list[Job]:
        """Return one job for each file of frames, by name, which writes its cloud into `folder` in the
        format of `suffix`; see `RecoverySettings.jobs`.
        """
        device = normalise_device(self.device)
        settings = {"verb": "cloud", **asdict(self), "suffix": suffix, "device": device}
        return list_jobs(
            folder,
            suffix,
            settings,
            frames,
            lambda name, result: partial(write_cloud, self, frames[name], result),
        )


def _explain_empty_cloud(frames: Frames) -> str:
    """Return why no return with a positive range was found, in a few words."""
    first, last = frames.times[0], frames.times[-1]
    if first < 0:
        # The same search with every time of flight positive shows whether the time zero is wrong.
        later = depth(replace(frames, times=frames.times - first + (last - first)))
        ranges = later.range - SPEED_OF_LIGHT * (last - 2 * first) / 2
        early = ranges[ranges < 0]
        if early.size:
            return (
                f"{early.size} of {ranges.size} returns have negative ranges "
                f"({early.min():.3g} to {early.max():.3g} m): "
                "time zero is later than the light; check the sign of `time_zero`"
            )
    return "no return stands out of the background, so there is no point to write"


def write_cloud(clouds: CloudSettings, frames: Path, result: Path) -> int:
    """Read frames, write their cloud, or their depth picture where that is asked for; return the
    number of points. Memory: the frames, and about as much again while returns are looked for.
    """
    cloud, returns = clouds.make_cloud(Frames.load(frames), str(frames))
    save_cloud(cloud, returns, result, clouds.organised)
    return len(cloud)


def save_cloud(cloud: PointCloud, returns: Returns, path: Path, organised: bool = False) -> None:
    """Write a cloud, a point for every pixel of an organised one, or the depth picture of its returns
    where the name ends in .exr.
    """
    if path.suffix.lower() == DEPTH_IMAGE_SUFFIX:
        from tofclip.lidar import save_depth

        save_depth(returns, path)
    elif organised:
        save_organised(returns, path)
    else:
        cloud.save(path)
