"""Loops are compiled in processes of their own, for the arguments that they are called with."""

from __future__ import annotations

import os
from pathlib import Path

import numba
import numpy as np
import pytest
from numba.core.sigutils import normalize_signature
from small_instrument import Run

from apps import compile_ahead
from apps.verbs import warm_up


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


def test_what_is_missing_is_compiled_by_other_processes_once(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    key = (compile_ahead.OPERATORS, "count_tile_nonzeros")
    loop = compile_ahead._find_loop(*key)
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))
    cache = type(loop)(loop.py_func, targetoptions=loop.targetoptions)
    cache.enable_caching()
    monkeypatch.setattr(compile_ahead, "_find_loop", lambda module, name: cache)
    monkeypatch.setattr(compile_ahead, "LOOPS", {key: compile_ahead.LOOPS[key]})
    monkeypatch.setattr(compile_ahead, "GROUPS", ((compile_ahead.OPERATORS,),))
    assert compile_ahead._is_missing(compile_ahead.OPERATORS)
    compile_ahead.compile_loops_ahead()
    assert not compile_ahead._is_missing(compile_ahead.OPERATORS)
    columns, slits = np.zeros(2, np.int32), np.zeros((1, 2), np.int64)
    cache(columns, columns, 1, slits)
    assert (len(cache.stats.cache_hits), len(cache.stats.cache_misses)) == (1, 0)


def test_a_process_that_fails_leaves_the_loops_to_be_compiled_when_they_are_called(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(compile_ahead, "_is_missing", lambda module: True)
    monkeypatch.setattr(compile_ahead.sys, "executable", os.devnull)
    compile_ahead.compile_loops_ahead()
