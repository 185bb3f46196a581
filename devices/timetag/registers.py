"""The FX2 time tagger's registers: commands on one endpoint, replies on another.

Sources: the gateware (bgamari/timetag-fpga: ``docs/registers``, ``reg_manager.v``), the firmware of
its USB chip (bgamari/timetag-fx2) and the makers' own client (bgamari/timetag-tools).
"""

from __future__ import annotations

import array
import contextlib
import enum
import struct

from devices.usb import UsbIdentity, UsbLink
from tofclip.errors import (
    DeviceStalledError,
    DeviceTimeoutError,
    ProtocolError,
    TransferOverflowError,
)

USB_IDENTITY = UsbIdentity(0x04B4, 0x1004)
BARE_CHIP_IDENTITY = UsbIdentity(0x04B4, 0x8613)
"""The same chip before its firmware was loaded."""

INSTRUMENT = "FX2 time tagger"
COMMAND_ENDPOINT, DATA_ENDPOINT, REPLY_ENDPOINT = 0x02, 0x86, 0x88
PACKET_BYTES = 512
REPLY_TIMEOUT_S = 0.5
DRAIN_TIMEOUT_S = 0.02
"""Seconds after which an endpoint that sent nothing is taken to be empty."""

MAX_DRAINED = 16
"""Transfers that are thrown away at once; one that sends more has another defect."""

ATTEMPTS = 4

_MAGIC, _READ, _WRITE = 0xAA, 0, 1
_SET_SEND_WINDOW, _FLUSH = 1, 2
_UNJAM = 0
"""A register that is not there: writing it completes a command that was cut short."""


class Register(enum.IntEnum):
    """Addresses of the registers."""

    VERSION = 1
    CLOCK = 2
    CAPTURE = 3
    STROBE = 4
    DELTA = 5
    RECORDS = 6
    """Records that went into the memory; any write sets it to zero."""
    LOST = 7
    """Records that found the memory full; any write sets it to zero."""
    CLEAR = 8
    """1 holds the memory empty, 0 lets it fill."""


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
    version, which must be what it always is; where it is not, the replies are thrown away, and the
    exchange is tried again.

    Making one of these synchronises.
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
        """Set a register.

        `value`: 32 bits.
        """
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
        """Throw away every record that waits in the memory and in the USB chip, which makes packets
        of 512 bytes then. Nothing may be registered meanwhile.
        """
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
        """Start the counter, then the registration, so that the first zero of the counter is not
        taken for a wrap.

        `channels, delta`: one bit for each channel whose edges are recorded as strobes, or whose
        levels; `capture`: what to switch on in the end.
        """
        self.write(Register.STROBE, channels)
        self.write(Register.DELTA, delta)
        self.write(Register.CAPTURE, Capture.COUNT)
        self.write(Register.CAPTURE, capture)

    def set_send_window(self, size: int) -> bool:
        """Set how many bytes make a packet, and let the chip send what it holds now, however
        little.

        `size`: at most 512. Packets of 512 bytes do not end a transfer, smaller ones do. Returns
        false where the firmware has no such request.
        """
        return self._request(_SET_SEND_WINDOW, size)

    def flush(self) -> bool:
        """Let the chip get rid of an unfinished packet: send it or, by other firmware, forget it.

        Returns false where the firmware has no such request.
        """
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
