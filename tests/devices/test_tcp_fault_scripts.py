"""Streak cameras and SPAD arrays under random faults: accounts balance, nothing hangs, the
exception is the right one.

In the suite it is a sample; ``python tests/devices/test_tcp_fault_scripts.py 1000`` runs as many as
it is reported.
"""

from __future__ import annotations

import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import pytest

import devices
from devices.emulation.faults import HOST, Fault, FaultKind
from devices.emulation.remoteex import EmulatedStreakCamera
from devices.emulation.scenes import EmulatedLight
from devices.emulation.spad512 import EmulatedSpadArray
from devices.source import Source, Stats
from tofclip.errors import DeviceError

SUITE_SCRIPTS = 48
AT_ONCE = 8
FRAMES = 25
LONGEST = 60.0
"""Seconds; an undisturbed script takes less than one, each fault adds a few tenths."""

STREAK_KINDS: dict[FaultKind, float] = {
    "timeout": 0.3,
    "short": 0.2,
    "unplug": 0.2,
    "lost": 0.2,
    "corrupt": 0.05,
    "overflow": 0.05,
}
ARRAY_KINDS: dict[FaultKind, float] = {
    "timeout": 0.3,
    "short": 0.25,
    "unplug": 0.25,
    "corrupt": 0.1,
    "stall": 0.1,
}
FATAL = {"corrupt", "overflow", "stall"}
"""After these a stream cannot be trusted any more: reading ends with an exception."""

SCREEN = EmulatedLight(np.full((6, 8), 5.0), np.linspace(0, 5e-11, 6), seed=1)
ARRAY_LIGHT = np.full((512, 512), 1e5)


@dataclass(frozen=True)
class Outcome:
    """What became of a script."""

    faults: tuple[Fault, ...]
    stats: Stats
    exception: Exception | None
    gain: str
    seconds: float

    @property
    def is_right(self) -> bool:
        """Whether nothing is unaccounted for, the tube is safe, and only a fatal fault has ended
        the stream.
        """
        survived = self.exception is None
        allowed = any(fault.kind in FATAL for fault in self.faults) and isinstance(
            self.exception, DeviceError
        )
        balanced = self.stats.is_balanced and self.stats.unread == 0
        return balanced and self.gain == "0" and (survived or allowed) and self.seconds < LONGEST


def script(seed: int, kinds: dict[FaultKind, float]) -> tuple[Fault, ...]:
    """Draw up to five faults among the first requests; the very first one, with which a source
    opens, goes well.
    """
    random = np.random.default_rng(seed)
    places = 1 + random.choice(15, random.integers(0, 6), replace=False)
    drawn = random.choice(len(kinds), len(places), p=list(kinds.values()))
    return tuple(
        Fault(int(place), list(kinds)[number], int(random.integers(1, 4)))
        for place, number in zip(places, drawn, strict=True)
    )


def run(seed: int) -> Outcome:
    """Run a script: a streak camera for odd seeds, an array for even ones."""
    if seed % 2:
        faults = script(seed, STREAK_KINDS)
        camera = EmulatedStreakCamera(SCREEN, 200, faults=faults)
        port, data_port = camera.ports
        address = (
            f"remoteex://{HOST}:{port}?data_port={data_port}&timeout_s=0.5&buffers=8&mcp_gain=9"
        )
        outcome = _read(devices.open(address))
        camera.close()
        return Outcome(faults, *outcome[:2], camera.gain, outcome[2])
    faults = script(seed, ARRAY_KINDS)
    array = EmulatedSpadArray(ARRAY_LIGHT, seed, faults=faults)
    outcome = _read(
        devices.open(f"spad512://{HOST}:{array.port}?width=4&timeout_s=1&images={1 + seed % 3}")
    )
    array.close()
    return Outcome(faults, *outcome[:2], "0", outcome[2])


def _read(source: Source) -> tuple[Stats, Exception | None, float]:
    began, exception = time.monotonic(), None
    try:
        while source.stats.delivered < FRAMES:
            source.read(LONGEST)
        source.stop()
        while source.read(LONGEST) is not None:
            pass
    except DeviceError as fault:
        exception = fault
    source.close()
    return source.stats, exception, time.monotonic() - began


def run_all(number: int) -> list[Outcome]:
    """Run scripts 0 to `number`, some at once."""
    with ThreadPoolExecutor(AT_ONCE) as pool:
        return list(pool.map(run, range(number)))


@pytest.fixture(scope="module")
def outcomes() -> list[Outcome]:
    return run_all(SUITE_SCRIPTS)


def test_every_script_ends_as_it_should(outcomes: list[Outcome]) -> None:
    assert [outcome for outcome in outcomes if not outcome.is_right] == []


def test_the_scripts_are_worth_running(outcomes: list[Outcome]) -> None:
    """All kinds of faults came up, some streams went on after a cable was pulled, some ended."""
    assert {fault.kind for outcome in outcomes for fault in outcome.faults} >= {
        *STREAK_KINDS,
        *ARRAY_KINDS,
    }
    assert (
        sum(outcome.stats.reconnects > 0 and outcome.exception is None for outcome in outcomes) > 3
    )
    assert sum(outcome.exception is not None for outcome in outcomes) > 3
    assert sum(outcome.stats.lost_device > 0 for outcome in outcomes) > 3


if __name__ == "__main__":
    found = run_all(int(sys.argv[1]) if len(sys.argv) > 1 else 1000)
    wrong = [outcome for outcome in found if not outcome.is_right]
    print(
        f"{len(found)} scripts, {len(wrong)} wrong, the slowest took {max(o.seconds for o in found):.1f} s",
        *wrong,
    )
