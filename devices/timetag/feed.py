"""The FX2 time tagger as a feed: acquisition, and recovery from faults."""

from __future__ import annotations

import array
from dataclasses import dataclass
from time import monotonic

from devices.ledger import Ledger
from devices.ring import Gap
from devices.source import Info
from devices.stream import Arrival
from devices.timetag.codec import RECORD_BYTES
from devices.timetag.registers import DATA, INSTRUMENT, PACKET_BYTES, Capture, Register, TimeTagger
from devices.usb import UsbLink
from tofclip.errors import (
    DeviceDisconnectedError,
    DeviceTimeoutError,
    InputError,
    ProtocolError,
    TransferOverflowError,
)
from tofclip.storage import Record, Scalar

_COUNTS = 1 << 32


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
        self._wanted = Capture.COUNT | Capture.REGISTER
        self._gone_since: float | None = None
        self._must_clear = False
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
        self._tagger.run(self._acquisition.channels, self._acquisition.delta, self._wanted)

    def pull(self, timeout: float) -> Arrival | None:
        while True:
            try:
                self._make_ready(timeout)
                length = self._link.read(DATA, self._buffer, timeout)
            except TransferOverflowError:
                self._must_clear = True
            except DeviceDisconnectedError as fault:
                self._wait_longer(fault)
            else:
                self._bytes_since_gap += length
                gap, self._gap = self._gap, Gap.NONE
                return Arrival(self._view[:length], gap)

    def stop(self) -> None:
        self._wanted = Capture.COUNT
        self._tagger.write(Register.CAPTURE, self._wanted)

    def close(self) -> None:
        try:
            self.stop()
            self._audit()
        finally:
            self._link.close()

    def _make_ready(self, timeout: float) -> None:
        """Do what has to be done before reading can go on."""
        if self._gone_since is not None:
            self._find_again(timeout)
        if self._must_clear:
            self._clear()

    def _clear(self) -> None:
        """Empty the instrument's memory, so that the stream begins with a whole record again."""
        self._gap = max(self._gap, Gap.LOSS)
        self._end_segment()
        self._tagger.write(Register.CAPTURE, Capture.COUNT)
        self._tagger.write(Register.CLEAR, 1)
        self._tagger.write(Register.CAPTURE, self._wanted)
        self._must_clear = False

    def _find_again(self, timeout: float) -> None:
        """Look for the unplugged instrument, but return in time for whoever wants to stop."""
        try:
            self._link.reconnect(min(timeout, self._patience_left))
        except DeviceDisconnectedError as fault:
            if self._patience_left > 0:
                raise DeviceTimeoutError("the time tagger is unplugged") from fault
            raise
        if self._tagger.read(Register.CAPTURE) & Capture.COUNT:
            self._must_clear = True  # it kept its power and went on
        else:
            self._gap = Gap.RESTART
            self.start()
        self._gone_since = None
        self._ledger.reconnect()

    def _wait_longer(self, fault: DeviceDisconnectedError) -> None:
        """Note that the instrument is gone; raise if it has been for too long."""
        if self._gone_since is None:
            self._gone_since = monotonic()
        if self._patience_left <= 0:
            raise DeviceDisconnectedError(
                f"the time tagger {self._link.serial} was unplugged and did not come back within "
                f"{self._acquisition.reconnect:g} s"
            ) from fault

    @property
    def _patience_left(self) -> float:
        begin = monotonic() if self._gone_since is None else self._gone_since
        return begin + self._acquisition.reconnect - monotonic()

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
