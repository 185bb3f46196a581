"""Parts of compiled loops, and hearing of the compiler's work."""

from __future__ import annotations

import os
import pty
import subprocess
import sys
from pathlib import Path

import numba
import pytest

from tofclip.compiling import compile_as_part, observe_compiling

SCRIPT = """
import sys
import numba
from apps import cli
from tofclip.compiling import compile_as_part
def run(words, **options):
    double = compile_as_part()(lambda number: 2 * number)
    @numba.njit
    def quadruple(number):
        return double(double(number))
    @numba.njit
    def add_one(number):
        return number + 1
    return add_one(quadruple(2)) - 9
cli.app = run
sys.exit(cli.main([]))
"""


def test_a_part_runs_from_python_and_from_a_compiled_loop() -> None:
    @compile_as_part(fastmath=True)
    def halve(number):  # type: ignore[no-untyped-def]
        return number / 2

    @numba.njit(error_model="python")
    def quarter(number):  # type: ignore[no-untyped-def]
        return halve(halve(number))

    names: list[str] = []
    stop = observe_compiling(names.append)
    try:
        assert (halve(3.0), names) == (1.5, [])
        assert quarter(3.0) == 0.75
        assert names == ["quarter", "halve"]
        assert quarter(5.0) == 1.25
        assert names == ["quarter", "halve"]
    finally:
        stop()
    assert quarter(1) == 0.25
    assert len(names) == 2


@pytest.mark.parametrize("terminal", [True, False])
def test_the_program_announces_compiling_in_one_line_on_a_terminal_only(
    terminal: bool, tmp_path: Path
) -> None:
    ours, theirs = pty.openpty() if terminal else os.pipe()
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT], stderr=theirs, env=environment, check=False
    )
    os.close(theirs)
    said = os.read(ours, 4096).decode()
    os.close(ours)
    assert done.returncode == 0
    assert said.count("compiling loops for this processor, once") == (1 if terminal else 0)
    assert said.count("\n") == (1 if terminal else 0)
