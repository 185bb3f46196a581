"""An emulated FX2 time tagger on the virtual USB, with faults to order. `devices.timetag` drives it unchanged."""

from __future__ import annotations

import errno
import struct
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from time import monotonic, sleep

from usb.core import USBError

from devices.codec import ByteView
from devices.emulation.byte_queue import ByteQueue
from devices.emulation.faults import Fault
from devices.emulation.photons import FOREVER, TagStream
from devices.emulation.usb import PACKET_BYTES, VirtualDevice, usb_error
from devices.timetag.codec import LOST, RECORD_BYTES
from devices.timetag.registers import COMMANDS, DATA, IDENTITY, INSTRUMENT, REPLIES, Capture, Register
from tofclip.errors import InputError

MAGIC, WRITE = 0xAA, 1
COMMAND = struct.Struct("<BBHI")
CLOCK_HZ = 128_000_000
VERSION = 1
SHORT_PACKET_BYTES = 510
UNUSED_BITS = 0x1F
MOST_AT_ONCE = 1 << 14
DARK = 5e-3
"""Seconds after which an instrument whose time is not the clock's says that nothing comes."""
NAP = 4e-3


@dataclass
class Truth:
    """What really happened, for comparison with what the driver says. All in records.

    Parameters
    ----------
    registered : int
        Photons that the instrument saw.
    not_kept : int
        Of these, found its memory full.
    forgotten : int
        Of these, were in the memory of an instrument that lost its power, and all of `not_kept` before that.
    garbled : int
        Of these, were handed over as something that is no record.
    """

    registered: int = 0
    not_kept: int = 0
    forgotten: int = 0
    garbled: int = 0


@dataclass(frozen=True)
class Setting:
    """How the emulated instrument behaves.

    Parameters
    ----------
    is_paced : bool
        Photons come when they are due, and are lost while the memory is full. Otherwise time runs as fast as the host
        reads.
    records : int
        Photons after which it is dark.
    packet_bytes : int
        Size of a packet. 510, as of the public firmware: each is shorter than the endpoint's 512 and ends a transfer.
        512: transfers are filled.
    memory_bytes : int
        What fits into the instrument. Far more than into a real one, because it shares the processor with the host,
        which is not always given its turn in time.
    """

    is_paced: bool = False
    records: int = FOREVER
    packet_bytes: int = PACKET_BYTES
    memory_bytes: int = 64 << 20

    def __post_init__(self) -> None:
        if self.packet_bytes not in (SHORT_PACKET_BYTES, PACKET_BYTES):
            raise InputError(f"a packet has {SHORT_PACKET_BYTES} or {PACKET_BYTES} bytes, got {self.packet_bytes}")
        if self.records < 0 or not PACKET_BYTES <= self.memory_bytes <= 1 << 32:
            raise InputError("an emulated time tagger needs records >= 0 and a memory of 512 bytes to 4 GiB")


class EmulatedTimeTagger(VirtualDevice):
    """The instrument.

    Memory: the larger of its own memory and one transfer.

    Parameters
    ----------
    light : callable
        Makes the light that falls on it from a moment at which its counter is reset; takes how often it was before.
    serial : str
    setting : Setting
    faults : iterable of Fault
    """

    def __init__(
        self, light: Callable[[int], TagStream], serial: str, setting: Setting, faults: Iterable[Fault] = ()
    ) -> None:
        super().__init__(IDENTITY, ("tofclip", INSTRUMENT, serial), (COMMANDS, DATA, REPLIES))
        self.truth = Truth()
        self._make_light, self.setting = light, setting
        self._light, self._resets = light(0), 0
        self._faults = {fault.transfer: fault for fault in faults}
        self._transfers = 0
        self._stalls = self._to_garble = 0
        self._registers = _fresh_registers()
        self._memory = ByteQueue()
        self._replies: list[bytes] = []
        self._started = monotonic()
        self._mark_lost = False
        self._segment_bytes = self._told = 0

    def receive(self, endpoint: int, data: bytes) -> None:
        if endpoint != COMMANDS or len(data) != COMMAND.size or data[0] != MAGIC:
            raise usb_error(errno.EPIPE)
        _, what, number, value = COMMAND.unpack(data)
        if number not in set(Register):
            raise usb_error(errno.EPIPE)
        register = Register(number)
        if what == WRITE:
            self._set(register, value)
        self._replies.append(struct.pack("<I", self._registers[register] % (1 << 32)))

    def fill(self, endpoint: int, buffer: memoryview, timeout: float) -> int:
        if endpoint == REPLIES:
            return self._reply(buffer)
        fault = self._faults.get(self._transfers)
        self._transfers += 1
        return self._hand_over(buffer, timeout) if fault is None else self._fail(fault, buffer, timeout)

    def clear_halt(self, endpoint: int) -> None:
        """End a stall, unless it is to come again."""
        self._stalls -= 1
        if self._stalls <= 0:
            super().clear_halt(endpoint)

    def _reply(self, buffer: memoryview) -> int:
        if not self._replies:
            raise usb_error(errno.ETIMEDOUT)
        reply = self._replies.pop(0)
        buffer[: len(reply)] = reply
        return len(reply)

    def _set(self, register: Register, value: int) -> None:
        if register in (Register.VERSION, Register.CLOCK):
            return
        if register in (Register.RECORDS, Register.LOST, Register.CLEAR):
            value = 0
        if register is Register.RECORDS:
            self._told = self._segment_bytes = 0
        if register is Register.CLEAR:
            self._empty()
        if register is Register.CAPTURE:
            self._switch(Capture(value))
        self._registers[register] = value

    def _switch(self, to: Capture) -> None:
        if Capture.REGISTER not in to:
            self._register_due()
        if Capture.RESET in to and self.truth.registered:
            self._resets += 1
            self._light = self._make_light(self._resets)
        if Capture.COUNT in to and Capture.COUNT not in self._capture:
            self._started = monotonic()

    @property
    def _capture(self) -> Capture:
        return Capture(self._registers[Register.CAPTURE])

    def _empty(self) -> None:
        self._told += -(-self._segment_bytes // RECORD_BYTES)
        self._segment_bytes = 0
        self._memory.clear()

    def _register_due(self) -> None:
        """Register what fell on the instrument up to now, where that depends on the time."""
        if not self.setting.is_paced or Capture.REGISTER not in self._capture:
            return
        tick = int((monotonic() - self._started) * CLOCK_HZ)
        found = MOST_AT_ONCE
        while found == MOST_AT_ONCE:
            words = self._seen(MOST_AT_ONCE, tick)
            found = len(words) // RECORD_BYTES
            room = max(0, self.setting.memory_bytes - len(self._memory)) // RECORD_BYTES * RECORD_BYTES
            self._keep(words[:room])
            self._lose(words[room:])

    def _seen(self, limit: int, last: int = FOREVER) -> ByteView:
        """Return the words of the next photons, at most `limit`."""
        words = self._light.words(max(0, min(limit, self.setting.records - self.truth.registered)), last)
        self.truth.registered += len(words) // RECORD_BYTES
        return words

    def _keep(self, words: ByteView) -> None:
        if len(words) == 0:
            return
        if self._mark_lost:
            words[0] |= LOST << 5
            self._mark_lost = False
        garbled = min(self._to_garble, len(words) // RECORD_BYTES)
        words[: garbled * RECORD_BYTES] |= UNUSED_BITS
        self.truth.garbled += garbled
        self._to_garble = 0
        self._memory.append(words)
        self._registers[Register.RECORDS] += len(words) // RECORD_BYTES

    def _lose(self, words: ByteView) -> None:
        lost = len(words) // RECORD_BYTES
        self.truth.not_kept += lost
        self._registers[Register.LOST] += lost
        self._mark_lost |= lost > 0

    def _hand_over(self, buffer: memoryview, timeout: float) -> int:
        """Fill the host's buffer with whatever there is, waiting for it at most `timeout` seconds."""
        packet = self.setting.packet_bytes
        wanted = len(buffer) if packet == PACKET_BYTES else min(packet, len(buffer))
        self._gather(wanted, timeout)
        length = self._memory.take(buffer[:wanted])
        if not length:
            raise usb_error(errno.ETIMEDOUT)
        self._segment_bytes += length
        return length

    def _gather(self, length: int, timeout: float) -> None:
        """See to it that `length` bytes are there, if they come in time."""
        if not self.setting.is_paced:
            if Capture.REGISTER in self._capture:
                self._keep(self._seen(-(-max(0, length - len(self._memory)) // RECORD_BYTES)))
            if not len(self._memory):
                sleep(min(timeout, DARK))
            return
        deadline = monotonic() + timeout
        self._register_due()
        while len(self._memory) < length and Capture.REGISTER in self._capture and monotonic() < deadline:
            sleep(NAP)
            self._register_due()

    def _fail(self, fault: Fault, buffer: memoryview, timeout: float) -> int:
        """Do what a fault orders: some are an exception, some a smaller or stranger transfer."""
        if fault.kind == "timeout":
            raise usb_error(errno.ETIMEDOUT)
        if fault.kind in ("stall", "unplug", "powerloss"):
            raise self._gone(fault)
        if fault.kind == "overflow":
            lost_on_the_wire = self._hand_over(buffer, timeout)
            self._segment_bytes -= lost_on_the_wire
            raise usb_error(errno.EOVERFLOW)
        if fault.kind == "short":
            return self._hand_over(buffer[: max(1, min(fault.amount, len(buffer)))], timeout)
        if fault.kind == "lost":
            self._lose(self._seen(fault.amount))
        else:
            self._to_garble = fault.amount
        return self._hand_over(buffer, timeout)

    def _gone(self, fault: Fault) -> USBError:
        if fault.kind == "stall":
            self.halted.add(DATA)
            self._stalls = fault.amount
            return usb_error(errno.EPIPE)
        if fault.kind == "powerloss":
            self._empty()
            self.truth.forgotten += self._registers[Register.RECORDS] + self._registers[Register.LOST] - self._told
            self._registers = _fresh_registers()
            self._mark_lost = False
        self.unplug(fault.amount)
        return usb_error(errno.ENODEV)


def _fresh_registers() -> dict[Register, int]:
    return {**dict.fromkeys(Register, 0), Register.VERSION: VERSION, Register.CLOCK: CLOCK_HZ}
