"""An emulated FX2 time tagger on the virtual USB, as unkind as the real one, with faults to order,
and the light that falls on it, as its words: even, or of a pulsed scene. `devices.timetag` drives it
unchanged.

Written from the gateware and the firmware (bgamari/timetag-fpga, bgamari/timetag-fx2), not from the
driver::

    photons -> memory of 2048 records -> USB chip: three packets -> host
               held empty by CLEAR       unfinished packets wait

When it is opened it is as a killed program left it: a reply that was never fetched waits, records
of the last session are in the USB chip, and the register manager waits for the end of a command.
"""

from __future__ import annotations

import errno
import math
import struct
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from time import monotonic, sleep

import numpy as np

from devices.address import Uri, option
from devices.emulation.harness import FOREVER, REPLY_FAULTS, Fault
from devices.emulation.scenes import LineLight, draw_cells, simulate_light
from devices.emulation.usb import PACKET_BYTES, VirtualDevice, VirtualUsb, make_usb_error
from devices.source import ByteView, Records
from devices.stream import StreamSource
from devices.timetag import (
    COMMAND_ENDPOINT,
    DATA_ENDPOINT,
    INSTRUMENT,
    REPLY_ENDPOINT,
    USB_IDENTITY,
    Capture,
    Register,
    TimeTagOptions,
    open_on_backend,
)
from devices.timetag_codec import COUNTER_RANGE, LOST, RECORD_BYTES, RECORD_DTYPE, WRAP, pack_words
from tofclip.arrays import IntArray
from tofclip.errors import InputError

MAX_TICK = (1 << 62) - 1  # A tick that never comes


class PoissonStream:
    """Photons at random, at a constant rate per second, evenly on four channels; one record at most
    for each tick of the clock.
    """

    def __init__(self, rate: float, clock_hz: int, seed: int) -> None:
        if not 0 < rate < clock_hz:
            raise InputError(
                f"a rate must be above 0 and below the clock's {clock_hz} per second, got {rate:g}"
            )
        # The whole part of an exponential variable is geometric, here with mean (ticks per photon)
        # - 1.
        self._scale = 1 / math.log1p(1 / (clock_hz / rate - 1))
        self._state = np.array([seed], np.uint64)
        self._now = np.zeros(1, np.int64)

    def next_words(self, limit: int, last: int) -> ByteView:
        """Return the next words: `limit` at most, none of them later than tick `last`; fewer is for
        good. Wraps of the counter are among them. How a stream is cut into calls does not change it.
        """
        from devices.timetag_kernels import fill_poisson_words

        words = np.empty(limit * RECORD_BYTES, np.uint8)
        written = fill_poisson_words(self._state, self._now, self._scale, last, words)
        return words[: written * RECORD_BYTES]


SYNC_MASK = 1  # Channel 0 sees the laser
PIXEL_MASKS = np.array([2, 4, 8], np.uint32)
PERIOD_TICKS = 1 << 7
PULSES_PER_BLOCK = 1 << 13
SCENE_SCALE = 64
"""The scene is this many times as large as a table-top one, and its light takes as many times as long: the counter's
ticks are 1.2 m of range."""

# a divisor of the counter's range: it wraps where a block begins
BLOCK_TICKS = PERIOD_TICKS * PULSES_PER_BLOCK


class PulsedSceneStream:
    """Photons of a line of pixels after each pulse of a laser.

    Three detectors stand at a sixth, a half and five sixths of the line. Photons that one of them
    sees within a tick count as one; what several channels see within a tick is one record. Memory:
    one block of 8192 pulses.

    `light`: of the scene before it is enlarged; after that, all within the laser's period of 128
    ticks; `rate`: photons per second on the three pixels together.
    """

    def __init__(self, light: LineLight, rate: float, clock_hz: int, seed: int) -> None:
        columns = light.photons.shape[1] * np.array([1, 3, 5]) // 6
        self._cumulative_photons = np.cumsum(light.photons[:, columns])
        times = light.row_times * SCENE_SCALE
        self._row_ticks = (times[1] - times[0]) * clock_hz
        self._delays = times * clock_hz - self._row_ticks / 2
        if not 0 < rate <= clock_hz:
            raise InputError(
                f"a rate must be above 0 and at most {clock_hz} per second, got {rate:g}"
            )
        if self._delays[0] < -self._row_ticks or self._delays[-1] + self._row_ticks >= PERIOD_TICKS:
            raise InputError(
                f"the light must come within the laser's period of {PERIOD_TICKS / clock_hz:.3g} s"
            )
        self._photons_per_block = rate * BLOCK_TICKS / clock_hz
        self._seed, self._block = seed, 0
        self._ticks: IntArray = np.empty(0, np.int64)
        self._words: ByteView = np.empty(0, np.uint8)

    def next_words(self, limit: int, last: int) -> ByteView:
        taken, left = [], limit
        while left:
            if not len(self._ticks):
                self._fill_block()
            ready = min(left, int(np.searchsorted(self._ticks, last, side="right")))
            taken.append(self._words[: ready * RECORD_BYTES])
            left -= ready
            self._ticks, self._words = self._ticks[ready:], self._words[ready * RECORD_BYTES :]
            if len(self._ticks):
                break
        return np.concatenate(taken) if taken else np.empty(0, np.uint8)

    def _fill_block(self) -> None:
        """Make the records of the next pulses; the same number of a block gives the same records."""
        records = self._draw_records(np.random.default_rng([self._seed, self._block]))
        first = self._block * BLOCK_TICKS
        self._block += 1
        if first == 0:
            records = records[records["time_ticks"] > 0]  # a zero would be taken for a wrap
        elif first % COUNTER_RANGE == 0:
            records["flags"][0] = WRAP
        records["time_ticks"] += first
        self._ticks, self._words = records["time_ticks"], pack_words(records)

    def _draw_records(self, random: np.random.Generator) -> Records:
        """Draw a block's pulses and photons, in ticks since the block began."""
        total = random.poisson(self._photons_per_block)
        row, pixel = draw_cells(random, self._cumulative_photons, total, 3)
        delay = self._delays[row] + random.uniform(0, self._row_ticks, total)
        # The half of the first row that lies before its pulse belongs to the pulse before, in
        # blocks as in the counter.
        ticks = random.integers(0, PULSES_PER_BLOCK, total) * PERIOD_TICKS
        ticks = (ticks + np.floor(delay).astype(int)) % BLOCK_TICKS
        pulses = np.arange(PULSES_PER_BLOCK) * PERIOD_TICKS
        all_ticks = np.concatenate([pulses, ticks])
        sync = np.full(PULSES_PER_BLOCK, SYNC_MASK, np.uint32)
        channels = np.concatenate([sync, PIXEL_MASKS[pixel]])
        order = np.argsort(all_ticks, kind="stable")
        distinct, begins = np.unique(all_ticks[order], return_index=True)
        records = np.zeros(len(distinct), RECORD_DTYPE)
        records["time_ticks"] = distinct
        records["channels"] = np.bitwise_or.reduceat(channels[order], begins)
        return records


MAGIC = 0xAA
COMMAND = struct.Struct("<BBHI")
CLOCK_HZ = 128_000_000
VERSION = 6
SHORT_PACKET_BYTES = 510
CHIP_PACKETS = 3
MAX_REPLIES = 3  # Two in the USB chip, one in the register manager, which then hears no commands
SET_SEND_WINDOW, FLUSH = 1, 2
NO_SUCH_REGISTER = 0xFFFFFFFF
# What the gateware has: with the USB chip's packets, 3.4 ms at 680,000 records a second
BOARD_MEMORY_BYTES = 2048 * RECORD_BYTES
UNUSED_BITS = 0x1F
MAX_BATCH_RECORDS = 1 << 14
# Seconds after which an instrument whose time is not the clock's says that nothing comes
DARK_WAIT_S = 5e-3
POLL_INTERVAL_S = 4e-3


@dataclass
class GroundTruth:
    """What really happened, for comparison with what the driver says. All in records."""

    registered: int = 0  # photons that the instrument saw
    lost_memory_full: int = 0  # of these, found its memory full
    # of these, were in the memory of an instrument that lost its power, and all of
    # `lost_memory_full` before that
    lost_power_off: int = 0
    corrupted: int = 0  # of these, were handed over as something that cannot be a record


@dataclass(frozen=True)
class EmulationOptions(TimeTagOptions):
    """Values of the emulation besides the driver's own."""

    seed: int = option(0, least=0, most=(1 << 63) - 1)
    # even light on all channels, or of a scene behind three of them
    light: str = option("", choices=("poisson", "scene"))
    rate: float | None = option(None, float)  # photons per second of its clock
    # photons come when they are due, and are lost while the memory is full. Otherwise time runs as
    # fast as the host reads
    pace: str = option("", choices=("fast", "realtime"))
    records: int = option(FOREVER, least=0)  # photons after which it is dark
    # of a packet when it is switched on: 510, as of the public firmware, each of which ends a
    # transfer, or 512
    packet_bytes: int = option(SHORT_PACKET_BYTES)
    # what fits into the instrument besides the USB chip. By default far more than into a real one
    # (`BOARD_MEMORY_BYTES`), because it shares the processor with the host, which is not always
    # given its turn in time
    memory_mib: float = option(64.0, least=PACKET_BYTES / (1 << 20), most=4096)
    faults: tuple[Fault, ...] = option((), Fault.parse)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.packet_bytes not in (SHORT_PACKET_BYTES, PACKET_BYTES):
            raise InputError(
                f"a packet has {SHORT_PACKET_BYTES} or {PACKET_BYTES} bytes, got {self.packet_bytes}"
            )


class EmulatedTimeTagger(VirtualDevice):
    """The instrument. What firmware and killed programs differ in is the class's: subclasses have
    other habits. Memory: the larger of its own memory and one transfer.

    `light`: makes the light that falls on it after its counter was reset so often.
    """

    flush_discards = True  # the request to flush throws an unfinished packet away, or sends it
    # what a killed program left: replies that it never fetched, records in the USB chip and the
    # memory, and bytes of a command that was cut short
    stale_replies = 1
    old_records = 40
    jammed_bytes = 3

    def __init__(
        self,
        light: Callable[[int], PoissonStream | PulsedSceneStream],
        options: EmulationOptions,
        serial: str = "",
    ) -> None:
        super().__init__(
            USB_IDENTITY,
            ("tofclip", INSTRUMENT, serial),
            (COMMAND_ENDPOINT, DATA_ENDPOINT, REPLY_ENDPOINT),
        )
        self.truth = GroundTruth()
        self.options = options
        self._is_paced = options.pace == "realtime"
        self._make_light, self._light = light, light(0)
        self._resets = self._registered_before_reset = 0
        self._faults, self._reply_faults = (
            {at.transfer: at for at in options.faults if (at.kind in REPLY_FAULTS) is of_replies}
            for of_replies in (False, True)
        )
        self._has_started = False
        self._transfers = self._replies_asked = self._reply_delay = 0
        self._stalls = self._records_to_corrupt = 0
        self._registers = _make_registers()
        self._command = COMMAND.pack(MAGIC, 0, Register.VERSION, 0)[: self.jammed_bytes]
        self._replies = [b"\x2a\0\0\0"] * self.stale_replies
        # what is in the memory and, before that, in the USB chip: of a session before this one
        old = PoissonStream(1e6, CLOCK_HZ, 12345).next_words(self.old_records, MAX_TICK)
        self._stream = bytearray(old)
        self._window = options.packet_bytes
        self._unfinished: deque[int] = deque()  # sizes of packets that were finished by request
        self._started = monotonic()
        self._mark_lost = False
        self._segment_bytes = self._reported = 0

    def open_driver(self) -> StreamSource:
        return open_on_backend(self.options, self.strings[2], VirtualUsb(self))

    def receive(self, endpoint: int, data: bytes) -> None:
        """Take a command, byte by byte as the gateware does, and queue its reply."""
        if endpoint != COMMAND_ENDPOINT:
            raise make_usb_error(errno.EPIPE)
        # Replies that are not fetched block the register manager.
        if len(self._replies) >= MAX_REPLIES:
            return  # swallowed
        for byte in data:
            if not self._command and byte != MAGIC:
                continue
            self._command += bytes([byte])
            if len(self._command) == COMMAND.size:
                self._execute(self._command)
                self._command = b""
                return  # what comes with it finds the register manager replying

    def control(self, request: int, value: int) -> None:
        """Set how many bytes make a packet (`value`), or send or discard what is unfinished."""
        # Bytes in the USB chip that belong to no packet which was finished by request.
        chip = min(len(self._stream), CHIP_PACKETS * self._window)
        unsent = max(0, chip - sum(self._unfinished))
        rest = unsent % self._window
        if request not in (SET_SEND_WINDOW, FLUSH):
            raise make_usb_error(errno.EPIPE)
        if request == FLUSH and self.flush_discards:
            del self._stream[len(self._stream) - rest :]
            return
        self._unfinished.extend([self._window] * (unsent // self._window))
        self._unfinished.append(rest)
        if request == SET_SEND_WINDOW:
            self._window = min(max(value, 1), PACKET_BYTES)

    def fill(self, endpoint: int, buffer: memoryview, timeout: float) -> int:
        """Write a reply or time tags into `buffer`, with the faults ordered for this transfer."""
        if endpoint == REPLY_ENDPOINT:
            return self._send_reply(buffer)
        fault = None
        if self._has_started and not self._is_held_empty:  # otherwise what comes is thrown away
            fault = self._faults.get(self._transfers)
            self._transfers += 1
        if fault is not None:
            return self._apply_fault(fault, buffer, timeout)
        return self._send_data(buffer, timeout)

    def clear_halt(self, endpoint: int) -> None:
        if endpoint == DATA_ENDPOINT:
            self._stalls -= 1
        if endpoint != DATA_ENDPOINT or self._stalls <= 0:
            super().clear_halt(endpoint)

    def _execute(self, command: bytes) -> None:
        _, what, number, value = COMMAND.unpack(command)
        answer = NO_SUCH_REGISTER
        if number in set(Register):
            register = Register(number)
            if what & 1:
                self._write_register(register, value)
            answer = self._registers[register] % (1 << 32)
        self._replies.append(struct.pack("<I", answer))

    def _send_reply(self, buffer: memoryview) -> int:
        if not self._replies:
            raise make_usb_error(errno.ETIMEDOUT)
        if not self._reply_delay:
            fault = self._reply_faults.pop(self._replies_asked, None)
            self._replies_asked += 1
            if fault is not None and fault.kind == "reply_stall":
                self.halted.add(REPLY_ENDPOINT)
                raise make_usb_error(errno.EPIPE)
            if fault is not None and fault.kind == "reply_lost":
                self._replies.pop(0)
                raise make_usb_error(errno.ETIMEDOUT)
            if fault is not None:
                self._reply_delay = 1 + fault.amount
        if self._reply_delay:
            self._reply_delay -= 1
            if self._reply_delay:
                raise make_usb_error(errno.ETIMEDOUT)
        reply = self._replies.pop(0)
        buffer[: len(reply)] = reply
        return len(reply)

    def _write_register(self, register: Register, value: int) -> None:
        # Read-only.
        if register in (Register.VERSION, Register.CLOCK):
            return
        if register in (Register.RECORDS, Register.LOST):
            value = 0
        if register is Register.RECORDS:
            self._reported = self._segment_bytes = 0
        if register is Register.CLEAR and value & 1:
            self._clear_memory()
        if register is Register.CAPTURE:
            self._switch_capture(Capture(value & 7))
        self._registers[register] = value

    def _switch_capture(self, to: Capture) -> None:
        if Capture.REGISTER not in to:
            self._register_until_now()
        elif not self._has_started and self._capture is Capture.OFF and Capture.COUNT in to:
            # Registration that begins together with the counter sees its zero as a wrap.
            self.truth.registered += 1
            self._store(np.array([WRAP << 5, 0, 0, 0, 0, 0], np.uint8))
        if Capture.RESET in to and self.truth.registered > self._registered_before_reset:
            self._registered_before_reset = self.truth.registered
            self._resets += 1
            self._light = self._make_light(self._resets)
        if Capture.COUNT in to and Capture.COUNT not in self._capture:
            self._started = monotonic()
        self._has_started |= Capture.REGISTER in to

    @property
    def _capture(self) -> Capture:
        return Capture(self._registers[Register.CAPTURE] & 7)

    def _clear_memory(self) -> None:
        """Forget the memory; the USB chip keeps what it has, to the end of a record."""
        self._end_segment()
        chip = min(len(self._stream), CHIP_PACKETS * self._window)
        del self._stream[chip + (len(self._stream) - chip) % RECORD_BYTES :]
        if not self._stream:
            self._unfinished.clear()

    def _register_until_now(self, in_flight: int = 0) -> None:
        """Register what fell on it; a transfer under way takes `in_flight` bytes more."""
        if not self._is_paced or Capture.REGISTER not in self._capture:
            return
        tick = int((monotonic() - self._started) * CLOCK_HZ)
        # Photons beyond memory, chip and the transfer under way have nowhere to go.
        memory = int(self.options.memory_mib * (1 << 20))
        capacity = memory + CHIP_PACKETS * self._window + in_flight
        found = MAX_BATCH_RECORDS
        while found == MAX_BATCH_RECORDS:
            words = self._register_photons(MAX_BATCH_RECORDS, tick)
            found = len(words) // RECORD_BYTES
            room = max(0, capacity - len(self._stream)) // RECORD_BYTES * RECORD_BYTES
            self._store(words[:room])
            self._discard(words[room:])

    def _register_photons(self, limit: int, last: int = MAX_TICK) -> ByteView:
        """Return the words of the next photons, at most `limit`."""
        left = max(0, self.options.records - self.truth.registered)
        words = self._light.next_words(min(limit, left), last)
        self.truth.registered += len(words) // RECORD_BYTES
        return words

    def _store(self, words: ByteView) -> None:
        if len(words) == 0:
            return
        if self._mark_lost:
            words[0] |= LOST << 5
            self._mark_lost = False
        # Bits that have to be zero are set, by which a decoder can recognise them.
        garbled = min(self._records_to_corrupt, len(words) // RECORD_BYTES)
        words[: garbled * RECORD_BYTES] |= UNUSED_BITS
        self.truth.corrupted += garbled
        self._records_to_corrupt = 0
        self._registers[Register.RECORDS] += len(words) // RECORD_BYTES
        if not self._is_held_empty:
            self._stream += words.data

    def _discard(self, words: ByteView) -> None:
        lost = len(words) // RECORD_BYTES
        self.truth.lost_memory_full += lost
        self._registers[Register.LOST] += lost
        self._mark_lost |= lost > 0

    @property
    def _is_held_empty(self) -> bool:
        return bool(self._registers[Register.CLEAR] & 1)

    def _send_data(self, buffer: memoryview, timeout: float) -> int:
        """Send packets until the buffer is full, a short one ends the transfer, or time is up."""
        deadline = monotonic() + timeout
        self._register_until_now()  # until now no transfer was under way
        length = 0
        while True:
            taken, is_over = self._take_packets(buffer[length:])
            length += taken
            if is_over or length == len(buffer):
                break
            if not self._wait_for_photons(len(buffer) - length, deadline):
                if not length:
                    raise make_usb_error(errno.ETIMEDOUT)
                break
        if not self._is_held_empty:  # what is thrown away was not handed over
            self._segment_bytes += length
        return length

    def _take_packets(self, buffer: memoryview) -> tuple[int, bool]:
        """Move packets into the buffer; return their bytes, and whether a short one came."""
        taken = 0
        while self._unfinished:
            size = self._unfinished[0]
            if size > len(buffer) - taken:
                return taken, True
            self._unfinished.popleft()
            taken += self._take(buffer[taken : taken + size])
            if size < PACKET_BYTES:
                return taken, True
        if self._window == PACKET_BYTES:
            whole = min(len(self._stream), len(buffer) - taken) // PACKET_BYTES * PACKET_BYTES
            return taken + self._take(buffer[taken : taken + whole]), False
        if len(self._stream) < self._window:
            return taken, False
        size = min(self._window, len(buffer) - taken)
        return taken + self._take(buffer[taken : taken + size]), True

    def _take(self, buffer: memoryview) -> int:
        """Move bytes from the front of the stream into `buffer`, as many as fit."""
        length = min(len(self._stream), len(buffer))
        with memoryview(self._stream) as stream:
            buffer[:length] = stream[:length]
        del self._stream[:length]
        return length

    def _wait_for_photons(self, room: int, deadline: float) -> bool:
        """Wait for more; False when nothing more comes in time."""
        if self._is_paced:
            if Capture.REGISTER not in self._capture or monotonic() >= deadline:
                return False
            sleep(min(POLL_INTERVAL_S, max(deadline - monotonic(), 0)))
            self._register_until_now(room)
            return True
        wanted = room if self._window == PACKET_BYTES else min(self._window, room)
        before = len(self._stream)
        if Capture.REGISTER in self._capture:
            missing = max(wanted - len(self._stream), 1)
            self._store(self._register_photons(-(-missing // RECORD_BYTES)))
        if len(self._stream) > before:
            return True
        sleep(max(0.0, min(deadline - monotonic(), DARK_WAIT_S)))
        return False

    def _send_cut(self, buffer: memoryview, timeout: float) -> int:
        """Fill a small buffer with the beginning of what there is."""
        while len(self._stream) < len(buffer):
            if not self._wait_for_photons(len(buffer), monotonic() + timeout):
                break
        length = self._take(buffer)
        rest = length
        while rest and self._unfinished:
            part = min(rest, self._unfinished[0])
            self._unfinished[0] -= part
            rest -= part
            if not self._unfinished[0]:
                self._unfinished.popleft()
        if not length:
            raise make_usb_error(errno.ETIMEDOUT)
        if not self._is_held_empty:
            self._segment_bytes += length
        return length

    def _apply_fault(self, fault: Fault, buffer: memoryview, timeout: float) -> int:
        """Do what a fault orders: some are an exception, some a smaller or stranger transfer."""
        # Faults of the transfer itself come first, then those of its contents.
        if fault.kind == "timeout":
            raise make_usb_error(errno.ETIMEDOUT)
        if fault.kind == "stall":
            self.halted.add(DATA_ENDPOINT)
            self._stalls = fault.amount
            raise make_usb_error(errno.EPIPE)
        if fault.kind in ("unplug", "powerloss"):
            if fault.kind == "powerloss":
                self._lose_power()
            self.unplug(fault.amount)
            raise make_usb_error(errno.ENODEV)
        if fault.kind == "overflow":
            lost_on_the_wire = self._send_data(buffer, timeout)
            if not self._is_held_empty:
                self._segment_bytes -= lost_on_the_wire
            raise make_usb_error(errno.EOVERFLOW)
        if fault.kind == "short":
            return self._send_cut(buffer[: max(1, min(fault.amount, len(buffer)))], timeout)
        if fault.kind == "lost":
            self._discard(self._register_photons(fault.amount))
        else:
            self._records_to_corrupt = fault.amount
        return self._send_data(buffer, timeout)

    def _lose_power(self) -> None:
        self._end_segment()
        self._stream.clear()
        self._unfinished.clear()
        self._window = self.options.packet_bytes
        self._replies.clear()
        self._command = b""
        counted = self._registers[Register.RECORDS] + self._registers[Register.LOST]
        self.truth.lost_power_off += counted - self._reported
        self._registers = _make_registers()
        self._reported = 0
        self._mark_lost = False

    def _end_segment(self) -> None:
        """Count what was handed over since something was thrown away, a part of a record as one."""
        self._reported += -(-self._segment_bytes // RECORD_BYTES)
        self._segment_bytes = 0


def _make_registers() -> dict[Register, int]:
    return {**dict.fromkeys(Register, 0), Register.VERSION: VERSION, Register.CLOCK: CLOCK_HZ}


POISSON_RATE_HZ = 12_800_000.0
SCENE_RATE_HZ = 1_000_000.0


def open_timetag(uri: Uri) -> StreamSource:
    """Open ``sim+timetag://?seed=1``: an emulated time tagger behind the real driver. The board's
    own memory, with which it loses what a loaded computer does not fetch within 3 ms, is
    ``memory_mib=0.01172``.
    """
    options = EmulationOptions.from_uri(uri)
    is_scene = options.light == "scene"
    usual = SCENE_RATE_HZ if is_scene else POISSON_RATE_HZ
    rate = usual if options.rate is None else options.rate

    def make_light(resets: int) -> PoissonStream | PulsedSceneStream:
        how = rate, CLOCK_HZ, options.seed + resets
        return PulsedSceneStream(simulate_light("small"), *how) if is_scene else PoissonStream(*how)

    # The real ones have no serial number.
    return EmulatedTimeTagger(make_light, options, uri.location).open_driver()
