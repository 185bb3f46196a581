"""`tofclip devices` and `tofclip record`: find instruments, try them out, record them, look after
their recordings.
"""

from __future__ import annotations

import math
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

import typer

from apps.cli import make_group
from apps.options import arg, opt
from apps.progress import show_share
from apps.report import RECORD_SUFFIXES, REPLACES, build_provenance, report, require_writable
from tofclip.errors import InputError

EXIT_DAMAGED = 2
ADDRESS = arg("URI", "Such as timetag://SERIAL, file://run.h5 or 'sim+timetag://?seed=1'.")
RECORDING = arg("H5", "Made by tofclip record.", read=True)

app = make_group(
    "Streak cameras, SPAD sensors, time taggers and their recordings, which tofclip record makes."
)


@app.command("list")
def list_() -> None:
    """Show the instruments that are connected, and the kinds of addresses there are.

    Example: tofclip devices list
    """
    from devices import discover, registry

    found = [asdict(one) for one in discover()]
    # Files have no opener of their own: the name's ending chooses one.
    figures = {"kinds": registry.list_schemes(), "file_types": registry.list_endings()}
    report({"devices": found, **figures}, note="" if found else "no instrument is connected")


@app.command()
def info(uri: str = ADDRESS) -> None:
    """Say what is known about an instrument or a recording.

    Example: tofclip devices info 'sim+linospad2://?seed=1'
    """
    import devices

    with devices.open(f"file://{uri}" if Path(uri).is_file() else uri) as source:
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
    report(figures)


@app.command("test")
def try_(
    uri: str = ADDRESS,
    seconds: float = opt("S", "How long to read.", 5.0),
) -> None:
    """Read and decode for a while, and say how fast and how well that went.

    Example: tofclip devices test 'sim+timetag://?seed=1' --seconds 1
    """
    import devices
    from devices.recorder import measure_throughput

    with show_share("reading", seconds) as watch:
        trial = measure_throughput(devices.open(uri), seconds, watch)
    report(trial.figures)


@app.command()
def verify(file: Path = RECORDING) -> None:
    """Read a recording from end to end and compare it with its checksums and accounts; exit status
    2 if it is damaged.

    A recording of a program that was killed is not complete, but as good as any up to its end.

    Example: tofclip devices verify run.h5
    """
    from devices.recording import check

    found = check.verify(file)
    report(found.as_dict())
    # The findings are printed in either case; only the exit status differs.
    if not found.is_sound:
        hint = "is damaged; tofclip devices repair makes a sound copy"
        print(f"tofclip: error: {file}: {hint}", file=sys.stderr)
        raise typer.Exit(EXIT_DAMAGED)
    if not found.complete:
        print(f"tofclip: {file}: is not complete: sound as far as it goes", file=sys.stderr)


@app.command()
def repair(
    file: Path = RECORDING,
    out: Path = opt("H5", "The sound copy to write.", ...),
) -> None:
    """Copy all that is sound of a damaged or unfinished recording, and mark where something is
    missing.

    Example: tofclip devices repair run.h5 --out sound.h5
    """
    from devices.recording import check

    require_writable(out, *RECORD_SUFFIXES, inputs=(file,))
    report(check.repair(file, out).as_dict(), [out])


def record(
    uri: str = arg("URI", "Such as timetag://SERIAL, or 'sim+timetag://?seed=1'; see devices."),
    out: Path = opt("H5", "The recording to write.", ...),
    seconds: float | None = opt("S", "How long.", shown="until its end, or Ctrl-C"),
) -> None:
    """Record an instrument: its bytes as they come, with clock, accounts and calibration.

    However this ends, by Ctrl-C, a signal or a crash, the file holds what came until then and opens
    as file://H5. Its content is tofclip's own format, not HDF5, regardless of its extension.

    Example: tofclip record 'sim+timetag://?seed=1' --out run.h5 --seconds 1
    """
    import devices
    from devices.recorder import record_source

    if seconds is not None and not seconds > 0:
        raise InputError(f"--seconds must be positive, got {seconds:g}")
    require_writable(out, *RECORD_SUFFIXES, inputs=(uri,))
    past = build_provenance({"verb": "record", "uri": uri, "seconds": seconds})
    limit = math.inf if seconds is None else seconds
    with show_share("recording", seconds) as watch:
        done = record_source(devices.open(uri), out, limit, past, watch, REPLACES.get())
    report({"seconds": done.seconds, "bytes": done.bytes, **done.figures}, [out])
