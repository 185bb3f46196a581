"""Sequences of streak images straight to point clouds, by the linear inverse, with all that is
prepared once kept in a file; several shots may be averaged for each cloud.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property, lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from tofclip.arrays import Float32Array, FloatArray
from tofclip.camera import Camera
from tofclip.errors import require
from tofclip.files import compute_sha256, require_apart
from tofclip.lidar import PointCloud
from tofclip.recovery import SharpestFocus, open_shot, parse_focus
from tofclip.sequences.inputs import Shot
from tofclip.sequences.jobs import Job, lock_output_folder
from tofclip.sequences.ranger import RangingPipeline, StillAverage
from tofclip.shots import Streak
from tofclip.storage import Storable, stored_array, stored_child, stored_value

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
    """How the shots of a sequence become clouds.

    Parameters
    ----------
    camera : Path, optional
        By default the one inside the first shot. A sweep that it does not know is found from that
        shot.
    time_zero : float, optional
        Reading of the time axis at which light of range 0 would arrive, s; the camera's by default.
    focus : str
        ``depth-locked`` or ``fixed:S``.
    average : int
        Shots averaged for each cloud.
    steady : bool
        Whether to find how late each shot comes against the first one, and take it off.
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
    """Sum of each raw row, counts, over the reference view's middle, where neighbouring views' skew
    does not matter.
    """
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
    """Changes of the root of the light: near objects outshine far ones, and a constant says
    nothing.
    """
    # Shot noise of a root of counts is the same at every level, so that no row dominates.
    rise = np.diff(np.sqrt(np.maximum(light - np.median(light), 0)), prepend=0.0)
    length = float(np.linalg.norm(rise)) or 1.0
    return rise / length
