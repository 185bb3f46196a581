"""Recorders that come to an end at random moments; a script, because it forks.

``ended_recorders.py FOLDER COUNT SEED`` kills as many, and prints one line for each: its file's name
and the bytes that it had reported as written, -1 if it had not come so far.

``ended_recorders.py FOLDER COUNT SEED ADDRESS`` lets `tofclip record` live for a while, sends it one
of the signals that end a program, and prints one line for each: the signal, the file's name, its
exit status, -1 if it hung, and how long it took to end. Before the next one it waits for a line of
input.
"""

from __future__ import annotations

import atexit
import os
import random
import select
import signal
import sys
import time
from pathlib import Path

import devices
from apps.cli import main as run_program
from devices import recorder, remoteex
from devices.recording.write import RecordingWriter
from devices.source import Piece

KILLED = "sim+timetag://?seed={seed}&pace=realtime&rate=5e5&transfer_kib=2&faults=lost@20:50,corrupt@30:3"
SIGNALS = (signal.SIGTERM, signal.SIGHUP, signal.SIGINT)
PATIENCE_S = 20.0
assert remoteex  # loaded before the forks, so that lives are spent at work


class Reporting(RecordingWriter):
    """Says how much it has written."""

    pipe = -1

    def add(self, piece: Piece) -> None:
        super().add(piece)
        os.write(self.pipe, self.bytes_written.to_bytes(8, "little"))


def kill_recorder(path: Path, seed: int, life: float) -> int:
    """Let a recorder live for some seconds, from the beginning or, every other one, from its first
    report on; return what it had written.
    """
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(reading)
        Reporting.pipe, recorder.RecordingWriter = writing, Reporting  # type: ignore[misc]
        recorder.record_source(devices.open(KILLED.format(seed=seed)), path)
    os.close(writing)
    if seed % 2:
        select.select([reading], [], [], PATIENCE_S)
    time.sleep(life)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    with os.fdopen(reading, "rb") as pipe:
        reports = pipe.read()
    return int.from_bytes(reports[-8:], "little") if reports else -1


def end_recorder(path: Path, address: str, number: signal.Signals, life: float) -> tuple[int, str]:
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


def main(folder: Path, count: int, seed: int, address: str = "") -> None:
    """End as many recorders as were asked for."""
    with devices.open(KILLED.format(seed=seed)) as source:  # loads what every child needs
        source.read()
    moments = random.Random(seed)
    for victim in range(count):
        path = folder / f"run{victim}.h5"
        if not address:
            print(path.name, kill_recorder(path, victim, moments.uniform(0, 0.3)), flush=True)
            continue
        number = SIGNALS[victim % len(SIGNALS)]
        ended = end_recorder(path, address, number, moments.uniform(0, 0.5))
        print(number.name, path.name, *ended, flush=True)
        sys.stdin.readline()


if __name__ == "__main__":
    main(Path(sys.argv[1]), *map(int, sys.argv[2:4]), *sys.argv[4:])
