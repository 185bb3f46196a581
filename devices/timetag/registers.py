"""The FX2 time tagger's registers: commands on one endpoint, replies on another."""

from __future__ import annotations

import array
import enum
import struct

from devices.usb import UsbIdentity, UsbLink
from tofclip.errors import ProtocolError

USB_IDENTITY = UsbIdentity(0x04B4, 0x1004)
BARE_CHIP_IDENTITY = UsbIdentity(0x04B4, 0x8613)
"""The same chip before its firmware was loaded."""

INSTRUMENT = "FX2 time tagger"
COMMAND_ENDPOINT, DATA_ENDPOINT, REPLY_ENDPOINT = 0x02, 0x86, 0x88
PACKET_BYTES = 512
REPLY_TIMEOUT_S = 1.0

_MAGIC, _READ, _WRITE = 0xAA, 0, 1


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
        """Set a register.

        Parameters
        ----------
        register : Register
        value : int
            32 bits.
        """
        self._exchange(_WRITE, register, value)

    def reset(self) -> None:
        """Stop, and forget records, counts and time."""
        self.write(Register.STROBE, 0)
        self.write(Register.DELTA, 0)
        self.write(Register.CAPTURE, Capture.RESET)
        self.write(Register.CAPTURE, Capture.OFF)
        for counter in (Register.RECORDS, Register.LOST, Register.CLEAR):
            self.write(counter, 1)

    def run(
        self, channels: int, delta: int, capture: Capture = Capture.COUNT | Capture.REGISTER
    ) -> None:
        """Start the counter, then the registration, so that the first zero of the counter is not
        taken for a wrap.

        Parameters
        ----------
        channels, delta : int
            Bits of the channels whose edges are recorded as strobes, and whose levels.
        capture : Capture
        """
        self.write(Register.STROBE, channels)
        self.write(Register.DELTA, delta)
        self.write(Register.CAPTURE, Capture.COUNT)
        self.write(Register.CAPTURE, capture)

    def _exchange(self, what: int, register: Register, value: int) -> int:
        self._link.write(
            COMMAND_ENDPOINT, struct.pack("<BBHI", _MAGIC, what, register, value), REPLY_TIMEOUT_S
        )
        length = self._link.read(REPLY_ENDPOINT, self._reply, REPLY_TIMEOUT_S)
        if length != 4:
            raise ProtocolError(
                f"the time tagger answered {length} bytes about register {register}, expected 4"
            )
        return int.from_bytes(self._reply[:4].tobytes(), "little")
