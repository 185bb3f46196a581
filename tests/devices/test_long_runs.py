"""Runs at the size of the acceptance: a minute at half of the highest rate, a thousand scripts of faults,
a hundred thousand damaged inputs.
"""

from __future__ import annotations

import resource
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

import devices
from devices.linospad2 import LinoSpad2Codec
from devices.recorder import measure_throughput
from devices.source import Info, Ledger, as_bytes
from devices.stream import StreamOptions, StreamSource, Transfer
from devices.timetag_codec import RECORD_BYTES
from tofclip.storage import Record

pytestmark = pytest.mark.nightly

SECONDS = 60.0
STAMPS_PER_SECOND = 25e6
"""Half of the 50 million that the instrument reaches."""

FILL_FRACTION = 0.6
TAG_BYTES_PER_SECOND = 75e6
MAX_GROWTH_MIB = 32.0
BYTES_PER_MIB = 1 << 20


def resident_mib() -> float:
    """Memory of this process now."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / BYTES_PER_MIB


class MemoryWatch:
    """Looks at the memory once a second, after a quarter of the time."""

    def __init__(self, seconds: float) -> None:
        self._from, self._next, self.sizes = seconds / 4, seconds / 4, list[float]()

    def look(self, passed: float) -> None:
        if passed >= self._next:
            self._next = passed + 1.0
            self.sizes.append(resident_mib())

    @property
    def growth_mib(self) -> float:
        return max(self.sizes) - self.sizes[0]


class SteadyFeed:
    """The same words again and again, each piece when it is due."""

    calibration: Record | None = None
    info = Info("steady words")

    def __init__(
        self, codec: LinoSpad2Codec, data: bytes, piece: int, bytes_per_second: float
    ) -> None:
        self.codec, self.ledger = codec, Ledger()
        self._data, self._piece, self._rate = memoryview(data), piece, bytes_per_second
        self._sent, self._total = 0, int(bytes_per_second * SECONDS / piece) * piece

    def start(self) -> None:
        self._began = time.monotonic()

    def pull(self, timeout: float) -> Transfer | None:
        if self._sent >= self._total:
            return None
        at = self._sent % len(self._data)
        self._sent += self._piece
        time.sleep(max(0.0, self._began + self._sent / self._rate - time.monotonic()))
        return Transfer(self._data[at : at + self._piece])

    def stop(self) -> None:
        self._total = self._sent

    def close(self) -> None:
        """Hold nothing."""


def test_a_minute_of_linospad2_at_half_rate_drops_nothing() -> None:
    codec, random = LinoSpad2Codec(), np.random.default_rng(0)
    stream = random.integers(0, 1 << 31, (80, codec.cycle_words), dtype=np.uint32)
    stream |= (random.random(stream.shape) < FILL_FRACTION).astype(np.uint32) << 31
    stream[:, 64 * codec.timestamps :] = 0
    data = stream.astype("<u4").tobytes()
    stamps_per_byte = codec.count_records(as_bytes(data)) / len(data)
    codec.decode(as_bytes(data), codec.start)  # loops are compiled before the clock runs
    feed = SteadyFeed(codec, data, 8 * codec.cycle_bytes, STAMPS_PER_SECOND / stamps_per_byte)
    watch, began, read = MemoryWatch(SECONDS), time.monotonic(), 0
    with StreamSource(feed, StreamOptions(policy="drop_oldest")) as source:
        for batch in source:
            read += len(batch.records)
            watch.look(time.monotonic() - began)
    assert source.stats.dropped_host == source.stats.malformed == 0
    assert read == source.stats.delivered == pytest.approx(STAMPS_PER_SECOND * SECONDS, rel=0.01)
    assert watch.growth_mib < MAX_GROWTH_MIB


def test_a_minute_of_time_tags_at_half_rate_drops_nothing() -> None:
    rate = TAG_BYTES_PER_SECOND / RECORD_BYTES
    watch = MemoryWatch(SECONDS)
    source = devices.open(f"sim+timetag://?seed=1&pace=realtime&rate={rate}")
    found = measure_throughput(source, SECONDS, watch.look)
    assert found.stats.dropped_host == found.stats.lost_device == found.stats.malformed == 0
    assert found.bytes / found.seconds == pytest.approx(TAG_BYTES_PER_SECOND, rel=0.02)
    assert watch.growth_mib < MAX_GROWTH_MIB


def test_a_thousand_scripts_of_faults_over_tcp() -> None:
    command = [sys.executable, str(Path(__file__).with_name("test_faults.py")), "1000"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=1800)
    assert done.returncode == 0, done.stderr[-2000:]
    assert done.stdout.startswith("1000 scripts, 0 wrong,"), done.stdout[-2000:]


def test_a_hundred_thousand_damaged_inputs() -> None:
    command = [sys.executable, str(Path(__file__).with_name("test_fuzz.py")), "100000"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=3600)
    assert done.returncode == 0, done.stderr[-2000:]
