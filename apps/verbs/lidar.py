"""`tofclip lidar`: how well ranges can be known, how views move with range, a scene's objects,
clouds of many shots.
"""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import typer

from apps.conventions import (
    PICTURE_SUFFIXES,
    RECORD_SUFFIXES,
    ClusterOption,
    JsonOption,
    TimeZeroOption,
    describe_ranges,
    report,
    require_writable,
)
from apps.figures.scene import make_scene_figure
from apps.figures.style import save_figure
from apps.progress import show_progress
from apps.sequences import report_summary, run_with_progress
from apps.verbs.bag import bag
from apps.verbs.cloud import require_format
from apps.verbs.photons import photons
from tofclip.errors import InputError
from tofclip.files import require_apart
from tofclip.lidar import Detection, Pulse, depth, point_cloud
from tofclip.lidar.photons import PhotonDetector, measure_accuracy
from tofclip.lidar.processing import find_objects
from tofclip.lidar.significance import SCENE_BRIGHTNESS_QUANTILE
from tofclip.recovery import count_parallax_work, fit_parallax_to_shot, open_shot
from tofclip.sequences import RangingSettings, list_shots
from tofclip.shots import Frames
from tofclip.units import MILLIMETRE, NANOSECOND, PICOSECOND

if TYPE_CHECKING:
    from tofclip.sequences.jobs import Report

app = typer.Typer()
app.command()(photons)
app.command()(bag)


@app.callback(invoke_without_command=True)
def _show_help(context: typer.Context) -> None:
    """How well a range can be known, and how the views' parallax grows with it; many shots in a
    row.
    """
    # The group alone shows its help; a verb below it runs by itself.
    if context.invoked_subcommand is None:
        print(context.get_help())


@app.command()
def accuracy(
    photons: Annotated[
        float, typer.Option(metavar="N", help="Expected photons of a return.")
    ] = 100.0,
    background: Annotated[
        float, typer.Option(metavar="N", help="Expected background photons in a bin.")
    ] = 0.1,
    pulse_ps: Annotated[
        float, typer.Option(metavar="PS", help="Full width at half maximum of the pulse.")
    ] = 60.0,
    decay_ps: Annotated[
        float | None,
        typer.Option(
            metavar="PS",
            help="Time constant of the pulse's tail.",
            show_default="a Gaussian, no tail",
        ),
    ] = None,
    bin_width_ps: Annotated[float, typer.Option(metavar="PS", help="Duration of a bin.")] = 20.0,
    bins: Annotated[int, typer.Option(metavar="N", help="Bins of a histogram.")] = 256,
    false_alarm_rate: Annotated[
        float,
        typer.Option(
            metavar="SHARE", help="Histograms without a return in which one may be announced."
        ),
    ] = 0.01,
    trials: Annotated[
        int, typer.Option(metavar="N", help="Histograms with a return, and as many without.")
    ] = 2000,
    seed: Annotated[int, typer.Option(metavar="N", help="Of the photons' chance.")] = 0,
    as_json: JsonOption = False,
) -> None:
    """Locate returns in simulated photon histograms and compare the error with the Cramer-Rao
    bound.

    Example: tofclip lidar accuracy --photons 100 --background 0.1 --pulse-ps 60 --bin-width-ps 20
    --trials 200
    """
    width = pulse_ps * PICOSECOND
    pulse = (
        Pulse.gaussian(width)
        if decay_ps is None
        else Pulse.exponentially_modified(width, decay_ps * PICOSECOND)
    )
    detector = PhotonDetector(pulse, bin_width_ps * PICOSECOND, bins, false_alarm_rate)
    with show_progress("simulating", max(trials, 1)) as advance:
        found = measure_accuracy(detector, photons, background, trials, seed, advance)
    report(asdict(found), as_json)


@app.command()
def parallax(
    streak: Annotated[
        Path, typer.Argument(metavar="STREAK", help="A shot of a scene at several ranges.")
    ],
    out: Annotated[
        Path,
        typer.Option(metavar="H5", help="The camera to write, for recover --focus depth-locked."),
    ],
    camera: Annotated[
        Path | None,
        typer.Option(metavar="H5", help="Made by calibrate.", show_default="the one inside STREAK"),
    ] = None,
    time_zero_ns: TimeZeroOption = None,
    gates: Annotated[int, typer.Option(metavar="N", help="Time gates, of equal brightness.")] = 8,
    shears: Annotated[
        tuple[float, float, int],
        typer.Option(metavar="S0 S1 N", help="Shears tried, pixels per view step."),
    ] = (-3.0, 3.0, 13),
    as_json: JsonOption = False,
) -> None:
    """Find lenslet pitch and focus distance from a shot: at which shear the views agree, gate by
    gate.

    Example: tofclip lidar parallax shot.tif --camera camera.h5 --out camera_locked.h5
    """
    require_writable(out, *RECORD_SUFFIXES, inputs=(streak, camera))
    zero = None if time_zero_ns is None else time_zero_ns * NANOSECOND
    shot = open_shot(streak, camera, zero)
    with show_progress("focusing", count_parallax_work(shot, shears)) as advance:
        found = fit_parallax_to_shot(shot, gates, shears, advance)
    found.camera.save(out)
    figures = {
        "strength_px_m": found.parallax.strength,
        "lenslet_pitch_m": found.camera.lenslet_pitch,
        "focus_distance_m": found.camera.focus_distance,
        "misfit_px": found.parallax.misfit_px,
        "range_m": found.distances,
        "shear_px": found.curve.shears,
        "weight": found.curve.weight,
    }
    report(figures, as_json, [out])


@app.command()
def scene(
    frames: Annotated[Path, typer.Argument(metavar="FRAMES", help="Recovered frames (HDF5).")],
    out: Annotated[Path, typer.Option(metavar="PNG", help="The picture to write.")],
    reach_mm: Annotated[
        float, typer.Option(metavar="MM", help="Points this close belong together.")
    ] = 40.0,
    fewest_points: Annotated[
        int, typer.Option(metavar="N", help="Smaller groups are not objects.")
    ] = 40,
    as_json: JsonOption = False,
) -> None:
    """List a scene's objects with range, size and standard deviation; draw them from three sides.

    Points fainter than a twentieth of the brightest are left out: most are rays that few views leave
    around bright things. `cloud` has them all.

    Example: tofclip lidar scene frames.h5 --out scene.png
    """
    require_writable(out, *PICTURE_SUFFIXES, inputs=(frames,))
    recovered = Frames.load(frames)
    cloud = point_cloud(depth(recovered))
    if len(cloud):
        brightest = np.quantile(cloud.intensity, SCENE_BRIGHTNESS_QUANTILE)
        cloud = cloud[cloud.intensity >= Detection().min_scene_fraction * brightest]
    objects = find_objects(cloud, reach_mm * MILLIMETRE, fewest_points)
    # Before the picture, which would show an empty scene.
    if not objects:
        raise InputError(f"{frames}: no {fewest_points} points lie together within {reach_mm:g} mm")
    save_figure(make_scene_figure(recovered, cloud, objects), out)
    named = ("range", "width", "height", "range_sigma", "scatter")
    rows = [
        {f"{name}_m": getattr(one, name) for name in named} | {"points": one.points.size}
        for one in objects
    ]
    if as_json:
        # `confidence_m` is the deviation's earlier name: for one more version
        renamed = [row | {"confidence_m": row["range_sigma_m"]} for row in rows]
        report({"points": len(cloud), "objects": renamed}, as_json=True)
        return
    table = {f"object {number}": row for number, row in enumerate(rows, 1)}
    report(table, as_json, [out], describe_ranges(recovered))


@app.command()
def sequence(
    shots: Annotated[
        Path,
        typer.Argument(
            metavar="SHOTS",
            help="A folder or quoted pattern of streak images, or an HDF5 stack of them.",
        ),
    ],
    out: Annotated[
        Path,
        typer.Option(metavar="FOLDER", help="Where the clouds go; those already there are kept."),
    ],
    camera: Annotated[
        Path | None,
        typer.Option(
            metavar="H5", help="Made by calibrate.", show_default="the one inside the first shot"
        ),
    ] = None,
    bin_width_ps: Annotated[
        float | None,
        typer.Option(
            metavar="PS", help="Duration of a row in ps; overrides the files' own time axis."
        ),
    ] = None,
    time_zero_ns: TimeZeroOption = None,
    average: Annotated[int, typer.Option(metavar="N", help="Shots averaged for each cloud.")] = 1,
    focus: Annotated[
        str, typer.Option(metavar="SHEAR", help="depth-locked or fixed:S.")
    ] = "fixed:0",
    suffix: Annotated[str, typer.Option(metavar=".EXT", help="Format of the clouds.")] = ".ply",
    keep_jitter: Annotated[
        bool,
        typer.Option(
            "--keep-jitter", help="Do not find how late each shot comes against the first."
        ),
    ] = False,
    cluster: ClusterOption = None,
    as_json: JsonOption = False,
) -> None:
    """Make a cloud of each shot by the linear inverse, one shot in memory at a time.

    Started again after an interruption, it makes the clouds that are missing in the folder. Shots
    of which none can be made are listed at the end, and the exit status is 1.

    Example: tofclip lidar sequence shots/ --camera camera.h5 --out clouds/
    """
    # Before the jobs claim the folder.
    require_format(suffix)
    require_apart([out], [shots, camera])
    width = None if bin_width_ps is None else bin_width_ps * PICOSECOND
    zero = None if time_zero_ns is None else time_zero_ns * NANOSECOND
    jobs = RangingSettings(camera, zero, focus, average, not keep_jitter).jobs(
        list_shots(shots, width), out, suffix
    )
    points: list[int] = []
    late: list[float] = []

    def watch(report: Report) -> None:
        # None for clouds that were there already, whose points are not counted again.
        if report.figures is not None:
            points.append(report.figures[0])
            late.extend(report.figures[1])

    summary = run_with_progress("ranging", jobs, cluster, watch)
    # Root mean square; 0 where nothing was done.
    jitter = (sum(one**2 for one in late) / len(late)) ** 0.5 if late else 0.0
    figures = {
        "shots": len(late),
        "shots_per_second": len(late) / summary.seconds,
        "points": sum(points),
        "jitter_rms_bins": jitter,
    }
    report_summary(summary, len(jobs), as_json, out, figures)
