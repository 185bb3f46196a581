"""`tofclip convert`: any streak image that can be read to our own HDF5."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from apps.conventions import RECORD_SUFFIXES, JsonOption, report, require_writable
from tofclip.io import read_streak
from tofclip.units import PICOSECOND


def convert(
    streak: Annotated[Path, typer.Argument(metavar="STREAK", help="HPD-TA TIFF or LIFT archive.")],
    out: Annotated[Path, typer.Option(metavar="H5", help="The file to write.")],
    bin_width_ps: Annotated[
        float | None,
        typer.Option(metavar="PS", help="Duration of a row in ps, where the file does not say it."),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Turn a streak image into this program's HDF5, with its time axis, camera, text and relay wall
    inside.

    Example: tofclip convert wall.npz --out wall.h5
    """
    require_writable(out, *RECORD_SUFFIXES, inputs=(streak,))
    # Options are in ps, everything inside in s.
    shot = read_streak(streak, None if bin_width_ps is None else bin_width_ps * PICOSECOND)
    shot.save(out)
    figures = {
        "rows": shot.counts.shape[0],
        "columns": shot.counts.shape[1],
        "has_time_axis": shot.row_times is not None,
        "has_camera": shot.camera is not None,
        "attachments": list(shot.attachments),
    }
    report(figures, as_json, [out])
