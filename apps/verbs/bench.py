"""`tofclip bench`: how fast and how large this program's parts are on this machine."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from apps.conventions import JsonOption, report, require_writable
from apps.progress import show_progress
from tofclip.files import atomic_path

if TYPE_CHECKING:
    from collections.abc import Mapping


def bench(
    name: Annotated[
        str,
        typer.Argument(
            metavar="NAME",
            help="recovery, clip, depth, streaming, rsd, propagation, confocal, backprojection, decode, or one of a "
            "group, as recovery-l1. Studies, by name only: camera, quality, accuracy, device, corner, sequence, "
            "driver, viewer.",
        ),
    ] = "all",
    page: Annotated[
        Path | None,
        typer.Option(metavar="MD", help="A page of the figures to write.", show_default="none"),
    ] = None,
    peers: Annotated[
        Path | None,
        typer.Option(
            metavar="PYTHON",
            help="A Python that has other programs to compare with: pip install y-tal pyfftw astra-toolbox lensless.",
            show_default="none",
        ),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Measure time and memory, each beside the least that the work needs.

    All cases together take some ten minutes on two cores and are cut short after twenty, with
    --peers half an hour more. Other programs slow it down: close them. TOFCLIP_THREADS bounds the number of threads.

    Example: tofclip bench recovery

    Example: tofclip bench --page benchmarks.md --json
    """
    from apps.benchmarks.harness import count_processes, find_cases, render_page, run_cases

    cases = find_cases(name)
    if page is not None:
        # Before the measurements, which take minutes.
        require_writable(page, ".md", inputs=(peers,))
    with show_progress("measuring", count_processes(cases)) as advance:
        figures = run_cases(cases, None if peers is None else str(peers), advance)
    if page is not None:
        command = "tofclip bench" if name == "all" else f"tofclip bench {name}"
        with atomic_path(page) as temporary:
            temporary.write_text(render_page(figures, command), encoding="utf-8")
    if as_json:
        report(figures, as_json=True)
    else:
        report(_format_summary(figures), as_json=False, written=[] if page is None else [page])


def _format_summary(figures: Mapping[str, Any]) -> dict[str, str]:
    """One line for each case, of its greatest size on all threads."""
    lines = {}
    for entry in figures["entries"]:
        # Sizes and threads rise, so that the last run is the largest.
        run = entry["runs"][-1]
        lines[entry["name"]] = run.get("problem") or (
            f"{run['seconds']['median']:.4g} s at {run['size']} {entry['size']}, {run['times_floor']:.2f} times "
            f"{entry['floor']}, {run['peak_mib']:.0f} MiB"
        )
    return lines
