"""Parts of compiled loops, and hearing of the compiler's work."""

from __future__ import annotations

import io
import sys

import numba
import pytest

from apps import cli
from tofclip.compile_observers import observers
from tofclip.compiling import compile_as_part


def test_a_part_runs_from_python_and_from_a_compiled_loop() -> None:
    @compile_as_part(fastmath=True)
    def halve(number):  # type: ignore[no-untyped-def]
        return number / 2

    @numba.njit(error_model="python")
    def quarter(number):  # type: ignore[no-untyped-def]
        return halve(halve(number))

    names: list[str] = []
    observers.append(names.append)
    observer = observers[-1]
    try:
        assert (halve(3.0), names) == (1.5, [])
        assert quarter(3.0) == 0.75
        assert names == ["quarter", "halve"]
        assert quarter(5.0) == 1.25
        assert names == ["quarter", "halve"]
    finally:
        observers.remove(observer)
    assert quarter(1) == 0.25
    assert len(names) == 2


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
