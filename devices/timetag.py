"""The FX2 time tagger: its registers (commands on one endpoint, replies on another), acquisition and
recovery from faults, and finding those that are connected.

Sources: the gateware (bgamari/timetag-fpga: ``docs/registers``, ``reg_manager.v``), the firmware of
its USB chip (bgamari/timetag-fx2) and the makers' own client (bgamari/timetag-tools).
"""

from __future__ import annotations

import array
import contextlib
import enum
import struct
from dataclasses import dataclass
from time import monotonic
from typing import Any

from devices.address import Uri, option
from devices.registry import DiscoveredInstrument
from devices.source import Gap, Info, Ledger
from devices.stream import Feed, LiveOptions, StreamSource, Transfer
from devices.timetag_codec import RECORD_BYTES, TimeTagCodec
from devices.usb import UsbIdentity, UsbLink, find_devices, read_serial, system_backend
from tofclip.errors import (
    DeviceDisconnectedError,
    DeviceError,
    DeviceNotFoundError,
    DeviceStalledError,
    DeviceTimeoutError,
    InputError,
    ProtocolError,
    TransferOverflowError,
)
from tofclip.storage import Record, Scalar

USB_IDENTITY = UsbIdentity(0x04B4, 0x1004)
BARE_CHIP_IDENTITY = UsbIdentity(0x04B4, 0x8613)  # The same chip before its firmware was loaded
WITHOUT_FIRMWARE = "a chip without firmware; load the time tagger's into it first"
INSTRUMENT = "FX2 time tagger"
COMMAND_ENDPOINT, DATA_ENDPOINT, REPLY_ENDPOINT = 0x02, 0x86, 0x88
PACKET_BYTES = 512
REPLY_TIMEOUT_S = 0.5
DRAIN_TIMEOUT_S = 0.02  # Seconds after which an endpoint that sent nothing is taken to be empty
MAX_DRAINED = 16  # Transfers that are thrown away at once; one that sends more has another defect
ATTEMPTS = 4

_MAGIC, _READ, _WRITE = 0xAA, 0, 1
_SET_SEND_WINDOW, _FLUSH = 1, 2
_UNJAM = 0  # A register that is not there: writing it completes a command that was cut short


class Register(enum.IntEnum):
    """Addresses of the registers."""

    VERSION = 1
    CLOCK = 2
    CAPTURE = 3
    STROBE = 4
    DELTA = 5
    RECORDS = 6  # Records that went into the memory; any write sets it to zero
    LOST = 7  # Records that found the memory full; any write sets it to zero
    CLEAR = 8  # 1 holds the memory empty, 0 lets it fill


class Capture(enum.IntFlag):
    """Bits of register `CAPTURE`."""

    OFF = 0
    REGISTER = 1
    COUNT = 2
    RESET = 4


class TimeTagger:
    """The instrument's registers, and the requests to its USB chip.

    A reply is four bytes that do not say which request they answer. One that a killed program never
    fetched would shift all later answers by one. So every exchange is followed by a reading of the
    version, which must be what it always is, or the exchange is tried again.
    """

    def __init__(self, link: UsbLink) -> None:
        self._link = link
        self._buffer = array.array("B", bytes(64 * PACKET_BYTES))
        self._has_requests = True
        self.version = 0
        self.synchronize()

    def synchronize(self) -> None:
        """Throw away replies to requests of the past, and end a command that was cut short."""
        for _ in range(ATTEMPTS):
            self._drain(REPLY_ENDPOINT)
            with contextlib.suppress(DeviceTimeoutError, DeviceStalledError):
                self._send(_WRITE, _UNJAM, 0)
            self._drain(REPLY_ENDPOINT)
            with contextlib.suppress(DeviceTimeoutError, DeviceStalledError):
                first = self._exchange(_READ, Register.VERSION, 0)
                if first == self._exchange(_READ, Register.VERSION, 0):
                    self.version = first
                    return
        raise ProtocolError(
            "the time tagger does not answer, or not what it is asked; unplug it and plug it in again"
        )

    def read(self, register: Register) -> int:
        """Return a register's value; ProtocolError if it cannot be had."""
        return self._transact(_READ, register, 0)

    def write(self, register: Register, value: int) -> None:
        self._transact(_WRITE, register, value)

    def reset(self) -> None:
        """Stop, and forget records, counts and time, also those of an earlier session."""
        self.write(Register.STROBE, 0)
        self.write(Register.DELTA, 0)
        self.write(Register.CAPTURE, Capture.RESET)
        self.write(Register.CAPTURE, Capture.OFF)
        self.clear_memory()
        self.write(Register.RECORDS, 0)
        self.write(Register.LOST, 0)

    def clear_memory(self) -> None:
        """Throw away what waits in memory and USB chip, while nothing is registered."""
        self.write(Register.CLEAR, 1)
        self.set_send_window(PACKET_BYTES)
        # The chip still holds packets, and a last one that is not full. Once they have left, a
        # record follows that had been taken out of the memory before. An endpoint that sends
        # nothing once may only have been slow.
        quiet = 0
        for _ in range(MAX_DRAINED):
            self.flush()
            quiet = 0 if self._drain(DATA_ENDPOINT) else quiet + 1
            if quiet == 2:
                break
        self.write(Register.CLEAR, 0)

    def run(
        self, channels: int, delta: int, capture: Capture = Capture.COUNT | Capture.REGISTER
    ) -> None:
        """Start the counter, then the registration, or the counter's first zero would be a wrap.
        `channels, delta`: one bit for each channel whose edges, or whose levels, are recorded.
        """
        self.write(Register.STROBE, channels)
        self.write(Register.DELTA, delta)
        self.write(Register.CAPTURE, Capture.COUNT)
        self.write(Register.CAPTURE, capture)

    def set_send_window(self, size: int) -> bool:
        """Set how many bytes make a packet, and let the chip send what it holds now. Packets of 512
        bytes do not end a transfer, smaller ones do. False where there is no such request.
        """
        return self._request(_SET_SEND_WINDOW, size)

    def flush(self) -> bool:
        """Let the chip send or forget an unfinished packet; False where it has no such request."""
        return self._request(_FLUSH, 0)

    def _request(self, number: int, value: int) -> bool:
        """Send a request to the USB chip's firmware; False where there is no such request."""
        if self._has_requests:
            try:
                self._link.request(number, value, REPLY_TIMEOUT_S)
            except (DeviceStalledError, DeviceTimeoutError):
                self._has_requests = False
        return self._has_requests

    def _drain(self, endpoint: int) -> int:
        """Throw away what waits at an endpoint, and return how many bytes that were."""
        thrown = 0
        for _ in range(MAX_DRAINED):
            try:
                thrown += self._link.read(endpoint, self._buffer, DRAIN_TIMEOUT_S)
            except DeviceTimeoutError:
                break
            except TransferOverflowError:
                thrown += 1
        return thrown

    def _transact(self, what: int, register: Register, value: int) -> int:
        """Do an exchange and make sure that the reply is the one to this request."""
        for attempt in range(ATTEMPTS):
            if attempt:
                self.synchronize()
            with contextlib.suppress(DeviceTimeoutError, DeviceStalledError):
                answer = self._exchange(what, register, value)
                if self._exchange(_READ, Register.VERSION, 0) == self.version:
                    return answer
        raise ProtocolError(
            f"the time tagger does not answer about register {register}; unplug it and plug it in "
            "again"
        )

    def _send(self, what: int, register: int, value: int) -> None:
        command = struct.pack("<BBHI", _MAGIC, what, register, value)
        self._link.write(COMMAND_ENDPOINT, command, REPLY_TIMEOUT_S)

    def _exchange(self, what: int, register: Register, value: int) -> int:
        self._send(what, register, value)
        length = self._link.read(REPLY_ENDPOINT, self._buffer, REPLY_TIMEOUT_S)
        if length != 4:
            raise ProtocolError(
                f"the time tagger answered {length} bytes about register {register}, expected 4"
            )
        return int.from_bytes(self._buffer[:4].tobytes(), "little")


_COUNTER_MODULUS = 1 << 32

# Whatever the gateware was built for, its clock is within these
MIN_CLOCK_HZ, MAX_CLOCK_HZ = 1_000_000, 1_000_000_000
PACKET_INTERVAL_S = 0.015
# Seconds after which a transfer is ended, and a chip that holds part of a packet is asked to send
LATENCY_S = 0.02
FULL_STREAM_BYTES_PER_S = 500_000


@dataclass(frozen=True)
class TimeTagOptions(LiveOptions):
    """Values of an address that say how to acquire."""

    channels: int = option(0xF, least=0, most=15)  # one bit for each that registers edges
    delta: int = option(0, least=0, most=15)  # one bit for each that registers levels
    transfer_kib: float = option(512.0, least=0.5, most=1 << 14)  # most that one transfer asks for

    def __post_init__(self) -> None:
        super().__post_init__()
        # Or a device may send more than fits.
        if self.transfer_bytes % PACKET_BYTES:
            raise InputError(f"a transfer must be a multiple of {PACKET_BYTES} bytes")

    @property
    def transfer_bytes(self) -> int:
        return int(self.transfer_kib * 1024)


class TimeTaggerFeed(Feed):
    """The time tagger's words, one transfer after the other; see `devices.stream.Feed`.

    What the instrument registered but never handed over is found by comparing its own counts with
    what arrived, when it closes and after it was unplugged; an instrument that lost its power has
    forgotten them.

    The firmware makes packets of 510 bytes, each of which ends a transfer because it is shorter than
    the endpoint's 512: 8,000 a second of a full stream, while the board holds no more than 3 ms.
    Packets of 512 bytes do not end a transfer, and so the system goes on reading by itself. At low
    rates, where a photon would wait for 84 others, packets are made small; see `SendWindow`.
    """

    codec = TimeTagCodec()

    def __init__(self, link: UsbLink, options: TimeTagOptions) -> None:
        self.ledger = Ledger()
        self._link, self._options = link, options
        self._tagger = TimeTagger(link)
        self._buffer = array.array("B", bytes(options.transfer_bytes))
        self._view = memoryview(self._buffer)
        self._window = SendWindow()
        self._gap = Gap.NONE
        self._capture_mode = Capture.COUNT | Capture.REGISTER
        # until which an unplugged instrument is waited for
        self._deadline: float | None = None
        self._must_clear = False
        self._is_flushed = False
        self._records_received = 0
        self._bytes_since_gap = 0
        clock_hz = self._tagger.read(Register.CLOCK)
        # Ticks become seconds by this number, so that a wrong one is refused before any record.
        if not MIN_CLOCK_HZ <= clock_hz <= MAX_CLOCK_HZ:
            advice = "unplug it and plug it in again" if clock_hz else "is its gateware loaded?"
            raise ProtocolError(
                f"the time tagger says that its clock has {clock_hz} Hz, which cannot be; {advice}"
            )
        details: dict[str, Scalar] = {
            "version": self._tagger.version,
            "clock_hz": clock_hz,
            "usb": str(link.identity),
        }
        self.info = Info(INSTRUMENT, link.serial, details)
        self.calibration = Record("calibration", attributes={"tick_s": 1 / clock_hz})

    def start(self) -> None:
        self._tagger.reset()
        self._window.size = PACKET_BYTES
        self._records_received = 0
        self._bytes_since_gap = 0
        self._tagger.run(self._options.channels, self._options.delta, self._capture_mode)

    def pull(self, timeout: float) -> Transfer | None:
        while True:
            try:
                if self._deadline is not None:
                    self._reconnect(timeout, self._deadline)
                if self._must_clear:
                    self._clear_memory()
                begin = self._window.clock()
                wait = min(timeout, self._window.read_timeout)
                length = self._link.read(DATA_ENDPOINT, self._buffer, wait)
            except TransferOverflowError:
                self._must_clear = True
            except DeviceDisconnectedError as fault:
                now, patience = monotonic(), self._options.reconnect_s
                self._deadline = self._deadline or now + patience
                if now >= self._deadline:
                    raise DeviceDisconnectedError(
                        f"the time tagger {self._link.serial} was unplugged and did not come back "
                        f"within {patience:g} s"
                    ) from fault
            except DeviceTimeoutError:
                if self._deadline is not None or not self._send_rest():
                    raise
                self.ledger.time_out()
            else:
                self._set_window(self._window.choose(length, self._window.clock() - begin))
                if not length:
                    continue  # an empty packet: the chip was asked to send, and had nothing
                self._bytes_since_gap += length
                gap, self._gap = self._gap, Gap.NONE
                return Transfer(self._view[:length], gap)

    def stop(self) -> None:
        self._capture_mode = Capture.COUNT
        self._tagger.write(Register.CAPTURE, self._capture_mode)

    def close(self) -> None:
        try:
            self.stop()
            self._end_segment()
            # What it counted, in 32 bits, and this program never saw.
            counted = self._tagger.read(Register.RECORDS)
            missing = (counted - self._records_received) % _COUNTER_MODULUS
            if missing >= _COUNTER_MODULUS // 2:
                raise ProtocolError("the time tagger sent more records than it counted")
            self.ledger.lose(missing + self._tagger.read(Register.LOST))
        finally:
            self._link.close()

    def _send_rest(self) -> bool:
        """Get hold of records that wait for others in the chip; False where there are none left."""
        if self._window.size > RECORD_BYTES:
            return self._set_window(RECORD_BYTES)
        if Capture.REGISTER in self._capture_mode or self._is_flushed:
            return False
        # The last resort, after everything was stopped: some firmware sends only on this request.
        self._is_flushed = True
        received = self._records_received + -(-self._bytes_since_gap // RECORD_BYTES)
        with contextlib.suppress(DeviceDisconnectedError):  # the next transfer notices
            return self._tagger.read(Register.RECORDS) != received and self._tagger.flush()
        return False

    def _set_window(self, size: int) -> bool:
        """Set how many bytes make a packet; False where that cannot be set."""
        if size == self._window.size:
            return True
        self._window.size = size
        with contextlib.suppress(DeviceDisconnectedError):  # the next transfer notices
            return self._tagger.set_send_window(size)
        return False

    def _clear_memory(self) -> None:
        """Empty the instrument's memory, so that the stream begins with a whole record again."""
        self._gap = max(self._gap, Gap.LOSS)
        self._end_segment()
        self._tagger.write(Register.CAPTURE, Capture.COUNT)
        self._tagger.clear_memory()
        self._window.size = PACKET_BYTES
        self._tagger.write(Register.CAPTURE, self._capture_mode)
        self._must_clear = False

    def _reconnect(self, timeout: float, deadline: float) -> None:
        """Look for the unplugged instrument, but return in time for a caller that wants to stop."""
        try:
            self._link.reconnect(min(timeout, deadline - monotonic()))
        except DeviceDisconnectedError as fault:
            if monotonic() < deadline:
                raise DeviceTimeoutError("the time tagger is unplugged") from fault
            raise
        self._tagger.synchronize()
        # After a loss of power the register is zero.
        if self._tagger.read(Register.CAPTURE) & Capture.COUNT:
            self._must_clear = True  # it kept its power and went on
        else:
            self._gap = Gap.RESTART
            self.start()
        self._deadline = None
        self.ledger.reconnect()

    def _end_segment(self) -> None:
        """Count what arrived without a gap, and a record of which only the beginning did."""
        self._records_received += -(-self._bytes_since_gap // RECORD_BYTES)
        self._bytes_since_gap = 0


class SendWindow:
    """How many bytes make a packet, so that no record waits long and a full stream is not cut up.

    The aim is one packet in `PACKET_INTERVAL_S`: the rate is measured while reading, over eight
    transfers or that time. A rate for which 512 bytes come sooner is read in packets of 512 bytes,
    which do not end a transfer.
    """

    clock = staticmethod(monotonic)  # By which rates are measured, s

    def __init__(self) -> None:
        self.size = PACKET_BYTES
        """Bytes of a packet."""
        self._rate = 0.0
        self._begin_count()

    def _begin_count(self) -> None:
        self._bytes, self._transfers, self._seconds = 0, 0, 0.0

    @property
    def read_timeout(self) -> float:
        """Seconds of a transfer: long where the stream is full, or ends it with each record."""
        is_full = self._rate > FULL_STREAM_BYTES_PER_S
        return 10.0 if is_full or self.size == RECORD_BYTES else LATENCY_S

    def choose(self, length: int, seconds: float) -> int:
        """Return how many bytes should make a packet from now on."""
        self._bytes += length
        self._transfers += 1
        self._seconds += seconds
        if self._transfers < 8 and self._seconds < PACKET_INTERVAL_S:
            return self.size
        self._rate = self._bytes / max(self._seconds, 1e-6)
        self._begin_count()
        wanted = self._rate * PACKET_INTERVAL_S
        if wanted >= PACKET_BYTES:
            return PACKET_BYTES
        size = max(1, int(wanted / RECORD_BYTES)) * RECORD_BYTES
        is_near = self.size / 2 <= size <= 2 * self.size and self.size < PACKET_BYTES
        return self.size if is_near else size


def open_timetag(uri: Uri) -> StreamSource:
    """Open ``timetag://SERIAL``; `TimeTagOptions` has its values."""
    options, backend = TimeTagOptions.from_uri(uri), system_backend()
    try:
        return open_on_backend(options, uri.location, backend)
    except DeviceNotFoundError as fault:
        if any(find_devices(BARE_CHIP_IDENTITY, backend)):
            raise DeviceNotFoundError(
                f"a USB device {BARE_CHIP_IDENTITY} is connected, {WITHOUT_FIRMWARE}"
            ) from fault
        raise


def open_on_backend(options: TimeTagOptions, serial: str, backend: Any) -> StreamSource:
    """Open the time tagger with a serial number (empty: any) behind a backend of pyusb."""
    link = UsbLink(USB_IDENTITY, serial, backend)
    try:
        return StreamSource(TimeTaggerFeed(link, options), options)
    except BaseException:
        link.close()
        raise


def find_timetaggers() -> list[DiscoveredInstrument]:
    """Look for connected time taggers; an empty list where there is no USB to look at."""
    try:
        backend = system_backend()
        bare = DiscoveredInstrument("timetag://", INSTRUMENT, WITHOUT_FIRMWARE)
        found = [_describe(device) for device in find_devices(USB_IDENTITY, backend)]
        return found + [bare for _ in find_devices(BARE_CHIP_IDENTITY, backend)]
    except DeviceError:
        return []


def _describe(device: Any) -> DiscoveredInstrument:
    try:
        return DiscoveredInstrument(f"timetag://{read_serial(device, USB_IDENTITY)}", INSTRUMENT)
    except DeviceError as fault:
        return DiscoveredInstrument("timetag://", INSTRUMENT, str(fault))
