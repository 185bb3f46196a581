"""`tofclip occlusion`: what is hidden behind an occluder, and what is seen through it all the same."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from apps.options import AsJson
from tofclip.units import MILLIMETRE

app = typer.Typer()


@app.callback(invoke_without_command=True)
def _without_verb(context: typer.Context) -> None:
    """See through occluders: which places no view can see, and a demonstration of the others."""
    if context.invoked_subcommand is None:
        print(context.get_help())


@app.command()
def region(
    baseline_mm: Annotated[float, typer.Option(metavar="MM", help="Distance between the outermost views.")] = 15.0,
    width_mm: Annotated[float, typer.Option(metavar="MM", help="Width of the occluder's solid part.")] = 6.0,
    distance_mm: Annotated[float, typer.Option(metavar="MM", help="From the views to the occluder.")] = 50.0,
    out: Annotated[Path | None, typer.Option(metavar="PNG", help="Draw it.", show_default="no picture")] = None,
    as_json: AsJson = False,
) -> None:
    """Tell how far behind a solid occluder nothing can be seen by any view.

    An occluder as wide as the views are apart, or wider, hides what lies behind its middle at every distance: nothing
    is promised then, and inactive_length_m is null.

    Example: tofclip occlusion region --baseline-mm 15 --width-mm 6 --distance-mm 50 --out region.png
    """
    from apps.files import PICTURE_SUFFIXES, require_writable
    from apps.report import report
    from tofclip.occlusion import InactiveRegion

    if out is not None:
        require_writable(out, *PICTURE_SUFFIXES)
    found = InactiveRegion(*(length * MILLIMETRE for length in (baseline_mm, width_mm, distance_mm)))
    if out is not None:
        from apps.figures.occlusion_region import region_figure
        from apps.figures.style import save

        save(region_figure(found), out)
    promise = "seen beyond the inactive length" if found.ends else "nothing: the occluder is as wide as the baseline"
    length = found.length if found.ends or as_json else "without end"
    figures = {"inactive_length_m": length, "promised": promise}
    report(figures, as_json, [] if out is None else [out])
