"""`tofclip lidar accuracy`: how close ranges from counted photons come to the Cramer-Rao bound."""

from __future__ import annotations

from typing import Annotated

import typer

from apps.options import AsJson
from tofclip.units import PICOSECOND

app = typer.Typer()


@app.callback(invoke_without_command=True)
def _without_verb(context: typer.Context) -> None:
    """Range from counted photons, and how well it can be known."""
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
