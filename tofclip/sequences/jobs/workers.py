"""Where jobs run: on workers started for them on this machine, or on those of a scheduler that is
there already.
"""

from __future__ import annotations

import contextlib
import logging
import signal
from collections.abc import Iterator
from multiprocessing import resource_tracker
from typing import TYPE_CHECKING, Any

from tofclip.errors import InputError, MissingDependencyError
from tofclip.threads import THREADS_VARIABLE, thread_count
from tofclip.version import __version__

if TYPE_CHECKING:
    from distributed import Client

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
