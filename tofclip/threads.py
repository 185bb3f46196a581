"""Blocks and threads: how a batch of pictures is cut up and shared between the processor's cores.

The compiled kernels of this package are serial and release the interpreter lock; whoever has many
frames cuts them into blocks and runs the blocks on a few Python threads. There is no second thread
pool (OpenMP, numba's) to fight with.
"""

from __future__ import annotations

import os
import threading
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager
from functools import cache
from typing import TYPE_CHECKING, Any, TypeVar

from tofclip.errors import InputError

if TYPE_CHECKING:
    from threadpoolctl import ThreadpoolController

T = TypeVar("T")
Made = TypeVar("Made")

LANES = 32
"""Frames per block: a row of a block is two full vectors of 512 bits, and a 174 x 174 picture stays
in cache.
"""

THREADS_VARIABLE = "TOFCLIP_THREADS"


def thread_count() -> int:
    """Threads to use: the environment's ``TOFCLIP_THREADS``, else one for each core this process
    may run on.

    Raises
    ------
    InputError
        The variable is not a positive whole number.
    """
    wanted = os.environ.get(THREADS_VARIABLE, "")
    if not wanted:
        affinity = getattr(os, "sched_getaffinity", None)
        return len(affinity(0)) if affinity else os.cpu_count() or 1
    if not wanted.isdecimal() or int(wanted) < 1:
        raise InputError(f"{THREADS_VARIABLE} must be a positive whole number, got '{wanted}'")
    return int(wanted)


_thread_state = threading.local()


@contextmanager
def limit_to_calling_thread() -> Iterator[None]:
    """Let `run_blocks` work on the calling thread alone, for whoever has other work for the other
    cores.
    """
    before = _is_limited()
    _thread_state.alone = True
    try:
        yield
    finally:
        _thread_state.alone = before


def _is_limited() -> bool:
    return getattr(_thread_state, "alone", False)


def map_per_core(work: Callable[[T], Made], items: Iterable[T]) -> Generator[Made, None, None]:
    """Yield what `work` makes of each item, in order, while every core is busy with another one of
    them.

    Items that share the cores wait for each other; items that have one each do not. `thread_count`
    of them are worked on at a time, and as many results are kept at most. NumPy's products keep to
    one thread until the end. The first exception is raised where its result would be.
    """

    def alone(item: T) -> Made:
        with limit_to_calling_thread():
            return work(item)

    count = thread_count()
    with limit_blas_threads(), ThreadPoolExecutor(count, "tofclip") as cores:
        under_way: deque[Future[Made]] = deque()
        try:
            for item in items:
                under_way.append(cores.submit(alone, item))
                if len(under_way) > count:
                    yield under_way.popleft().result()
            while under_way:
                yield under_way.popleft().result()
        finally:
            for one in under_way:
                one.cancel()


def split_blocks(total: int, size: int = LANES) -> Iterator[slice]:
    """Cut ``range(total)`` into slices of at most `size`."""
    for start in range(0, total, size):
        yield slice(start, min(start + size, total))


def run_blocks(work: Callable[[slice], None], total: int, size: int = LANES) -> None:
    """Call `work` on every block of ``range(total)``, on `thread_count` threads; the first
    exception is raised.

    An interruption (Ctrl-C) waits for the blocks under way and starts no further ones.
    """
    pieces = list(split_blocks(total, size))
    threads = 1 if _is_limited() else min(thread_count(), len(pieces))
    if threads <= 1:
        for piece in pieces:
            work(piece)
        return
    pool = ThreadPoolExecutor(threads, thread_name_prefix="tofclip")
    try:
        for _ in pool.map(work, pieces):
            pass
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def limit_blas_threads() -> AbstractContextManager[Any]:
    """Keep matrix products on the threads that call them.

    Where blocks keep every core busy already, BLAS threads of its own would wait for, and spin
    against, ours.
    """
    limited: AbstractContextManager[Any] = _blas_controller().limit(limits=1, user_api="blas")
    return limited


@cache
def _blas_controller() -> ThreadpoolController:
    """The linear-algebra libraries that are loaded; looking for them takes as long as a small
    image.
    """
    import scipy.linalg  # noqa: F401 - brings one of its own beside NumPy's
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()
