"""The FX2 time tagger: registers, acquisition and recovery from faults. Its words are in `devices.codecs.timetag`.

Four inputs, a 36-bit counter, USB 2.0 bulk transfers through a Cypress FX2; gateware and protocol are public.
"""

from __future__ import annotations

import array
import enum
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from devices.codecs.timetag import RECORD_BYTES, TimeTagCodec
from devices.ledger import Ledger
from devices.registry import Found
from devices.ring import POLICIES, Gap
from devices.source import Info
from devices.stream import Arrival, Buffering, StreamSource
from devices.uri import Uri
from devices.usb import UsbIdentity, UsbLink, find, serial_of, system_backend
from tofclip.errors import (
    DeviceDisconnectedError,
    DeviceError,
    DeviceNotFoundError,
    InputError,
    ProtocolError,
    TransferOverflowError,
)
from tofclip.storage import Record, Scalar

IDENTITY = UsbIdentity(0x04B4, 0x1004)
BARE_CHIP = UsbIdentity(0x04B4, 0x8613)
"""The same chip before its firmware was loaded."""

COMMANDS, DATA, REPLIES = 0x02, 0x86, 0x88
PACKET_BYTES = 512
REPLY_TIMEOUT = 1.0
INSTRUMENT = "FX2 time tagger"
OPTIONS = ("channels", "delta", "transfer_kib", "buffer_mib", "policy", "reconnect_s")

_MAGIC, _READ, _WRITE = 0xAA, 0, 1
_COUNTS = 1 << 32


class Register(enum.IntEnum):
    """Addresses of the registers."""

    VERSION = 1
    CLOCK = 2
    CAPTURE = 3
    STROBE = 4
    DELTA = 5
    RECORDS = 6
    LOST = 7
    CLEAR = 8


class Capture(enum.IntFlag):
    """Bits of register `CAPTURE`."""

    OFF = 0
    REGISTER = 1
    COUNT = 2
    RESET = 4


@dataclass(frozen=True)
class Acquisition:
    """How to acquire.

    Parameters
    ----------
    channels, delta : int
        One bit for each channel that registers edges, or levels.
    transfer_bytes : int
        Most that one transfer asks for: whole packets of 512 bytes, or a device may send more than fits.
    reconnect : float
        Seconds to wait for an instrument that was unplugged.
    """

    channels: int = 0xF
    delta: int = 0
    transfer_bytes: int = 1 << 19
    reconnect: float = 5.0

    def __post_init__(self) -> None:
        if not (0 <= self.channels <= 0xF and 0 <= self.delta <= 0xF):
            raise InputError("channels and delta are masks of four bits: 0 to 15")
        if not 0 < self.transfer_bytes <= 1 << 24 or self.transfer_bytes % PACKET_BYTES:
            raise InputError(f"a transfer must be a multiple of {PACKET_BYTES} bytes, at most 16 MiB")
        if not 0 <= self.reconnect <= 600:
            raise InputError("the time to wait for an unplugged instrument must be within 0 s and 600 s")


class TimeTagger:
    """The instrument's registers.

    Parameters
    ----------
    link : UsbLink
    """

    def __init__(self, link: UsbLink) -> None:
        self._link = link
        self._reply = array.array("B", bytes(PACKET_BYTES))

    def read(self, register: Register) -> int:
        """Return a register's value."""
        return self._exchange(_READ, register, 0)

    def write(self, register: Register, value: int) -> None:
        """Set a register."""
        self._exchange(_WRITE, register, value)

    def reset(self) -> None:
        """Stop, and forget records, counts and time."""
        self.write(Register.STROBE, 0)
        self.write(Register.DELTA, 0)
        self.write(Register.CAPTURE, Capture.RESET)
        self.write(Register.CAPTURE, Capture.OFF)
        for counter in (Register.RECORDS, Register.LOST, Register.CLEAR):
            self.write(counter, 1)

    def run(self, channels: int, delta: int) -> None:
        """Start the counter, then the registration, so that the first zero of the counter is not taken for a wrap."""
        self.write(Register.STROBE, channels)
        self.write(Register.DELTA, delta)
        self.write(Register.CAPTURE, Capture.COUNT)
        self.write(Register.CAPTURE, Capture.COUNT | Capture.REGISTER)

    def _exchange(self, what: int, register: Register, value: int) -> int:
        self._link.write(COMMANDS, struct.pack("<BBHI", _MAGIC, what, register, value), REPLY_TIMEOUT)
        length = self._link.read(REPLIES, self._reply, REPLY_TIMEOUT)
        if length != 4:
            raise ProtocolError(f"the time tagger answered {length} bytes about register {register}, expected 4")
        return int.from_bytes(self._reply[:4].tobytes(), "little")


class TimeTaggerFeed:
    """The time tagger's words, one transfer after the other; see `devices.stream.Feed`.

    What the instrument registered but never handed over is found by comparing its own counts with what arrived, when
    it closes and after it was unplugged; an instrument that lost its power has forgotten them.

    The public firmware commits packets of 510 bytes. Each of them ends a transfer, because it is shorter than the
    endpoint's 512, whatever the transfer asked for.
    """

    def __init__(self, link: UsbLink, ledger: Ledger, acquisition: Acquisition) -> None:
        self._link, self._ledger, self._acquisition = link, ledger, acquisition
        self._tagger = TimeTagger(link)
        self._buffer = array.array("B", bytes(acquisition.transfer_bytes))
        self._view = memoryview(self._buffer)
        self._gap = Gap.NONE
        self._arrived = self._bytes_since_gap = 0
        self._version = self._tagger.read(Register.VERSION)
        self._clock_hz = self._tagger.read(Register.CLOCK)
        if not self._clock_hz:
            raise ProtocolError("the time tagger says that its clock has 0 Hz; is its gateware loaded?")

    @property
    def info(self) -> Info:
        details: dict[str, Scalar] = {
            "version": self._version,
            "clock_hz": self._clock_hz,
            "usb": str(self._link.identity),
        }
        return Info(INSTRUMENT, self._link.serial, details)

    @property
    def calibration(self) -> Record:
        return Record("calibration", attributes={"tick_s": 1 / self._clock_hz})

    def start(self) -> None:
        self._tagger.reset()
        self._arrived = self._bytes_since_gap = 0
        self._tagger.run(self._acquisition.channels, self._acquisition.delta)

    def pull(self, timeout: float) -> Arrival | None:
        while True:
            try:
                length = self._link.read(DATA, self._buffer, timeout)
            except TransferOverflowError:
                self._clear()
            except DeviceDisconnectedError:
                self._reconnect()
            else:
                self._bytes_since_gap += length
                gap, self._gap = self._gap, Gap.NONE
                return Arrival(self._view[:length], gap)

    def stop(self) -> None:
        self._tagger.write(Register.CAPTURE, Capture.COUNT)

    def close(self) -> None:
        try:
            self.stop()
            self._audit()
        finally:
            self._link.close()

    def _clear(self) -> None:
        """Empty the instrument's memory, so that the stream begins with a whole record again."""
        self._gap = max(self._gap, Gap.LOSS)
        self._end_segment()
        self._tagger.write(Register.CAPTURE, Capture.COUNT)
        self._tagger.write(Register.CLEAR, 1)
        self._tagger.write(Register.CAPTURE, Capture.COUNT | Capture.REGISTER)

    def _reconnect(self) -> None:
        self._link.reconnect(self._acquisition.reconnect)
        self._ledger.reconnect()
        if self._tagger.read(Register.CAPTURE) & Capture.REGISTER:
            self._clear()  # it kept its power and went on
        else:
            self._gap = Gap.RESTART
            self.start()

    def _audit(self) -> None:
        """Enter what the instrument counted and this program never saw."""
        self._end_segment()
        missing = (self._tagger.read(Register.RECORDS) - self._arrived) % _COUNTS  # the counts have 32 bits
        if missing >= _COUNTS // 2:
            raise ProtocolError("the time tagger sent more records than it counted")
        self._ledger.lose(missing + self._tagger.read(Register.LOST))

    def _end_segment(self) -> None:
        """Count what arrived without a gap; a record of which only the beginning arrived counts as well."""
        self._arrived += -(-self._bytes_since_gap // RECORD_BYTES)
        self._bytes_since_gap = 0


def open_timetag(uri: Uri) -> StreamSource:
    """Open ``timetag://SERIAL?channels=15&delta=0&transfer_kib=512&buffer_mib=64&policy=block&reconnect_s=5``."""
    uri.only(*OPTIONS)
    backend = system_backend()
    try:
        return opened(uri, uri.place, backend)
    except DeviceNotFoundError as fault:
        if any(find(BARE_CHIP, backend)):
            raise DeviceNotFoundError(
                f"a USB device {BARE_CHIP} is connected, a chip without firmware; load the time tagger's into it first"
            ) from fault
        raise


def opened(uri: Uri, serial: str, backend: Any) -> StreamSource:
    """Open the time tagger behind a backend of pyusb, with the values of an address (`OPTIONS`)."""
    standard, buffering = Acquisition(), Buffering()
    acquisition = Acquisition(
        uri.value("channels", int, standard.channels),
        uri.value("delta", int, standard.delta),
        int(uri.value("transfer_kib", float, standard.transfer_bytes / 1024) * 1024),
        uri.value("reconnect_s", float, standard.reconnect),
    )
    capacity = uri.value("buffer_mib", float, buffering.capacity / (1 << 20)) * (1 << 20)
    if not 0 < capacity <= 1 << 36:
        raise InputError(f"'{uri.text}': buffer_mib must be within 0 and 65536")
    ledger = Ledger()
    policy = next(policy for policy in POLICIES if policy == uri.choice("policy", *POLICIES))
    link = UsbLink(IDENTITY, serial, backend)
    try:
        feed = TimeTaggerFeed(link, ledger, acquisition)
        return StreamSource(feed, TimeTagCodec(), ledger, Buffering(int(capacity), policy))
    except BaseException:
        link.close()
        raise


def find_timetaggers() -> list[Found]:
    """Look for connected time taggers; an empty list where there is no USB to look at."""
    try:
        backend = system_backend()
        return [*_listed(backend), *_bare_chips(backend)]
    except DeviceError:
        return []


def _listed(backend: Any) -> Iterator[Found]:
    for device in find(IDENTITY, backend):
        try:
            serial, note = serial_of(device, IDENTITY), ""
        except DeviceError as fault:
            serial, note = "", str(fault)
        yield Found(f"timetag://{serial}", INSTRUMENT, note)


def _bare_chips(backend: Any) -> Iterator[Found]:
    for _ in find(BARE_CHIP, backend):
        yield Found("timetag://", INSTRUMENT, "a chip without firmware; load the time tagger's into it first")
