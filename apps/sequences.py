"""Run the jobs of a sequence under a progress bar, say what became of them, and end with 1 if some
failed.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from apps.conventions import report
from apps.progress import show_progress
from tofclip.arrays import parse_device
from tofclip.errors import MissingDependencyError
from tofclip.sequences.jobs import run_jobs, select_unfinished

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
    """Run the jobs that are not done yet, with a bar that shows the time left.

    `title`: of the bar; `cluster`: where; one after the other in this process by default; `watch`:
    called with each report.
    """
    missing = select_unfinished(jobs)
    with show_progress(title, len(missing)) as advance:

        def note(report: Report) -> None:
            watch(report)
            advance(1)

        return run_jobs(missing, cluster, note)


def resolve_device(device: str, cluster: str | None) -> str:
    """Return which device a name stands for here; workers on other machines look for it themselves.

    `cluster`: address of the cluster's scheduler.
    """
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
    """Print the figures of a sequence and its failures.

    `total`: jobs of the sequence, those included that were done by an earlier run; `out`: where the
    results are; `figures`: further ones.
    """
    attempted = summary.done + len(summary.failures)
    figures = {
        "results": summary.done,
        "kept_from_before": total - attempted,
        "failed": len(summary.failures),
        "seconds": summary.seconds,
        "results_per_second": summary.done / summary.seconds,
        "processes": summary.processes,
        "peak_memory_mib_per_process": summary.peak_bytes / BYTES_PER_MIB,
        **(figures or {}),
    }
    if as_json:
        failures = [
            {"name": failure.name, "problem": failure.problem} for failure in summary.failures
        ]
        report({**figures, "failures": failures}, as_json=True)
    else:
        report(figures, as_json=False, written=[out])
        for failure in summary.failures:
            print(f"failed: {failure.name}: {failure.problem}", file=sys.stderr)
    if summary.failures:
        raise typer.Exit(EXIT_SOME_FAILED)
