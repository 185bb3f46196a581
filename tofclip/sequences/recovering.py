"""Streak images to frames: how one is recovered, and the jobs of many."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from tofclip.arrays import HERE
from tofclip.camera import Camera
from tofclip.recovery import Task, focus_named, method_named, prepare
from tofclip.sequences.inputs import Shot, result_paths
from tofclip.sequences.jobs import Job, claim
from tofclip.sequences.kept import KeptInverse, kept
from tofclip.shots import Frames, Streak
from tofclip.solvers import LinearInverse, Method
from tofclip.storage import provenance, sha256_of

FRAMES_SUFFIX = ".h5"


@dataclass(frozen=True)
class Recovery:
    """How a shot becomes frames.

    Parameters
    ----------
    method : str
        A name that `tofclip.recovery.method_named` knows.
    iterations, weight : int and float, optional
        Of the method; its own by default.
    focus : str
        As `tofclip.recovery.focus_named` reads it.
    camera : Path, optional
        By default each shot carries its own.
    time_zero : float, optional
        Reading of the time axis at which light of range 0 would arrive, s; the camera's by default.
    device : str
        Where, by a name that `tofclip.arrays.place_named` knows; each worker of a cluster looks for it anew.

    Raises
    ------
    InputError
        No such method or focus, or the method has no such settings.
    """

    method: str = "tv"
    iterations: int | None = None
    weight: float | None = None
    focus: str = "fixed:0"
    camera: Path | None = None
    time_zero: float | None = None
    device: str = "cpu"

    def __post_init__(self) -> None:
        self.solver()
        focus_named(self.focus)

    def solver(self) -> Method:
        """Return the method with its settings."""
        chosen = {"iterations": self.iterations, "weight": self.weight}
        return method_named(self.method, **{name: value for name, value in chosen.items() if value is not None})

    def task(self, streak: Streak) -> Task:
        """Check a shot against the camera, before any work is done."""
        known = None if self.camera is None else Camera.load(self.camera)
        focus = focus_named(self.focus)
        task = prepare(streak, known, self.solver(), device=self.device)
        camera = task.camera if self.time_zero is None else task.camera.replace(time_zero=self.time_zero)
        focus.require(camera)
        return replace(task, camera=camera, focus=focus)

    def jobs(self, shots: Mapping[str, Shot], folder: Path) -> list[Job]:
        """Return one job for each shot, which writes its frames into `folder`.

        The folder is made, and claimed for these settings (`tofclip.sequences.jobs.claim`).
        """
        claim(folder, self.settings() | {"bin_width": next(iter(shots.values())).bin_width})
        here = self if self.camera is None else replace(self, camera=self.camera.resolve())
        paths = result_paths(shots, folder, FRAMES_SUFFIX)
        return [Job(name, paths[name], partial(recover_shot, here, shot, paths[name])) for name, shot in shots.items()]

    def settings(self) -> dict[str, Any]:
        """Return what a result depends on besides the shot."""
        camera = None if self.camera is None else sha256_of(self.camera)
        return {"verb": "recover", **asdict(self), "camera": camera, "device": device_setting(self.device)}


def device_setting(device: str) -> str | None:
    """Return the device as a setting that results depend on; this processor is no news, as in folders of old."""
    return None if device == str(HERE) else device


def recover_shot(recovery: Recovery, shot: Shot, result: Path) -> None:
    """Read a shot, recover it, write its frames; operators are made once in a process.

    Memory: the shot, its readings and mask, and the frames twice while they are written.
    """
    task = recovery.task(shot())
    if task.camera.sweep is not None:  # otherwise it is fitted to the shot, and another for each
        method = KeptInverse(task.method) if isinstance(task.method, LinearInverse) else task.method
        task = replace(task, camera=kept(task.camera), method=method)
    with_history(task.run(), task).save(result)


def with_history(frames: Frames, task: Task, *inputs: Path) -> Frames:
    """Return frames that tell how they came about."""
    told = {"method": repr(task.method), "focus": str(task.focus), "time_zero_s": task.camera.time_zero}
    past = provenance({"verb": "recover", **told}, *inputs) | {"earlier": dict(frames.provenance)}
    return replace(frames, provenance=past)
