"""What every stream rests on: the ring between the instrument and a slow reader with its accounts, an
instrument's clock estimated from messages that are delayed, and a connection that misbehaves.
"""

import resource
import threading
import time
from pathlib import Path

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import settings
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule
from instruments import RepeatingFeed

import devices
from devices.linospad2 import LinoSpad2Codec
from devices.recorder import measure_throughput
from devices.source import (
    OVERFLOW_POLICIES,
    Gap,
    Ledger,
    Piece,
    RingBuffer,
    as_bytes,
)
from devices.stream import WINDOW_S, InstrumentClock, StreamOptions, StreamSource
from devices.timetag_codec import RECORD_BYTES, TimeTagCodec
from tofclip.errors import (
    BufferOverflowError,
    DeviceDisconnectedError,
    DeviceTimeoutError,
)

SOON, LONG = 0.02, 5.0


class RingMachine(RuleBasedStateMachine):
    """Pieces put and taken in any order: acquired = delivered + unread + dropped + lost + malformed,
    at every moment, and what is dropped is marked at the next piece by the worst that it was.
    """

    @initialize(policy=st.sampled_from(OVERFLOW_POLICIES), capacity=st.sampled_from([10, 30]))
    def begin(self, policy, capacity):
        self.policy, self.capacity, self.ledger = policy, capacity, Ledger()
        self.ring = RingBuffer(capacity, policy, self.ledger)
        self.held = []  # name, gap, records
        self.counts = dict.fromkeys(("acquired", "delivered", "dropped", "lost"), 0)
        self.names, self.has_failed = 0, False

    def has_room(self):
        return not self.held or 10 * len(self.held) + 10 <= self.capacity

    @precondition(lambda self: not self.has_failed)
    @rule(records=st.integers(1, 5), gap=st.sampled_from(Gap))
    def put(self, records, gap):
        if self.policy == "block" and not self.has_room():
            return  # would wait
        self.counts["acquired"] += records
        piece = Piece(bytes([self.names % 256]) * 10, records, gap)
        if self.policy == "fail" and not self.has_room():
            with pytest.raises(BufferOverflowError, match="policy=drop_oldest"):
                self.ring.put(piece)
            self.counts["dropped"] += records
            self.has_failed = True
            return
        self.ring.put(piece)
        self.held.append((self.names % 256, gap, records))
        self.names += 1
        while 10 * len(self.held) > self.capacity:
            _, lost_gap, dropped = self.held.pop(0)
            self.counts["dropped"] += dropped
            name, gap, kept = self.held[0]
            self.held[0] = (name, max(gap, lost_gap, Gap.LOSS), kept)

    @rule(malformed=st.integers(0, 1))
    def take(self, malformed):
        if not self.held:
            fault = BufferOverflowError if self.has_failed else DeviceTimeoutError
            with pytest.raises(fault):
                self.ring.get(1e-4)
            return
        name, gap, records = self.held.pop(0)
        piece = self.ring.get(SOON)
        assert piece is not None
        assert (piece.data[0], piece.gap, piece.records) == (name, gap, records)
        self.ledger.deliver(records - malformed, malformed)
        self.counts["delivered"] += records

    @rule(records=st.integers(0, 9))
    def lose(self, records):
        self.ledger.lose(records)
        self.counts["lost"] += records
        self.counts["acquired"] += records

    @invariant()
    def accounts_balance(self):
        stats, counts = self.ledger.stats, self.counts
        assert stats.is_balanced
        assert stats.acquired == counts["acquired"]
        assert stats.delivered + stats.malformed == counts["delivered"]
        assert (stats.dropped_host, stats.lost_device) == (counts["dropped"], counts["lost"])
        assert stats.unread == sum(records for _, _, records in self.held)


TestRing = RingMachine.TestCase
TestRing.settings = settings(stateful_step_count=30)


@pytest.mark.parametrize("method", ["pull", "close"])
def test_a_reader_thread_never_dies_silently(method, monkeypatch):
    def fail(*_):
        raise ZeroDivisionError("of an unforeseen kind")

    monkeypatch.setattr(f"devices.timetag.TimeTaggerFeed.{method}", fail)
    source = devices.open("sim+timetag://?seed=4&records=8000")
    source.stop()
    with pytest.raises(ZeroDivisionError):
        list(source)
    source.close()


@pytest.mark.parametrize("is_under_way", [False, True])
def test_ctrl_c_while_a_source_opens_is_not_hidden_by_what_breaks_then(monkeypatch, is_under_way):
    """The instrument is let go of once, by the thread that uses it where one does already."""
    closers, begin = [], threading.Thread.start

    class Feed(RepeatingFeed):
        def close(self):
            closers.append(threading.current_thread().name)
            raise DeviceDisconnectedError("the connection broke")

    def interrupt(thread):
        if is_under_way:
            begin(thread)
        raise KeyboardInterrupt

    monkeypatch.setattr(threading.Thread, "start", interrupt)
    with pytest.raises(KeyboardInterrupt):
        StreamSource(Feed(TimeTagCodec(), lambda _: bytes(RECORD_BYTES), 1000, 0.01))
    assert closers == ["device reader" if is_under_way else "MainThread"]


def test_the_least_delay_remains_in_the_estimate_and_nothing_else():
    random, clock = np.random.default_rng(0), InstrumentClock()
    assert clock.to_host(1.0) == 0.0  # nothing known yet
    delays = 0.002 + random.exponential(0.05, 500)
    for number, delay in enumerate(delays):
        clock.observe(number * 0.01, 1000 + number * 0.01 + delay)
    assert clock.to_host(2.5) == pytest.approx(1002.5 + delays.min())


def test_quartzes_that_part_are_followed():
    clock, drift = InstrumentClock(), 50e-6
    for second in range(600):
        clock.observe(second * (1 + drift), second + 0.001)
    # An estimate from the first second would be wrong by 30 ms, one of two windows by 3 at most.
    assert clock.to_host(600 * (1 + drift)) == pytest.approx(600, abs=2 * WINDOW_S * drift + 0.001)


LATE = [(0.0, 1.0), (WINDOW_S, WINDOW_S + 1.5)]


@pytest.mark.parametrize(
    ("messages", "asked"),
    [
        # A stamp that goes back begins anew.
        ([(100.0, 5.0), (0.0, 6.0)], (1.0, 7.0)),
        # A new window, late from its first message on: the one before it still counts,
        (LATE, (40.0, 41.0)),
        # and then is forgotten.
        ([*LATE, (2 * WINDOW_S + 1, 2 * WINDOW_S + 2.8)], (80.0, 81.5)),
    ],
)
def test_what_a_clock_forgets(messages, asked):
    clock = InstrumentClock()
    for stamp, arrived_at in messages:
        clock.observe(stamp, arrived_at)
    assert clock.to_host(asked[0]) == pytest.approx(asked[1])


MINUTE_S = 60.0
MAX_GROWTH_MIB = 32.0


class MemoryWatch:
    """Looks at this process' memory once a second, after a quarter of the time."""

    def __init__(self):
        self._next, self.sizes = MINUTE_S / 4, list[float]()

    def look(self, passed):
        if passed >= self._next:
            self._next = passed + 1.0
            pages = int(Path("/proc/self/statm").read_text().split()[1])
            self.sizes.append(pages * resource.getpagesize() / (1 << 20))

    def require_steady(self):
        assert max(self.sizes) - self.sizes[0] < MAX_GROWTH_MIB


@pytest.mark.nightly
def test_a_minute_of_linospad2_at_half_rate_drops_nothing():
    """The instrument reaches 50 million stamps a second."""
    rate, codec, random = 25e6, LinoSpad2Codec(), np.random.default_rng(0)
    words = random.integers(0, 1 << 31, (80, codec.cycle_words), dtype=np.uint32)
    words |= (random.random(words.shape) < 0.6).astype(np.uint32) << 31
    words[:, 64 * codec.timestamps :] = 0
    size, data = 8 * codec.unit_bytes, memoryview(words.astype("<u4").tobytes())
    interval = codec.count_records(as_bytes(data)) / 10 / rate
    codec.decode(as_bytes(data), codec.start)  # loops are compiled before the clock runs
    make = lambda number: data[number % 10 * size :][:size]  # noqa: E731
    feed = RepeatingFeed(codec, make, int(MINUTE_S / interval), interval)
    watch, began, read = MemoryWatch(), time.monotonic(), 0
    with StreamSource(feed, StreamOptions(policy="drop_oldest")) as source:
        for batch in source:
            read += len(batch.records)
            watch.look(time.monotonic() - began)
    assert source.stats.dropped_host == source.stats.malformed == 0
    assert read == source.stats.delivered == pytest.approx(rate * MINUTE_S, rel=0.01)
    watch.require_steady()


@pytest.mark.nightly
def test_a_minute_of_time_tags_at_half_rate_drops_nothing():
    bytes_per_second, watch = 75e6, MemoryWatch()
    rate = bytes_per_second / RECORD_BYTES
    source = devices.open(f"sim+timetag://?seed=1&pace=realtime&rate={rate}")
    found = measure_throughput(source, MINUTE_S, watch.look)
    assert found.stats.dropped_host == found.stats.lost_device == found.stats.malformed == 0
    assert found.bytes / found.seconds == pytest.approx(bytes_per_second, rel=0.02)
    watch.require_steady()
