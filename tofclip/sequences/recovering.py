"""What a sequence consists of; streak images to frames, frames to point clouds, and shots straight to
clouds by the linear inverse, several averaged for each: how one is made, the jobs of many, and the sweeps
over settings.
"""

from __future__ import annotations

import glob
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property, lru_cache, partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from tofclip.arrays import CPU, Float32Array, FloatArray, parse_device
from tofclip.camera import Camera
from tofclip.errors import FileFormatError, InputError, StorageError, require, require_known
from tofclip.files import compute_sha256, require_apart
from tofclip.io import read_streak
from tofclip.io.streaks import StreakStack
from tofclip.lidar import PointCloud, Returns, depth, point_cloud
from tofclip.lidar.cloud import save_organised
from tofclip.recovery import (
    RecoveryPlan,
    SharpestFocus,
    SurfaceRecovery,
    make_method,
    open_shot,
    parse_focus,
    plan_recovery,
)
from tofclip.recovery.plan import DEFAULT_METHOD
from tofclip.sequences.jobs import SETTINGS_NAME, Job, list_jobs, lock_output_folder
from tofclip.sequences.ranger import CachedInverse, RangingPipeline, StillAverage, get_cached_camera
from tofclip.shots import RETURN_CHOICES, Frames, Streak
from tofclip.solvers import LinearInverse, Method
from tofclip.storage import (
    Storable,
    is_own_file,
    read_outline,
    stored_array,
    stored_child,
    stored_value,
)
from tofclip.units import SPEED_OF_LIGHT

RESULT_SUFFIXES = (".png", ".pdf", ".svg", ".ply", ".toml", ".json")


@dataclass(frozen=True)
class Shot:
    """A streak image in the file `path`, of a stack that of a `number`, of which no other is read;
    calling it reads it. `bin_width`: duration of a row, s, which overrides the file's time axis.
    """

    path: Path
    bin_width: float | None = None
    number: int | None = None

    def __call__(self) -> Streak:
        """Read the shot."""
        if self.number is None:
            return read_streak(self.path, self.bin_width)
        shot = StreakStack(self.path).read_shot(self.number)
        return shot if self.bin_width is None else shot.with_bin_width(self.bin_width)


def is_sequence(source: str | Path) -> bool:
    """Return whether `source` is a folder, a pattern or an HDF5 stack, and no single file."""
    text, path = str(source), Path(source)
    # The address of an instrument, which may hold characters that a pattern uses.
    if "://" in text:
        return False
    # A file whose name contains * or [ is that file, not a pattern.
    return path.is_dir() or (StreakStack.is_one(path) if path.exists() else glob.has_magic(text))


def list_shots(source: str | Path, bin_width: float | None = None) -> dict[str, Shot]:
    """Return the shots of a sequence by name, in order: of a `source`, folder, glob pattern or
    HDF5 stack (`tofclip.io.StreakStack`). Cameras, frames and pictures that lie beside the
    shots of a folder are left out. `bin_width`: duration of a row, s, which overrides time
    axes. `InputError`, `StorageError` or `FileFormatError` where there is none.
    """
    path = Path(source)
    if path.is_dir() or not path.exists():
        files = list_files(source, _may_be_shot)
        return {name: Shot(file, bin_width) for name, file in files.items()}
    import h5py

    if not h5py.is_hdf5(path):
        raise FileFormatError(
            path,
            "is one file and no sequence: shots come in a folder, by a pattern such as 'shots/*.tif', "
            "or in an HDF5 stack",
        )
    path = path.absolute()
    numbers = range(len(StreakStack(path)))
    return {f"{path.stem}_{number:06d}": Shot(path, bin_width, number) for number in numbers}


def _may_be_shot(path: Path) -> bool:
    """Whether a file of a folder is not one that this program makes of shots, or for them."""
    if path.suffix.lower() in RESULT_SUFFIXES:
        return False
    try:
        return not is_own_file(path) or read_outline(path).kind == Streak.RECORD_KIND
    except FileFormatError:
        return True  # a damaged one is reported


def list_files(
    source: str | Path, accept: Callable[[Path], bool] = lambda path: True
) -> dict[str, Path]:
    """Return the files of a `source`, a folder or a glob pattern, by name, in the order of their names. `accept`:
    which files of a folder count; those of a pattern all do.

    A file's name is its path from the folder that they have in common, without the ending. Paths
    are absolute: a cluster's workers run in other folders. Hidden files are left out, and the settings
    that a run leaves beside its results. `InputError` where there is no file, or two have the same
    name, `StorageError` where there is no such folder.
    """
    folder = Path(source)
    if folder.is_dir():
        found = [path for path in folder.iterdir() if path.name != SETTINGS_NAME and accept(path)]
    elif glob.has_magic(str(source)):
        found = [Path(name) for name in glob.glob(str(source), recursive=True)]
    else:
        raise StorageError(f"{source}: no such folder or pattern")
    files = sorted(
        path.absolute() for path in found if path.is_file() and not path.name.startswith(".")
    )
    require(files, f"{source}: there is no file")
    common = Path(os.path.commonpath([path.parent for path in files]))
    named: dict[str, Path] = {}
    for path in files:
        name = path.relative_to(common).with_suffix("").as_posix()
        if name in named:
            raise InputError(
                f"{named[name]} and {path.name} have one name; choose some by a pattern such as '*{path.suffix}'"
            )
        named[name] = path
    return named


FRAMES_SUFFIX = ".h5"


@dataclass(frozen=True)
class RecoverySettings:
    """How a shot becomes frames: by a `method` that `tofclip.recovery.make_method` knows, with `iterations`,
    `weight` and further settings of its `own`, its usual ones by default; a `focus`, as
    `tofclip.recovery.parse_focus` reads it; a `camera`, by default the one that each shot carries, with a
    `time_zero`, reading of the time axis at which light of range 0 would arrive, s, by default its own; on
    a `device`, by a name that `tofclip.arrays.parse_device` knows, for which each worker of a cluster looks
    anew. `InputError` for no such method or focus, or settings that the method has not.
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
    """Return the device as a setting of results; the CPU is left out, as in older folders."""
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
    """How frames become a cloud: whether points far from their neighbours are left out (`drop_outliers`); the
    side of cubes with one point each (`voxel`), m, all points by default; the `device` on which returns
    are looked for, as `tofclip.arrays.parse_device` knows it; which `returns` of a pixel, ``"first"``,
    ``"strongest"``, ``"last"`` or ``"all"``; whether files have a place for every pixel of the picture
    (`organised`, see `tofclip.lidar.cloud`); and `false_alarm`, see `tofclip.depth`. `InputError` where an
    organised cloud is to have all returns, or one point for each of some cubes.
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
        from tofclip.lidar.cloud import downsample_cloud, find_outliers

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
    """Write a cloud, organised or not, or its returns' depth picture if the name ends in .exr."""
    if path.suffix.lower() == DEPTH_IMAGE_SUFFIX:
        from tofclip.lidar import save_depth

        save_depth(returns, path)
    elif organised:
        save_organised(returns, path)
    else:
        cloud.save(path)


PLAN_NAME = "plan.h5"
MAX_JITTER_BINS = 32


@dataclass(frozen=True)
class RangingPlan(Storable):
    """What all shots of a sequence share: the `camera` with its sweep; `row_times` (rows,), the
    instant of each row, s; the `light` (rows,) of the first shot over time, with which the
    others are compared, empty where they are taken as they come; the `focus`, as
    `tofclip.recovery.parse_focus` reads it.
    """

    RECORD_KIND = "ranging"

    camera: Camera = field(metadata=stored_child(Camera.from_record, "camera"))
    row_times: FloatArray = field(metadata=stored_array("s", "time"))
    light: FloatArray = field(metadata=stored_array("count", "time"))
    focus: str = field(metadata=stored_value(dtype=str))


@dataclass(frozen=True)
class RangingSettings:
    """How the shots of a sequence become clouds: by `camera`, the one inside the first shot by default, from
    which a sweep that it does not know is found; `time_zero`, reading of the time axis at which light of
    range 0 would arrive, s, the camera's by default; `focus`, ``depth-locked`` or ``fixed:S``; so many
    shots averaged for each (`average`); and whether it is found how late each shot comes against the first
    one, and taken off (`steady`).
    """

    camera: Path | None = None
    time_zero: float | None = None
    focus: str = "fixed:0"
    average: int = 1
    steady: bool = True

    def __post_init__(self) -> None:
        require(
            not isinstance(parse_focus(self.focus), SharpestFocus),
            "a sequence has one focus for all shots: depth-locked or fixed:S",
        )
        require(self.average >= 1, "a sequence needs at least one shot to average")

    def jobs(self, shots: Mapping[str, Shot], folder: Path, suffix: str) -> list[Job]:
        """Return one job for each cloud, which writes it into `folder` in the format of `suffix`.

        The folder is made, and locked for these settings (`lock_output_folder`). What is prepared
        for all shots is kept there; a run that goes on uses it again.
        """
        plan, readers, names = folder.resolve() / PLAN_NAME, list(shots.values()), list(shots)
        # What is left over at the end makes one more cloud.
        parts = [slice(at, at + self.average) for at in range(0, len(names), self.average)]
        results = [folder.resolve() / f"{name_cloud(names[part])}{suffix}" for part in parts]
        require_apart([plan, *results], {self.camera, *(shot.path for shot in readers)})
        # Made before the folder is claimed, and saved after: a first shot that cannot be used
        # leaves no folder behind, and a folder of other settings gets no plan.
        made = None if plan.exists() else self.plan(readers[0]())
        camera = None if self.camera is None else compute_sha256(self.camera)
        settings = {"verb": "lidar sequence", **asdict(self), "camera": camera, "suffix": suffix}
        inputs = {name: shot.path for name, shot in shots.items()}
        lock_output_folder(folder, settings | {"bin_width": readers[0].bin_width}, inputs)
        if made is not None:
            made.save(plan)
        # a worker that holds an older plan notices by the hash
        version = compute_sha256(plan)
        make = partial(write_average_cloud, plan, version)
        return [
            Job(result.stem, result, partial(make, tuple(readers[part]), result))
            for part, result in zip(parts, results, strict=True)
        ]

    def plan(self, first: Streak) -> RangingPlan:
        """Return what all shots share with the first one."""
        camera = open_shot(first, self.camera, self.time_zero).fit_camera().camera
        parse_focus(self.focus).check_camera(camera)
        light = compute_light_curve(first, camera) if self.steady else np.empty(0)
        return RangingPlan(camera, first.times, light, self.focus)


def name_cloud(shots: Sequence[str]) -> str:
    """Return the name of the cloud of some shots, at least one: ``run2_shot_07`` of ``run2/shot_07``,
    ``a_03-a_05`` of all from ``a_03`` to ``a_05``.
    """
    ends = shots[:1] if len(shots) == 1 else (shots[0], shots[-1])
    return "-".join(name.replace("/", "_") for name in ends)


def write_average_cloud(
    plan: Path, version: str, shots: tuple[Shot, ...], result: Path
) -> tuple[int, list[float]]:
    """Write the cloud of some shots; return its points and by how many rows each shot was late. The
    pipeline is made once in a process for each `version` (SHA-256) of the plan. Memory: one shot,
    and twice as much again for its measurements and what is recovered of them.
    """
    pipeline, jitter = _load_plan(plan, version)
    cloud, late = make_average_cloud(shots, pipeline, jitter)
    cloud.save(result)
    return len(cloud), late.tolist()


@lru_cache(maxsize=2)
def _load_plan(plan: Path, version: str) -> tuple[RangingPipeline, JitterEstimator | None]:
    shared = RangingPlan.load(plan)
    pipeline = RangingPipeline(shared.camera, shared.row_times, focus=parse_focus(shared.focus))
    return pipeline, JitterEstimator(shared.light) if shared.light.size else None


@dataclass(frozen=True)
class JitterEstimator:
    """Finds by how many rows a shot is late, from its light over time."""

    reference: FloatArray  # (rows,), light of the shot with which the others are compared

    @cached_property
    def _spectrum(self) -> Any:
        # padded to twice the length: a circular correlation would compare the end with the
        # beginning
        return np.fft.rfft(_differentiate_root(self.reference), 2 * self.reference.size).conj()

    def late_bin(self, light: FloatArray) -> float:
        """Rows by which `light` comes later than the reference, below a row; at most 32 either way."""
        spectrum = np.fft.rfft(_differentiate_root(light), 2 * light.size)
        agreement = np.fft.irfft(spectrum * self._spectrum)
        reach = min(MAX_JITTER_BINS, light.size // 2 - 1)
        near = np.concatenate([agreement[-reach:], agreement[: reach + 1]])
        best = int(near.argmax())
        # A maximum at the edge of the search has no neighbour for the parabola.
        if best in (0, near.size - 1):
            return float(best - reach)
        # a parabola through the maximum and its neighbours gives the fraction of a bin
        left, centre, right = near[best - 1 : best + 2]
        curvature = max(2 * centre - left - right, np.finfo(np.float64).tiny)
        return best - reach + float((right - left) / 2 / curvature)


def compute_light_curve(streak: Streak, camera: Camera) -> FloatArray:
    """Sum of each raw row over the reference view's middle, where skew does not matter."""
    reference = int(np.argmin(np.abs(camera.view_positions)))
    # the middle half of one view, which neighbours do not reach
    half = camera.image_shape[1] // 4
    middle = round(camera.centres_px[reference])
    counts = streak.counts[:, max(0, middle - half) : middle + half + 1]
    return counts.sum(axis=1, dtype=np.float64)


def make_average_cloud(
    shots: Sequence[Callable[[], Streak]], pipeline: RangingPipeline, jitter: JitterEstimator | None
) -> tuple[PointCloud, FloatArray]:
    """Make one cloud of successive shots, each read when it is called, and say by how many rows each
    was late; without `jitter` they are taken as they come.
    """
    require(shots, "a cloud needs at least one shot")
    late = np.zeros(len(shots))

    def measurements(place: int) -> Float32Array:
        streak = shots[place]()
        if jitter is not None:
            late[place] = jitter.late_bin(compute_light_curve(streak, pipeline.camera))
        return pipeline.rectifier.rectify(streak.counts, delay=float(late[place]))

    # rectified before they are averaged, because every shot has a delay of its own
    seen = measurements(0)
    if len(shots) > 1:
        pulse_rows = pipeline.camera.pulse_fwhm / float(np.mean(np.diff(pipeline.times)))
        average = StillAverage(seen.T, pulse_rows, len(shots))
        seen = average.add(seen.T).T
        for place in range(1, len(shots)):
            seen = average.add(measurements(place).T).T
    return pipeline.cloud(np.ascontiguousarray(seen)), late


def _differentiate_root(light: FloatArray) -> FloatArray:
    """Changes of the root: near objects outshine far ones, and a constant says nothing."""
    # Shot noise of a root of counts is the same at every level, so that no row dominates.
    rise = np.diff(np.sqrt(np.maximum(light - np.median(light), 0)), prepend=0.0)
    length = float(np.linalg.norm(rise)) or 1.0
    return rise / length
