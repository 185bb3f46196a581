"""Compile the loops of a first run side by side, in processes of their own, before they are needed.

The compiler lets only one thread of a process work. Each group of `GROUPS` is compiled by a process
that leaves the result in the compiler's cache, from which this process loads it.
"""

from __future__ import annotations

import gc
import os
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from types import MappingProxyType
from typing import Any

from apps.progress import show_progress
from tofclip.__main__ import OBJECTS_PER_COLLECTION
from tofclip.compile_observers import observers
from tofclip.threads import map_parallel

TITLE = "compiling loops for this processor, once"

PEAKS, NEIGHBOURS = "tofclip.lidar.search.peaks", "tofclip.lidar.neighbours"
TABLE, EXACT = "tofclip.lidar.search.table_fit", "tofclip.lidar.search.exact_fit"
CAMERA, OPERATORS = "tofclip.camera.kernels", "tofclip.operators.kernels"
SOLVERS, SURFACES = "tofclip.solvers.kernels", "tofclip.recovery.surfaces.kernels"

LOOPS: Mapping[tuple[str, str], str] = MappingProxyType(
    {
        (PEAKS, "find_strongest_peaks"): (
            "(f4[:,::1], f8[::1], f4[::1], f4[:,::1], i8[::1], i8[::1], i8[::1], f4[::1],"
            " f4[:,::1], i8[::1], f8[::1], UniTuple(f8, 3), i8[:,::1], UniTuple(f8, 5), f4[::1],"
            " f4[:,::1], f4[::1], f8[:,::1], f8[:,:,::1])"
        ),
        (PEAKS, "confirm_peaks"): (
            "(f4[:,::1], f8[::1], f4[:,::1], i8[::1], f8[::1], UniTuple(f8, 5), f4[::1],"
            " f8[:,::1], f8[:,:,::1], f8[:,::1])"
        ),
        (TABLE, "cut_out_returns"): (
            "(f4[:,::1], i8[::1], f8[:,::1], b1[::1], i8, f8[:,::1], i8, f4[:,::1], i8[::1],"
            " i8[::1], i8[::1])"
        ),
        (TABLE, "fit_lone_returns"): (
            "(f8[:,::1], f4[:,::1], i8[::1], i8, f4[:,::1], f4[:,::1], f8[:,::1])"
        ),
        (TABLE, "fit_crowded_returns"): (
            "(f8[:,::1], f4[:,::1], i8[::1], i8, i8, f4[:,::1], f4[:,::1], f4[:,::1], f8[:,::1])"
        ),
        (TABLE, "measure_returns_by_table"): (
            "(f8[:,::1], i8, f4[:,::1], f8, i8[::1], f8[::1], f4[:,::1], f4[:,::1], f8[:,::1],"
            " f8[:,:,::1], i8[::1])"
        ),
        (TABLE, "list_returns"): "(f8[:,:,::1], i8[::1], i8[::1], f8[:,::1])",
        (EXACT, "fit_returns_exactly"): (
            "(f4[:,::1], i8[::1], f8[::1], f8[:,::1], f8, i8[:,::1], f8[:,::1], i8,"
            " Tuple((f8[:,::1], UniTuple(f8, 4))), f8[:,::1], f8[:,::1], f8[:,:,::1], i8[::1])"
        ),
        (CAMERA, "sample_runs"): "(f4[:,::1], f4, f4[:,::1], u8[:,::1], f4[:,::1])",
        (CAMERA, "mark_valid"): "(b1[:,::1], f4[:,::1], f4[:,::1], f4, b1[:,::1])",
        (OPERATORS, "count_tile_nonzeros"): "(i4[::1], i4[::1], i8, i8[:,::1])",
        (OPERATORS, "sort_into_tiles"): (
            "(i4[::1], i4[::1], f4[::1], i8, i8[:,::1], u4[::1], f4[::1])"
        ),
        (OPERATORS, "multiply_sparse_block"): (
            "(i8[:,::1], u4[::1], f4[::1], f4[:,::1], f4[:,::1])"
        ),
        (SOLVERS, "descend_total_variation"): (
            "(i8, f4[:,::1], f4[:,::1], f4[::1], f4[:,::1], f4[::1], f4[::1], f4[:,:,::1], f4[::1],"
            " f4[:,::1], f4[::1])"
        ),
        (SOLVERS, "restore_frames"): "(f4[:,:,::1], f4[:,:,::1], f4[::1])",
        (SOLVERS, "shrink_nonnegative"): (
            "(f4[::1], f4[::1], f4[::1], f4[::1], f4[::1], f4[::1], f4[:,::1], f8[::1], f8[::1])"
        ),
        (SOLVERS, "copy_lanes_to_frames"): "(f4[:,::1], f4[:,::1])",
        (NEIGHBOURS, "pool_significance"): (
            "(i8[::1], f8[::1], f8[::1], f8[::1], i8[::1], UniTuple(i8, 2), UniTuple(f8, 2),"
            " f8[::1])"
        ),
        (NEIGHBOURS, "raise_to_maximum"): "(i8[::1], f8[::1], f8[::1])",
        (NEIGHBOURS, "scatter_about_planes"): (
            "(f8[::1], f8[::1], i8[::1], i8, f8[:,:,:,::1], f8, i8[::1], f4[:,::1], f8[::1])"
        ),
        (NEIGHBOURS, "borrow_scatter"): (
            "(f8[::1], f8[::1], i8[::1], UniTuple(i8, 2), f8, f8[:,::1], f8[::1])"
        ),
        (SURFACES, "split_over_slit"): "(f8[::1], f8, i8, i4[::1], f4[:,::1])",
        (SURFACES, "add_light"): "(f4[::1], i4[::1], f4[:,::1], i4[::1], f4[:,::1], f4[:,::1])",
        (SURFACES, "gather_light"): (
            "(f4[:,::1], f8, i4[::1], f4[:,::1], i4[::1], f4[:,::1], f4[::1])"
        ),
        (SURFACES, "smooth_rows"): "(f4[:,::1], f4[::1], i8[::1], i8, f4[:,::1])",
        (SURFACES, "apply_dual"): "(f4[:,::1], b1[:,::1], f8, f4[:,:,::1], f4[:,::1])",
        (SURFACES, "ascend_dual"): ("(f4[:,::1], b1[:,::1], f8, f8, f4[:,:,::1], f4[:,:,::1])"),
    }
)
"""Module and name of the loops that recovery and ranging of a shot call, and for which arguments: a
letter and bytes for each kind of number, as Numba writes them."""

GROUPS: Sequence[Sequence[str]] = (
    (PEAKS, TABLE, EXACT, OPERATORS),
    (SOLVERS, CAMERA, NEIGHBOURS, SURFACES),
)
"""Modules whose loops take about as long to compile together, each for a process."""

FUNCTIONS_PER_GROUP = (25, 33)
"""Loops and their parts, which the compiler takes one by one."""


def compile_loops_ahead() -> None:
    """Compile what recovering and ranging a shot call, on two cores if they may be used.

    What is in the cache is not compiled again, and if nothing is missing nothing is said. A process
    that fails leaves its loops to be compiled when they are called.
    """
    groups = [number for number, group in enumerate(GROUPS) if any(map(_is_missing, group))]
    if not groups:
        return
    total = sum(FUNCTIONS_PER_GROUP[number] for number in groups)
    with show_progress(TITLE, total) as advance:

        def compile_group(number: int) -> None:
            left = FUNCTIONS_PER_GROUP[number]
            for _ in _read_compiled(GROUPS[number]):
                advance(min(left, 1))
                left -= min(left, 1)
            advance(left)

        for _ in map_parallel(compile_group, groups):
            pass


def _is_missing(module: str) -> bool:
    """Whether a loop of a module was never compiled as it stands on this machine."""
    return any(not _has_entry(_find_loop(home, name)) for home, name in LOOPS if home == module)


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


def _read_compiled(modules: Sequence[str]) -> Iterator[str]:
    """Compile the loops of modules in a process and yield each function's name as its turn comes."""
    root = str(Path(__file__).resolve().parents[1])
    paths = [root, *filter(None, [os.environ.get("PYTHONPATH")])]
    try:
        process = subprocess.Popen(
            [sys.executable, "-m", "apps.compile_ahead", *modules],
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(paths)},
        )
    except OSError:  # no other process can be started: the loops are compiled when they are called
        return
    with process:
        try:
            assert process.stdout is not None
            for line in process.stdout:
                yield line.strip()
        finally:
            process.kill()


def compile_modules(modules: Sequence[str], report: Callable[[str], None]) -> None:
    """Compile the loops of modules in this process.

    Parameters
    ----------
    modules : sequence of str
        Of those in `LOOPS`.
    report : callable
        Called with the name of each function whose compiling begins.
    """
    from numba.core.sigutils import normalize_signature

    observers.append(report)
    try:
        for (module, name), arguments in LOOPS.items():
            if module in modules:
                # the cache knows a loop by the types as a call gives them, not by their names
                _find_loop(module, name).compile(normalize_signature(arguments)[0])
    finally:
        observers.remove(report)


if __name__ == "__main__":
    gc.set_threshold(OBJECTS_PER_COLLECTION)
    compile_modules(sys.argv[1:], lambda name: print(name, flush=True))
