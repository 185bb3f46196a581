"""Damaged bytes, in every way that a wire or a disk can damage them, through every codec.

Whatever comes in, only our own exceptions come out, and no more memory is taken than `Target.bound`
says. In the suite it is a sample, small where a target is slow; ``python
tests/devices/test_fuzz.py 100000`` shares that number of mutations out evenly and prints a table.
"""

from __future__ import annotations

import subprocess
import sys
import time
import tracemalloc
from collections.abc import Iterator

import numpy as np
from fuzz_targets import TARGETS, Target

from tofclip.errors import TofclipError

SUITE_MUTATIONS = 12_000
SAMPLE = "sample"
MIN_JUDGED = 400
"""Of fewer inputs, all may well be refused."""


TELLING = np.array([0, 1, 0x7F, 0x80, 0xFF, 0x20, 0x2C, 0x0D, 0x23, 0x30, 0x39], np.uint8)
"""Bytes on which decisions hang: extremes, signs, separators, digits."""


def mutations(seeds: tuple[bytes, ...], random: np.random.Generator) -> Iterator[bytes]:
    """Damage inputs for ever: bits flipped, bytes replaced, pieces cut, repeated, moved, filled and
    invented.
    """
    while True:
        data = bytearray(seeds[random.integers(len(seeds))])
        for _ in range(random.integers(1, 4)):
            _damage(data, random)
        yield bytes(data)


def _damage(data: bytearray, random: np.random.Generator) -> None:
    kind, length = random.integers(7), len(data)
    at = int(random.integers(length)) if length else 0
    size = int(random.integers(1, 17))
    if kind == 0 and length:
        data[at] ^= 1 << int(random.integers(8))
    elif kind == 1 and length:
        data[at] = int(random.choice(TELLING))
    elif kind == 2:
        del data[at:]
    elif kind == 3:
        del data[at : at + size]
    elif kind == 4:
        data[at:at] = data[at : at + size] * int(random.integers(1, 20))
    elif kind == 5:
        data[at : at + size] = bytes([int(random.choice(TELLING))]) * size
    else:
        data[at:at] = random.bytes(size)


def attack(target: Target, count: int, seed: int) -> tuple[int, int]:
    """Decode `count_records` damaged inputs; return how many were refused, and most bytes taken
    beyond the bound's share.

    Raises
    ------
    AssertionError
        An exception that is not ours, or too much memory, with the input that does it.
    """
    for data in target.seeds:
        target.decode(data)  # compile, and fill caches, before memory is watched
    refused, most = 0, 0
    damaged = mutations(target.seeds, np.random.default_rng(seed))
    tracemalloc.start()
    try:
        for _ in range(count):
            data = next(damaged)
            tracemalloc.reset_peak()
            before = tracemalloc.get_traced_memory()[0]
            message = ""
            try:
                target.decode(data)
            except TofclipError as fault:
                message = str(fault)
            except Exception as fault:
                raise AssertionError(f"{data!r} raises {type(fault).__name__}: {fault}") from fault
            refused += bool(message)
            assert "\n" not in message, data
            taken = tracemalloc.get_traced_memory()[1] - before
            assert taken <= target.bound(len(data)), f"{data!r} takes {taken} bytes"
            most = max(most, taken)
    finally:
        tracemalloc.stop()
    return refused, most


def test_damaged_input_raises_only_our_own_errors_and_takes_little_memory() -> None:
    """In a process of its own: threads that other libraries leave behind take memory as well."""
    command = [sys.executable, __file__, str(SUITE_MUTATIONS), SAMPLE]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    assert [line[:24].strip() for line in done.stdout.splitlines()[1:]] == list(TARGETS)


def main(total: int, is_sample: bool) -> None:
    """Attack every target and print what came of it; of a sample, slow targets get less."""
    print(f"{'target':24} {'inputs':>9} {'refused':>9} {'most bytes':>11} {'per second':>11}")
    for name, target in TARGETS.items():
        began = time.perf_counter()
        count = -(-total // len(TARGETS)) // (target.slowness if is_sample else 1)
        refused, most = attack(target, count, seed=2)
        assert refused < count or count < MIN_JUDGED or target.notices_all, (
            f"{name}: the damage is so heavy that nothing ever gets beyond the first check"
        )
        assert most > 0, f"{name}: no memory was watched"
        print(
            f"{name:24} {count:9} {refused:9} {most:11} {count / (time.perf_counter() - began):11.0f}",
            flush=True,
        )


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 100_000, SAMPLE in sys.argv)
