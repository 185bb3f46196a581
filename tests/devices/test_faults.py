"""Every record is accounted for, whatever goes wrong: faults, drawn at random and one by one, against
each emulated instrument, and readers that are late.

Accounts balance by construction, so balancing alone says nothing: those of the time tagger are
compared with what the emulator knows.
"""

import contextlib
import threading
import time
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from time import monotonic

import numpy as np
import pytest
from instruments import RepeatingFeed, joined, make_tagger, true_records

import devices
from devices.emulation.harness import FAULT_KINDS, HOST, REPLY_FAULTS, Fault
from devices.emulation.remoteex import EmulatedStreakCamera
from devices.emulation.scenes import EmulatedLight
from devices.emulation.spad512 import EmulatedSpadArray
from devices.emulation.timetag import GroundTruth
from devices.frames import FrameCodec
from devices.source import Batch, Stats
from devices.stream import StreamOptions, StreamSource
from devices.timetag import SendWindow
from tofclip.errors import (
    BufferOverflowError,
    DeviceDisconnectedError,
    DeviceError,
    DeviceStalledError,
    DeviceTimeoutError,
)

RECORDS, FRAMES = 8000, 25
TRANSFERS = 36
"""Of 512 bytes each: by then the instrument is not dark, even if six faults lose 600 records each."""
LONGEST_S = 60.0
"""An undisturbed script takes less than one second, each fault adds a few tenths."""
PERMANENT = 1_000_000
"""Enumerations after which nothing looks any more."""
FATAL = {"corrupt", "overflow", "stall"}
"""After these a stream of pictures cannot be trusted any more: reading ends with an exception."""

FINE = {"timeout": 0.3, "short": 0.2, "unplug": 0.2}
STREAK_KINDS = FINE | {"lost": 0.2, "corrupt": 0.05, "overflow": 0.05}
ARRAY_KINDS = FINE | {"corrupt": 0.15, "stall": 0.15}
"""How often each kind of fault is drawn."""
SCREEN = EmulatedLight(np.full((6, 8), 5.0), np.linspace(0, 5e-11, 6), seed=1)
ARRAY_LIGHT = np.full((512, 512), 1e5)


@dataclass
class Outcome:
    """What became of a script."""

    faults: Sequence[Fault]
    batches: list[Batch] = field(default_factory=list)
    stats: Stats = field(default_factory=Stats)
    fault: Exception | None = None
    truth: GroundTruth = field(default_factory=GroundTruth)
    gain: str = "0"
    seconds: float = float("inf")


def read_script(source, outcome, is_over, is_rest_read):
    """Read until it is over, and the rest that waits if wanted; stop, and enter how it ended."""
    began = monotonic()
    try:
        with source:
            while not is_over():
                with contextlib.suppress(DeviceTimeoutError):
                    while (batch := source.read(0.02)) is not None:
                        outcome.batches.append(batch)
                        if is_over() and not is_rest_read:
                            break
            source.stop()
            outcome.batches += list(source)
    except DeviceError as fault:
        outcome.fault = fault
    outcome.stats, outcome.seconds = source.stats, monotonic() - began


def draw_tagger_script(seed):
    """Draw up to six faults of any kind, at most one for a transfer."""
    random = np.random.default_rng(seed)
    faults = []
    for transfer in sorted(random.permutation(TRANSFERS)[: random.integers(0, 7)].tolist()):
        kind = FAULT_KINDS[random.integers(len(FAULT_KINDS))]
        amount = int(random.integers(0, 600))
        if kind in ("stall", "unplug", "powerloss"):
            amount = int(random.choice([1, 2], p=[0.85, 0.15]))
            # Rarely the instrument never comes back.
            amount = PERMANENT if amount == 2 and kind != "stall" else amount
        elif kind in REPLY_FAULTS:
            amount = int(random.integers(1, 4))
        faults.append(Fault(transfer, kind, amount))
    return faults


def run_tagger(faults, seed):
    """Read a time tagger until it is dark or fails, under a watchdog."""
    options = {"records": RECORDS, "transfer_kib": 0.5, "reconnect_s": 2}
    instrument = make_tagger(seed=seed, faults=tuple(faults), **options)
    outcome = Outcome(faults, truth=instrument.truth)

    def read():
        is_over = lambda: bool(instrument.truth.registered >= RECORDS)  # noqa: E731
        read_script(instrument.open_driver(), outcome, is_over, is_rest_read=True)

    thread = threading.Thread(target=read, daemon=True)
    thread.start()
    thread.join(LONGEST_S)
    assert not thread.is_alive(), f"hangs with {faults}"
    return outcome


def expect_fault(script):
    """Return the exception that must end a run, which nothing but a lasting stall or absence does."""
    stalls = {fault.transfer for fault in script if fault.kind == "stall"}
    for fault in script:
        if fault.kind == "stall" and (fault.amount > 1 or fault.transfer + 1 in stalls):
            return DeviceStalledError
        if fault.kind in ("unplug", "powerloss") and fault.amount >= PERMANENT:
            return DeviceDisconnectedError
    return None


def is_among(ticks, known):
    """Whether every tick is one of those known, which rise."""
    places = np.searchsorted(known, ticks).clip(max=len(known) - 1)
    return bool(np.all(known[places] == ticks))


def require_tagger_account(seed, outcome):
    """What came and what was reported is what happened; nothing is made up or out of order."""
    stats, truth = outcome.stats, outcome.truth
    assert type(outcome.fault) is (expect_fault(outcome.faults) or type(None)), outcome.faults
    assert stats.is_balanced
    assert stats.delivered == sum(map(len, outcome.batches))
    assert stats.dropped_host == 0
    assert truth.corrupted <= stats.malformed  # and records of which a gap has cut off the end
    if isinstance(outcome.fault, DeviceDisconnectedError):
        assert stats.acquired <= truth.registered
    else:
        assert stats.acquired == truth.registered - truth.lost_power_off
        assert stats.lost_device >= truth.lost_memory_full or truth.lost_power_off
    resets, last, after_gap = 0, -1, False
    known = true_records(seed, RECORDS)["time_ticks"]
    for batch in outcome.batches:
        after_gap |= batch.after_gap
        if not len(batch):
            continue  # nothing but malformed records
        ticks = batch.records["time_ticks"]
        while after_gap and not is_among(ticks, known) and resets < stats.reconnects:
            resets, last = resets + 1, -1  # the instrument's clock began anew
            known = true_records(seed, RECORDS, resets)["time_ticks"]
        assert is_among(ticks, known)
        assert np.all(np.diff(ticks, prepend=last) > 0)
        last, after_gap = ticks[-1], False


def run_pictures(seed):
    """Run a script of up to five faults among the first requests: a streak camera for odd seeds, an
    array for even ones. The very first request, with which a source opens, goes well.
    """
    kinds, random = STREAK_KINDS if seed % 2 else ARRAY_KINDS, np.random.default_rng(seed)
    places = 1 + random.choice(15, random.integers(0, 6), replace=False)
    drawn = random.choice(len(kinds), len(places), p=list(kinds.values()))
    faults = [
        Fault(int(place), list(kinds)[number], int(random.integers(1, 4)))
        for place, number in zip(places, drawn, strict=True)
    ]
    if seed % 2:
        server = EmulatedStreakCamera(SCREEN, 200, faults=faults)
        port, data_port = server.ports
        values = f"data_port={data_port}&timeout_s=0.5&buffers=8&mcp_gain=9"
        address = f"remoteex://{HOST}:{port}?{values}"
    else:
        server = EmulatedSpadArray(ARRAY_LIGHT, seed, faults=faults)
        address = f"spad512://{HOST}:{server.port}?width=4&timeout_s=1&images={1 + seed % 3}"
    outcome, source = Outcome(faults), devices.open(address)
    is_over = lambda: source.stats.delivered >= FRAMES  # noqa: E731
    read_script(source, outcome, is_over, is_rest_read=False)
    server.close()
    outcome.gain = getattr(server, "gain", "0")
    return outcome


def is_right(outcome):
    """Whether nothing of pictures is unaccounted for, the tube is safe, and only a fatal fault has
    ended the stream.
    """
    is_allowed = any(fault.kind in FATAL for fault in outcome.faults)
    is_balanced = outcome.stats.is_balanced and outcome.stats.unread == 0
    is_safe = outcome.gain == "0" and outcome.seconds < LONGEST_S
    return is_balanced and is_safe and (outcome.fault is None or is_allowed)


def run_at_once(run, *arguments):
    """Run scripts, some at once: they wait most of the time."""
    with ThreadPoolExecutor(12) as pool:
        return list(pool.map(run, *arguments))


def sample(count):
    """Try so many seeds with every commit, and up to a thousand at night."""
    rest = pytest.param(range(count, 1000), marks=pytest.mark.nightly)
    return pytest.mark.parametrize("seeds", [range(count), rest], ids=["sample", "rest"])


@pytest.fixture(autouse=True)
def own_time(monkeypatch):
    """Let the driver measure rates by its own work: the emulated instrument's time runs as fast as it
    is read, and packets would get smaller while other programs have the processor.
    """
    monkeypatch.setattr(SendWindow, "clock", staticmethod(time.thread_time))


@sample(120)
def test_random_faults_of_a_time_tagger(seeds):
    outcomes = run_at_once(run_tagger, map(draw_tagger_script, seeds), seeds)
    for seed, outcome in zip(seeds, outcomes, strict=True):
        require_tagger_account(seed, outcome)


@sample(48)
def test_random_faults_of_cameras(seeds):
    """All kinds of faults came up, some streams went on after a cable was pulled, some ended."""
    outcomes = run_at_once(run_pictures, seeds)
    assert [outcome for outcome in outcomes if not is_right(outcome)] == []
    kinds = {fault.kind for outcome in outcomes for fault in outcome.faults}
    assert kinds >= {*STREAK_KINDS, *ARRAY_KINDS}
    assert sum(one.stats.reconnects > 0 and one.fault is None for one in outcomes) > 3
    assert sum(one.fault is not None for one in outcomes) > 3
    assert sum(one.stats.lost_device > 0 for one in outcomes) > 3


def test_short_transfers_single_stalls_and_timeouts_lose_nothing():
    stats = run_tagger(Fault.parse("short@3:7,stall@5,timeout@8,short@9:1"), 1).stats
    assert (stats.delivered, stats.malformed, stats.lost_device) == (RECORDS, 0, 0)
    assert stats.timeouts >= 1


def test_the_stream_goes_on_after_it_was_unplugged():
    outcome = run_tagger(Fault.parse("unplug@10:2"), 2)
    gaps = [batch for batch in outcome.batches if batch.after_gap]
    assert (outcome.fault, len(gaps), outcome.stats.reconnects) == (None, 1, 1)
    # What the instrument held at that moment, a part of one record, is lost; its clock went on.
    whole = np.delete(true_records(2, RECORDS), gaps[0].first)
    np.testing.assert_array_equal(joined(outcome.batches), whole)
    assert (outcome.stats.acquired, outcome.stats.malformed) == (RECORDS, 1)


def test_an_instrument_that_lost_its_power_begins_anew():
    outcome = run_tagger(Fault.parse("powerloss@10:1"), 3)
    gap = next(batch for batch in outcome.batches if batch.after_gap)
    assert outcome.stats.reconnects == 1
    assert outcome.truth.registered == RECORDS
    assert outcome.stats.acquired + outcome.truth.lost_power_off == RECORDS
    assert gap.first > 800  # ten transfers of 85 records
    assert gap.records["time_ticks"][0] == true_records(3, 1, resets=1)["time_ticks"][0]


@pytest.mark.parametrize(
    ("script", "fault", "said"),
    [
        (f"unplug@10:{PERMANENT}", DeviceDisconnectedError, "did not come back within 2 s"),
        ("stall@10:2", DeviceStalledError, "stalled"),
    ],
)
def test_gone_for_good(script, fault, said):
    outcome = run_tagger(Fault.parse(script), 4)
    assert type(outcome.fault) is fault
    assert said in str(outcome.fault)
    assert outcome.stats.delivered == 10 * 512 // 6  # all that came before was read first


def test_losses_are_told_apart():
    outcome = run_tagger(Fault.parse("lost@4:50,overflow@8,corrupt@12:9"), 5)
    stats = outcome.stats
    assert stats.acquired == RECORDS
    # A transfer of 512 bytes holds 85 or 86 records of which it has the beginning.
    assert 50 + 85 <= stats.lost_device <= 50 + 87
    assert 9 <= stats.malformed <= 10
    assert [batch.after_gap for batch in outcome.batches].count(True) == 1


PICTURES = 80
MEBIBYTE = FrameCodec(1024, 1024, 8)


def make_picture(number):
    return MEBIBYTE.pack_frame(number, bytes(MEBIBYTE.pixel_bytes))


@pytest.mark.parametrize("policy", ["block", "drop_oldest", "fail", "newest"])
def test_a_reader_64_mib_behind(policy):
    """What it gets, what is reported to it, and that the age is among it."""
    feed, is_newest = RepeatingFeed(MEBIBYTE, make_picture, PICTURES), policy == "newest"
    source = StreamSource(feed, StreamOptions(64.0, "block" if is_newest else policy))
    if is_newest:
        source.keep_newest()
    deadline = monotonic() + 20
    while source.stats.acquired < (PICTURES if is_newest else 62) and monotonic() < deadline:
        time.sleep(1e-3)
    began, numbers = monotonic(), []
    try:
        for batch in source:
            assert 0 < batch.taken_at <= batch.received_at <= monotonic()
            numbers += batch.records["number"].tolist()
    except BufferOverflowError:
        assert policy == "fail"
    source.close()
    stats = source.stats
    assert stats.is_balanced
    assert stats.delivered == len(numbers)
    assert np.all(np.diff(numbers) > 0)
    if policy == "block":
        assert numbers == list(range(PICTURES))  # it waits, and nothing is lost
    elif is_newest:
        assert numbers[-1] == PICTURES - 1
        assert stats.dropped_host == PICTURES - len(numbers)
    else:
        assert stats.dropped_host > 0 or stats.delivered == PICTURES
    assert monotonic() - began < 20


class ClosingFeed(RepeatingFeed):
    """Closes its own source with its third picture, as the collector may on the reader's thread."""

    source = Future()

    def pull(self, timeout):
        source = self.source.result()
        if self._number == 3:
            source.close()
        return super().pull(timeout)


def test_a_source_that_is_closed_on_its_own_thread_ends_as_any_other():
    source = StreamSource(ClosingFeed(MEBIBYTE, make_picture, PICTURES))
    ClosingFeed.source.set_result(source)
    while source._ring.get(5.0) is not None:
        pass
    source._thread.join(5.0)
    assert not source._thread.is_alive()
