"""Recorders that are asked to end at random moments; a script, because it forks.

``ended_recorders.py FOLDER COUNT SEED ADDRESS`` lets `tofclip record` live for a while, sends it one
of the signals that end a program, and prints one line for each: the signal, the file's name, its
exit status, -1 if it hung, and how long it took to end. Before the next one it waits for a line of
input.
"""

import atexit
import os
import random
import signal
import sys
import time
from pathlib import Path

import devices
from apps.cli import main as run_program
from devices import remoteex

SIGNALS = (signal.SIGTERM, signal.SIGHUP, signal.SIGINT)
PATIENCE_S = 20.0
assert remoteex  # loaded before the forks, so that lives are spent at work


def end_recorder(path, address, number, life):
    """Let a recorder live for some seconds, and ask it to end."""
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
            atexit._run_exitfuncs()  # what the interpreter does when it ends
            os._exit(status)
    time.sleep(life)
    os.kill(child, number)
    asked = time.monotonic()
    while time.monotonic() - asked < PATIENCE_S:
        ended, status = os.waitpid(child, os.WNOHANG)
        if ended:
            return os.waitstatus_to_exitcode(status), f"{time.monotonic() - asked:.2f}"
        time.sleep(0.01)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return -1, str(PATIENCE_S)


def main(folder, count, seed, address):
    """End as many recorders as were asked for."""
    with devices.open("sim+timetag://") as source:  # loads what every child needs
        source.read()
    moments = random.Random(seed)
    for victim in range(count):
        path, number = folder / f"run{victim}.h5", SIGNALS[victim % len(SIGNALS)]
        ended = end_recorder(path, address, number, moments.uniform(0, 0.5))
        print(number.name, path.name, *ended, flush=True)
        sys.stdin.readline()


if __name__ == "__main__":
    main(Path(sys.argv[1]), *map(int, sys.argv[2:4]), sys.argv[4])
