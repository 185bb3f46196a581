"""Records in processes that are killed at random moments; a script, because it forks.

``killed_recorders.py FOLDER NUMBER SEED`` prints one line per recording: its file's name and the
bytes that its recorder had reported as written.
"""

from __future__ import annotations

import os
import random
import select
import signal
import sys
import time
from pathlib import Path

import devices
from devices import recorder
from devices.recording import write as writer
from devices.source import Piece

ADDRESS = "sim+timetag://?seed={seed}&pace=realtime&rate=5e5&transfer_kib=2&faults=lost@20:50,corrupt@30:3"
LONGEST_LIFE = 0.3
PATIENCE_S = 20.0
FLUSHED = 8


class Reporting(writer.RecordingWriter):
    """Says how much it has written."""

    pipe = -1

    def add(self, piece: Piece) -> None:
        super().add(piece)
        os.write(self.pipe, self.bytes_written.to_bytes(FLUSHED, "little"))


def live(path: Path, seed: int, pipe: int) -> None:
    """Record until it is killed."""
    Reporting.pipe = pipe
    vars(recorder)["RecordingWriter"] = Reporting
    recorder.record_source(devices.open(ADDRESS.format(seed=seed)), path)


def killed(path: Path, seed: int, life: float, has_begun: bool) -> int:
    """Let a recorder live for some seconds, from the beginning or from its first report on; return
    what it had written, -1 if it had not come so far.
    """
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(reading)
        live(path, seed, writing)
    os.close(writing)
    if has_begun:
        select.select([reading], [], [], PATIENCE_S)
    time.sleep(life)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    with os.fdopen(reading, "rb") as pipe:
        reports = pipe.read()
    return int.from_bytes(reports[-FLUSHED:], "little") if reports else -1


def main() -> None:
    """Kill as many recorders as were asked for."""
    folder, number, seed = Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])
    with devices.open(ADDRESS.format(seed=seed)) as source:  # loads what every child needs
        source.read()
    moments = random.Random(seed)
    for victim in range(number):
        path = folder / f"run{victim}.h5"
        life = moments.uniform(0, LONGEST_LIFE)
        print(path.name, killed(path, victim, life, victim % 2 == 1), flush=True)


if __name__ == "__main__":
    main()
