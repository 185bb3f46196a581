"""`tofclip lidar`: how well counted photons tell a range, and how far a shot says that the views move with range."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from apps.options import AsJson, TimeZero
from tofclip.units import NANOSECOND, PICOSECOND

app = typer.Typer()


@app.callback(invoke_without_command=True)
def _without_verb(context: typer.Context) -> None:
    """How well a range can be known, and how the views' parallax grows with it."""
    if context.invoked_subcommand is None:
        print(context.get_help())


@app.command()
def accuracy(
    photons: Annotated[float, typer.Option(metavar="N", help="Expected photons of a return.")] = 100.0,
    background: Annotated[float, typer.Option(metavar="N", help="Expected background photons in a bin.")] = 0.1,
    pulse_ps: Annotated[float, typer.Option(metavar="PS", help="Full width at half maximum of the pulse.")] = 60.0,
    decay_ps: Annotated[
        float | None,
        typer.Option(metavar="PS", help="Time constant of the pulse's tail.", show_default="a Gaussian, no tail"),
    ] = None,
    bin_width_ps: Annotated[float, typer.Option(metavar="PS", help="Duration of a bin.")] = 20.0,
    bins: Annotated[int, typer.Option(metavar="N", help="Bins of a histogram.")] = 256,
    false_alarm_rate: Annotated[
        float, typer.Option(metavar="SHARE", help="Histograms without a return in which one may be announced.")
    ] = 0.01,
    trials: Annotated[int, typer.Option(metavar="N", help="Histograms with a return, and as many without.")] = 2000,
    seed: Annotated[int, typer.Option(metavar="N", help="Of the photons' chance.")] = 0,
    as_json: AsJson = False,
) -> None:
    """Locate returns in simulated photon histograms and compare the error with the Cramer-Rao bound."""
    from dataclasses import asdict

    from apps.report import report
    from tofclip.lidar import Pulse
    from tofclip.lidar.photons import PhotonDetector, measure_accuracy

    width = pulse_ps * PICOSECOND
    pulse = Pulse.gaussian(width) if decay_ps is None else Pulse.exponentially_modified(width, decay_ps * PICOSECOND)
    detector = PhotonDetector(pulse, bin_width_ps * PICOSECOND, bins, false_alarm_rate)
    report(asdict(measure_accuracy(detector, photons, background, trials, seed)), as_json)


@app.command()
def parallax(
    streak: Annotated[Path, typer.Argument(metavar="STREAK", help="A shot of a scene at several ranges.")],
    out: Annotated[Path, typer.Option(metavar="H5", help="The camera to write, for recover --focus depth-locked.")],
    camera: Annotated[
        Path | None, typer.Option(metavar="H5", help="Made by calibrate.", show_default="the one inside STREAK")
    ] = None,
    time_zero_ns: TimeZero = None,
    gates: Annotated[int, typer.Option(metavar="N", help="Time gates, of equal brightness.")] = 8,
    shears: Annotated[
        tuple[float, float, int], typer.Option(metavar="S0 S1 N", help="Shears tried, pixels per view step.")
    ] = (-3.0, 3.0, 13),
    as_json: AsJson = False,
) -> None:
    """Find lenslet pitch and focus distance from a shot: at which shear the views agree, gate by gate."""
    from apps.files import RECORD_SUFFIXES, require_writable
    from apps.progress import progress
    from apps.report import report
    from tofclip.calibration.parallax import LOOK
    from tofclip.camera import Camera
    from tofclip.io import read_streak
    from tofclip.reconstruct import parallax_from_shot, prepare

    require_writable(out, *RECORD_SUFFIXES, inputs=(streak,) if camera is None else (streak, camera))
    task = prepare(read_streak(streak), None if camera is None else Camera.load(camera))
    known = task.camera if time_zero_ns is None else task.camera.replace(time_zero=time_zero_ns * NANOSECOND)
    rows = task.streak.counts.shape[0]
    with progress("focusing", task.work - task.method.work(rows) + shears[2] * LOOK.work(rows)) as advance:
        found = parallax_from_shot(task.streak, known, gates, shears, advance)
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
