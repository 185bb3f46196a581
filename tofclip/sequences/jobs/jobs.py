"""A job, how it is attempted, how many are run here or on the workers of a cluster, and what is
reported of them.
"""

from __future__ import annotations

import os
import platform
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tofclip.errors import InputError, TofclipError
from tofclip.files import format_error_line, remove_temporary_files
from tofclip.sequences.jobs.workers import connect_workers
from tofclip.threads import limit_blas_threads

if TYPE_CHECKING:
    from distributed import Client, Future, as_completed


@dataclass(frozen=True)
class Job:
    """Something to be done once.

    Parameters
    ----------
    name : str
        What a message calls it.
    result : Path
        The file it makes, whole or not at all; on a cluster, where every worker can write it.
    work : callable
        Makes the file; may return a few figures about it. It has to survive pickling: a
        `functools.partial` of a function of a module with names of files and numbers.
    extra_outputs : tuple of Path
        Further files that it writes, before the result.
    """

    name: str
    result: Path
    work: Callable[[], Any]
    extra_outputs: tuple[Path, ...] = ()


@dataclass(frozen=True)
class Report:
    """What became of a job.

    Parameters
    ----------
    name : str
    problem : str
        Empty if it went well.
    figures : object
        What its work returned; None as well where the result was there already.
    process : str
        Which process did it; empty where none did.
    peak_bytes : int
        Most memory that this process has held so far; 0 where the system does not report it.
    """

    name: str
    problem: str = ""
    figures: Any = None
    process: str = ""
    peak_bytes: int = 0


@dataclass(frozen=True)
class Failure:
    """A job that did not make its result, and why, in one line."""

    name: str
    problem: str


@dataclass(frozen=True)
class Summary:
    """What became of many jobs.

    Parameters
    ----------
    done : int
        Jobs whose result is there now.
    failures : tuple of Failure
        The others.
    processes : int
        How many processes took part.
    peak_bytes : int
        Most memory that one of them held, its program and libraries included.
    seconds : float
    """

    done: int
    failures: tuple[Failure, ...]
    processes: int
    peak_bytes: int
    seconds: float

    @classmethod
    def from_reports(cls, reports: Iterable[Report], started: float) -> Summary:
        """Sum up reports as they come.

        Parameters
        ----------
        reports : iterable of Report
        started : float
            Value of `time.perf_counter` when the first job began.

        Returns
        -------
        Summary
        """
        done, failures, processes, peak = 0, [], set(), 0
        for report in reports:
            if report.problem:
                failures.append(Failure(report.name, report.problem))
            else:
                done += 1
            processes.add(report.process)
            peak = max(peak, report.peak_bytes)
        failures.sort(key=lambda failure: failure.name)
        return cls(
            done, tuple(failures), len(processes - {""}), peak, time.perf_counter() - started
        )


def select_unfinished(jobs: Iterable[Job]) -> list[Job]:
    """Return the jobs whose result is not there yet."""
    return [job for job in jobs if not job.result.exists()]


def run_job(job: Job) -> Report:
    """Do a job unless its result is there; whatever goes wrong is reported, so that the
    others go on.

    The libraries of linear algebra get one thread: with more, they round differently, and jobs
    would give other results on a cluster than here.
    """
    problem, figures = "", None
    try:
        # Asked again here: a job may be given to a second worker after the first had finished it.
        if not job.result.exists():
            with limit_blas_threads():
                figures = job.work()
    except TofclipError as fault:
        problem = format_error_line(fault)
    except Exception as fault:
        problem = f"unforeseen {type(fault).__name__}: {format_error_line(fault)}"
    return Report(
        job.name, problem, figures, f"{platform.node()}:{os.getpid()}", measure_peak_memory_bytes()
    )


def measure_peak_memory_bytes() -> int:
    """Most memory that this process has held so far; 0 where the system does not report it."""
    try:
        import resource
    except ImportError:  # Windows
        return 0
    # getrusage(2) gives kilobytes on Linux and bytes on macOS.
    unit = 1024 if sys.platform.startswith("linux") else 1
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit


JOBS_PER_THREAD = 2
"""For each thread of the workers: one under way, and one so that it need not wait for the next."""

RECOUNT_INTERVAL_S = 1.0
POLL_INTERVAL_S = 0.01
MAX_WORKERLESS_S = 120.0
"""Workers that died are started again within seconds, or by a queue of a computing centre."""


class JobPool:
    """The workers of a cluster.

    The scheduler knows only as many jobs as there are threads, twice: a sequence of millions costs
    it no memory, and few are blamed for a worker's death.

    `on_killed`: called with a job whose workers died too often, in place of a report of failure.
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
            for future in self._iterate_finished(finished):
                report = self._collect_report(future, running.pop(future))
                submit()
                if report is not None:
                    yield report
        finally:
            # Reached early when the caller stops iterating or is interrupted; otherwise nothing is
            # left.
            if running:
                self._client.cancel(list(running))

    def _iterate_finished(self, finished: as_completed) -> Iterator[Future[Any]]:
        """Yield futures as they finish, while there are workers to finish them."""
        counted_at_s = had_workers_at_s = time.monotonic()
        while not finished.is_empty():
            now = time.monotonic()
            if finished.has_ready():
                had_workers_at_s = now
                yield next(finished)
                continue
            if now > counted_at_s + RECOUNT_INTERVAL_S:
                counted_at_s = now
                had_workers_at_s = now if self._client.nthreads() else had_workers_at_s
            if now > had_workers_at_s + MAX_WORKERLESS_S:
                raise InputError(
                    f"the cluster has had no worker for {MAX_WORKERLESS_S:.0f} s; start some and "
                    "run this again: what is done stays"
                )
            time.sleep(POLL_INTERVAL_S)

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
