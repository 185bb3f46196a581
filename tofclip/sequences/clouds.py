"""Frames to point clouds: how one is made, and the jobs of many."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path

from tofclip.arrays import parse_device
from tofclip.errors import InputError
from tofclip.lidar import PointCloud, Returns, depth, point_cloud
from tofclip.lidar.cloud import save_organised
from tofclip.sequences.jobs import Job, list_jobs
from tofclip.sequences.recovering import normalise_device
from tofclip.shots import RETURN_CHOICES, Frames
from tofclip.units import SPEED_OF_LIGHT

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
        if self.returns not in RETURN_CHOICES:
            raise InputError(
                f"no return is called '{self.returns}'; choose one of {', '.join(RETURN_CHOICES)}"
            )
        if self.organised and self.returns == "all":
            raise InputError(
                "an organised cloud has one point for a pixel: choose the first, strongest or last "
                "return"
            )
        if self.organised and self.voxel is not None:
            raise InputError("an organised cloud keeps its pixels: leave the side of voxels out")

    def make_cloud(self, frames: Frames, origin: str) -> tuple[PointCloud, Returns]:
        """Find each pixel's returns, where the frames carry none, and place them in space;
        `InputError` where there is none, which names their `origin`.
        """
        from tofclip.lidar.processing import downsample_cloud, find_outliers

        returns = frames.returns
        if returns is None:
            device = parse_device(self.device)
            with device.activate():
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
