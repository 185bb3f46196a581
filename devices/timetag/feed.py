"""The FX2 time tagger as a feed: acquisition, and recovery from faults."""

from __future__ import annotations

import array
import contextlib
from dataclasses import dataclass
from time import monotonic

from devices.ledger import Ledger
from devices.ring import Gap
from devices.source import Info
from devices.stream import Transfer
from devices.timetag.codec import RECORD_BYTES
from devices.timetag.registers import (
    DATA_ENDPOINT,
    INSTRUMENT,
    PACKET_BYTES,
    Capture,
    Register,
    TimeTagger,
)
from devices.usb import UsbLink
from tofclip.errors import (
    DeviceDisconnectedError,
    DeviceTimeoutError,
    InputError,
    ProtocolError,
    TransferOverflowError,
)
from tofclip.storage import Record, Scalar

_COUNTER_MODULUS = 1 << 32

MIN_CLOCK_HZ, MAX_CLOCK_HZ = 1_000_000, 1_000_000_000
"""Whatever the gateware was built for, its clock is within these."""

PACKET_INTERVAL_S = 0.015
LATENCY_S = 0.02
"""Seconds after which a transfer is ended, and a chip that holds part of a packet is asked to send."""

FULL_STREAM_BYTES_PER_S = 500_000


@dataclass(frozen=True)
class AcquisitionSettings:
    """How to acquire."""

    channels: int = 0xF  # one bit for each channel that registers edges, or levels
    delta: int = 0  # one bit for each channel that registers edges, or levels
    # most that one transfer asks for: whole packets of 512 bytes, or a device may send more than
    # fits
    transfer_bytes: int = 1 << 19
    reconnect: float = 5.0  # seconds to wait for an instrument that was unplugged

    def __post_init__(self) -> None:
        if not (0 <= self.channels <= 0xF and 0 <= self.delta <= 0xF):
            raise InputError("channels and delta are masks of four bits: 0 to 15")
        if not 0 < self.transfer_bytes <= 1 << 24 or self.transfer_bytes % PACKET_BYTES:
            raise InputError(
                f"a transfer must be a multiple of {PACKET_BYTES} bytes, at most 16 MiB"
            )
        if not 0 <= self.reconnect <= 600:
            raise InputError(
                "the time to wait for an unplugged instrument must be within 0 s and 600 s"
            )


class TimeTaggerFeed:
    """The time tagger's words, one transfer after the other; see `devices.stream.Feed`.

    What the instrument registered but never handed over is found by comparing its own counts with
    what arrived, when it closes and after it was unplugged; an instrument that lost its power has
    forgotten them.

    The firmware makes packets of 510 bytes, each of which ends a transfer because it is shorter than
    the endpoint's 512: 8,000 a second of a full stream, while the board holds no more than 3 ms.
    Packets of 512 bytes do not end a transfer, and so the system goes on reading by itself. At low
    rates, where a photon would wait for 84 others, packets are made small; see `SendWindow`.
    """

    def __init__(self, link: UsbLink, ledger: Ledger, acquisition: AcquisitionSettings) -> None:
        self._link = link
        self._ledger = ledger
        self._acquisition = acquisition
        self._tagger = TimeTagger(link)
        self._buffer = array.array("B", bytes(acquisition.transfer_bytes))
        self._view = memoryview(self._buffer)
        self._window = SendWindow()
        self._gap = Gap.NONE
        self._capture_mode = Capture.COUNT | Capture.REGISTER
        self._disconnected_at: float | None = None
        self._must_clear = False
        self._is_flushed = False
        self._records_received = 0
        self._bytes_since_gap = 0
        self._clock_hz = self._tagger.read(Register.CLOCK)
        # Ticks become seconds by this number, so that a wrong one is refused before any record.
        if not self._clock_hz:
            raise ProtocolError(
                "the time tagger says that its clock has 0 Hz; is its gateware loaded?"
            )
        if not MIN_CLOCK_HZ <= self._clock_hz <= MAX_CLOCK_HZ:
            raise ProtocolError(
                f"the time tagger says that its clock has {self._clock_hz} Hz, which cannot be; "
                "unplug it and plug it in again"
            )

    @property
    def info(self) -> Info:
        details: dict[str, Scalar] = {
            "version": self._tagger.version,
            "clock_hz": self._clock_hz,
            "usb": str(self._link.identity),
        }
        return Info(INSTRUMENT, self._link.serial, details)

    @property
    def calibration(self) -> Record:
        return Record("calibration", attributes={"tick_s": 1 / self._clock_hz})

    def start(self) -> None:
        self._tagger.reset()
        self._window.size = PACKET_BYTES
        self._records_received = 0
        self._bytes_since_gap = 0
        self._tagger.run(self._acquisition.channels, self._acquisition.delta, self._capture_mode)

    def pull(self, timeout: float) -> Transfer | None:
        while True:
            try:
                self._prepare_read(timeout)
                begin = self._window.clock()
                wait = min(timeout, self._window.read_timeout)
                length = self._link.read(DATA_ENDPOINT, self._buffer, wait)
            except TransferOverflowError:
                self._must_clear = True
            except DeviceDisconnectedError as fault:
                self._note_disconnect(fault)
            except DeviceTimeoutError:
                if self._disconnected_at is not None or not self._send_rest():
                    raise
                self._ledger.time_out()
            else:
                self._set_window(self._window.choose(length, self._window.clock() - begin))
                if not length:
                    continue  # an empty packet: the chip was asked to send, and had nothing
                self._bytes_since_gap += length
                gap = self._gap
                self._gap = Gap.NONE
                return Transfer(self._view[:length], gap)

    def stop(self) -> None:
        self._capture_mode = Capture.COUNT
        self._tagger.write(Register.CAPTURE, self._capture_mode)

    def close(self) -> None:
        try:
            self.stop()
            self._count_losses()
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

    def _prepare_read(self, timeout: float) -> None:
        """Do what has to be done before reading can go on."""
        if self._disconnected_at is not None:
            self._reconnect(timeout)
        if self._must_clear:
            self._clear_memory()

    def _clear_memory(self) -> None:
        """Empty the instrument's memory, so that the stream begins with a whole record again."""
        self._gap = max(self._gap, Gap.LOSS)
        self._end_segment()
        self._tagger.write(Register.CAPTURE, Capture.COUNT)
        self._tagger.clear_memory()
        self._window.size = PACKET_BYTES
        self._tagger.write(Register.CAPTURE, self._capture_mode)
        self._must_clear = False

    def _reconnect(self, timeout: float) -> None:
        """Look for the unplugged instrument, but return in time for a caller that wants to stop."""
        try:
            self._link.reconnect(min(timeout, self._reconnect_time_left))
        except DeviceDisconnectedError as fault:
            if self._reconnect_time_left > 0:
                raise DeviceTimeoutError("the time tagger is unplugged") from fault
            raise
        self._tagger.synchronize()
        # After a loss of power the register is zero.
        if self._tagger.read(Register.CAPTURE) & Capture.COUNT:
            self._must_clear = True  # it kept its power and went on
        else:
            self._gap = Gap.RESTART
            self.start()
        self._disconnected_at = None
        self._ledger.reconnect()

    def _note_disconnect(self, fault: DeviceDisconnectedError) -> None:
        """Note that the instrument is gone; raise if it has been for too long."""
        if self._disconnected_at is None:
            self._disconnected_at = monotonic()
        if self._reconnect_time_left <= 0:
            raise DeviceDisconnectedError(
                f"the time tagger {self._link.serial} was unplugged and did not come back within "
                f"{self._acquisition.reconnect:g} s"
            ) from fault

    @property
    def _reconnect_time_left(self) -> float:
        begin = monotonic() if self._disconnected_at is None else self._disconnected_at
        return begin + self._acquisition.reconnect - monotonic()

    def _count_losses(self) -> None:
        """Enter what the instrument counted and this program never saw."""
        self._end_segment()
        missing = (
            self._tagger.read(Register.RECORDS) - self._records_received
        ) % _COUNTER_MODULUS  # the counts have 32 bits
        if missing >= _COUNTER_MODULUS // 2:
            raise ProtocolError("the time tagger sent more records than it counted")
        self._ledger.lose(missing + self._tagger.read(Register.LOST))

    def _end_segment(self) -> None:
        """Count what arrived without a gap; a record of which only the beginning arrived counts as
        well.
        """
        self._records_received += -(-self._bytes_since_gap // RECORD_BYTES)
        self._bytes_since_gap = 0


class SendWindow:
    """How many bytes make a packet, so that no record waits long and a full stream is not cut up.

    The aim is one packet in `PACKET_INTERVAL_S`: the rate is measured while reading, over eight
    transfers or that time. A rate for which 512 bytes come sooner is read in packets of 512 bytes,
    which do not end a transfer.
    """

    clock = staticmethod(monotonic)
    """By which rates are measured, s."""

    def __init__(self) -> None:
        self.size = PACKET_BYTES
        """Bytes of a packet."""
        self._bytes = 0
        self._transfers = 0
        self._seconds = 0.0
        self._rate = 0.0

    @property
    def read_timeout(self) -> float:
        """Seconds that one transfer may take: long for a full stream, which is not cut then, and
        for packets of single records, which end a transfer at once.
        """
        is_full = self._rate > FULL_STREAM_BYTES_PER_S
        return 10.0 if is_full or self.size == RECORD_BYTES else LATENCY_S

    def choose(self, length: int, seconds: float) -> int:
        """Return how many bytes should make a packet from now on.

        `length`: bytes that the last transfer brought; `seconds`: how long it took. Returns bytes.
        """
        self._bytes += length
        self._transfers += 1
        self._seconds += seconds
        if self._transfers < 8 and self._seconds < PACKET_INTERVAL_S:
            return self.size
        self._rate = self._bytes / max(self._seconds, 1e-6)
        self._bytes = 0
        self._transfers = 0
        self._seconds = 0.0
        wanted = self._rate * PACKET_INTERVAL_S
        if wanted >= PACKET_BYTES:
            return PACKET_BYTES
        size = max(1, int(wanted / RECORD_BYTES)) * RECORD_BYTES
        is_near = self.size / 2 <= size <= 2 * self.size and self.size < PACKET_BYTES
        return self.size if is_near else size
