"""The contract of sources: every kind is listed here and passes all of it.

A kind is a function that takes a folder and returns the address of a source with a few thousand
records, after which a live one is silent and any other at its end.
"""

import json
import time

import numpy as np
import pytest

import devices
from devices.emulation.linospad2 import SimulatedBoard, draw_uneven_calibration
from devices.emulation.scenes import simulate_light
from devices.linospad2 import LinoSpad2Codec
from devices.recorder import record_source
from devices.recording.check import verify
from devices.source import DecodedSource, as_bytes
from devices.timetag import SendWindow
from tofclip.errors import DeviceTimeoutError, InputError

RECORDS = 4000
SILENCE = 0.12
QUIET_POLLS = 3
"""Times that a driver must have asked its instrument in vain before that is taken to have ended: a busy
machine delays the asking as it delays the instrument, so that no pause of its own ends a reading.
"""
LONG = 60.0  # compiling, on a slow machine
SIMULATED = f"sim+timetag://?seed=3&records={RECORDS}&transfer_kib=1&reconnect_s=5"


EMULATED = {
    "emulated": SIMULATED,
    "emulated in short packets": f"{SIMULATED}&packet_bytes=510",
    "emulated with faults": f"{SIMULATED}&faults=stall@2,unplug@5:1,corrupt@8:3,overflow@11,short@13:5,lost@15:20",
    "simulated linospad2": "sim+linospad2://?seed=2&cycles=12",
    "emulated spad array": "sim+spad512://?seed=2&width=16&pictures=20",
    "emulated streak camera": "sim+remoteex://?seed=2&scene=small&frames=8&frame_rate=100",
}


def recorded(folder):
    path = folder / "run.h5"
    if not path.exists():
        record_until_quiet(devices.open(EMULATED["emulated with faults"]), path)
    return f"file://{path}"


def record_until_quiet(source, path):
    """Record all that a source has; a live one is stopped once it falls silent."""
    seen, asked = 0, 0

    def stop_when_quiet(seconds):
        nonlocal seen, asked
        stats = source.stats
        if stats.delivered + stats.malformed > seen:
            seen, asked = stats.delivered + stats.malformed, stats.timeouts
        elif seen and stats.timeouts - asked >= QUIET_POLLS:
            source.stop()

    record_source(source, path, LONG, watch=stop_when_quiet if source.is_live else None)


def recorded_and_paced(folder):
    return f"{recorded(folder)}?pace=realtime"


def recorded_linospad2(folder):
    path = folder / "linospad2.h5"
    if not path.exists():
        record_source(devices.open(EMULATED["simulated linospad2"]), path)
    return f"file://{path}"


def words_of_linospad2(folder):
    path = folder / "words.dat"
    if not path.exists():
        parts = simulate_light("small"), draw_uneven_calibration(2), LinoSpad2Codec()
        board = SimulatedBoard(*parts, 100, 2)
        path.write_bytes(b"".join(board.encode_cycle(number) for number in range(45)))
        path.with_suffix(".toml").write_text(
            'firmware = "2212b"\ntimestamps_per_cycle = 512\nabsolute_counter = false\n'
        )
    return f"linospad2://{path}"


def photons_of_a_ptu(folder):
    ptufile = pytest.importorskip("ptufile")
    path = folder / "photons.ptu"
    if not path.exists():
        counts = np.random.default_rng(1).poisson(900, (1, 1, 1, 2, 250)).astype(np.uint16)
        clocks = {"global_resolution": 25e-9, "tcspc_resolution": 32e-12, "pixel_time": 1e-2}
        ptufile.imwrite(path, counts, **clocks)
    return f"file://{path}"


WRITTEN = [recorded, recorded_and_paced, recorded_linospad2, words_of_linospad2, photons_of_a_ptu]
KINDS = EMULATED | {kind.__name__: kind for kind in WRITTEN}


@pytest.fixture(autouse=True)
def own_time(monkeypatch):
    """Let the time tagger's driver measure rates by its own work: the emulated instrument's time runs
    as fast as it is read, and does not while other programs have the processor.
    """
    monkeypatch.setattr(SendWindow, "clock", staticmethod(time.thread_time))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """What the kinds write, once."""
    return tmp_path_factory.mktemp("sources")


@pytest.fixture(params=KINDS)
def address(request, folder):
    kind = KINDS[request.param]
    return kind if isinstance(kind, str) else kind(folder)


@pytest.fixture
def opened(address):
    return lambda: devices.open(address)


def read_on(source, batches):
    """Read until nothing more comes: a live source is stopped once it falls silent, a paced replay
    is waited for.
    """
    asked = source.stats.timeouts
    while not batches or source.stats.timeouts - asked < QUIET_POLLS:
        try:
            batch = source.read(SILENCE if source.is_live and batches else LONG)
        except DeviceTimeoutError:
            assert source.is_live
            assert batches
            continue
        if batch is None:
            return
        batches.append(batch)
        asked = source.stats.timeouts
    source.stop()
    while (batch := source.read(LONG)) is not None:
        batches.append(batch)


def joined(batches):
    return np.concatenate([batch.records for batch in batches])


def test_it_says_what_it_is(opened):
    with opened() as source:
        assert source.info.instrument
        assert json.loads(json.dumps(source.info.as_dict()))["instrument"] == source.info.instrument
        assert source.calibration is None or source.calibration.kind


def test_batches_are_numbered_arrays_of_records(opened):
    batches = []
    with opened() as source:
        read_on(source, batches)
    assert len(batches) > 5
    position = 0
    for batch in batches:
        assert batch.first == position
        assert batch.records.dtype.names
        assert batch.records.ndim == 1
        position += len(batch)
    assert position > len(batches) / 2


def test_accounts_balance_at_every_moment(opened):
    delivered = 0
    with opened() as source:
        assert source.stats.is_balanced
        for _ in range(4):
            batch = source.read(LONG)
            assert batch is not None
            delivered += len(batch)
            assert source.stats.is_balanced
            assert source.stats.delivered == delivered
    assert source.stats.is_balanced
    assert source.stats.delivered == delivered
    assert source.stats.unread > 0


def test_everything_read_is_everything_there_was(opened, address):
    batches = []
    with opened() as source:
        read_on(source, batches)
    stats = source.stats
    assert (stats.unread, stats.dropped_host) == (0, 0)
    assert stats.delivered == len(joined(batches))
    if source.is_live and "faults" not in address:
        assert stats.acquired == stats.delivered
    if address.startswith(SIMULATED):
        assert stats.acquired == RECORDS


def test_after_the_end_or_after_closing_there_is_nothing(opened):
    with opened() as source:
        read_on(source, [])
        assert source.read(0.0) is None
        assert list(source) == []
    source = opened()
    source.read(LONG)
    source.close()
    source.close()
    assert source.read(0.0) is None
    assert source.stats.is_balanced
    with pytest.raises(ZeroDivisionError), opened() as source:
        raise ZeroDivisionError
    assert source.read(0.0) is None


def test_waiting_is_bounded(opened):
    with opened() as source:
        if not source.is_live:
            return
        source.read(LONG)
        try:
            while source.read(SILENCE) is not None:
                pass
        except DeviceTimeoutError:
            begin = time.monotonic()
        else:
            return
        with pytest.raises(DeviceTimeoutError):
            source.read(SILENCE)
        assert SILENCE <= time.monotonic() - begin < SILENCE + 5


def test_seeking_is_exact_or_refused(opened):
    with opened() as source:
        if not source.is_seekable:
            with pytest.raises(InputError, match="cannot seek"):
                source.seek(0)
            return
        first = []
        read_on(source, first)
        whole = joined(first)
        for target in (len(whole) // 2, 0, 1, len(whole) // 3, len(whole) - 1):
            source.seek(target)
            again = []
            read_on(source, again)
            assert again[0].first == target
            np.testing.assert_array_equal(joined(again), whole[target:])
            # As if everything before had been read.
            assert source.stats.is_balanced
            assert (source.stats.delivered, source.stats.unread) == (len(whole), 0)
        source.seek(len(whole))
        assert source.read(LONG) is None
        for absent in (-1, len(whole) + 1):
            with pytest.raises(InputError, match="record"):
                source.seek(absent)


def test_the_same_again_is_the_same(opened):
    runs = [[], []]
    for batches in runs:
        with opened() as source:
            read_on(source, batches)
    np.testing.assert_array_equal(joined(runs[0]), joined(runs[1]))
    gaps = [[batch.first for batch in batches if batch.after_gap] for batches in runs]
    assert gaps[0] == gaps[1]


def test_its_bytes_are_tapped_before_they_are_decoded(opened, tmp_path):
    with opened() as source:
        if not isinstance(source, DecodedSource):
            return
        tapped = []
        source.tap = lambda piece: tapped.append(piece.data)
        batch = source.read(LONG)
        assert batch is not None
        found = source.codec.decode(as_bytes(tapped[0]), source.codec.start)
        np.testing.assert_array_equal(found.records, batch.records)


def test_its_recording_replays_what_it_gave(opened, tmp_path):
    path, recorded_from = tmp_path / "again.h5", opened()
    if not isinstance(recorded_from, DecodedSource):
        with recorded_from, pytest.raises(InputError, match="nothing to record"):
            record_source(recorded_from, path)
        return
    record_until_quiet(recorded_from, path)
    assert verify(path).is_sound
    live = []
    with opened() as source:
        read_on(source, live)
    with devices.open(f"file://{path}") as replay:
        again = list(replay)
    assert joined(again).tobytes() == joined(live).tobytes()
    assert replay.info == source.info


def test_unknown_values_in_its_address_are_refused(address):
    with pytest.raises(InputError, match="'colour' is unknown"):
        devices.open(f"{address}{'&' if '?' in address else '?'}colour=red")
