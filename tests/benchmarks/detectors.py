"""The long run of LinoSPAD2's path: words in real time through buffer, decoder and histogram.

Run with ``python tests/benchmarks/detectors.py [--steady S] [--json]``; ``--steady 60`` is the
acceptance's. Words arrive at half of the required rate; nothing may be dropped and memory must not
grow. How fast each part is alone, `tofclip bench decode` tells.
"""

from __future__ import annotations

import argparse
import json
import resource
import time
from pathlib import Path

import numpy as np

from devices.codec import as_bytes
from devices.histogram import BinAxis, StampHistogram
from devices.ledger import Ledger
from devices.linospad2.codec import LinoSpad2Codec
from devices.linospad2.simulation import LASER_PERIOD_S, draw_uneven_calibration
from devices.source import Info
from devices.stream import BufferSettings, StreamSource, Transfer
from tofclip.storage import Record
from tofclip.threads import thread_count

MEGA = 1e6
STEADY_RATE = 25e6
"""Time stamps per second in the long run: half of the 50 million that are asked for."""

FILLED = 0.6
"""Share of the words that hold a time stamp, in the long run: 167 MB/s of words then."""

Figures = dict[str, float]


def words(filled: float, cycles: int) -> bytes:
    """Random words of which a share holds a time stamp."""
    codec, random = LinoSpad2Codec(), np.random.default_rng(0)
    stream = random.integers(0, 1 << 31, (cycles, codec.cycle_words), dtype=np.uint32)
    stream |= (random.random(stream.shape) < filled).astype(np.uint32) << 31
    stream[:, 64 * codec.timestamps :] = 0
    return stream.astype("<u4").tobytes()


class SteadyFeed:
    """The same cycles again and again, each when it is due."""

    calibration: Record | None = None
    info = Info("steady words")

    def __init__(self, data: bytes, piece: int, bytes_per_second: float, seconds: float) -> None:
        self._data, self._piece, self._rate = memoryview(data), piece, bytes_per_second
        self._sent, self._total = 0, int(bytes_per_second * seconds / piece) * piece

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


def steady(seconds: float) -> Figures:
    """Words in real time, with the buffer's policy that drops; memory is looked at once a second."""
    codec = LinoSpad2Codec()
    data = words(FILLED, 80)
    share = codec.count(as_bytes(data)) / len(data)
    feed = SteadyFeed(data, 8 * codec.cycle_bytes, STEADY_RATE / share, seconds)
    histogram = StampHistogram(
        BinAxis(20e-12, 576, 0.0, LASER_PERIOD_S), draw_uneven_calibration(0)
    )
    memory, began, looked = [], time.monotonic(), 0.0
    with StreamSource(feed, codec, Ledger(), BufferSettings(policy="drop_oldest")) as source:
        for batch in source:
            histogram.add(batch.records)
            passed = time.monotonic() - began
            if passed > looked + min(1.0, seconds / 10):
                looked = passed
                memory.append(resident_mib())
    settled = memory[len(memory) // 4 :]
    stats = source.stats
    return {
        "seconds": time.monotonic() - began,
        "stamps_per_second": stats.delivered / (time.monotonic() - began),
        "dropped_host": stats.dropped_host,
        "malformed": stats.malformed,
        "photons_in_bins": float(histogram.counts.sum()),
        "memory_mib": settled[-1],
        "memory_growth_mib": max(settled) - settled[0],
    }


def resident_mib() -> float:
    """Memory of this process now."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize() / (1 << 20)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steady", type=float, default=10.0, metavar="S")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    figures = {"threads": thread_count(), **steady(options.steady)}
    print(
        json.dumps(figures)
        if options.json
        else "\n".join(f"{name:20} {value:.6g}" for name, value in figures.items())
    )


if __name__ == "__main__":
    main()
