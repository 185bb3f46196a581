"""Many jobs that each make a file: here, on workers started for them on this machine, or on those
of a scheduler that is there already.

A folder of results belongs to one set of settings and inputs, so that no run goes on with the
results of another.
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
from itertools import islice
from multiprocessing import resource_tracker
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tofclip.errors import (
    FileFormatError,
    InputError,
    StorageError,
    TofclipError,
    explain_import,
)
from tofclip.files import (
    atomic_path,
    explain_os_error,
    format_error_line,
    identify_file,
    remove_temporary_files,
    require_apart,
    translate_read_errors,
)
from tofclip.threads import THREADS_VARIABLE, limit_blas_threads, thread_count
from tofclip.version import __version__

if TYPE_CHECKING:
    from distributed import Client, Future, as_completed

__all__ = [
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
    """Make a folder for the results of a run, or refuse one that holds results of other settings or
    of files that have changed since. `settings`: whatever a result depends on besides its input,
    strings, numbers and None; `inputs`: files by the names of their results, of which the folder may
    hold more or less.
    """
    path = folder / SETTINGS_NAME
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as fault:
        raise StorageError(f"{folder}: cannot be made: {explain_os_error(fault)}") from fault
    wanted = {name: str(one) if isinstance(one, Path) else one for name, one in settings.items()}
    inputs = inputs or {}
    # the shots of a stack share a file, which is read once
    identities = {file: identify_file(file) for file in set(inputs.values())}
    marks = {name: identities[file] for name, file in inputs.items()}
    if not path.exists():
        _write_settings(path, wanted, marks)
        return
    try:
        with translate_read_errors(path):
            known = json.loads(path.read_text("utf-8"))
        noted = known.pop(INPUTS_KEY, {})
    except (ValueError, AttributeError, TypeError) as fault:
        raise FileFormatError(
            path, "holds no settings; remove it if the results beside it are to be made again"
        ) from fault
    # Settings that only one side knows count as None on the other, so that a new setting with the
    # default None fits folders written before it.
    reported = ", ".join(
        f"{name} {known.get(name)} instead of {wanted.get(name)}"
        for name in {**known, **wanted}
        if known.get(name) != wanted.get(name)
    )
    if reported:
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


def _write_settings(path: Path, settings: Mapping[str, Any], marks: Mapping[str, str]) -> None:
    content = {**settings, INPUTS_KEY: dict(marks)} if marks else dict(settings)
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


ADDRESS_SCHEMES = ("tcp://", "tls://")
WAIT_SECONDS = 30.0


@contextlib.contextmanager
def connect_workers(where: str) -> Iterator[Client]:
    """Yield a client of the workers that `where` names. `where`: ``local``: one worker for each
    core of this machine; ``local:N``: N workers, which share the cores; ``tcp://HOST:PORT`` or
    ``tls://HOST:PORT``: a scheduler (``dask scheduler``), whose workers (``dask worker``) have this
    version of this program and see the files under the same names.
    """
    number = count_local_workers(where)
    with explain_import("a cluster needs dask.distributed: pip install 'tofclip[cluster]'"):
        import distributed
    # What matters is in the summary: the library's log stays off the screen.
    logger = logging.getLogger("distributed")
    level = logger.level
    logger.setLevel(logging.CRITICAL)
    try:
        with contextlib.ExitStack() as running:
            if not number:
                client = running.enter_context(_connect_scheduler(distributed, where))
            else:
                # Processes of one job at a time that share the cores, each minded by another that
                # replaces it if it dies. Only while they start; a Ctrl-C of that time comes then.
                with _shield_children_from_interrupt():
                    cluster = distributed.LocalCluster(
                        n_workers=number,
                        threads_per_worker=1,
                        processes=True,
                        dashboard_address="127.0.0.1:0",  # no one else may look
                        silence_logs=logging.CRITICAL,
                        env={THREADS_VARIABLE: str(max(1, thread_count() // number))},
                    )
                    running.enter_context(cluster)
                client = running.enter_context(distributed.Client(cluster))
            yield client
    finally:
        logger.setLevel(level)


def count_local_workers(where: str) -> int:
    """Return how many workers to start on this machine; 0: none, `where` is an address."""
    name, separator, number = where.partition(":")
    if name == "local" and not separator:
        return thread_count()
    if name == "local" and number.isdecimal() and int(number) >= 1:
        return int(number)
    if where.startswith(ADDRESS_SCHEMES) and len(where.split("://")[1]) > 0:
        return 0
    raise InputError(f"no cluster is called '{where}'; use local, local:N or tcp://HOST:PORT")


def _connect_scheduler(distributed: Any, where: str) -> Client:
    """Refuse a cluster without workers, or with workers that have not this version of this program."""
    try:
        client: Client = distributed.Client(where, timeout=WAIT_SECONDS)
    except (OSError, ValueError) as fault:
        raise InputError(
            f"{where}: no scheduler answers; start one with 'dask scheduler'"
        ) from fault
    try:
        client.wait_for_workers(1, timeout=WAIT_SECONDS)
        versions = set(client.run(_version).values())
        if versions == {__version__}:
            return client
        theirs = ", ".join(sorted(versions))
        problem = f"its workers have tofclip {theirs}, this is {__version__}; install the same"
    except TimeoutError:
        problem = f"the scheduler has no worker; start some with 'dask worker {where}'"
    except Exception as fault:
        problem = f"its workers have no tofclip {__version__}: {fault}"
    client.close()
    raise InputError(f"{where}: {problem}")


def _version() -> str:
    return __version__


@contextlib.contextmanager
def _shield_children_from_interrupt() -> Iterator[None]:
    """Keep processes started now from hearing Ctrl-C, sent to all: we end them ourselves."""
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


@dataclass(frozen=True)
class Job:
    """Something to be done once."""

    name: str  # what a message calls it
    result: Path  # the file it makes, whole or not at all, where every worker can write it
    # Makes the file; may return a few figures about it. It has to survive pickling: a
    # `functools.partial` of a function of a module with names of files and numbers.
    work: Callable[[], Any]
    extra_outputs: tuple[Path, ...] = ()  # further files that it writes, before the result


@dataclass(frozen=True)
class Report:
    """What became of a job."""

    name: str
    problem: str = ""  # in one line; empty if it went well
    figures: Any = None  # what its work returned; None as well where the result was there already
    process: str = ""  # which process did it; empty where none did
    peak_bytes: int = 0  # most memory that this process has held so far, where the system says


@dataclass(frozen=True)
class Summary:
    """What became of many jobs."""

    done: int  # jobs whose result is there now
    failures: tuple[Report, ...]  # the others, by name
    processes: int  # how many took part
    peak_bytes: int  # most memory that one of them held, its program and libraries included
    seconds: float


def select_unfinished(jobs: Iterable[Job]) -> list[Job]:
    """Return the jobs whose result is not there yet."""
    return [job for job in jobs if not job.result.exists()]


def list_jobs(
    folder: Path,
    suffix: str,
    settings: Mapping[str, Any],
    inputs: Mapping[str, Path],
    make_work: Callable[[str, Path], Callable[[], Any]],
    others: Iterable[Path | None] = (),
) -> list[Job]:
    """Return a job for each input, which writes its result, of the same name, into a folder that is
    made for the settings, or is that of the same ones; refuse one that would overwrite an input, or
    one of the `others` that are read.
    """
    # Workers have another working directory.
    paths = {name: folder.resolve() / f"{name}{suffix}" for name in inputs}
    require_apart(paths.values(), {*inputs.values(), *others})
    # Before the folders inside are made: a folder of other settings stays untouched.
    lock_output_folder(folder, settings, inputs)
    for parent in {path.parent for path in paths.values()}:
        parent.mkdir(parents=True, exist_ok=True)
    return [Job(name, path, make_work(name, path)) for name, path in paths.items()]


def run_job(job: Job) -> Report:
    """Do a job unless its result is there; whatever goes wrong is reported, so that the others go
    on. The libraries of linear algebra get one thread: with more, they round differently, and jobs
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
    process = f"{platform.node()}:{os.getpid()}"
    return Report(job.name, problem, figures, process, measure_peak_memory_bytes())


def measure_peak_memory_bytes() -> int:
    """Most memory that this process has held so far; 0 where the system does not report it."""
    try:
        import resource
    except ImportError:  # Windows
        return 0
    # getrusage(2) gives kilobytes on Linux and bytes on macOS.
    unit = 1024 if sys.platform.startswith("linux") else 1
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit


MAX_SUBMITTED = 1000  # jobs that the scheduler knows: a sequence of millions costs it no memory
RECOUNT_INTERVAL_S, POLL_INTERVAL_S = 1.0, 0.01
MAX_WORKERLESS_S = 120.0  # those that died start again, or by a queue of a computing centre


def run_jobs(
    jobs: Sequence[Job],
    cluster: str | None = None,
    on_report: Callable[[Report], object] | None = None,
) -> Summary:
    """Attempt every job once; one that fails is in the summary and stops none of the others. `cluster`
    as of `connect_workers`, by default one job after the other in this process; scripts that start
    local workers need ``if __name__ == "__main__":``. `on_report` is called in this thread.

    A job whose worker dies (killed, out of memory, power failure) is given to another. One that
    outlives too many workers (the scheduler's ``allowed-failures``) may be innocent, because those
    that wait beside it are blamed as well: at the end each of them gets another chance, alone. What a
    worker that died was writing, under a temporary name, is removed at the end.
    """
    started = time.perf_counter()
    done, peak = 0, 0
    failures: list[Report] = []
    processes: set[str] = set()
    try:
        for report in map(run_job, jobs) if cluster is None else _run_on_cluster(jobs, cluster):
            if on_report is not None:
                on_report(report)
            if report.problem:
                failures.append(report)
            done += not report.problem
            processes.add(report.process)
            peak = max(peak, report.peak_bytes)
    finally:
        # Also after an interrupt: workers that were killed could not clean up themselves.
        remove_temporary_files(path for job in jobs for path in (job.result, *job.extra_outputs))
    failures.sort(key=lambda failure: failure.name)
    seconds = time.perf_counter() - started
    return Summary(done, tuple(failures), len(processes - {""}), peak, seconds)


def _run_on_cluster(jobs: Sequence[Job], cluster: str) -> Iterator[Report]:
    if not jobs:
        return
    with connect_workers(cluster) as client:
        suspects: list[Job] = []
        yield from _run_on_workers(client, jobs, suspects)
        # One at a time, so that a death can be blamed on no other job.
        for job in suspects:
            killers: list[Job] = []
            yield from _run_on_workers(client, [job], killers)
            if killers:
                yield Report(job.name, "each worker that tried it died; is there enough memory?")


def _run_on_workers(client: Client, jobs: Sequence[Job], killers: list[Job]) -> Iterator[Report]:
    """Do all jobs; yield the reports as they come. `killers` gets those whose workers died."""
    from distributed import KilledWorker, as_completed

    waiting = iter(jobs)
    running: dict[Future[Any], Job] = {}
    finished = as_completed(raise_errors=False)

    def submit(count: int) -> None:
        for job in islice(waiting, count):
            # Not pure: Dask would otherwise give the earlier answer to an equal job.
            future = client.submit(run_job, job, pure=False)
            running[future] = job
            finished.add(future)

    submit(MAX_SUBMITTED)
    try:
        for future in _iterate_finished(client, finished):
            job = running.pop(future)
            fault = future.exception()
            if isinstance(fault, KilledWorker):
                killers.append(job)
            elif fault is None:
                yield future.result()
            else:
                name = type(fault).__name__
                yield Report(job.name, f"the cluster did not do it: {name} {fault}")
            submit(1)
    finally:
        # Reached early when the caller stops iterating or is interrupted; otherwise nothing is left.
        if running:
            client.cancel(list(running))


def _iterate_finished(client: Client, finished: as_completed) -> Iterator[Future[Any]]:
    """Yield futures as they finish, while there are workers to finish them."""
    counted_s = had_workers_s = time.monotonic()
    while not finished.is_empty():
        now = time.monotonic()
        if finished.has_ready():
            had_workers_s = now
            yield next(finished)
            continue
        if now > counted_s + RECOUNT_INTERVAL_S:
            counted_s = now
            had_workers_s = now if client.nthreads() else had_workers_s
        if now > had_workers_s + MAX_WORKERLESS_S:
            raise InputError(
                f"the cluster has had no worker for {MAX_WORKERLESS_S:.0f} s; start some and "
                "run this again: what is done stays"
            )
        time.sleep(POLL_INTERVAL_S)
