"""Bars on a terminal, and nothing elsewhere."""

from __future__ import annotations

import os
import pty
import re
import subprocess
import sys

import pytest

PROGRAM = """
import time
from apps.progress import show_activity, show_progress
with show_progress("choosing the weight", 4) as advance:
    for _ in range(4):
        advance(1)
        time.sleep(0.15)
with show_activity("simulating"):
    time.sleep(0.3)
print("done")
"""


def run_on_a_terminal(command: list[str]) -> str:
    """What a program writes on a terminal, without the codes that move its cursor."""
    ours, its = pty.openpty()
    environment = os.environ | {"TERM": "xterm", "COLUMNS": "100"}
    program = subprocess.Popen(command, stdin=its, stdout=its, stderr=its, env=environment)
    os.close(its)
    written = b""
    while True:
        try:
            piece = os.read(ours, 65536)
        except OSError:  # how Linux says that the other side was closed
            break
        if not piece:
            break
        written += piece
    os.close(ours)
    assert program.wait(20) == 0
    return re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", written.decode())


@pytest.mark.skipif(sys.platform == "win32", reason="terminals of another kind")
def test_a_bar_shows_what_is_done_how_long_it_took_and_what_is_left() -> None:
    seen = run_on_a_terminal([sys.executable, "-c", PROGRAM])
    lines = [line for line in re.split(r"[\r\n]+", seen) if "choosing the weight" in line]
    assert any("50%" in line for line in lines)
    assert all(re.search(r"\d:\d\d:\d\d left", line) for line in lines)
    assert re.search(r"simulating .*0:00:00", seen)
    assert "done" in seen


def test_without_a_terminal_there_is_none() -> None:
    ended = subprocess.run(
        [sys.executable, "-c", PROGRAM], capture_output=True, text=True, timeout=60, check=True
    )
    assert (ended.stdout, ended.stderr) == ("done\n", "")
