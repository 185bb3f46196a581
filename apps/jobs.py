"""Run the jobs of a sequence under a progress bar, say what became of them, and end with 1 if some
failed.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from apps.progress import show_progress
from apps.report import may_replace, name_options, report
from tofclip.errors import MissingDependencyError

if TYPE_CHECKING:
    from tofclip.sequences.jobs import Job, Report, Summary

EXIT_SOME_FAILED = 1
BYTES_PER_MIB = 1 << 20


def run_with_progress(
    title: str,
    jobs: Sequence[Job],
    cluster: str | None,
    watch: Callable[[Report], object] = lambda _: None,
) -> Summary:
    """Run the jobs that are not done yet, or all where results may be replaced, one after the other in
    this process unless a cluster is named, with a bar that shows the time left; `watch` is called
    with each report.
    """
    from tofclip.sequences.jobs import run_jobs, select_unfinished

    if may_replace():
        for job in jobs:
            job.result.unlink(missing_ok=True)
    missing = select_unfinished(jobs)
    with show_progress(title, len(missing)) as advance:

        def note(report: Report) -> None:
            watch(report)
            advance(1)

        return run_jobs(missing, cluster, note)


def resolve_device(device: str, cluster: str | None) -> str:
    """Return which device a name stands for here; workers on other machines look for it themselves."""
    from tofclip.arrays import parse_device

    try:
        found = str(parse_device(device))
    except MissingDependencyError:
        if cluster is None:
            raise
        return device
    return found if cluster is None else device


def report_summary(
    summary: Summary, total: int, as_json: bool, out: Path, figures: Mapping[str, Any] | None = None
) -> None:
    """Print the figures of a sequence and its failures. `total`: its jobs, those included that were
    done by an earlier run; `figures`: further ones.
    """
    failed = {one.name: name_options(one.problem) for one in summary.failures}
    figures = {
        "results": summary.done,
        "kept_from_before": total - summary.done - len(failed),
        "failed": len(failed),
        "seconds": summary.seconds,
        "results_per_second": summary.done / summary.seconds,
        "processes": summary.processes,
        "peak_memory_mib_per_process": summary.peak_bytes / BYTES_PER_MIB,
        **(figures or {}),
    }
    if as_json:
        listed = [{"name": name, "problem": problem} for name, problem in failed.items()]
        figures |= {"failures": listed}
    report(figures, as_json, [out])
    if not as_json:
        for name, problem in failed.items():
            print(f"failed: {name}: {problem}", file=sys.stderr)
    if failed:
        raise typer.Exit(EXIT_SOME_FAILED)
