"""`tofclip record`: an instrument's bytes to a file that replays exactly."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated

import typer

from apps.options import AsJson

STEPS_PER_SECOND = 100


def record(
    uri: Annotated[
        str, typer.Argument(metavar="URI", help="Such as timetag://SERIAL, or 'sim+timetag://?seed=1'; see devices.")
    ],
    out: Annotated[Path, typer.Option(metavar="H5", help="The recording to write.")],
    seconds: Annotated[
        float | None, typer.Option(metavar="S", help="How long.", show_default="until its end, or Ctrl-C")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Record an instrument: its bytes as they come, with clock, accounts and calibration.

    However this ends, by Ctrl-C or by a crash, the file holds what came until then and opens as file://H5.

    Example: tofclip record 'sim+timetag://?seed=1' --out run.h5 --seconds 1
    """
    import devices
    from apps.files import RECORD_SUFFIXES, history, require_writable
    from apps.report import report
    from devices.recorder import record as recorded
    from tofclip.errors import InputError

    if seconds is not None and not seconds > 0:
        raise InputError(f"--seconds must be positive, got {seconds:g}")
    require_writable(out, *RECORD_SUFFIXES, inputs=(Path(uri.removeprefix("file://").partition("?")[0]),))
    past = history({"verb": "record", "uri": uri, "seconds": seconds})
    with ticking("recording", seconds) as watch:
        done = recorded(devices.open(uri), out, math.inf if seconds is None else seconds, past, watch)
    figures = done.stats.as_dict()
    rate = {"bytes": done.bytes, "bytes_per_second": done.bytes / done.seconds, "records": figures.pop("acquired")}
    report({"seconds": done.seconds, **rate, **figures}, as_json, [out])


@contextlib.contextmanager
def ticking(title: str, seconds: float | None) -> Iterator[Callable[[float], None]]:
    """Show a bar that fills while time passes; yield a function to call with the seconds that have passed."""
    from apps.progress import progress

    if seconds is None:
        yield lambda _: None
        return
    with progress(title, round(seconds * STEPS_PER_SECOND)) as advance:
        shown = 0

        def watch(passed: float) -> None:
            nonlocal shown
            advance(round(passed * STEPS_PER_SECOND) - shown)
            shown = round(passed * STEPS_PER_SECOND)

        yield watch
