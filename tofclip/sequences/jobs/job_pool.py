"""Workers kept busy: each has a job and the next one, however many there are and whenever they come
and go.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any

from tofclip.sequences.jobs.jobs import Job, Report, run_job

if TYPE_CHECKING:
    from distributed import Client, Future

JOBS_PER_THREAD = 2
"""For each thread of the workers: one under way, and one so that it need not wait for the next."""

RECOUNT_INTERVAL_S = 1.0


class JobPool:
    """The workers of a cluster.

    The scheduler knows only as many jobs as there are threads, twice: a sequence of millions costs
    it no memory, and few are blamed for a worker's death.

    Parameters
    ----------
    client : distributed.Client
    on_killed : callable, optional
        Called with a job whose workers died too often, in place of a report of failure.
    """

    def __init__(self, client: Client, on_killed: Callable[[Job], object] | None = None) -> None:
        self._client, self._on_killed = client, on_killed
        self._slots, self._counted_at_s = 1, 0.0

    def run_all(self, jobs: Sequence[Job]) -> Iterator[Report]:
        """Do all jobs, and yield the reports as they come."""
        from distributed import as_completed

        waiting = iter(jobs)
        running: dict[Future[Any], Job] = {}
        finished = as_completed(raise_errors=False)

        def submit() -> None:
            while len(running) < self._count_slots() and (job := next(waiting, None)) is not None:
                # Not pure: Dask would otherwise give the earlier answer to an equal job.
                future = self._client.submit(run_job, job, pure=False)
                running[future] = job
                finished.add(future)

        submit()
        try:
            for future in finished:
                report = self._collect_report(future, running.pop(future))
                submit()
                if report is not None:
                    yield report
        finally:
            # Reached early when the caller stops iterating or is interrupted; otherwise nothing is
            # left.
            if running:
                self._client.cancel(list(running))

    def _count_slots(self) -> int:
        """Return how many jobs may be under way; workers are counted once a second."""
        now = time.monotonic()
        if now > self._counted_at_s + RECOUNT_INTERVAL_S:
            self._slots = JOBS_PER_THREAD * max(1, sum(self._client.nthreads().values()))
            self._counted_at_s = now
        return self._slots

    def _collect_report(self, future: Future[Any], job: Job) -> Report | None:
        """Return a job's own report, or say what kept it from making one."""
        from distributed import KilledWorker

        try:
            report: Report = future.result()
        except KilledWorker:
            if self._on_killed is None:
                return Report(job.name, "each worker that tried it died; is there enough memory?")
            # Jobs queued on a worker that dies are blamed with it, so that this one may be
            # innocent.
            self._on_killed(job)
            return None
        except Exception as fault:
            return Report(job.name, f"the cluster did not do it: {type(fault).__name__} {fault}")
        return report
