"""An emulated FX2 time tagger on the virtual USB, with faults to order. `devices.timetag` drives it
unchanged.
"""

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
from devices.emulation.photons import MAX_TICK, TagStream
from devices.emulation.usb import PACKET_BYTES, VirtualDevice, make_usb_error
from devices.timetag.codec import LOST, RECORD_BYTES
from devices.timetag.registers import (
    COMMAND_ENDPOINT,
    DATA_ENDPOINT,
    INSTRUMENT,
    REPLY_ENDPOINT,
    USB_IDENTITY,
    Capture,
    Register,
)
from tofclip.errors import InputError

MAGIC, WRITE = 0xAA, 1
COMMAND = struct.Struct("<BBHI")
CLOCK_HZ = 128_000_000
VERSION = 1
SHORT_PACKET_BYTES = 510
UNUSED_BITS = 0x1F
MAX_BATCH_RECORDS = 1 << 14
DARK_WAIT_S = 5e-3
"""Seconds after which an instrument whose time is not the clock's says that nothing comes."""
POLL_INTERVAL_S = 4e-3


@dataclass
class GroundTruth:
    """What really happened, for comparison with what the driver says. All in records.

    Parameters
    ----------
    registered : int
        Photons that the instrument saw.
    lost_memory_full : int
        Of these, found its memory full.
    lost_power_off : int
        Of these, were in the memory of an instrument that lost its power, and all of
        `lost_memory_full` before that.
    corrupted : int
        Of these, were handed over as something that is no record.
    """

    registered: int = 0
    lost_memory_full: int = 0
    lost_power_off: int = 0
    corrupted: int = 0


@dataclass(frozen=True)
class EmulatorSettings:
    """How the emulated instrument behaves.

    Parameters
    ----------
    is_paced : bool
        Photons come when they are due, and are lost while the memory is full. Otherwise time runs
        as fast as the host reads.
    records : int
        Photons after which it is dark.
    packet_bytes : int
        Size of a packet. 510, as of the public firmware: each is shorter than the endpoint's 512
        and ends a transfer. 512: transfers are filled.
    memory_bytes : int
        What fits into the instrument. Far more than into a real one, because it shares the
        processor with the host, which is not always given its turn in time.
    """

    is_paced: bool = False
    records: int = MAX_TICK
    packet_bytes: int = PACKET_BYTES
    memory_bytes: int = 64 << 20

    def __post_init__(self) -> None:
        if self.packet_bytes not in (SHORT_PACKET_BYTES, PACKET_BYTES):
            raise InputError(
                f"a packet has {SHORT_PACKET_BYTES} or {PACKET_BYTES} bytes, got {self.packet_bytes}"
            )
        if self.records < 0 or not PACKET_BYTES <= self.memory_bytes <= 1 << 32:
            raise InputError(
                "an emulated time tagger needs records >= 0 and a memory of 512 bytes to 4 GiB"
            )


class EmulatedTimeTagger(VirtualDevice):
    """The instrument.

    Memory: the larger of its own memory and one transfer.

    Parameters
    ----------
    light : callable
        Makes the light that falls on it from a moment at which its counter is reset; takes how
        often it was before.
    serial : str
    setting : EmulatorSettings
    faults : iterable of Fault
    """

    def __init__(
        self,
        light: Callable[[int], TagStream],
        serial: str,
        setting: EmulatorSettings,
        faults: Iterable[Fault] = (),
    ) -> None:
        super().__init__(
            USB_IDENTITY,
            ("tofclip", INSTRUMENT, serial),
            (COMMAND_ENDPOINT, DATA_ENDPOINT, REPLY_ENDPOINT),
        )
        self.truth = GroundTruth()
        self._make_light, self.setting = light, setting
        self._light, self._resets = light(0), 0
        self._faults = {fault.transfer: fault for fault in faults}
        self._transfers = 0
        self._stalls = self._records_to_corrupt = 0
        self._registers = _make_registers()
        self._memory = ByteQueue()
        self._replies: list[bytes] = []
        self._started = monotonic()
        self._mark_lost = False
        self._segment_bytes = self._reported = 0

    def receive(self, endpoint: int, data: bytes) -> None:
        """Carry out a command of the host and queue its reply.

        Parameters
        ----------
        endpoint : int
            Address.
        data : bytes
            One command.

        Raises
        ------
        usb.core.USBError
            The command is not one that the instrument knows.
        """
        if endpoint != COMMAND_ENDPOINT or len(data) != COMMAND.size or data[0] != MAGIC:
            raise make_usb_error(errno.EPIPE)
        _, what, number, value = COMMAND.unpack(data)
        if number not in set(Register):
            raise make_usb_error(errno.EPIPE)
        register = Register(number)
        if what == WRITE:
            self._write_register(register, value)
        self._replies.append(struct.pack("<I", self._registers[register] % (1 << 32)))

    def fill(self, endpoint: int, buffer: memoryview, timeout: float) -> int:
        """Write a reply or time tags into `buffer`, with the faults that were ordered for this
        transfer.

        Parameters
        ----------
        endpoint : int
            Address.
        buffer : memoryview
            Overwritten.
        timeout : float
            Seconds.

        Returns
        -------
        int
            Bytes.
        """
        if endpoint == REPLY_ENDPOINT:
            return self._send_reply(buffer)
        fault = self._faults.get(self._transfers)
        self._transfers += 1
        return (
            self._send_data(buffer, timeout)
            if fault is None
            else self._apply_fault(fault, buffer, timeout)
        )

    def clear_halt(self, endpoint: int) -> None:
        """End a stall, unless it is to come again."""
        self._stalls -= 1
        if self._stalls <= 0:
            super().clear_halt(endpoint)

    def _send_reply(self, buffer: memoryview) -> int:
        if not self._replies:
            raise make_usb_error(errno.ETIMEDOUT)
        reply = self._replies.pop(0)
        buffer[: len(reply)] = reply
        return len(reply)

    def _write_register(self, register: Register, value: int) -> None:
        if register in (Register.VERSION, Register.CLOCK):
            return
        if register in (Register.RECORDS, Register.LOST, Register.CLEAR):
            value = 0
        if register is Register.RECORDS:
            self._reported = self._segment_bytes = 0
        if register is Register.CLEAR:
            self._clear_memory()
        if register is Register.CAPTURE:
            self._switch_capture(Capture(value))
        self._registers[register] = value

    def _switch_capture(self, to: Capture) -> None:
        if Capture.REGISTER not in to:
            self._register_until_now()
        if Capture.RESET in to and self.truth.registered:
            self._resets += 1
            self._light = self._make_light(self._resets)
        if Capture.COUNT in to and Capture.COUNT not in self._capture:
            self._started = monotonic()

    @property
    def _capture(self) -> Capture:
        return Capture(self._registers[Register.CAPTURE])

    def _clear_memory(self) -> None:
        self._reported += -(-self._segment_bytes // RECORD_BYTES)
        self._segment_bytes = 0
        self._memory.clear()

    def _register_until_now(self) -> None:
        """Register what fell on the instrument up to now, where that depends on the time."""
        if not self.setting.is_paced or Capture.REGISTER not in self._capture:
            return
        tick = int((monotonic() - self._started) * CLOCK_HZ)
        found = MAX_BATCH_RECORDS
        while found == MAX_BATCH_RECORDS:
            words = self._register_photons(MAX_BATCH_RECORDS, tick)
            found = len(words) // RECORD_BYTES
            room = (
                max(0, self.setting.memory_bytes - len(self._memory)) // RECORD_BYTES * RECORD_BYTES
            )
            self._store(words[:room])
            self._discard(words[room:])

    def _register_photons(self, limit: int, last: int = MAX_TICK) -> ByteView:
        """Return the words of the next photons, at most `limit`."""
        words = self._light.next_words(
            max(0, min(limit, self.setting.records - self.truth.registered)), last
        )
        self.truth.registered += len(words) // RECORD_BYTES
        return words

    def _store(self, words: ByteView) -> None:
        if len(words) == 0:
            return
        if self._mark_lost:
            words[0] |= LOST << 5
            self._mark_lost = False
        garbled = min(self._records_to_corrupt, len(words) // RECORD_BYTES)
        words[: garbled * RECORD_BYTES] |= UNUSED_BITS
        self.truth.corrupted += garbled
        self._records_to_corrupt = 0
        self._memory.append(words)
        self._registers[Register.RECORDS] += len(words) // RECORD_BYTES

    def _discard(self, words: ByteView) -> None:
        lost = len(words) // RECORD_BYTES
        self.truth.lost_memory_full += lost
        self._registers[Register.LOST] += lost
        self._mark_lost |= lost > 0

    def _send_data(self, buffer: memoryview, timeout: float) -> int:
        """Fill the host's buffer with whatever there is, waiting for it at most `timeout` seconds."""
        packet = self.setting.packet_bytes
        wanted = len(buffer) if packet == PACKET_BYTES else min(packet, len(buffer))
        self._wait_for_bytes(wanted, timeout)
        length = self._memory.read_into(buffer[:wanted])
        if not length:
            raise make_usb_error(errno.ETIMEDOUT)
        self._segment_bytes += length
        return length

    def _wait_for_bytes(self, length: int, timeout: float) -> None:
        """See to it that `length` bytes are there, if they come in time."""
        if not self.setting.is_paced:
            if Capture.REGISTER in self._capture:
                self._store(
                    self._register_photons(-(-max(0, length - len(self._memory)) // RECORD_BYTES))
                )
            if not len(self._memory):
                sleep(min(timeout, DARK_WAIT_S))
            return
        deadline = monotonic() + timeout
        self._register_until_now()
        while (
            len(self._memory) < length
            and Capture.REGISTER in self._capture
            and monotonic() < deadline
        ):
            sleep(POLL_INTERVAL_S)
            self._register_until_now()

    def _apply_fault(self, fault: Fault, buffer: memoryview, timeout: float) -> int:
        """Do what a fault orders: some are an exception, some a smaller or stranger transfer."""
        if fault.kind == "timeout":
            raise make_usb_error(errno.ETIMEDOUT)
        if fault.kind in ("stall", "unplug", "powerloss"):
            raise self._interrupt(fault)
        if fault.kind == "overflow":
            lost_on_the_wire = self._send_data(buffer, timeout)
            self._segment_bytes -= lost_on_the_wire
            raise make_usb_error(errno.EOVERFLOW)
        if fault.kind == "short":
            return self._send_data(buffer[: max(1, min(fault.amount, len(buffer)))], timeout)
        if fault.kind == "lost":
            self._discard(self._register_photons(fault.amount))
        else:
            self._records_to_corrupt = fault.amount
        return self._send_data(buffer, timeout)

    def _interrupt(self, fault: Fault) -> USBError:
        if fault.kind == "stall":
            self.halted.add(DATA_ENDPOINT)
            self._stalls = fault.amount
            return make_usb_error(errno.EPIPE)
        if fault.kind == "powerloss":
            self._clear_memory()
            self.truth.lost_power_off += (
                self._registers[Register.RECORDS] + self._registers[Register.LOST] - self._reported
            )
            self._registers = _make_registers()
            self._mark_lost = False
        self.unplug(fault.amount)
        return make_usb_error(errno.ENODEV)


def _make_registers() -> dict[Register, int]:
    return {**dict.fromkeys(Register, 0), Register.VERSION: VERSION, Register.CLOCK: CLOCK_HZ}
