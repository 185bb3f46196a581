"""Run many jobs, here one after the other or on a cluster, and sum up what became of them."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence

from tofclip.sequences.jobs.job_pool import JobPool
from tofclip.sequences.jobs.jobs import Job, Report, Summary, run_job
from tofclip.sequences.jobs.workers import connect_workers
from tofclip.storage import remove_temporary_files


def run_jobs(
    jobs: Sequence[Job],
    cluster: str | None = None,
    on_report: Callable[[Report], object] | None = None,
) -> Summary:
    """Attempt every job once; one that fails is reported in the summary and stops none of the
    others.

    Parameters
    ----------
    jobs : sequence of Job
        Independent of each other. `unfinished` leaves out those whose result is there.
    cluster : str, optional
        ``local``, ``local:N`` or ``tcp://HOST:PORT``, see
        `tofclip.sequences.jobs.workers.connect_workers`; by default one job after the other in this
        process. Scripts that start local workers need ``if __name__ == "__main__":``.
    on_report : callable, optional
        Called in this thread with the report of each job as it comes.

    Returns
    -------
    Summary

    Notes
    -----
    A job whose worker dies (killed, out of memory, power failure) is given to another. One that
    outlives too many workers (the scheduler's ``allowed-failures``) may be innocent, because those
    that wait beside it are blamed as well: at the end each of them gets another chance, alone. A
    worker that died in the middle of writing leaves a file under a temporary name, which is removed
    at the end.

    Memory here: a few hundred bytes for each job. A worker holds what one job needs.
    """
    started = time.perf_counter()
    try:
        return Summary.from_reports(
            _notify_each(_iterate_reports(jobs, cluster), on_report), started
        )
    finally:
        # Also after an interrupt: workers that were killed could not clean up themselves.
        remove_temporary_files(path for job in jobs for path in (job.result, *job.extra_outputs))


def _notify_each(
    reports: Iterator[Report], on_report: Callable[[Report], object] | None
) -> Iterator[Report]:
    for report in reports:
        if on_report is not None:
            on_report(report)
        yield report


def _iterate_reports(jobs: Sequence[Job], cluster: str | None) -> Iterator[Report]:
    if cluster is None:
        yield from map(run_job, jobs)
    elif jobs:
        with connect_workers(cluster) as client:
            suspects: list[Job] = []
            yield from JobPool(client, suspects.append).run_all(jobs)
            # One at a time, so that a death can be blamed on no other job.
            for job in suspects:
                yield from JobPool(client).run_all([job])
