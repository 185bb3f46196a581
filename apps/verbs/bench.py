"""`tofclip bench`: how fast and how large this program's parts are on this machine."""

from __future__ import annotations

from pathlib import Path

from apps.options import JSON, arg, opt
from apps.progress import show_progress
from apps.report import report, require_writable
from tofclip.files import atomic_path


def bench(
    name: str = arg(
        "NAME",
        "recovery, clip, depth, streaming, rsd, propagation, confocal, backprojection, decode, or one of a group, as "
        "recovery-l1. Studies, by name only: camera, quality, accuracy, device, corner, sequence, driver, viewer.",
        "all",
    ),
    page: Path | None = opt("MD", "A page of the figures to write.", shown="none"),
    peers: Path | None = opt(
        "PYTHON",
        "A Python that has other programs to compare with: pip install y-tal pyfftw astra-toolbox lensless.",
        shown="none",
    ),
    as_json: bool = JSON,
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
        report(figures, as_json)
        return
    lines = {}
    for entry in figures["entries"]:
        # Sizes and threads rise, so that the last run is the largest.
        run = entry["runs"][-1]
        lines[entry["name"]] = run.get("problem") or (
            f"{run['seconds']['median']:.4g} s at {run['size']} {entry['size']}, {run['times_floor']:.2f} times "
            f"{entry['floor']}, {run['peak_mib']:.0f} MiB"
        )
    report(lines, as_json, [] if page is None else [page])
