"""Recorders that are asked to end at random moments; a script, because it forks.

``signalled_recorders.py FOLDER NUMBER SEED ADDRESS`` lets `tofclip record` live for a while, sends
it one of the signals that end a program, and prints one line for each: the signal, the file's name,
its exit status, and how long it took to end. Before the next one it waits for a line of input.
"""

from __future__ import annotations

import os
import random
import signal
import sys
import time
from pathlib import Path

from apps.cli import main as run_program
from devices import remoteex as client
from devices import remoteex as source

SIGNALS = (signal.SIGTERM, signal.SIGHUP, signal.SIGINT)
LONGEST_LIFE_S = 0.5
PATIENCE_S = 20.0
assert client, source  # loaded before the forks, so that lives are spent at work


def end_recorder(
    path: Path, address: str, number: signal.Signals, life: float
) -> tuple[int, float]:
    """Let a recorder live for some seconds; return its exit status, -1 if it hung, and how long it
    took to end.
    """
    child = os.fork()
    if child == 0:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        # A shell's background jobs ignore the one and nohup's the other, and a program that was
        # asked to ignore a signal does so rightly.
        signal.signal(signal.SIGINT, signal.default_int_handler)
        signal.signal(signal.SIGHUP, signal.SIG_DFL)
        status = 70
        try:
            status = run_program(["record", address, "--out", str(path), "--json"])
        finally:
            sys.stdout.flush()
            _run_exit_handlers()
            os._exit(status)
    time.sleep(life)
    os.kill(child, number)
    reported = time.monotonic()
    while time.monotonic() - reported < PATIENCE_S:
        ended, status = os.waitpid(child, os.WNOHANG)
        if ended:
            return os.waitstatus_to_exitcode(status), time.monotonic() - reported
        time.sleep(0.01)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return -1, PATIENCE_S


def _run_exit_handlers() -> None:
    import atexit

    atexit._run_exitfuncs()  # what the interpreter does when it ends


def main() -> None:
    """End as many recorders as were asked for, each signal in turn."""
    folder, count, seed, address = Path(sys.argv[1]), *map(int, sys.argv[2:4]), sys.argv[4]
    moments = random.Random(seed)
    for victim in range(count):
        number = SIGNALS[victim % len(SIGNALS)]
        path = folder / f"run{victim}.h5"
        status, seconds = end_recorder(path, address, number, moments.uniform(0, LONGEST_LIFE_S))
        print(number.name, path.name, status, f"{seconds:.2f}", flush=True)
        sys.stdin.readline()


if __name__ == "__main__":
    main()
