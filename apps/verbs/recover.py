"""`tofclip recover`: a streak image to one picture per instant."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from apps.options import AsJson, Picture, TimeZero, completing
from tofclip.units import NANOSECOND, PICOSECOND

if TYPE_CHECKING:
    from tofclip.reconstruct import Task
    from tofclip.recovery import Method
    from tofclip.transient import Frames, Streak


def recover(
    streak: Annotated[
        str,
        typer.Argument(
            metavar="STREAK",
            help="HPD-TA TIFF, ITEX, LIFT archive, our HDF5, or a source such as sim+linospad2://?seed=1.",
        ),
    ],
    out: Annotated[Path, typer.Option(metavar="H5", help="The frames to write.")],
    camera: Annotated[
        Path | None, typer.Option(metavar="H5", help="Made by calibrate.", show_default="the one inside STREAK")
    ] = None,
    bin_width_ps: Annotated[
        float | None,
        typer.Option(metavar="PS", help="Duration of a row in ps; overrides the file's own time axis."),
    ] = None,
    time_zero_ns: TimeZero = None,
    method: Annotated[
        str,
        typer.Option(
            metavar="NAME",
            help="tv, l1, linear or adjoint.",
            autocompletion=completing("tv", "l1", "linear", "adjoint"),
        ),
    ] = "tv",
    iterations: Annotated[
        int | None, typer.Option(metavar="N", help="At most so many, for tv and l1.", show_default="the method's")
    ] = None,
    focus: Annotated[
        str,
        typer.Option(
            metavar="SHEAR",
            help="depth-locked: each frame at the shear of its range; fixed:S: all at S pixels per view step; "
            "stack:S0:S1:N: each gate at the best of N.",
        ),
    ] = "fixed:0",
    cloud: Annotated[
        Path | None, typer.Option(metavar="PLY", help="A point cloud to write as well.", show_default="none")
    ] = None,
    preview: Picture = None,
    as_json: AsJson = False,
) -> None:
    """Recover every transient frame of a raw streak image.

    Where the camera's sweep is not known, skew, gains and centres are found from the shot itself.

    Example: tofclip recover shot.tif --camera camera.h5 --out frames.h5 --time-zero-ns -10.784
    """
    from apps.figures.preview import preview_figure
    from apps.figures.style import save
    from apps.files import PICTURE_SUFFIXES, RECORD_SUFFIXES, require_writable
    from apps.progress import progress
    from apps.verbs.cloud import FORMATS as CLOUD_SUFFIXES
    from apps.verbs.cloud import save_cloud
    from tofclip.reconstruct import focus_named, method_named

    inputs = tuple(Path(name) for name in (streak, camera) if name is not None and not _is_address(name))
    preview = preview or out.with_suffix(".png")
    require_writable(out, *RECORD_SUFFIXES, inputs=inputs)
    require_writable(preview, *PICTURE_SUFFIXES, inputs=inputs)
    if cloud is not None:
        require_writable(cloud, *CLOUD_SUFFIXES, inputs=inputs)
    chosen = method_named(method) if iterations is None else method_named(method, iterations=iterations)
    sharp = focus_named(focus)
    task = replace(_prepared(streak, camera, bin_width_ps, time_zero_ns, chosen), focus=sharp)
    sharp.require(task.camera)
    with progress("recovering", task.work) as advance:
        frames = _with_history(task.run(advance), task, inputs)
    frames.save(out)
    save(preview_figure(task.streak, frames), preview)
    written = [out, preview]
    if cloud is not None:
        written.append(save_cloud(frames, cloud))
    _report(frames, as_json, written)


def _prepared(
    streak: str, camera: Path | None, bin_width_ps: float | None, time_zero_ns: float | None, method: Method
) -> Task:
    """Read the inputs and check them against each other."""
    from tofclip.camera import Camera
    from tofclip.reconstruct import prepare

    known = None if camera is None else Camera.load(camera)
    shot = _shot(streak, None if bin_width_ps is None else bin_width_ps * PICOSECOND)
    task = prepare(shot, known, method)
    if time_zero_ns is None:
        return task
    return replace(task, camera=task.camera.replace(time_zero=time_zero_ns * NANOSECOND))


def _is_address(name: str | Path) -> bool:
    return "://" in str(name)


def _shot(streak: str, bin_width: float | None) -> Streak:
    """Read a file, or a source until it ends."""
    if _is_address(streak):
        from devices.transients import read_transient

        return read_transient(streak, bin_width)
    from tofclip.io import read_streak

    return read_streak(streak, bin_width)


def _with_history(frames: Frames, task: Task, inputs: tuple[Path, ...]) -> Frames:
    from apps.files import history

    settings = {
        "verb": "recover",
        "method": repr(task.method),
        "focus": str(task.focus),
        "time_zero_s": task.camera.time_zero,
    }
    return replace(frames, provenance=history(settings, *inputs, earlier=frames.provenance))


def _report(frames: Frames, as_json: bool, written: list[Path]) -> None:
    from apps.report import report
    from tofclip.reconstruct import time_shift_bins

    known = frames.figures
    report(
        {
            "frames": frames.values.shape[0],
            "image_shape": frames.camera.image_shape,
            "method": known["method"],
            "iterations": known["iterations"],
            "relative_residual": known["relative_residual"],
            "seconds": known["seconds"],
            "frames_per_second": known["frames_per_second"],
            "view_gains": frames.camera.gains,
            "time_shift_bins": time_shift_bins(frames.camera),
            "stopped_because": known["stopped_because"],
        },
        as_json,
        written,
    )
