"""Compile the loops of a first run in other processes, while this one does what needs none.

The compiler lets only one thread of a process work. Other processes leave what they compile in the
compiler's cache, from which this one loads it. It waits only where it calls a loop that is not
there yet, and that loop is compiled next.
"""

from __future__ import annotations

import contextlib
import gc
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from importlib import import_module
from pathlib import Path
from types import MappingProxyType
from typing import Any

from apps.processes import prepare_module_run
from tofclip.compile_observers import observers, suppliers
from tofclip.threads import thread_count

MAX_PROCESSES = 3
"""Each takes as long to start as two loops to compile."""

CANDIDATES, NEIGHBOURS = "tofclip.lidar.search.candidates", "tofclip.lidar.neighbours"
JUDGED = "tofclip.lidar.candidate_loops"
TABLE, EXACT = "tofclip.lidar.search.table_fit", "tofclip.lidar.search.exact_fit"
CAMERA, OPERATORS = "tofclip.camera.kernels", "tofclip.operators.kernels"
SOLVERS, SURFACES = "tofclip.solvers.kernels", "tofclip.recovery.surfaces.kernels"

LOOPS: Mapping[tuple[str, str], str] = MappingProxyType(
    {
        (CAMERA, "mark_valid"): "(b1[:,::1], f4[:,::1], f4[:,::1], f4, b1[:,::1])",
        (CAMERA, "sample_rows"): (
            "(f4[:,::1], f4, f4[:,::1], u8[:,::1], i8[::1], i8[::1], f4[:,::1])"
        ),
        (SOLVERS, "shrink_nonnegative"): (
            "(f4[::1], f4[::1], f4[::1], f4[::1], f4[::1], f4[::1], f4[:,::1], f8[::1], f8[::1])"
        ),
        (OPERATORS, "count_tile_nonzeros"): "(i4[::1], i4[::1], i8, i8[:,::1])",
        (OPERATORS, "sort_into_tiles"): (
            "(i4[::1], i4[::1], f4[::1], i8, i8[:,::1], u4[::1], f4[::1])"
        ),
        (OPERATORS, "multiply_sparse_block"): "(i8[:,::1], u4[::1], f4[::1], f4[:,::1], f4[:,::1])",
        (SOLVERS, "copy_lanes_to_frames"): "(f4[:,::1], f4[:,::1])",
        (SOLVERS, "restore_frames"): "(f4[:,:,::1], f4[:,:,::1], f4[::1])",
        (CANDIDATES, "find_candidates"): (
            "(f4[:,::1], i8[::1], f8[::1], f4[::1], f4[:,::1], i8[::1], i8[::1], i8[::1], f4[::1],"
            " f4[::1], f4[:,::1], i8[::1], f8[::1], UniTuple(f8, 3), i4[:,::1], UniTuple(f8, 5),"
            " b1[::1], i8, f4[::1], i4[:,::1], f4[::1], f4[::1], f8[:,::1], f8[:,::1],"
            " f8[:,::1], f4[:,::1], i8[::1], i8[::1], i8[::1])"
        ),
        (EXACT, "fit_returns_exactly"): (
            "(f4[:,::1], i8[::1], f8[::1], f8[:,::1], f8, i4[:,::1], f8[:,::1], i8,"
            " Tuple((f8[:,::1], UniTuple(f8, 4))), f8[:,::1], f8[:,::1], f8[:,:,::1], i8[::1])"
        ),
        (TABLE, "fit_crowded_returns"): (
            "(f4[:,::1], f8[:,::1], b1[::1], i8, f8[:,::1], f4[:,::1], i8[::1], i8, f4[:,::1],"
            " f4[:,::1], f4[:,::1], f8[:,::1])"
        ),
        (TABLE, "fit_lone_returns"): (
            "(f4[:,::1], f8[:,::1], b1[::1], i8, f8[:,::1], f4[:,::1], i8[::1], i8, f4[:,::1],"
            " f4[:,::1], f8[:,::1])"
        ),
        (TABLE, "measure_returns_by_table"): (
            "(f8[:,::1], i8, f4[:,::1], f8, i8[::1], f8[::1], f4[:,::1], f4[:,::1], f8[:,::1],"
            " f8[:,:,::1], i8[::1])"
        ),
        (TABLE, "list_returns"): "(f8[:,:,::1], i8[::1], i8[::1], f8[:,::1])",
        (NEIGHBOURS, "scatter_about_planes"): (
            "(f8[::1], f8[::1], i8[::1], i8, f4[:,:,:,::1], f8, i8[::1], f4[:,::1], f8[::1])"
        ),
        (NEIGHBOURS, "borrow_scatter"): (
            "(f8[::1], f8[::1], i8[::1], UniTuple(i8, 2), f8, f4[:,::1], f8[::1])"
        ),
        (JUDGED, "pool_significance"): (
            "(i8[::1], f8[::1], f8[::1], f8[::1], i8[::1], UniTuple(i8, 2), UniTuple(f8, 2),"
            " f8[::1])"
        ),
        (JUDGED, "list_kept"): (
            "(i8[::1], f8[:,::1], b1[::1], i8, i8[::1], i4[:,::1], u1[::1], f8[:,::1], f4[::1])"
        ),
        (NEIGHBOURS, "count_returns"): "(i8[::1], i8[::1])",
        (NEIGHBOURS, "fill_layers"): "(f8[::1], i8[::1], i8[::1], i8, f4[:,:,:,::1])",
        (NEIGHBOURS, "widen_deviations"): "(f8[::1], f8[::1], f4[::1])",
        (SURFACES, "split_over_slit"): "(f8[::1], f8, i8, i4[::1], f4[:,::1])",
        (SURFACES, "add_light"): "(f4[::1], i4[::1], f4[:,::1], i4[::1], f4[:,::1], f4[:,::1])",
        (SURFACES, "smooth_rows"): "(f4[:,::1], f4[::1], i8[::1], i8, f4[:,::1])",
        (SURFACES, "gather_light"): (
            "(f4[:,::1], f8, i4[::1], f4[:,::1], i4[::1], f4[:,::1], f4[::1])"
        ),
        (SURFACES, "apply_dual"): "(f4[:,::1], b1[:,::1], f8, f4[:,:,::1], f4[:,::1])",
        (SURFACES, "ascend_dual"): "(f4[:,::1], b1[:,::1], f8, f8, f4[:,:,::1], f4[:,:,::1])",
        (JUDGED, "raise_maxima"): (
            "(i8[::1], f8[::1], f8[::1], UniTuple(f8, 2), f8[::1], f8[::1])"
        ),
        (JUDGED, "mark_strong"): (
            "(i8[::1], f8[::1], f8[::1], UniTuple(f8, 2), f8[::1], f8[::1], b1[::1])"
        ),
        (SOLVERS, "descend_total_variation"): (
            "(i8, f4[:,::1], f4[:,::1], f4[::1], f4[:,::1], f4[::1], f4[::1], f4[:,:,::1],"
            " f4[::1], f4[:,::1], f4[::1])"
        ),
    }
)
"""Module and name of the loops that recovery and ranging of a shot call, and for which arguments: a
letter and bytes for each kind of number, as Numba writes them. What the demonstration needs first
comes first, and of what it needs together that which takes longest to compile."""


@contextlib.contextmanager
def compile_loops_ahead() -> Iterator[None]:
    """Compile what recovering and ranging a shot call, in other processes, while the block runs.

    What is in the cache is not compiled again. If a process fails, what is left is compiled when it
    is called. What is not compiled at the end of the block is left to the next run.
    """
    missing = [loop for loop in LOOPS if not _has_entry(_find_loop(*loop))]
    if not missing:
        yield
        return
    for report in tuple(observers):
        report(missing[0][1])
    compilation = _Compilation(missing)
    suppliers.append(compilation.wait_for)
    try:
        compilation.start()
        yield
    finally:
        suppliers.remove(compilation.wait_for)
        compilation.stop()


def _find_loop(module: str, name: str) -> Any:
    return getattr(import_module(module), name)


def _has_entry(loop: Any) -> bool:
    """Whether the compiler's cache has a loop; what is not compiled at all needs no entry."""
    if not hasattr(loop, "stats"):
        return True
    source = Path(loop.py_func.__code__.co_filename)
    stem = f"{source.stem}.{loop.__name__}-{loop.py_func.__code__.co_firstlineno}."
    changed = source.stat().st_mtime
    folder = Path(loop.stats.cache_path)
    return any(entry.stat().st_mtime >= changed for entry in folder.glob(f"{stem}*.nbi"))


class _Compilation:
    """Processes that compile loops, each of them one loop after another.

    Parameters
    ----------
    loops : iterable of (str, str)
        Module and name, in the order in which they are needed.
    """

    def __init__(self, loops: Iterable[tuple[str, str]]) -> None:
        self._left = deque(loops)
        self._ended = {loop: threading.Event() for loop in self._left}
        self._lock = threading.Lock()
        self._processes: list[subprocess.Popen[str]] = []

    def start(self) -> None:
        """Begin to compile."""
        try:
            for _ in range(min(thread_count(), MAX_PROCESSES, len(self._left))):
                self._processes.append(_start_process())
        except OSError:  # no further process can be started
            if not self._processes:
                self._give_up()
        for process in self._processes:
            threading.Thread(target=self._feed, args=(process,), daemon=True).start()

    def stop(self) -> None:
        """End all processes, also those that are at work."""
        self._give_up()
        for process in self._processes:
            process.kill()
            process.wait()

    def wait_for(self, module: str, name: str) -> None:
        """Return when a loop is in the cache, or left to its caller; it is the next in turn.

        Parameters
        ----------
        module, name : str
        """
        loop = module, name
        with self._lock:
            if loop in self._left:
                self._left.remove(loop)
                self._left.appendleft(loop)
        if loop in self._ended:
            self._ended[loop].wait()

    def _feed(self, process: subprocess.Popen[str]) -> None:
        """Let a process compile what is left, one loop after another."""
        assert process.stdin is not None
        assert process.stdout is not None
        with contextlib.suppress(OSError), process.stdin, process.stdout:
            while (loop := self._take_next()) is not None:
                print(*loop, file=process.stdin, flush=True)
                if not process.stdout.readline():
                    break
                self._ended[loop].set()
            else:
                return
        self._give_up()  # it has died

    def _take_next(self) -> tuple[str, str] | None:
        with self._lock:
            return self._left.popleft() if self._left else None

    def _give_up(self) -> None:
        """Leave what is left to those who call it."""
        with self._lock:
            self._left.clear()
        for ended in self._ended.values():
            ended.set()


def _start_process() -> subprocess.Popen[str]:
    command, environment = prepare_module_run("apps.compile_ahead")
    return subprocess.Popen(
        command,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        env=environment,
    )


def compile_named(lines: Iterable[str], report: Callable[[str], None]) -> None:
    """Compile loops in this process.

    Parameters
    ----------
    lines : iterable of str
        Module and name of each loop, which is one of `LOOPS`.
    report : callable
        Called with the name of each loop that is compiled.
    """
    from numba.core.sigutils import normalize_signature

    for line in lines:
        module, name = line.split()
        # the cache knows a loop by the types as a call gives them, not by their names
        arguments, _ = normalize_signature(LOOPS[module, name])
        _find_loop(module, name).compile(arguments)
        report(name)


if __name__ == "__main__":
    gc.disable()  # nearly all that the compiler makes stays, and the process ends soon
    compile_named(sys.stdin, lambda name: print(name, flush=True))
