"""Run many jobs, here one after the other or on a cluster, and sum up what became of them."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence

from tofclip.sequences.jobs.crew import Crew
from tofclip.sequences.jobs.jobs import Job, Report, Summary, attempt
from tofclip.sequences.jobs.workers import workers
from tofclip.storage import remove_leftovers


def run(jobs: Sequence[Job], cluster: str | None = None, watch: Callable[[Report], object] | None = None) -> Summary:
    """Attempt every job once; one that fails is told in the summary and stops none of the others.

    Parameters
    ----------
    jobs : sequence of Job
        Independent of each other. `unfinished` leaves out those whose result is there.
    cluster : str, optional
        ``local``, ``local:N`` or ``tcp://HOST:PORT``, see `tofclip.sequences.jobs.workers.workers`; by default
        one job after the other in this process. Scripts that start local workers need ``if __name__ == "__main__":``.
    watch : callable, optional
        Called in this thread with the report of each job as it comes.

    Notes
    -----
    A job whose worker dies (killed, out of memory, power failure) is given to another. One that outlives too many
    workers (the scheduler's ``allowed-failures``) may be innocent, because those that wait beside it are blamed as
    well: at the end each of them gets another chance, alone. A worker that died in the middle of writing leaves a file
    under a temporary name, which is removed at the end.

    Memory here: a few hundred bytes for each job. A worker holds what one job needs.
    """
    started = time.perf_counter()
    try:
        return Summary.of(_watched(_reports(jobs, cluster), watch), started)
    finally:
        remove_leftovers(path for job in jobs for path in (job.result, *job.beside))


def _watched(reports: Iterator[Report], watch: Callable[[Report], object] | None) -> Iterator[Report]:
    for report in reports:
        if watch is not None:
            watch(report)
        yield report


def _reports(jobs: Sequence[Job], cluster: str | None) -> Iterator[Report]:
    if cluster is None:
        yield from map(attempt, jobs)
    elif jobs:
        with workers(cluster) as client:
            suspects: list[Job] = []
            yield from Crew(client, suspects.append).reports(jobs)
            for job in suspects:
                yield from Crew(client).reports([job])
