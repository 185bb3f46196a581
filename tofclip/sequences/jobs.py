"""A folder of results belongs to one set of settings, so that no run goes on with the results of
another.

Where jobs run: on workers started for them on this machine, or on those of a scheduler that is
there already.

A job, how it is attempted, how many are run here or on the workers of a cluster, and what is
reported of them.
"""

from __future__ import annotations

import contextlib
import glob
import json
import logging
import os
import platform
import signal
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from multiprocessing import resource_tracker
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tofclip.errors import (
    FileFormatError,
    InputError,
    MissingDependencyError,
    StorageError,
    TofclipError,
)
from tofclip.files import (
    atomic_path,
    format_error_line,
    identify_file,
    remove_temporary_files,
    translate_read_errors,
)
from tofclip.threads import THREADS_VARIABLE, limit_blas_threads, thread_count
from tofclip.version import __version__

if TYPE_CHECKING:
    from distributed import Client, Future, as_completed

__all__ = [
    "Failure",
    "Job",
    "Report",
    "Summary",
    "lock_output_folder",
    "run_jobs",
    "select_unfinished",
]


SETTINGS_NAME = "settings.json"
INPUTS_KEY = "inputs"


def lock_output_folder(
    folder: Path, settings: Mapping[str, Any], inputs: Mapping[str, Path] | None = None
) -> None:
    """Make a folder for the results of a run, or check that the one there holds results of the same
    settings and inputs.

    Parameters
    ----------
    folder : Path
        Made with its parents if it is missing.
    settings : mapping
        Whatever a result depends on, besides its input: names to strings, numbers and None.
    inputs : mapping of str to Path, optional
        Files by the names of their results. The folder may hold results of more, or of less.

    Raises
    ------
    InputError
        The folder belongs to other settings, or a file has changed since its result was made.
    StorageError, FileFormatError
        It cannot be made, read or written.
    """
    path = folder / SETTINGS_NAME
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as fault:
        raise StorageError(f"{folder}: cannot be made: {fault.strerror or fault}") from fault
    wanted = {
        name: str(value) if isinstance(value, Path) else value for name, value in settings.items()
    }
    marks = _identify_files(inputs or {})
    if not path.exists():
        _write_settings(path, wanted, marks)
        return
    known = _read_settings(path)
    noted = known.pop(INPUTS_KEY, {})
    # Settings that only one side knows count as None on the other, so that a new setting with the
    # default None fits folders written before it.
    names = [name for name in {**known, **wanted} if known.get(name) != wanted.get(name)]
    if names:
        reported = ", ".join(
            f"{name} {known.get(name)} instead of {wanted.get(name)}" for name in names
        )
        raise InputError(
            f"{folder}: holds results of other settings ({reported}); choose another folder or remove it"
        )

    # A file without a result may change: a damaged shot is replaced, and its run goes on.
    changed = [
        name
        for name, mark in marks.items()
        if noted.get(name, mark) != mark and any(folder.glob(f"{glob.escape(name)}.*"))
    ]
    if changed:
        raise InputError(
            f"{folder}: holds results of other inputs ({len(changed)} have changed since, the first "
            f"is {changed[0]}); choose another folder or remove it"
        )
    if any(noted.get(name) != mark for name, mark in marks.items()):
        _write_settings(path, known, {**noted, **marks})


def _identify_files(inputs: Mapping[str, Path]) -> dict[str, str]:
    # the shots of a stack share a file, which is read once
    marks = {file: identify_file(file) for file in set(inputs.values())}
    return {name: marks[file] for name, file in inputs.items()}


def _write_settings(path: Path, settings: Mapping[str, Any], marks: Mapping[str, str]) -> None:
    content = {**settings, INPUTS_KEY: dict(marks)} if marks else dict(settings)
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def _read_settings(path: Path) -> dict[str, Any]:
    try:
        with translate_read_errors(path):
            found = json.loads(path.read_text("utf-8"))
    except ValueError as fault:
        raise FileFormatError(
            path, "is not JSON; remove it if the results beside it are to be made again"
        ) from fault
    if not isinstance(found, dict):
        raise FileFormatError(
            path, "holds no settings; remove it if the results beside it are to be made again"
        )
    return found


LOCAL = "local"
ADDRESS_SCHEMES = ("tcp://", "tls://")
WAIT_SECONDS = 30.0


@contextlib.contextmanager
def connect_workers(where: str) -> Iterator[Client]:
    """Yield a client of the workers that `where` names.

    `where`: ``local``: one worker for each core of this machine; ``local:N``: N workers, which
    share the cores; ``tcp://HOST:PORT`` or ``tls://HOST:PORT``: a scheduler (``dask scheduler``),
    whose workers (``dask worker``) have this version of this program and see the files under the
    same names.
    """
    number = count_local_workers(where)
    try:
        import distributed
    except ImportError as fault:
        raise MissingDependencyError(
            "a cluster needs dask.distributed: pip install 'tofclip[cluster]'"
        ) from fault
    opened = (
        _start_local_cluster(distributed, number)
        if number
        else _connect_scheduler(distributed, where)
    )
    with opened as client:
        yield client


def count_local_workers(where: str) -> int:
    """Return how many workers to start on this machine; 0: none, `where` is an address."""
    name, separator, number = where.partition(":")
    if name == LOCAL and not separator:
        return thread_count()
    if name == LOCAL and number.isdecimal() and int(number) >= 1:
        return int(number)
    if where.startswith(ADDRESS_SCHEMES) and len(where.split("://")[1]) > 0:
        return 0
    raise InputError(f"no cluster is called '{where}'; use local, local:N or tcp://HOST:PORT")


@contextlib.contextmanager
def _start_local_cluster(distributed: Any, number: int) -> Iterator[Client]:
    """Start processes of one job at a time that share the cores, each minded by another that
    replaces it if it dies.
    """
    threads = str(max(1, thread_count() // number))
    with _silence_log(), contextlib.ExitStack() as running:
        # Only while processes start; a Ctrl-C of that time comes at the end of the shield.
        with _shield_children_from_interrupt():
            cluster = running.enter_context(
                distributed.LocalCluster(
                    n_workers=number,
                    threads_per_worker=1,
                    processes=True,
                    dashboard_address="127.0.0.1:0",  # no one else may look
                    silence_logs=logging.CRITICAL,
                    env={THREADS_VARIABLE: threads},
                )
            )
        yield running.enter_context(distributed.Client(cluster))


@contextlib.contextmanager
def _connect_scheduler(distributed: Any, where: str) -> Iterator[Client]:
    try:
        client = distributed.Client(where, timeout=WAIT_SECONDS)
    except (OSError, ValueError) as fault:
        raise InputError(
            f"{where}: no scheduler answers; start one with 'dask scheduler'"
        ) from fault
    with _silence_log(), client:
        _check_workers(client, where)
        yield client


def _check_workers(client: Client, where: str) -> None:
    """Refuse a cluster without workers, or with workers that have not this version of this program."""
    try:
        client.wait_for_workers(1, timeout=WAIT_SECONDS)
        found = set(client.run(_version).values())
    except TimeoutError as fault:
        raise InputError(
            f"{where}: the scheduler has no worker; start some with 'dask worker {where}'"
        ) from fault
    except Exception as fault:
        raise InputError(f"{where}: its workers have no tofclip {__version__}: {fault}") from fault
    if found != {__version__}:
        versions = ", ".join(sorted(found))
        raise InputError(
            f"{where}: its workers have tofclip {versions}, this is {__version__}; install the same"
        )


def _version() -> str:
    return __version__


@contextlib.contextmanager
def _shield_children_from_interrupt() -> Iterator[None]:
    """Keep processes started now from hearing Ctrl-C: a terminal sends it to all, and we end them
    ourselves.
    """
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    # It unblocks the signal once it has started, so it has to be there before.
    resource_tracker.ensure_running()
    # Blocked, not ignored: threads and processes started now inherit it, and nothing is lost.
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextlib.contextmanager
def _silence_log() -> Iterator[None]:
    """Keep the library's log off the screen: what matters is in the summary."""
    logger = logging.getLogger("distributed")
    before = logger.level
    logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        logger.setLevel(before)


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
        `tofclip.sequences.jobs.connect_workers`; by default one job after the other in this
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
