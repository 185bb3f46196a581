"""A job, how it is attempted, and what is reported about many of them."""

from __future__ import annotations

import os
import platform
import sys
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tofclip.errors import TofclipError
from tofclip.storage import format_error_line
from tofclip.threads import limit_blas_threads


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
