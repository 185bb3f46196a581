"""`tofclip record`: an instrument's bytes to a file that replays exactly."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated

import typer

import devices
from apps.conventions import RECORD_SUFFIXES, JsonOption, build_provenance, report, require_writable
from apps.progress import show_progress
from devices.recorder import record_source as recorded
from tofclip.errors import InputError

PROGRESS_STEPS_PER_S = 100


def record(
    uri: Annotated[
        str,
        typer.Argument(
            metavar="URI", help="Such as timetag://SERIAL, or 'sim+timetag://?seed=1'; see devices."
        ),
    ],
    out: Annotated[Path, typer.Option(metavar="H5", help="The recording to write.")],
    seconds: Annotated[
        float | None,
        typer.Option(metavar="S", help="How long.", show_default="until its end, or Ctrl-C"),
    ] = None,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace a recording that exists.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Record an instrument: its bytes as they come, with clock, accounts and calibration.

    However this ends, by Ctrl-C, a signal or a crash, the file holds what came until then and opens
    as file://H5. Its content is tofclip's own format, not HDF5, whatever its name ends in.

    Example: tofclip record 'sim+timetag://?seed=1' --out run.h5 --seconds 1
    """
    if seconds is not None and not seconds > 0:
        raise InputError(f"--seconds must be positive, got {seconds:g}")
    require_writable(out, *RECORD_SUFFIXES, inputs=(uri,))
    past = build_provenance({"verb": "record", "uri": uri, "seconds": seconds})
    with show_time_progress("recording", seconds) as watch:
        done = recorded(
            devices.open(uri), out, math.inf if seconds is None else seconds, past, watch, overwrite
        )
    figures = done.stats.as_dict()
    rate = {
        "bytes": done.bytes,
        "bytes_per_second": done.bytes / done.seconds,
        "records": figures.pop("acquired"),
    }
    report({"seconds": done.seconds, **rate, **figures}, as_json, [out])


@contextlib.contextmanager
def show_time_progress(title: str, seconds: float | None) -> Iterator[Callable[[float], None]]:
    """Show a bar that fills while time passes; yield a function to call with the seconds that have
    passed.
    """
    if seconds is None or not math.isfinite(seconds):
        yield lambda _: None
        return
    with show_progress(title, round(seconds * PROGRESS_STEPS_PER_S)) as advance:
        shown = 0

        def watch(passed: float) -> None:
            nonlocal shown
            # A bar takes whole steps forward; the difference of rounded sums never drifts.
            advance(round(passed * PROGRESS_STEPS_PER_S) - shown)
            shown = round(passed * PROGRESS_STEPS_PER_S)

        yield watch
