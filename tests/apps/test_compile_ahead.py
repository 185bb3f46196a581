"""Loops are compiled in processes of their own, for the arguments that they are called with."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pytest
from numba.core.sigutils import normalize_signature
from small_instrument import Run

from apps import compile_ahead
from apps.verbs import warm_up
from tofclip.compile_observers import observers, suppliers
from tofclip.compiling import compile_loop


def test_loops_are_compiled_for_the_arguments_that_recovery_and_ranging_give(
    run: Run, tmp_path: Path
) -> None:
    warm_up._save_shots(tmp_path)
    shot, frames = str(tmp_path / "shots" / "first.h5"), str(tmp_path / "frames.h5")
    for method in ("tv", "surfaces"):
        words = ("--method", method, "--iterations", "2")
        assert run("recover", shot, "--out", frames, *words).status == 0
    for (module, name), arguments in compile_ahead.LOOPS.items():
        loop = compile_ahead._find_loop(module, name)
        assert normalize_signature(arguments)[0] in loop.overloads, name


@pytest.fixture
def loop(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Any:
    """The only loop to compile, with an empty cache of its own; it is not compiled in this process."""
    key = (compile_ahead.OPERATORS, "count_tile_nonzeros")
    usual = compile_ahead._find_loop(*key)
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))
    fresh = compile_loop()(usual.py_func)
    monkeypatch.setattr(compile_ahead, "_find_loop", lambda module, name: fresh)
    monkeypatch.setattr(compile_ahead, "LOOPS", {key: compile_ahead.LOOPS[key]})
    return fresh


def call(loop: Any) -> tuple[int, int]:
    """Call the loop, and count what came from the cache and what was compiled for it."""
    columns, slits = np.zeros(2, np.int32), np.zeros((1, 2), np.int64)
    loop(columns, columns, 1, slits)
    return len(loop.stats.cache_hits), len(loop.stats.cache_misses)


def test_a_call_waits_for_the_process_that_compiles_the_loop(loop: Any) -> None:
    names: list[str] = []
    observers.append(names.append)
    observer = observers[-1]
    try:
        with compile_ahead.compile_loops_ahead():
            assert call(loop) == (1, 0)
        assert names == ["count_tile_nonzeros"]
        with compile_ahead.compile_loops_ahead():
            assert not suppliers
        assert names == ["count_tile_nonzeros"]
    finally:
        observers.remove(observer)
    assert not suppliers


def test_processes_compile_the_program_that_runs_not_one_in_the_users_folder(
    loop: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """As where it is installed, and started in a checkout."""
    for name in ("apps", "tofclip"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").write_text("raise SystemExit")
    monkeypatch.chdir(tmp_path)
    with compile_ahead.compile_loops_ahead():
        assert call(loop) == (1, 0)


def test_what_is_called_first_is_compiled_first() -> None:
    first, second = list(compile_ahead.LOOPS)[:2]
    compilation = compile_ahead._Compilation([first, second])
    waiting = threading.Thread(target=compilation.wait_for, args=second)
    waiting.start()
    while compilation._left[0] != second:
        time.sleep(0.001)
    assert compilation._take_next() == second
    assert compilation._take_next() == first
    assert compilation._take_next() is None
    assert waiting.is_alive()
    compilation.stop()
    waiting.join()
    compilation.wait_for("a.module", "that_nobody_compiles")


@pytest.mark.parametrize("program", [os.devnull, "/bin/true"])
def test_a_process_that_fails_leaves_the_loops_to_be_compiled_when_they_are_called(
    program: str, loop: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "executable", program)
    with compile_ahead.compile_loops_ahead():
        assert call(loop) == (0, 1)


def test_processes_end_with_the_block(loop: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    started: list[subprocess.Popen[str]] = []

    def start() -> subprocess.Popen[str]:
        pipe = subprocess.PIPE
        forever = [sys.executable, "-c", "import time; time.sleep(600)"]
        started.append(subprocess.Popen(forever, stdin=pipe, stdout=pipe, text=True))
        return started[-1]

    monkeypatch.setattr(compile_ahead, "_start_process", start)
    with pytest.raises(KeyError), compile_ahead.compile_loops_ahead():
        raise KeyError
    assert [process.returncode for process in started] == [-signal.SIGKILL]
    assert call(loop) == (0, 1)
