"""How fast photons become transients: words of LinoSPAD2, time tags, and both into histograms.

Run with ``python tests/benchmarks/detectors.py [--repeats N] [--steady S] [--json]``. Medians of the repeats, with the
least and the greatest. ``--steady 60`` is the long run of the acceptance: words arrive in real time, at half of the
required rates, through buffer, decoder and histogram; nothing may be dropped and memory must not grow.
"""

from __future__ import annotations

import argparse
import json
import resource
import statistics
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from devices.codec import Records, as_bytes
from devices.histogram import BinAxis, StampHistogram, TagHistogram
from devices.ledger import Ledger
from devices.linospad2.codec import STAMP, LinoSpad2Codec
from devices.linospad2.simulation import LASER_PERIOD, uneven_board
from devices.source import Info
from devices.stream import Arrival, Buffering, StreamSource
from devices.timetag.codec import RECORD
from tofclip.arrays import thread_count
from tofclip.storage import Record

MEGA = 1e6
PHOTONS = 8_000_000
STEADY_RATE = 25e6
"""Time stamps per second in the long run: half of the 50 million that are asked for."""

FILLED = 0.6
"""Share of the words that hold a time stamp, in the long run: 167 MB/s of words then."""

Figures = dict[str, float]


def rates(amount: float, action: Callable[[], object], repeats: int) -> Figures:
    """Median, least and greatest of `amount` per second."""
    action()  # compile, and touch memory
    found = []
    for _ in range(repeats):
        begin = time.perf_counter()
        action()
        found.append(amount / (time.perf_counter() - begin))
    return {"median": statistics.median(found), "least": min(found), "greatest": max(found)}


def words(filled: float, cycles: int) -> bytes:
    """Random words of which a share holds a time stamp."""
    codec, random = LinoSpad2Codec(), np.random.default_rng(0)
    stream = random.integers(0, 1 << 31, (cycles, codec.cycle_words), dtype=np.uint32)
    stream |= (random.random(stream.shape) < filled).astype(np.uint32) << 31
    stream[:, 64 * codec.timestamps :] = 0
    return stream.astype("<u4").tobytes()


def decoding(repeats: int) -> dict[str, Figures]:
    """Words to records, in MB/s of words."""
    codec, found = LinoSpad2Codec(), {}
    for filled in (0.05, 0.5, 1.0):
        data = as_bytes(words(filled, 240))
        found[f"LinoSPAD2 decode, {filled:.0%} filled (MB/s)"] = rates(
            len(data) / MEGA, partial(codec.decode, data, 0), repeats
        )
    return found


def stamps() -> Records:
    """Time stamps in the order of the stream."""
    random = np.random.default_rng(1)
    records = np.zeros(PHOTONS, STAMP)
    records["pixel"] = np.arange(PHOTONS) // 100 * 4 % 256 + random.integers(0, 4, PHOTONS)
    records["code"] = random.integers(0, 1 << 27, PHOTONS)
    return records


def tags() -> Records:
    """Time tags of three detectors and the laser."""
    records = np.zeros(PHOTONS, RECORD)
    records["time_ticks"] = np.arange(PHOTONS) * 3
    records["channels"] = np.random.default_rng(2).choice([1, 2, 4, 8], PHOTONS)
    return records


def histogramming(repeats: int) -> dict[str, Figures]:
    """Records to histograms, in millions per second."""
    sensor = StampHistogram(BinAxis(20e-12, 576, 0.0, LASER_PERIOD), uneven_board(0))
    tagger = TagHistogram(BinAxis(1e-9, 512), 0, (1, 2, 3), 1 / 128e6)
    in_order, tagged = stamps(), tags()
    shuffled = np.random.default_rng(3).permutation(in_order)
    return {
        "time stamps in stream order (M/s)": rates(PHOTONS / MEGA, lambda: sensor.add(in_order), repeats),
        "time stamps at random (M/s)": rates(PHOTONS / MEGA, lambda: sensor.add(shuffled), repeats),
        "time tags (M/s)": rates(PHOTONS / MEGA, lambda: tagger.add(tagged), repeats),
    }


class SteadyFeed:
    """The same cycles again and again, each when it is due."""

    calibration: Record | None = None
    info = Info("steady words")

    def __init__(self, data: bytes, piece: int, bytes_per_second: float, seconds: float) -> None:
        self._data, self._piece, self._rate = memoryview(data), piece, bytes_per_second
        self._sent, self._total = 0, int(bytes_per_second * seconds / piece) * piece

    def start(self) -> None:
        self._began = time.monotonic()

    def pull(self, timeout: float) -> Arrival | None:
        if self._sent >= self._total:
            return None
        at = self._sent % len(self._data)
        self._sent += self._piece
        time.sleep(max(0.0, self._began + self._sent / self._rate - time.monotonic()))
        return Arrival(self._data[at : at + self._piece])

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
    histogram = StampHistogram(BinAxis(20e-12, 576, 0.0, LASER_PERIOD), uneven_board(0))
    memory, began, looked = [], time.monotonic(), 0.0
    with StreamSource(feed, codec, Ledger(), Buffering(policy="drop_oldest")) as source:
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
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--steady", type=float, default=10.0, metavar="S")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    figures = {**decoding(options.repeats), **histogramming(options.repeats)}
    long_run = steady(options.steady)
    if options.json:
        print(json.dumps({"threads": thread_count(), **figures, "steady": long_run}))
        return
    print(f"{thread_count()} threads")
    for name, found in figures.items():
        print(f"{name:40} {found['median']:9.1f}   ({found['least']:.1f} .. {found['greatest']:.1f})")
    print("steady:", ", ".join(f"{name} {value:.6g}" for name, value in long_run.items()))


if __name__ == "__main__":
    main()
