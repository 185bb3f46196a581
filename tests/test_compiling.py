"""Parts of compiled loops, hearing of the compiler's work, and runs that cannot keep it."""

from __future__ import annotations

import io
import logging
import os
import subprocess
import sys
from pathlib import Path

import numba
import pytest

from apps import cli
from tofclip.compiling import compile_as_part


def test_a_part_runs_from_python_and_from_a_compiled_loop(
    caplog: pytest.LogCaptureFixture,
) -> None:
    @compile_as_part(fastmath=True)
    def halve(number):  # type: ignore[no-untyped-def]
        return number / 2

    @numba.njit(error_model="python")
    def quarter(number):  # type: ignore[no-untyped-def]
        return halve(halve(number))

    caplog.set_level(logging.INFO, "tofclip.compiling")
    assert (halve(3.0), caplog.messages) == (1.5, [])
    assert quarter(3.0) == 0.75
    assert caplog.messages == ["quarter", "halve"]
    assert quarter(5.0) == 1.25
    assert caplog.messages == ["quarter", "halve"]


class Terminal(io.StringIO):
    """What is printed, as on a terminal or not."""

    def __init__(self, terminal: bool) -> None:
        super().__init__()
        self.terminal = terminal

    def isatty(self) -> bool:
        return self.terminal


@pytest.mark.parametrize("terminal", [True, False])
def test_the_program_announces_compiling_in_one_line_on_a_terminal_only(
    terminal: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    def run(words: list[str], **options: object) -> int:
        double = compile_as_part()(lambda number: 2 * number)

        @numba.njit
        def quadruple(number):  # type: ignore[no-untyped-def]
            return double(double(number))

        @numba.njit
        def add_one(number):  # type: ignore[no-untyped-def]
            return number + 1

        return int(add_one(quadruple(2))) - 9

    printed = Terminal(terminal)
    monkeypatch.setattr(cli, "app", run)
    monkeypatch.setattr(sys, "stderr", printed)
    assert cli.main([]) == 0
    said = printed.getvalue()
    assert said.count("compiling loops for this processor, once") == (1 if terminal else 0)
    assert said.count("\n") == (1 if terminal else 0)


def simulate(home: Path, cache: Path | str, *first: str) -> subprocess.CompletedProcess[str]:
    """Compile and run a loop by the program, in a process without other places for the cache."""
    code = "import sys; " + "; ".join(first) + CALL_A_VERB
    places = {"HOME": str(home), "XDG_CACHE_HOME": str(home), "NUMBA_CACHE_DIR": str(cache)}
    return subprocess.run(
        [sys.executable, "-c", code, str(home.parent / "made.h5")],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), **places},
        capture_output=True,
        text=True,
        check=False,
    )


CALL_A_VERB = """
from apps.cli import main
words = "nlos simulate --letters T --facet-mm 200 --wall-points 4 --bin-width-ps 32 --json"
sys.exit(main([*words.split(), "--out", sys.argv[1]]))
"""
NOT_KEPT = "tofclip: warning: compiled loops cannot be kept, so every run compiles them again"


def test_without_a_place_for_compiled_loops_they_are_compiled_for_the_run(tmp_path: Path) -> None:
    """As in an installation that is read-only, for a user without a home."""
    (tmp_path / "file").touch()  # a folder below it cannot be made by anybody
    forbid = "from numba.core.caching import InTreeCacheLocator as place"
    nowhere = "place.get_cache_path = lambda _: '/dev/null/cache'"
    done = simulate(tmp_path / "file", tmp_path / "file" / "cache", forbid, nowhere)
    assert done.returncode == 0
    assert (tmp_path / "made.h5").is_file()
    (line,) = done.stderr.splitlines()
    assert line.startswith(NOT_KEPT)
    assert "NUMBA_CACHE_DIR" in line


def test_a_full_disk_of_the_cache_keeps_no_result(tmp_path: Path) -> None:
    fill = "from numba.core.caching import IndexDataCacheFile as file"
    full = "file._save_data = lambda *_: open('/dev/full', 'w', 1).write('loop\\n')"
    done = simulate(tmp_path / "home", tmp_path / "cache", fill, full)
    assert (done.returncode, done.stderr.count("\n")) == (0, 1)
    assert done.stderr.startswith(NOT_KEPT)
    assert (tmp_path / "made.h5").is_file()


def test_a_damaged_cache_is_passed_over(tmp_path: Path) -> None:
    assert simulate(tmp_path / "home", tmp_path).stderr == ""
    kept = list(tmp_path.rglob("*.nb[ic]"))
    assert kept
    for file in kept:
        file.write_bytes(b"")
    done = simulate(tmp_path / "home", tmp_path)
    assert (done.returncode, done.stderr.count("\n")) == (0, 1)
    assert done.stderr.startswith(NOT_KEPT)
