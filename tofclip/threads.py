"""Work on every core: blocks of an array, or independent jobs, on a few Python threads.

The compiled kernels of this package are serial and release the interpreter lock. Work is therefore
shared between cores in one place, here, by threads that each take one job at a time. There is no
second thread pool (OpenMP, numba's) to compete with, and BLAS is limited to one thread meanwhile.
"""

from __future__ import annotations

import os
import sys
import threading
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Executor, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from contextvars import copy_context
from functools import lru_cache
from typing import TYPE_CHECKING, TypeVar

from tofclip.errors import require

if TYPE_CHECKING:
    from threadpoolctl import LibController

Job = TypeVar("Job")
Result = TypeVar("Result")

# Frames per block: a row of a block is two full vectors of 512 bits, and a 174 x 174 picture stays in
# cache.
LANES = 32

THREADS_VARIABLE = "TOFCLIP_THREADS"
# Of others, that bring a linear-algebra library of their own, or load the system's.
BLAS_PACKAGES = ("cupy", "cv2", "jax", "mkl", "open3d", "sklearn", "tensorflow", "torch")


def thread_count() -> int:
    """Return how many threads to use: ``TOFCLIP_THREADS``, else one for each core we may use."""
    wanted = os.environ.get(THREADS_VARIABLE, "")
    if not wanted:
        affinity = getattr(os, "sched_getaffinity", None)
        return len(affinity(0)) if affinity else os.cpu_count() or 1
    require(
        wanted.isdecimal() and int(wanted) >= 1,
        f"{THREADS_VARIABLE} must be a positive whole number, got '{wanted}'",
    )
    return int(wanted)


_worker = threading.local()


def _mark_worker() -> None:
    """Make a worker keep to itself: a job within a job would only wait for the same cores."""
    _worker.alone = True


@contextmanager
def open_worker_pool() -> Iterator[Executor]:
    """Yield an executor with a thread for each core, for jobs that each keep to one core; BLAS has one
    thread meanwhile. At the end of the block, jobs that have not begun are cancelled and those under
    way waited for.
    """
    pool = ThreadPoolExecutor(thread_count(), "tofclip", _mark_worker)
    with limit_blas_threads():
        try:
            yield pool
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


def count_block_threads() -> int:
    """Return on how many threads `map_parallel` and `run_blocks` work when they are called here."""
    return 1 if getattr(_worker, "alone", False) else thread_count()


def map_parallel(
    work: Callable[[Job], Result], jobs: Iterable[Job], lookahead: int | None = None
) -> Generator[Result, None, None]:
    """Yield ``work(job)`` for each job, in order, while the other cores work on the next ones.

    The one parallel map of this package. Every job has one core to itself: maps within `work` run
    on its thread, and BLAS products too. Jobs are taken as they are needed; `lookahead` of them, by
    default one per thread, may be under way or done before their turn, which bounds the results in
    memory. The first exception is raised in its result's place, and no further job is started.
    """
    threads = count_block_threads()
    if threads == 1:
        yield from map(work, jobs)
        return
    pool, pending = _keep_pool(threads), deque[Future[Result]]()
    with limit_blas_threads():
        try:
            for job in jobs:
                # in the caller's context: NumPy keeps there which faults are ignored
                pending.append(pool.submit(copy_context().run, work, job))
                if len(pending) > (lookahead or threads):
                    yield pending.popleft().result()
            while pending:
                yield pending.popleft().result()
        finally:
            wait([one for one in pending if not one.cancel()])


def _keep_pool(threads: int) -> Executor:
    """Return the calling thread's workers, which stay: to begin some for each map took as long as a
    small map itself. A forked process has none of them.
    """
    known = os.getpid(), threads
    if getattr(_worker, "known", None) != known:
        _worker.known, _worker.pool = known, ThreadPoolExecutor(threads, "tofclip", _mark_worker)
    pool: Executor = _worker.pool
    return pool


def split_blocks(total: int, size: int = LANES) -> Iterator[slice]:
    """Cut ``range(total)`` into slices of at most `size`."""
    for start in range(0, total, size):
        yield slice(start, min(start + size, total))


def run_blocks(work: Callable[[slice], None], total: int, size: int = LANES) -> None:
    """Call `work` on every block of ``range(total)``, blocks on all cores; see `map_parallel`. They must
    not write to the same memory. An interruption (Ctrl-C) waits for the blocks under way and starts no
    further ones.
    """
    blocks = list(split_blocks(total, size))
    if len(blocks) == 1:  # on the calling thread, with all threads that BLAS has
        work(blocks[0])
        return
    for _ in map_parallel(work, blocks, lookahead=len(blocks)):
        pass


# The collector may close a forgotten `map_parallel` at any time, also on the thread that holds it.
_blas_lock = threading.RLock()
_open_blocks = 0
# By file: libraries that have one number of threads for the process, and what they had.
_limited: dict[str, tuple[LibController, int]] = {}


@contextmanager
def limit_blas_threads() -> Iterator[None]:
    """Keep matrix products on the threads that call them.

    Where blocks keep every core busy already, BLAS threads of its own would wait for, and spin
    against, ours. Most libraries have one number of threads for the whole process: blocks on
    several threads are counted, the first one sets the limit and the last one restores what was
    there before. Libraries that run on OpenMP have a number for each calling thread.
    """
    global _open_blocks
    libraries = _find_blas_libraries(tuple(name in sys.modules for name in BLAS_PACKAGES))
    own = {
        library: library.get_num_threads()
        for library in libraries
        if getattr(library, "threading_layer", "") == "openmp"
    }
    with _blas_lock:
        _open_blocks += 1
        for library in libraries:  # also those that were loaded while another block was open
            if library not in own and library.filepath not in _limited:
                _limited[library.filepath] = library, library.get_num_threads()
                _set_blas_threads(library, 1)
    for library in own:
        _set_blas_threads(library, 1)
    try:
        yield
    finally:
        for library, number in own.items():
            _set_blas_threads(library, number)
        with _blas_lock:
            _open_blocks -= 1
            if _open_blocks == 0:
                for library, number in _limited.values():
                    _set_blas_threads(library, number)
                _limited.clear()


def _set_blas_threads(library: LibController, number: int) -> None:
    # From 3.8 on, threadpoolctl lets only the thread that came first set OpenBLAS's number and
    # ignores all others, which leaves them unlimited. Here the lock and the count keep order.
    release = getattr(library, "clear_controlling_thread", lambda force: None)
    release(force=True)
    library.set_num_threads(number)
    release(force=True)


@lru_cache(maxsize=1)
def _find_blas_libraries(imported: tuple[bool, ...]) -> list[LibController]:
    """Return the linear-algebra libraries that are loaded. To look for them takes almost a
    millisecond, a tenth of all time where surfaces are fitted: it is done again where one of
    `BLAS_PACKAGES` has been imported since.
    """
    import scipy.linalg  # noqa: F401 - brings one of its own beside NumPy's
    from threadpoolctl import ThreadpoolController

    return [
        library
        for library in ThreadpoolController().lib_controllers
        if library.user_api == "blas" and library.get_num_threads() is not None
    ]
