"""`tofclip calibrate`: four focus-mode pictures of a point source to a camera file."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from apps.conventions import JsonOption, PreviewOption, choose_preview, report
from apps.figures.calibration import make_calibration_figure
from apps.figures.style import save_figure
from apps.progress import show_activity
from tofclip.camera.focus_pictures import calibrate_views as fit
from tofclip.io import read_streak
from tofclip.units import NANOSECOND, PICOSECOND

if TYPE_CHECKING:
    from tofclip.camera.focus_pictures import FocusCalibration


def calibrate(
    line: Annotated[
        Path, typer.Option(metavar="TIF", help="Point source, slit open: a line for each lenslet.")
    ],
    line_background: Annotated[
        Path, typer.Option(metavar="TIF", help="The same without the source.")
    ],
    dot: Annotated[
        Path, typer.Option(metavar="TIF", help="Point source, slit closed: a dot for each lenslet.")
    ],
    dot_background: Annotated[
        Path, typer.Option(metavar="TIF", help="The same without the source.")
    ],
    out: Annotated[Path, typer.Option(metavar="H5", help="The camera file to write.")],
    time_zero_ns: Annotated[
        float | None,
        typer.Option(
            metavar="NS",
            help="Reading of the time axis at which light of range 0 would arrive, in ns; e.g. -10.784. These pictures "
            "do not show it; calibrate range finds it.",
            show_default="not known: ranges are right up to one constant",
        ),
    ] = None,
    focal_length_px: Annotated[
        float | None,
        typer.Option(
            metavar="PX",
            help="Distance from lenslet to picture in pixels, which these pictures do not show. It gives the cloud its "
            "width and height.",
            show_default="265, that of similar instruments",
        ),
    ] = None,
    pulse_ps: Annotated[
        float | None,
        typer.Option(
            metavar="PS",
            help="Full width at half maximum of the response to a short pulse.",
            show_default="60",
        ),
    ] = None,
    preview: PreviewOption = None,
    as_json: JsonOption = False,
) -> None:
    """Find every view's slit centre and line angle, and draw the fits over the data.

    The uncertainty of every parameter is written as well. `tofclip calibrate range` adds what a
    target at known distances tells of ranges.

    Example: tofclip calibrate --line line.tif --line-background line_background.tif --dot dot.tif
    --dot-background dot_background.tif --out camera.h5
    """
    pictures = (line, line_background, dot, dot_background)
    # Both outputs are checked before any picture is read, and neither may replace an input.
    preview = choose_preview(out, preview, pictures)
    lines, no_lines, dots, no_dots = (read_streak(path).counts for path in pictures)
    with show_activity("calibrating"):
        found = fit(lines, no_lines, dots, no_dots)
    known = {
        "time_zero": None if time_zero_ns is None else time_zero_ns * NANOSECOND,
        "focal_length_px": focal_length_px,
        "pulse_fwhm": None if pulse_ps is None else pulse_ps * PICOSECOND,
    }
    # Options that were not given leave the defaults of the camera alone.
    camera = found.camera(**{name: value for name, value in known.items() if value is not None})
    camera.save(out)
    save_figure(make_calibration_figure(found), preview)
    _report_calibration(found, as_json, [out, preview])


def _report_calibration(found: FocusCalibration, as_json: bool, written: list[Path]) -> None:
    figures: dict[str, Any] = {
        "angles_deg": np.rad2deg(found.angles),
        "centres_px": found.centres_px,
        "centre_uncertainty_px": found.centre_uncertainty_px,
    }
    if as_json:
        report(figures, as_json)
        return
    print("view   centre (px)        angle (deg)")
    angle_uncertainty = np.rad2deg(found.angle_uncertainty)
    rows = zip(*figures.values(), angle_uncertainty, strict=True)
    for view, (angle, centre, centre_error, angle_error) in enumerate(rows):
        print(
            f"{view:4d}   {centre:8.2f} +- {centre_error:4.2f}   {angle:7.2f} +- {angle_error:4.2f}"
        )
    report({}, as_json, written)
