"""The time tagger's driver on the emulated instrument: what the address can set, policies, pace,
odd answers.
"""

from __future__ import annotations

import array
import contextlib
import errno
import time

import numpy as np
import pytest

import devices
from devices.address import Uri
from devices.emulation.faults import Fault
from devices.emulation.timetag import (
    CLOCK_HZ,
    MAX_TICK,
    EmulatedTimeTagger,
    EmulatorSettings,
    PoissonStream,
)
from devices.emulation.usb import VirtualUsb, make_usb_error
from devices.source import Ledger, Source, as_bytes
from devices.timetag.codec import COUNTER_RANGE, WRAP, TimeTagCodec
from devices.timetag.driver import (
    COMMAND_ENDPOINT,
    REPLY_ENDPOINT,
    USB_IDENTITY,
    AcquisitionSettings,
    Capture,
    Register,
    TimeTagger,
    TimeTaggerFeed,
    open_on_backend,
)
from devices.usb import UsbLink
from tofclip.errors import (
    BufferOverflowError,
    DeviceTimeoutError,
    InputError,
    ProtocolError,
)

RATE = 12_800_000.0
SMALL = "sim+timetag://?seed=3&transfer_kib=8"


def tagger(rate: float = RATE, **options: object) -> tuple[EmulatedTimeTagger, VirtualUsb]:
    instrument = EmulatedTimeTagger(
        lambda _: PoissonStream(rate, CLOCK_HZ, 1), "T1", EmulatorSettings(**options)
    )  # type: ignore[arg-type]
    return instrument, VirtualUsb(instrument)


def read_all(source: Source) -> np.ndarray[tuple[int], np.dtype[np.void]]:
    """Read until nothing more comes, then stop and read the rest."""
    found = []
    try:
        while (batch := source.read(0.3)) is not None:
            found.append(batch.records)
    except DeviceTimeoutError:
        source.stop()
        while (batch := source.read()) is not None:
            found.append(batch.records)
    return np.concatenate(found)


def test_what_it_says_of_itself() -> None:
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
        assert (source.is_live, source.is_seekable) == (True, False)


@pytest.mark.parametrize("packet", [510, 512])
def test_packets_of_either_size_carry_the_same_records(packet: int) -> None:
    with devices.open(f"{SMALL}&records=5000&packet_bytes={packet}") as source:
        records = read_all(source)
    known = TimeTagCodec().decode(
        as_bytes(PoissonStream(RATE, CLOCK_HZ, 3).next_words(5000, MAX_TICK)), TimeTagCodec.start
    )
    np.testing.assert_array_equal(records, known.records)
    assert source.stats.delivered == source.stats.acquired == 5000


def test_photons_are_poisson() -> None:
    codec = TimeTagCodec()
    records = codec.decode(
        as_bytes(PoissonStream(RATE, CLOCK_HZ, 8, (1, 2, 3, 4)).next_words(200_000, MAX_TICK)),
        codec.start,
    ).records
    gaps = np.diff(records["time_ticks"])
    # Ten ticks per photon, geometrically distributed; five standard deviations of 200 000.
    assert abs(gaps.mean() - 10) < 0.11
    assert abs(gaps.std() - np.sqrt(90)) < 0.2
    shares = np.bincount(records["channels"], minlength=9)[[1, 2, 4, 8]] / len(records)
    np.testing.assert_allclose(shares, [0.1, 0.2, 0.3, 0.4], atol=0.005)  # four standard deviations


def test_wraps_are_in_the_stream_and_cuts_are_not() -> None:
    rare = 5.0  # photons per second: the counter wraps every 537 s
    whole = PoissonStream(rare, CLOCK_HZ, 2).next_words(20_000, MAX_TICK)
    light = PoissonStream(rare, CLOCK_HZ, 2)
    pieces = [
        light.next_words(1, MAX_TICK) if number % 3 else light.next_words(7, COUNTER_RANGE)
        for number in range(500)
    ]
    cut = np.concatenate(pieces)
    np.testing.assert_array_equal(cut, whole[: len(cut)])
    records = TimeTagCodec().decode(as_bytes(whole), TimeTagCodec.start)
    assert records.malformed == 0
    marks = records.records[records.records["flags"] == WRAP]["time_ticks"]
    np.testing.assert_array_equal(marks, COUNTER_RANGE * np.arange(1, len(marks) + 1))
    assert len(marks) == records.records["time_ticks"][-1] // COUNTER_RANGE > 5


def test_a_slow_reader_loses_the_oldest() -> None:
    with devices.open(f"{SMALL}&records=200000&policy=drop_oldest&buffer_mib=0.1") as source:
        while source.stats.acquired < 199_000:
            time.sleep(0.01)
        batch = source.read()
        assert batch is not None
        assert batch.after_gap
        records = read_all(source)
    stats = source.stats
    assert stats.dropped_host > 150_000
    assert stats.acquired == 200_000
    assert stats.delivered == len(batch) + len(records) == 200_000 - stats.dropped_host


def test_a_slow_reader_fails_if_told_so() -> None:
    with devices.open(f"{SMALL}&policy=fail&buffer_mib=0.1") as source:
        while source.stats.dropped_host == 0:
            time.sleep(0.01)
        with pytest.raises(BufferOverflowError):
            read_all(source)
    assert source.stats.is_balanced
    assert source.stats.lost_device == 0


def test_a_slow_reader_makes_the_instrument_wait() -> None:
    with devices.open(f"{SMALL}&buffer_mib=0.1") as source:
        time.sleep(0.1)
        assert source.stats.unread <= 100_000 / 6 + 8192
    assert source.stats.dropped_host == 0
    assert source.stats.unread > 0
    assert source.read() is None


def test_photons_come_when_they_are_due() -> None:
    rate, seconds = 1e6, 0.3
    with devices.open(f"{SMALL}&pace=realtime&rate={rate}") as source:
        begin = time.monotonic()
        while time.monotonic() < begin + seconds:
            source.read()
        source.stop()
        while source.read() is not None:
            pass
        took = time.monotonic() - begin
    assert source.stats.lost_device == 0
    # Not before their time (five standard deviations), and up to the moment of the stop.
    assert rate * seconds - 3000 < source.stats.delivered < rate * (took + 0.1) + 3000


def test_a_full_memory_loses_photons_and_says_so() -> None:
    # Photons that a busy machine can draw faster than they fall: a memory for 1 ms of them.
    instrument, bus = tagger(1e6, is_paced=True, memory_bytes=6000)
    with open_on_backend(Uri.parse("timetag://?transfer_kib=64"), "", bus) as source:
        first = source.read()
        while instrument.truth.lost_memory_full == 0:
            time.sleep(0.01)
            source.read()
        source.stop()
        while source.read() is not None:
            pass
    assert first is not None
    assert source.stats.lost_device == instrument.truth.lost_memory_full > 0
    assert source.stats.acquired == instrument.truth.registered


def test_registers_answer_and_reset() -> None:
    _, bus = tagger()
    registers = TimeTagger(UsbLink(USB_IDENTITY, "", bus))
    assert registers.read(Register.CLOCK) == CLOCK_HZ
    registers.write(Register.CLOCK, 5)
    assert registers.read(Register.CLOCK) == CLOCK_HZ
    registers.run(0b101, 0b10)
    assert registers.read(Register.CAPTURE) == Capture.COUNT | Capture.REGISTER
    assert (registers.read(Register.STROBE), registers.read(Register.DELTA)) == (0b101, 0b10)
    registers.reset()
    assert registers.read(Register.CAPTURE) == Capture.OFF


@pytest.mark.parametrize("command", ["", "aa0002", "ab00020000000000"])
def test_a_wrong_command_is_not_answered(command: str) -> None:
    _, bus = tagger(stale_replies=0, jammed_bytes=0)
    link = UsbLink(USB_IDENTITY, "", bus)
    link.write(COMMAND_ENDPOINT, bytes.fromhex(command), 0.1)
    buffer = array.array("B", bytes(8))
    with pytest.raises(DeviceTimeoutError):
        link.read(REPLY_ENDPOINT, buffer, 0.1)


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ("channels=16", "four bits"),
        ("transfer_kib=0.3", "multiple of 512"),
        ("buffer_mib=0", "buffer_mib"),
        ("policy=hope", "policy must be block or drop_oldest or fail"),
        ("reconnect_s=-1", "unplugged"),
        ("rate=2e8", "rate must be above 0"),
        ("seed=-1", "a seed must"),
        ("packet_bytes=64", "510 or 512"),
        ("memory_mib=0", "memory of 512 bytes"),
        ("colour=red", "'colour' is unknown"),
        ("faults=boom", "not a fault"),
    ],
)
def test_unusable_values_are_refused(wrong: str, said: str) -> None:
    with pytest.raises(InputError, match=said):
        devices.open(f"sim+timetag://?{wrong}")


def test_odd_answers_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    _, bus = tagger()
    monkeypatch.setattr(EmulatedTimeTagger, "_send_reply", lambda *_: 3)
    with pytest.raises(ProtocolError, match="answered 3 bytes"):
        open_on_backend(Uri.parse("timetag://"), "", bus)
    monkeypatch.setattr(EmulatedTimeTagger, "_send_reply", lambda *_: 4)
    with pytest.raises(ProtocolError, match="0 Hz"):
        open_on_backend(Uri.parse("timetag://"), "", bus)


@pytest.mark.parametrize(
    "fault", [Fault(1, "unplug", 2), Fault(1, "powerloss", 2), Fault(1, "overflow")]
)
def test_one_that_was_stopped_stays_so_whatever_happens(fault: Fault) -> None:
    instrument = EmulatedTimeTagger(
        lambda _: PoissonStream(RATE, CLOCK_HZ, 1),
        "T1",
        EmulatorSettings(packet_bytes=510),
        [fault],
    )
    link = UsbLink(USB_IDENTITY, "", VirtualUsb(instrument))
    feed = TimeTaggerFeed(link, Ledger(), AcquisitionSettings(transfer_bytes=1024))
    feed.start()
    assert feed.pull(0.1) is not None
    feed.stop()
    with contextlib.suppress(DeviceTimeoutError):
        feed.pull(0.5)  # the rest of what was registered before
    with pytest.raises(DeviceTimeoutError):
        feed.pull(0.5)
    assert not TimeTagger(link).read(Register.CAPTURE) & Capture.REGISTER


def test_closing_does_not_wait_for_one_that_is_gone() -> None:
    instrument, bus = tagger()
    source = open_on_backend(Uri.parse("timetag://?transfer_kib=0.5&reconnect_s=600"), "", bus)
    source.read()
    instrument.unplug(float("inf"))
    begin = time.monotonic()
    source.close()
    assert time.monotonic() - begin < 5
    assert source.stats.is_balanced


def test_a_loose_plug_is_followed(monkeypatch: pytest.MonkeyPatch) -> None:
    """It goes again while it is being set up after it came back."""
    instrument, bus = tagger()
    with open_on_backend(
        Uri.parse("timetag://?transfer_kib=0.5&reconnect_s=10"), "", bus
    ) as source:
        source.read()
        answer, left = instrument.receive, [3]

        def receive(endpoint: int, data: bytes) -> None:
            if left[0]:
                left[0] -= 1
                instrument.unplug(1)
                raise make_usb_error(errno.ENODEV)
            answer(endpoint, data)

        monkeypatch.setattr(instrument, "receive", receive)
        instrument.unplug(1)
        while not (batch := source.read()).after_gap:  # type: ignore[union-attr]
            pass
        assert batch is not None
        assert source.stats.reconnects == 1
        assert left == [0]


def test_a_defect_in_the_thread_reaches_the_reader(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> int:
        raise ZeroDivisionError("a defect")

    with devices.open(SMALL) as source:
        monkeypatch.setattr(EmulatedTimeTagger, "_send_data", fail)
        with pytest.raises(ZeroDivisionError):
            list(source)
