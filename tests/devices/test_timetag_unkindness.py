"""What the real time tagger does and a first driver did not expect: one behaviour at a time.

Each fails `OldTagger`, which is how the first driver was, and passes the driver.
"""

from __future__ import annotations

import errno
import time
from typing import Any

import numpy as np
import pytest

from devices.address import Uri
from devices.emulation.faults import Fault
from devices.emulation.timetag import (
    BOARD_MEMORY_BYTES,
    CLOCK_HZ,
    COMMAND,
    MAGIC,
    EmulatedTimeTagger,
    EmulatorSettings,
    PoissonStream,
)
from devices.emulation.usb import VirtualUsb, make_usb_error
from devices.source import Records, Source
from devices.timetag import driver as feed
from devices.timetag.driver import (
    COMMAND_ENDPOINT,
    DATA_ENDPOINT,
    USB_IDENTITY,
    Capture,
    Register,
    TimeTagger,
    open_on_backend,
)
from devices.usb import UsbLink
from tofclip.errors import DeviceError, DeviceTimeoutError, ProtocolError

KIND: dict[str, Any] = {
    "clear_is_level": False,
    "holds_packets": False,
    "stale_replies": 0,
    "old_records": 0,
    "jammed_bytes": 0,
    "packet_bytes": 512,
}
RECORDS = 2000
OLD: dict[str, Any] = {"old_records": 400, "holds_packets": True, "flush_discards": False}


class OldTagger(TimeTagger):
    """The first driver: believes every reply, writes CLEAR once, knows nothing of the USB chip."""

    version = 6

    def synchronize(self) -> None:
        self.version = self._exchange(0, Register.VERSION, 0)

    def _transact(self, what: int, register: Register, value: int) -> int:
        return self._exchange(what, register, value)

    def clear_memory(self) -> None:
        self.write(Register.CLEAR, 1)

    def set_send_window(self, size: int) -> bool:
        return False

    def flush(self) -> bool:
        return False


@pytest.fixture(scope="module", autouse=True)
def compiled() -> None:
    """Compile what every test needs, so that none of them is late."""
    assert len(true_ticks()) == RECORDS


@pytest.fixture(params=["old", "new"])
def is_old(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> bool:
    """Use the first driver, or this one."""
    if request.param == "old":
        monkeypatch.setattr(feed, "TimeTagger", OldTagger)
    return bool(request.param == "old")


def make_instrument(rate: float = 1e6, **unkind: Any) -> EmulatedTimeTagger:
    setting = EmulatorSettings(**{**KIND, "records": RECORDS, **unkind})
    return EmulatedTimeTagger(lambda _: PoissonStream(rate, CLOCK_HZ, 1), "", setting)


def open_source(instrument: EmulatedTimeTagger, **options: object) -> Source:
    query = "&".join(f"{name}={value}" for name, value in options.items())
    return open_on_backend(Uri.parse(f"timetag://?{query}"), "", VirtualUsb(instrument))


def read_all(instrument: EmulatedTimeTagger) -> Records:
    """Read until it is dark, then stop it and read the rest."""
    found = []
    with open_source(instrument, transfer_kib=4) as source:
        try:
            while (batch := source.read(0.3)) is not None:
                found.append(batch.records)
        except DeviceTimeoutError:
            source.stop()
            found += [batch.records for batch in source]
    assert source.stats.is_balanced
    return np.concatenate([np.empty(0, source.codec.dtype), *found])  # type: ignore[attr-defined]


def true_ticks() -> Any:
    kind = make_instrument()
    return read_all(kind)["time_ticks"]


@pytest.mark.parametrize(
    "unkind",
    [
        {"clear_is_level": True},
        {"stale_replies": 1},
        {"stale_replies": 2, "jammed_bytes": 5},
        {"old_records": 40, "holds_packets": True},
        OLD,
        {"holds_packets": True, "packet_bytes": 510},
        {"holds_packets": True, "packet_bytes": 510, "flush_discards": False},
    ],
    ids=str,
)
def test_every_record_of_this_session_and_no_other(unkind: dict[str, Any], is_old: bool) -> None:
    instrument = make_instrument(**unkind)
    if is_old:
        try:
            records = read_all(instrument)
        except DeviceError:
            return
        assert len(records) != RECORDS or not np.array_equal(records["time_ticks"], true_ticks())
        return
    np.testing.assert_array_equal(read_all(instrument)["time_ticks"], true_ticks())


@pytest.mark.parametrize("rate", [20.0, 1000.0, 6000.0])
def test_a_photon_does_not_wait_for_others(rate: float, is_old: bool) -> None:
    """Age of the oldest record of each batch when it is read, by the instrument's own clock."""
    instrument = make_instrument(
        rate, holds_packets=True, packet_bytes=510, is_paced=True, records=10**9
    )
    ages: list[float] = []
    with open_source(instrument) as source:
        end = time.monotonic() + 1.5
        while time.monotonic() < end:
            try:
                batch = source.read(0.2)
            except DeviceTimeoutError:
                continue
            if batch is not None and len(batch):
                now = time.monotonic() - instrument._started
                ages.append(now - batch.records["time_ticks"][0] / CLOCK_HZ)
    if is_old:
        assert not ages or (rate < 1700 and np.median(ages) > 0.05) or rate > 1700
    else:
        assert len(ages) > 5
        assert np.median(ages) < 0.05


def test_a_full_stream_takes_few_transfers(is_old: bool) -> None:
    """The board holds 3.4 ms; a transfer for every packet of 510 bytes is too slow under load."""
    instrument = make_instrument(
        680_000,
        holds_packets=True,
        packet_bytes=510,
        is_paced=True,
        memory_bytes=BOARD_MEMORY_BYTES,
        records=10**9,
    )
    with open_source(instrument) as source:
        end = time.monotonic() + 1.0
        while time.monotonic() < end:
            source.read()
    delivered, transfers = source.stats.delivered, instrument._transfers
    assert source.stats.malformed == 0
    assert source.stats.acquired == instrument.truth.registered
    per_transfer = delivered / transfers
    assert per_transfer <= 85 if is_old else per_transfer > 2000


def test_registration_that_begins_with_the_counter_sees_a_wrap() -> None:
    """Which is why the driver starts the counter first."""
    instrument = make_instrument()
    instrument._write_register(Register.CAPTURE, Capture.COUNT | Capture.REGISTER)
    assert instrument.truth.registered == 1
    buffer = memoryview(bytearray(6))
    instrument._stream.read_into(buffer)
    assert bytes(buffer) == bytes([0x40, 0, 0, 0, 0, 0])


def test_a_clock_that_cannot_be_is_refused() -> None:
    instrument = make_instrument()
    instrument._registers[Register.CLOCK] = 42
    with pytest.raises(ProtocolError, match="42 Hz, which cannot be"):
        open_source(instrument)


@pytest.mark.parametrize("stale", [1, 2])
def test_a_late_reply_does_not_answer_the_next_request(stale: int) -> None:
    """What another program asked, and never fetched, comes while this one works."""
    instrument = make_instrument()
    tagger = TimeTagger(UsbLink(USB_IDENTITY, "", VirtualUsb(instrument)))

    def reply_late() -> None:
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
def test_records_of_the_last_session_are_thrown_away_though_they_come_slowly(silent: int) -> None:
    """One request for them is not answered in time."""

    class Slow(EmulatedTimeTagger):
        requests = 0

        def fill(self, endpoint: int, buffer: memoryview, timeout: float) -> int:
            if endpoint == DATA_ENDPOINT:
                self.requests += 1
                if self.requests == silent + 1:
                    raise make_usb_error(errno.ETIMEDOUT)
            return super().fill(endpoint, buffer, timeout)

    setting = EmulatorSettings(**{**KIND, "records": RECORDS, **OLD})
    instrument = Slow(lambda _: PoissonStream(1e6, CLOCK_HZ, 1), "", setting)
    np.testing.assert_array_equal(read_all(instrument)["time_ticks"], true_ticks())


@pytest.mark.parametrize("number", range(12))
@pytest.mark.parametrize("kind", ["reply_late", "reply_lost", "reply_stall"])
def test_no_reply_is_taken_for_another(kind: str, number: int) -> None:
    setting = EmulatorSettings(records=RECORDS)
    faults = Fault.parse(f"{kind}@{number}:2,{kind}@{number + 13}:1,{kind}@{number + 40}:3")
    instrument = EmulatedTimeTagger(lambda _: PoissonStream(1e6, CLOCK_HZ, 1), "", setting, faults)
    records = read_all(instrument)
    assert len(records) == RECORDS
