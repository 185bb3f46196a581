"""`tofclip devices`: find instruments, try them out, look after their recordings."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

import devices
from apps.conventions import RECORD_SUFFIXES, JsonOption, report, require_writable
from apps.verbs.record import show_time_progress
from devices import discover, registry
from devices.recorder import measure_throughput
from devices.recording.check import repair as repaired
from devices.recording.check import verify as verified

EXIT_DAMAGED = 2

app = typer.Typer(
    help="Streak cameras, SPAD sensors, time taggers and their recordings.", no_args_is_help=True
)

AddressArgument = Annotated[
    str,
    typer.Argument(
        metavar="URI", help="Such as timetag://SERIAL, file://run.h5 or 'sim+timetag://?seed=1'."
    ),
]
RecordingArgument = Annotated[Path, typer.Argument(metavar="H5", help="Made by tofclip record.")]


@app.command("list")
def list_(as_json: JsonOption = False) -> None:
    """Show the instruments that are connected, and the kinds of addresses there are.

    Example: tofclip devices list
    """
    found = [asdict(one) for one in discover()]
    # Files have no opener of their own: the name's ending chooses one.
    kinds = sorted({*registry.OPENERS, "file"})
    if as_json:
        report(
            {"devices": found, "kinds": kinds, "file_types": sorted(registry.FILE_OPENERS)}, as_json
        )
        return
    for one in found:
        print(f"{one['uri']:<24}{one['instrument']}{': ' if one['note'] else ''}{one['note']}")
    print(f"{len(found) or 'no'} instruments are connected")
    print(f"addresses begin with {', '.join(f'{kind}://' for kind in kinds)}")


@app.command()
def info(uri: AddressArgument, as_json: JsonOption = False) -> None:
    """Say what is known about an instrument or a recording.

    Example: tofclip devices info 'sim+linospad2://?seed=1'
    """
    with devices.open(uri) as source:
        figures: dict[str, Any] = {
            **source.info.as_dict(),
            "is_live": source.is_live,
            "is_seekable": source.is_seekable,
        }
        calibration = source.calibration
    if calibration is not None:
        # Tables have thousands of entries; their shapes say what is known.
        shapes = {name: list(entry.values.shape) for name, entry in calibration.fields.items()}
        figures |= {f"calibration_{name}": value for name, value in calibration.attributes.items()}
        figures |= {f"calibration_{name}_shape": shape for name, shape in shapes.items()}
    report(figures, as_json)


@app.command("test")
def try_(
    uri: AddressArgument,
    seconds: Annotated[float, typer.Option(metavar="S", help="How long to read.")] = 5.0,
    as_json: JsonOption = False,
) -> None:
    """Read and decode for a while, and say how fast and how well that went.

    Example: tofclip devices test 'sim+timetag://?seed=1' --seconds 1
    """
    with show_time_progress("reading", seconds) as watch:
        trial = measure_throughput(devices.open(uri), seconds, watch)
    report(trial.figures, as_json)


@app.command()
def verify(file: RecordingArgument, as_json: JsonOption = False) -> None:
    """Read a recording from end to end and compare it with its checksums and accounts; exit status
    2 if it is damaged.

    A recording of a program that was killed is not complete, but as good as any up to its end.

    Example: tofclip devices verify run.h5
    """
    found = verified(file)
    report(found.as_dict(), as_json)
    # The findings are printed in either case; only the exit status differs.
    if not found.is_sound:
        typer.echo(
            f"tofclip: error: {file}: is damaged; tofclip devices repair makes a sound copy",
            err=True,
        )
        raise typer.Exit(EXIT_DAMAGED)


@app.command()
def repair(
    file: RecordingArgument,
    out: Annotated[Path, typer.Option(metavar="H5", help="The sound copy to write.")],
    as_json: JsonOption = False,
) -> None:
    """Copy all that is sound of a damaged or unfinished recording, and mark where something is
    missing.

    Example: tofclip devices repair run.h5 --out sound.h5
    """
    require_writable(out, *RECORD_SUFFIXES, inputs=(file,))
    report(repaired(file, out).as_dict(), as_json, [out])
