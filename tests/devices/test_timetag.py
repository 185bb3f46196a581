"""The time tagger's driver on the emulated instrument: policies, pace, odd answers; one behaviour at a
time, what the real one does and a first driver did not expect; and the light that falls on it.
"""

import contextlib
import errno
import time
from dataclasses import replace

import numpy as np
import pytest
from instruments import finish, joined, make_tagger, read_until_dark, true_records
from numpy.testing import assert_allclose, assert_array_equal

import devices
from devices.emulation.harness import Fault
from devices.emulation.scenes import simulate_light
from devices.emulation.timetag import (
    BOARD_MEMORY_BYTES,
    CLOCK_HZ,
    PERIOD_TICKS,
    SCENE_SCALE,
    EmulatedTimeTagger,
    PulsedSceneStream,
)
from devices.emulation.usb import VirtualUsb, make_usb_error
from devices.timetag import (
    USB_IDENTITY,
    Capture,
    Register,
    TimeTagger,
    TimeTaggerFeed,
    TimeTagOptions,
)
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


@pytest.mark.parametrize(("length", "said"), [(3, "answered 3 bytes"), (4, "0 Hz")])
def test_odd_answers_are_refused(length, said):
    with pytest.raises(ProtocolError, match=said):
        make_tagger(_send_reply=lambda *_: length).open_driver()


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


@pytest.mark.parametrize("number", range(12))
@pytest.mark.parametrize("kind", ["reply_late", "reply_lost", "reply_stall"])
def test_no_reply_is_taken_for_another(kind, number):
    faults = Fault.parse(f"{kind}@{number}:2,{kind}@{number + 13}:1,{kind}@{number + 40}:3")
    instrument = make_tagger(records=RECORDS, transfer_kib=4, faults=faults)
    assert len(read_all(instrument)) == RECORDS


# A simulated scene before the emulated time tagger: the photons' delays are the scene's.

SCENE_RATE = 2e6


@pytest.fixture(scope="module")
def light():
    return simulate_light("small")


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
