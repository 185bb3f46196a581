"""Every record is accounted for, whatever goes wrong.

The accounts are compared with what the emulator knows: they balance by construction, so balancing
alone says nothing. `.ci/nightly` runs a thousand of these.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from fault_scripts import RECORDS, TRANSFERS, Outcome, expected_fault, light, run
from numpy.typing import NDArray

from devices.emulation.faults import PERMANENT_ENUMERATIONS, Fault, draw_fault_script
from devices.emulation.timetag import MAX_TICK
from devices.source import Records, as_bytes
from devices.timetag.codec import RECORD_DTYPE, TimeTagCodec
from devices.timetag.driver import SendWindow
from tofclip.errors import DeviceDisconnectedError, DeviceStalledError, InputError

SCRIPTS, NIGHTLY_SCRIPTS = 300, 1000
AT_ONCE = 16


@pytest.fixture(autouse=True)
def own_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the driver measure rates by its own work: the emulated instrument's time runs as fast as it
    is read, and packets would get smaller while other programs have the processor.
    """
    monkeypatch.setattr(SendWindow, "clock", staticmethod(time.thread_time))


def true_records(seed: int, count: int, resets: int = 0) -> Records:
    codec = TimeTagCodec()
    return codec.decode(
        as_bytes(light(seed, resets).next_words(count, MAX_TICK)), codec.start
    ).records


def joined(outcome: Outcome) -> Records:
    return np.concatenate(
        [np.empty(0, RECORD_DTYPE), *(batch.records for batch in outcome.batches)]
    )


def require_account(seed: int, script: Sequence[Fault], outcome: Outcome) -> None:
    stats, truth = outcome.stats, outcome.truth
    assert type(outcome.fault) is (expected_fault(script) or type(None)), script
    assert stats.is_balanced
    assert stats.delivered == sum(map(len, outcome.batches))
    assert stats.dropped_host == 0
    assert truth.corrupted <= stats.malformed  # and records of which a gap has cut off the end
    if not isinstance(outcome.fault, DeviceDisconnectedError):
        assert stats.acquired == truth.registered - truth.lost_power_off
        assert stats.lost_device >= truth.lost_memory_full or truth.lost_power_off
    else:
        assert stats.acquired <= truth.registered
    require_true_records(seed, outcome)


def require_true_records(seed: int, outcome: Outcome) -> None:
    """Nothing is made up, nothing is out of order; at a gap the instrument's clock may begin anew."""
    resets, last, after_gap = 0, -1, False
    known = true_records(seed, RECORDS)["time_ticks"]
    for batch in outcome.batches:
        after_gap |= batch.after_gap
        if not len(batch):
            continue  # nothing but malformed records
        ticks = batch.records["time_ticks"]
        while after_gap and not are_among(ticks, known) and resets < outcome.stats.reconnects:
            resets, last = resets + 1, -1
            known = true_records(seed, RECORDS, resets)["time_ticks"]
        assert are_among(ticks, known)
        assert np.all(np.diff(ticks, prepend=last) > 0)
        last, after_gap = ticks[-1], False


def are_among(some: NDArray[np.int64], known: NDArray[np.int64]) -> bool:
    """Whether all of `read_available` are in `known`, which rises."""
    return bool(np.all(known[np.searchsorted(known, some) % len(known)] == some))


@pytest.mark.parametrize(
    "seeds",
    [range(SCRIPTS), pytest.param(range(SCRIPTS, NIGHTLY_SCRIPTS), marks=pytest.mark.nightly)],
    ids=["sample", "rest"],
)
def test_random_faults(seeds: range) -> None:
    scripts = [draw_fault_script(seed, TRANSFERS) for seed in seeds]
    with ThreadPoolExecutor(AT_ONCE) as pool:  # they wait most of the time
        outcomes = list(pool.map(run, scripts, seeds))
    for seed, script, outcome in zip(seeds, scripts, outcomes, strict=True):
        require_account(seed, script, outcome)


def test_without_faults_everything_arrives_as_it_was() -> None:
    outcome = run((), 7)
    assert outcome.fault is None
    records = joined(outcome)
    np.testing.assert_array_equal(records, true_records(7, RECORDS))
    assert outcome.stats.acquired == outcome.stats.delivered == RECORDS
    firsts = np.cumsum([0, *map(len, outcome.batches)])
    assert [batch.first for batch in outcome.batches] == firsts[:-1].tolist()
    assert not any(batch.after_gap for batch in outcome.batches)


def test_what_goes_unnoticed() -> None:
    """Short transfers, single stalls and timeouts lose nothing."""
    script = [Fault(3, "short", 7), Fault(5, "stall"), Fault(8, "timeout"), Fault(9, "short", 1)]
    outcome = run(script, 1)
    assert (outcome.stats.delivered, outcome.stats.malformed, outcome.stats.lost_device) == (
        RECORDS,
        0,
        0,
    )
    assert outcome.stats.timeouts >= 1


def test_the_stream_goes_on_after_it_was_unplugged() -> None:
    outcome = run([Fault(10, "unplug", 2)], 2)
    gaps = [batch for batch in outcome.batches if batch.after_gap]
    assert (outcome.fault, len(gaps), outcome.stats.reconnects) == (None, 1, 1)
    records = joined(outcome)
    # What the instrument held at that moment, a part of one record, is lost; its clock went on.
    known = true_records(2, RECORDS)
    np.testing.assert_array_equal(records, np.delete(known, gaps[0].first))
    assert (outcome.stats.acquired, outcome.stats.malformed) == (RECORDS, 1)


def test_an_instrument_that_lost_its_power_begins_anew() -> None:
    outcome = run([Fault(10, "powerloss", 1)], 3)
    gap = next(batch for batch in outcome.batches if batch.after_gap)
    assert outcome.stats.reconnects == 1
    assert outcome.truth.registered == RECORDS
    assert outcome.stats.acquired + outcome.truth.lost_power_off == RECORDS
    assert gap.first > 800  # ten transfers of 85 records
    assert gap.records["time_ticks"][0] == true_records(3, 1, resets=1)["time_ticks"][0]


def test_gone_for_good() -> None:
    outcome = run([Fault(10, "unplug", PERMANENT_ENUMERATIONS)], 4)
    assert isinstance(outcome.fault, DeviceDisconnectedError)
    assert "did not come back within 2 s" in str(outcome.fault)
    assert outcome.stats.delivered == 10 * 512 // 6  # all that came before was read first
    outcome = run([Fault(10, "stall", 2)], 4)
    assert isinstance(outcome.fault, DeviceStalledError)
    assert outcome.stats.delivered == 10 * 512 // 6


def test_losses_are_told_apart() -> None:
    outcome = run([Fault(4, "lost", 50), Fault(8, "overflow"), Fault(12, "corrupt", 9)], 5)
    stats = outcome.stats
    assert stats.acquired == RECORDS
    # A transfer of 512 bytes holds 85 or 86 records of which it has the beginning.
    assert 50 + 85 <= stats.lost_device <= 50 + 87
    assert 9 <= stats.malformed <= 10
    assert [batch.after_gap for batch in outcome.batches].count(True) == 1


def test_scripts_are_drawn_from_their_seed_and_read_from_text() -> None:
    assert draw_fault_script(5, 30) == draw_fault_script(5, 30) != draw_fault_script(6, 30)
    assert Fault.parse("stall@3,unplug@10:2") == (Fault(3, "stall"), Fault(10, "unplug", 2))
    for text in ("boom@3", "stall", "stall@x", "stall@3:-1"):
        with pytest.raises(InputError, match="is not a fault"):
            Fault.parse(text)
