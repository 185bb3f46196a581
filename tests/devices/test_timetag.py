"""The time tagger's driver on the emulated instrument: policies, pace, odd answers; one behaviour at a
time, what the real one does and a first driver did not expect; and the light that falls on it.
"""

import array
import contextlib
import errno
import time
from dataclasses import replace

import numpy as np
import pytest
from instruments import TAGS, finish, joined, make_tagger, read_until_dark, true_records
from numpy.testing import assert_allclose, assert_array_equal

import devices
from devices.emulation.harness import Fault
from devices.emulation.scenes import simulate_line_light
from devices.emulation.timetag import (
    BLOCK_TICKS,
    BOARD_MEMORY_BYTES,
    CLOCK_HZ,
    COMMAND,
    MAGIC,
    MAX_TICK,
    PERIOD_TICKS,
    SCENE_SCALE,
    SYNC_MASK,
    EmulatedTimeTagger,
    PoissonStream,
    PulsedSceneStream,
)
from devices.emulation.usb import VirtualUsb, make_usb_error
from devices.source import as_bytes
from devices.timetag import (
    COMMAND_ENDPOINT,
    DATA_ENDPOINT,
    REPLY_ENDPOINT,
    USB_IDENTITY,
    Capture,
    Register,
    TimeTagger,
    TimeTaggerFeed,
    TimeTagOptions,
)
from devices.timetag_codec import COUNTER_RANGE, WRAP
from devices.transients import read_transient
from devices.usb import UsbLink
from tofclip.errors import (
    DeviceTimeoutError,
    InputError,
    ProtocolError,
)

RATE = 12_800_000.0
RECORDS = 2000
SMALL = "sim+timetag://?seed=3&transfer_kib=8"
OLD = {"old_records": 400, "flush_discards": False}


def link_to(instrument):
    return UsbLink(USB_IDENTITY, "", VirtualUsb(instrument))


def read_all(instrument):
    with instrument.open_driver() as source:
        found = joined(read_until_dark(source))
    assert source.stats.is_balanced
    return found


@pytest.fixture(scope="module", autouse=True)
def compiled():
    """Compile what every test needs, so that none of them is late."""
    assert len(true_records(1, 10)) == 10


def test_what_it_says_of_itself():
    with devices.open(SMALL) as source:
        assert source.info.as_dict() == {
            "instrument": "FX2 time tagger",
            "serial": "",  # as of the real ones
            "version": 6,
            "clock_hz": CLOCK_HZ,
            "usb": "04b4:1004",
        }
        assert source.calibration is not None
        assert source.calibration.attribute("tick_s") == 1 / CLOCK_HZ


def test_photons_are_poisson():
    words = PoissonStream(RATE, CLOCK_HZ, 8).next_words(200_000, MAX_TICK)
    records = TAGS.decode(as_bytes(words), TAGS.start).records
    gaps = np.diff(records["time_ticks"])
    # Ten ticks per photon, geometrically distributed; five standard deviations of 200 000.
    assert abs(gaps.mean() - 10) < 0.11
    assert abs(gaps.std() - np.sqrt(90)) < 0.2
    shares = np.bincount(records["channels"], minlength=9)[[1, 2, 4, 8]] / len(records)
    assert_allclose(shares, 0.25, atol=0.005)  # four standard deviations


def test_wraps_are_in_the_stream_and_cuts_are_not():
    rare = 5.0  # photons per second: the counter wraps every 537 s
    whole = PoissonStream(rare, CLOCK_HZ, 2).next_words(20_000, MAX_TICK)
    light = PoissonStream(rare, CLOCK_HZ, 2)
    pieces = [
        light.next_words(1, MAX_TICK) if number % 3 else light.next_words(7, COUNTER_RANGE)
        for number in range(500)
    ]
    cut = np.concatenate(pieces)
    assert_array_equal(cut, whole[: len(cut)])
    found = TAGS.decode(as_bytes(whole), TAGS.start)
    assert found.malformed == 0
    marks = found.records[found.records["flags"] == WRAP]["time_ticks"]
    assert_array_equal(marks, COUNTER_RANGE * np.arange(1, len(marks) + 1))
    assert len(marks) == found.records["time_ticks"][-1] // COUNTER_RANGE > 5


def test_photons_come_when_they_are_due():
    rate, seconds = 1e6, 0.3
    with devices.open(f"{SMALL}&pace=realtime&rate={rate}") as source:
        begin = time.monotonic()
        while time.monotonic() < begin + seconds:
            source.read()
        finish(source)
        took = time.monotonic() - begin
    assert source.stats.lost_device == 0
    # Not before their time (five standard deviations), and up to the moment of the stop.
    assert rate * seconds - 3000 < source.stats.delivered < rate * (took + 0.1) + 3000


def test_a_full_memory_loses_photons_and_says_so():
    # Photons that a busy machine can draw faster than they fall: a memory for 1 ms of them.
    instrument = make_tagger(pace="realtime", memory_mib=6000 / (1 << 20), transfer_kib=64)
    with instrument.open_driver() as source:
        assert source.read() is not None
        while instrument.truth.lost_memory_full == 0:
            time.sleep(0.01)
            source.read()
        finish(source)
    assert source.stats.lost_device == instrument.truth.lost_memory_full > 0
    assert source.stats.acquired == instrument.truth.registered


@pytest.mark.parametrize("command", ["", "aa0002", "ab00020000000000"])
def test_a_wrong_command_is_not_answered(command):
    link = link_to(make_tagger(stale_replies=0, jammed_bytes=0))
    link.write(COMMAND_ENDPOINT, bytes.fromhex(command), 0.1)
    with pytest.raises(DeviceTimeoutError):
        link.read(REPLY_ENDPOINT, array.array("B", bytes(8)), 0.1)


@pytest.mark.parametrize(("length", "said"), [(3, "answered 3 bytes"), (4, "0 Hz")])
def test_odd_answers_are_refused(length, said):
    with pytest.raises(ProtocolError, match=said):
        make_tagger(_send_reply=lambda *_: length).open_driver()


def test_a_clock_that_cannot_be_is_refused():
    instrument = make_tagger()
    instrument._registers[Register.CLOCK] = 42
    with pytest.raises(ProtocolError, match="42 Hz, which cannot be"):
        instrument.open_driver()


@pytest.mark.parametrize("fault", ["unplug@1:2", "powerloss@1:2", "overflow@1"])
def test_one_that_was_stopped_stays_so_whatever_happens(fault):
    link = link_to(make_tagger(rate=RATE, faults=Fault.parse(fault)))
    feed = TimeTaggerFeed(link, TimeTagOptions(transfer_kib=1.0))
    feed.start()
    assert feed.pull(0.1) is not None
    feed.stop()
    with contextlib.suppress(DeviceTimeoutError):
        feed.pull(0.5)  # the rest of what was registered before
    with pytest.raises(DeviceTimeoutError):
        feed.pull(0.5)
    assert not TimeTagger(link).read(Register.CAPTURE) & Capture.REGISTER


def test_closing_does_not_wait_for_one_that_is_gone():
    instrument = make_tagger(transfer_kib=0.5, reconnect_s=600)
    source = instrument.open_driver()
    source.read()
    instrument.unplug(float("inf"))
    begin = time.monotonic()
    source.close()
    assert time.monotonic() - begin < 5
    assert source.stats.is_balanced


def test_a_loose_plug_is_followed():
    """It goes again while it is being set up after it came back."""

    class Loose(EmulatedTimeTagger):
        left = 0

        def receive(self, endpoint, data):
            if self.left:
                self.left -= 1
                self.unplug(1)
                raise make_usb_error(errno.ENODEV)
            super().receive(endpoint, data)

    instrument = make_tagger(Loose, transfer_kib=0.5, reconnect_s=10)
    with instrument.open_driver() as source:
        source.read()
        instrument.left = 3
        instrument.unplug(1)
        while not source.read().after_gap:
            pass
        assert source.stats.reconnects == 1
        assert instrument.left == 0


@pytest.mark.parametrize("packet", [510, 512])
@pytest.mark.parametrize(
    "unkind",
    [{"stale_replies": 2, "jammed_bytes": 5}, {"jammed_bytes": 0}, {"old_records": 0}, OLD],
    ids=str,
)
def test_every_record_of_this_session_and_no_other(unkind, packet):
    instrument = make_tagger(transfer_kib=4, packet_bytes=packet, records=RECORDS, **unkind)
    assert_array_equal(read_all(instrument), true_records(1, RECORDS))


@pytest.mark.parametrize("rate", [20.0, 1000.0, 6000.0])
def test_a_photon_does_not_wait_for_others(rate):
    """Age of the oldest record of each batch when it is read, by the instrument's own clock."""
    instrument = make_tagger(rate=rate, pace="realtime")
    ages = []
    with instrument.open_driver() as source:
        end = time.monotonic() + 1.5
        while time.monotonic() < end:
            with contextlib.suppress(DeviceTimeoutError):
                batch = source.read(0.2)
                if len(batch):
                    now = time.monotonic() - instrument._started
                    ages.append(now - batch.records["time_ticks"][0] / CLOCK_HZ)
    assert len(ages) > 5
    assert np.median(ages) < 0.05


def test_a_full_stream_takes_few_transfers():
    """The board holds 3.4 ms; a transfer for every packet of 510 bytes, which has 85 records, is too
    slow under load.
    """
    memory = BOARD_MEMORY_BYTES / (1 << 20)
    instrument = make_tagger(rate=680_000, pace="realtime", memory_mib=memory)
    with instrument.open_driver() as source:
        end = time.monotonic() + 1.0
        while time.monotonic() < end:
            source.read()
    assert source.stats.malformed == 0
    assert source.stats.acquired == instrument.truth.registered
    assert source.stats.delivered / instrument._transfers > 2000


def test_registration_that_begins_with_the_counter_sees_a_wrap():
    """Which is why the driver starts the counter first."""
    instrument = make_tagger(old_records=0)
    instrument._write_register(Register.CAPTURE, Capture.COUNT | Capture.REGISTER)
    assert instrument.truth.registered == 1
    assert bytes(instrument._stream) == bytes([0x40, 0, 0, 0, 0, 0])


@pytest.mark.parametrize("stale", [1, 2])
def test_a_late_reply_does_not_answer_the_next_request(stale):
    """What another program asked, and never fetched, comes while this one works."""
    instrument = make_tagger()
    tagger = TimeTagger(link_to(instrument))

    def reply_late():
        for _ in range(stale):
            instrument.receive(COMMAND_ENDPOINT, COMMAND.pack(MAGIC, 0, Register.CLOCK, 0))

    tagger.write(Register.STROBE, 5)
    reply_late()
    assert tagger.read(Register.STROBE) == 5
    reply_late()
    tagger.write(Register.STROBE, 9)
    assert tagger.read(Register.STROBE) == 9
    assert tagger.version == 6


@pytest.mark.parametrize("silent", [0, 1, 2])
def test_records_of_the_last_session_are_thrown_away_though_they_come_slowly(silent):
    """One request for them is not answered in time."""

    class Slow(EmulatedTimeTagger):
        requests = 0

        def fill(self, endpoint, buffer, timeout):
            if endpoint == DATA_ENDPOINT:
                self.requests += 1
                if self.requests == silent + 1:
                    raise make_usb_error(errno.ETIMEDOUT)
            return super().fill(endpoint, buffer, timeout)

    instrument = make_tagger(Slow, transfer_kib=4, records=RECORDS, **OLD)
    ticks = read_all(instrument)["time_ticks"]
    assert_array_equal(ticks, true_records(1, RECORDS)["time_ticks"])


@pytest.mark.parametrize("number", range(12))
@pytest.mark.parametrize("kind", ["reply_late", "reply_lost", "reply_stall"])
def test_no_reply_is_taken_for_another(kind, number):
    faults = Fault.parse(f"{kind}@{number}:2,{kind}@{number + 13}:1,{kind}@{number + 40}:3")
    instrument = make_tagger(records=RECORDS, transfer_kib=4, faults=faults)
    assert len(read_all(instrument)) == RECORDS


# A simulated scene before the emulated time tagger: the photons' delays are the scene's.

SCENE_RATE = 2e6
STEPS = 50
"""Instants by which the duration of a row is stood for."""


@pytest.fixture(scope="module")
def light():
    return simulate_line_light()


def seen(scene, limit, last=MAX_TICK):
    found = TAGS.decode(as_bytes(scene.next_words(limit, last)), TAGS.start)
    assert found.malformed == 0
    return found.records


def test_delays_are_those_of_the_scene(light):
    records = seen(PulsedSceneStream(light, SCENE_RATE, CLOCK_HZ, 4), 400_000)
    is_pulse = records["channels"] & SYNC_MASK != 0
    assert np.all(records["time_ticks"][is_pulse] % PERIOD_TICKS == 0)
    assert np.all(np.diff(records["time_ticks"][is_pulse]) == PERIOD_TICKS)
    pulses = np.count_nonzero(is_pulse)
    expected = light.photons[:, 256 * np.array([1, 3, 5]) // 6]
    expected = expected * (SCENE_RATE * PERIOD_TICKS / CLOCK_HZ * pulses / expected.sum())
    width = light.row_times[1] - light.row_times[0]
    instants = light.row_times[:, np.newaxis] + width * (np.arange(0.5, STEPS) / STEPS - 0.5)
    ticks = np.floor(instants * SCENE_SCALE * CLOCK_HZ).astype(int).ravel() % PERIOD_TICKS
    for pixel, channel in enumerate((2, 4, 8)):
        delays = records["time_ticks"][records["channels"] & channel != 0] % PERIOD_TICKS
        counts = np.bincount(delays, minlength=PERIOD_TICKS)
        known = np.bincount(ticks, np.repeat(expected[:, pixel] / STEPS, STEPS), PERIOD_TICKS)
        # Five standard deviations; two photons within a tick that count as one.
        tolerance = 5 * np.sqrt(known + 1) + known**2 / pulses
        assert np.all(np.abs(counts - known) < tolerance)
        assert counts.sum() > 50_000


def test_cuts_do_not_change_the_stream(light):
    whole = seen(PulsedSceneStream(light, SCENE_RATE, CLOCK_HZ, 5), 40_000)
    scene = PulsedSceneStream(light, SCENE_RATE, CLOCK_HZ, 5)
    limits = ((10_000, MAX_TICK), (40_000, BLOCK_TICKS), (5, BLOCK_TICKS))
    pieces = [scene.next_words(*limit) for limit in limits]
    assert len(pieces[2]) == 0
    pieces.append(scene.next_words(40_000 - sum(map(len, pieces)) // 6, MAX_TICK))
    assert_array_equal(TAGS.decode(np.concatenate(pieces), TAGS.start).records, whole)
    assert len(scene.next_words(0, MAX_TICK)) == 0


def test_the_counter_wraps_where_a_block_begins(light):
    scene = PulsedSceneStream(light, SCENE_RATE, CLOCK_HZ, 6)
    scene._block = COUNTER_RANGE // BLOCK_TICKS - 1
    before = COUNTER_RANGE - BLOCK_TICKS
    records = seen(scene, 40_000)
    assert records["time_ticks"][0] == before
    marks = records[records["flags"] == WRAP]
    assert marks["time_ticks"].tolist() == [COUNTER_RANGE]


def test_light_that_does_not_fit_is_refused(light):
    with pytest.raises(InputError, match="within the laser's period of 1e-06 s"):
        PulsedSceneStream(replace(light, row_times=light.row_times + 1e-8), SCENE_RATE, CLOCK_HZ, 1)


def test_it_becomes_a_streak_image_of_three_columns(light):
    address = "sim+timetag://?seed=2&light=scene&seconds=0.4&period_ps=1000000"
    streak = read_transient(address, 1 / CLOCK_HZ)
    assert streak.counts.shape == (PERIOD_TICKS, 3)
    columns = light.photons[:, 256 * np.array([1, 3, 5]) // 6]
    mean = SCENE_SCALE * (light.row_times[:, np.newaxis] * columns).sum(0) / columns.sum(0)
    measured = (streak.times[:, np.newaxis] * streak.counts).sum(0) / streak.counts.sum(0)
    # Within a tick: a record says only in which one a photon came.
    assert_allclose(measured, mean, atol=1 / CLOCK_HZ)
