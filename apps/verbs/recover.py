"""`tofclip recover`: a streak image to one picture per instant."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from apps.conventions import (
    ClusterOption,
    DeviceOption,
    JsonOption,
    PreviewOption,
    TimeZeroOption,
    choose_preview,
    make_completer,
    report,
    require_writable,
)
from apps.figures.preview import make_preview_figure
from apps.figures.style import save_figure
from apps.progress import show_progress
from apps.sequences import report_summary, resolve_device, run_with_progress
from apps.verbs.cloud import CLOUD_SUFFIXES as CLOUD_SUFFIXES
from tofclip.errors import InputError
from tofclip.files import require_apart
from tofclip.recovery import (
    compute_view_delays_bins,
    make_method,
    open_shot,
    parse_focus,
    plan_recovery,
)
from tofclip.sequences import CloudSettings, RecoverySettings, expand_sweep, is_sequence, list_shots
from tofclip.units import NANOSECOND, PICOSECOND

if TYPE_CHECKING:
    from tofclip.recovery import Shot
    from tofclip.shots import Frames


def recover(
    streak: Annotated[
        str,
        typer.Argument(
            metavar="STREAK",
            help="HPD-TA TIFF, ITEX, LIFT archive, our HDF5, or a source such as sim+linospad2://?seed=1. "
            "A sequence: a folder, a quoted pattern, or an HDF5 stack.",
        ),
    ],
    out: Annotated[
        Path, typer.Option(metavar="H5", help="The frames to write; of a sequence: their folder.")
    ],
    camera: Annotated[
        Path | None,
        typer.Option(metavar="H5", help="Made by calibrate.", show_default="the one inside STREAK"),
    ] = None,
    bin_width_ps: Annotated[
        float | None,
        typer.Option(
            metavar="PS", help="Duration of a row in ps; overrides the file's own time axis."
        ),
    ] = None,
    time_zero_ns: TimeZeroOption = None,
    method: Annotated[
        str,
        typer.Option(
            metavar="NAME",
            help="tv, l1, linear, adjoint, or surfaces: range and brightness of each pixel from the whole shot.",
            autocompletion=make_completer("tv", "l1", "linear", "adjoint", "surfaces"),
        ),
    ] = "tv",
    iterations: Annotated[
        int | None,
        typer.Option(
            metavar="N",
            help="Maximum number of iterations of tv, l1 and surfaces.",
            show_default="the method's",
        ),
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
        Path | None,
        typer.Option(metavar="PLY", help="A point cloud to write as well.", show_default="none"),
    ] = None,
    preview: PreviewOption = None,
    sweep: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=V,V",
            help="Of a sequence: every combination of these values of method, iterations, weight or focus, each in a "
            "folder of its own; may be given again.",
            show_default="none",
        ),
    ] = None,
    cluster: ClusterOption = None,
    device: DeviceOption = "cpu",
    as_json: JsonOption = False,
) -> None:
    """Recover every transient frame of a raw streak image, or of each one of a sequence.

    Where the camera's sweep is not known, skew, gains and centres are found from the shot itself.
    frames_per_second is the pace of the iterations alone, frames_per_second_overall that of the
    whole run, from reading the shot to writing the frames. duality_gap (of l1): the objective is
    above the least one by at most this fraction of it. defective_readings are hot, dead or struck
    by a particle and left out; clipped_readings are cut off at the sensor's limit and may be
    brighter.

    Of a sequence, what is in the folder already is kept: started again, a run goes on where it
    stopped. Shots that cannot be recovered are listed at the end, and the exit status is 1.

    Example: tofclip recover shot.tif --camera camera.h5 --out frames.h5 --time-zero-ns -10.784
    """
    zero = None if time_zero_ns is None else time_zero_ns * NANOSECOND
    width = None if bin_width_ps is None else bin_width_ps * PICOSECOND
    if is_sequence(streak):
        # Options without effect are refused rather than ignored.
        _check_sequence_options(cloud, preview)
        recovery = RecoverySettings(method, iterations, None, focus, camera, zero, device)
        used = resolve_device(device, cluster)
        require_apart([out], [streak, camera])
        _recover_sequence(recovery, (streak, width), out, sweep or [], (cluster, used, as_json))
        return
    _check_single_options(streak, cluster, sweep)
    preview = choose_preview(out, preview, (streak, camera))
    if cloud is not None:
        require_writable(cloud, *CLOUD_SUFFIXES, inputs=(streak, camera))
    solver, chosen_focus = make_method(method, iterations=iterations), parse_focus(focus)
    started = time.perf_counter()
    # Outputs and settings have been checked by now: an instrument is not started for nothing.
    shot = _open_source(streak, camera, zero, width)
    plan = plan_recovery(shot, solver, chosen_focus, device)
    # An instrument's address is no file with a checksum.
    inputs = tuple(Path(name) for name in (streak, camera) if name and not _is_address(name))
    with show_progress("recovering", plan.work) as advance:
        frames = plan.add_provenance(plan.run(advance), *inputs)
    frames.save(out)
    seconds = time.perf_counter() - started
    save_figure(make_preview_figure(shot.streak, frames), preview)
    written = [out, preview]
    if cloud is not None:
        points, _ = CloudSettings(device=device).make_cloud(frames, "the recovered frames")
        points.save(cloud)
        written.append(cloud)
    _report_frames(frames, seconds, as_json, written)


def _check_sequence_options(cloud: Path | None, preview: Path | None) -> None:
    if cloud is not None:
        raise InputError("--cloud is for one shot; give the folder of frames to tofclip cloud")
    if preview is not None:
        raise InputError("--preview is for one shot")


def _check_single_options(streak: str, cluster: str | None, sweep: list[str] | None) -> None:
    if cluster is not None or sweep:
        option = "--sweep" if cluster is None else "--cluster"
        raise InputError(
            f"{streak}: {option} is for a sequence: a folder, a quoted pattern or an HDF5 stack of shots"
        )


def _recover_sequence(
    recovery: RecoverySettings,
    shots: tuple[str, float | None],
    out: Path,
    sweep: list[str],
    how: tuple[str | None, str, bool],
) -> None:
    cluster, device, as_json = how
    found = list_shots(*shots)
    swept = expand_sweep(recovery, dict(map(_parse_sweep, sweep)))
    jobs = [job for label, variant in swept.items() for job in variant.jobs(found, out / label)]
    report_summary(
        run_with_progress("recovering", jobs, cluster), len(jobs), as_json, out, {"device": device}
    )


def _parse_sweep(text: str) -> tuple[str, list[str]]:
    name, _, values = text.partition("=")
    return name, values.split(",")


def _is_address(name: str | Path) -> bool:
    return "://" in str(name)


def _open_source(
    source: str, camera: Path | None, time_zero: float | None, bin_width: float | None
) -> Shot:
    """Open a file, or read an instrument until it ends."""
    if not _is_address(source):
        return open_shot(source, camera, time_zero, bin_width)
    from devices.transients import read_transient

    return open_shot(read_transient(source, bin_width), camera, time_zero)


def _report_frames(frames: Frames, seconds: float, as_json: bool, written: list[Path]) -> None:
    """Report a recovery that took `seconds` from reading the shot to writing the frames."""
    known = frames.figures
    # methods that know how far they are from the best there is say so, and shots that are not clean
    further = ("duality_gap", "defective_readings", "clipped_readings")
    report(
        {
            "frames": frames.values.shape[0],
            "image_shape": frames.camera.image_shape,
            "method": known["method"],
            "iterations": known["iterations"],
            "relative_residual": known["relative_residual"],
            "seconds": known["seconds"],
            # of the iterations alone, as for the next shot of a sequence, and of the whole run
            "frames_per_second": known["frames_per_second"],
            "frames_per_second_overall": frames.values.shape[0] / seconds,
            "view_gains": frames.camera.gains,
            "time_shift_bins": compute_view_delays_bins(frames.camera),
            "stopped_because": known["stopped_because"],
            "device": known["device"],
        }
        | {name: known[name] for name in further if name in known},
        as_json,
        written,
    )
