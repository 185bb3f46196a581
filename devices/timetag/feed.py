"""The FX2 time tagger as a feed: acquisition, and recovery from faults."""

from __future__ import annotations

import array
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


@dataclass(frozen=True)
class AcquisitionSettings:
    """How to acquire.

    Parameters
    ----------
    channels, delta : int
        One bit for each channel that registers edges, or levels.
    transfer_bytes : int
        Most that one transfer asks for: whole packets of 512 bytes, or a device may send more than
        fits.
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

    The public firmware commits packets of 510 bytes. Each of them ends a transfer, because it is
    shorter than the endpoint's 512, whatever the transfer asked for.
    """

    def __init__(self, link: UsbLink, ledger: Ledger, acquisition: AcquisitionSettings) -> None:
        self._link, self._ledger, self._acquisition = link, ledger, acquisition
        self._tagger = TimeTagger(link)
        self._buffer = array.array("B", bytes(acquisition.transfer_bytes))
        self._view = memoryview(self._buffer)
        self._gap = Gap.NONE
        self._capture_mode = Capture.COUNT | Capture.REGISTER
        self._disconnected_at: float | None = None
        self._must_clear = False
        self._records_received = self._bytes_since_gap = 0
        self._version = self._tagger.read(Register.VERSION)
        self._clock_hz = self._tagger.read(Register.CLOCK)
        if not self._clock_hz:
            raise ProtocolError(
                "the time tagger says that its clock has 0 Hz; is its gateware loaded?"
            )

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
        self._records_received = self._bytes_since_gap = 0
        self._tagger.run(self._acquisition.channels, self._acquisition.delta, self._capture_mode)

    def pull(self, timeout: float) -> Transfer | None:
        while True:
            try:
                self._prepare_read(timeout)
                length = self._link.read(DATA_ENDPOINT, self._buffer, timeout)
            except TransferOverflowError:
                self._must_clear = True
            except DeviceDisconnectedError as fault:
                self._note_disconnect(fault)
            else:
                self._bytes_since_gap += length
                gap, self._gap = self._gap, Gap.NONE
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
        self._tagger.write(Register.CLEAR, 1)
        self._tagger.write(Register.CAPTURE, self._capture_mode)
        self._must_clear = False

    def _reconnect(self, timeout: float) -> None:
        """Look for the unplugged instrument, but return in time for whoever wants to stop."""
        try:
            self._link.reconnect(min(timeout, self._reconnect_time_left))
        except DeviceDisconnectedError as fault:
            if self._reconnect_time_left > 0:
                raise DeviceTimeoutError("the time tagger is unplugged") from fault
            raise
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
