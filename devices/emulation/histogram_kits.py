"""Histogram kits made of software, behind a pseudo-terminal."""

from __future__ import annotations

import contextlib
import os
import select
import threading
import time
import tty
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from devices.address import Options, Uri, option
from devices.emulation.harness import open_on
from devices.histogram_kits import (
    TMF_BINS,
    TMF_CAPTURES,
    TMF_CHANNELS,
    TMF_LANES,
    TMF_NUMBERS,
    TMF_TICK_S,
    VL53_SCALE,
    KitFeed,
    Tmf8828Options,
    Vl53l8Options,
    find_tmf_zones,
)
from devices.stream import StreamSource
from tofclip.arrays import AnyArray, FloatArray
from tofclip.units import SPEED_OF_LIGHT

PEAK_COUNTS, BACKGROUND_COUNTS = 400.0, 4.0
PULSE_S = 0.375e-9  # Standard deviation of the emulated pulse


def format_tmf8828(counts: AnyArray, number: int, tick: int) -> list[bytes]:
    """Return the lines that a TMF8828's program sends for a frame; the inverse of `Tmf8828Parser`.
    `counts` (128, zones); `number`: of the frame; `tick`: 0.2 us. Returns with their ends.
    """
    counts = counts[:, find_tmf_zones(counts.shape[1])]
    captures, halves = (TMF_CAPTURES, 2) if counts.shape[1] == 64 else (1, 1)
    width = counts.shape[1] // captures
    lines = []
    for place in range(captures):
        some = counts[:, place * width : (place + 1) * width].T.reshape(halves, -1, TMF_BINS)
        for half in range(halves):
            for lane in range(TMF_LANES):
                channel, shift = lane % TMF_CHANNELS, 8 * (lane // TMF_CHANNELS)
                values = np.zeros(TMF_BINS, np.int64)
                if 1 <= channel <= some.shape[1]:
                    values = some[half, channel - 1].astype(np.int64) >> shift & 0xFF
                words = ",".join(map(str, values.tolist()))
                lines.append(f"#Raw,65,{half * TMF_LANES + lane},{words}\r\n".encode())
        result = (number * captures + place) % TMF_NUMBERS
        lines.append(f"#Obj,65,{result},25,{width},{tick}{',0' * 72}\r\n".encode())
    return lines


def format_vl53l8(counts: AnyArray, number: int = 0, tick: int = 0) -> list[bytes]:
    """Return the lines that a VL53L8CH's program sends for counts (bins, zones)."""
    lines = [b"Ranging Results:\r\n"]
    for zone, column in enumerate(counts.T):
        words = "".join(f"{value / VL53_SCALE:.1f}, " for value in column.tolist())
        lines.append(f"Aggregate {zone}, Ambient: 0.5, Bins: {words}\r\n".encode())
    return lines


def compute_zone_ranges(zones: int) -> FloatArray:
    """Return how far the emulated scene, an inclined wall, is in each zone, m."""
    return 0.5 + 1.0 * np.arange(zones) / zones


@dataclass(frozen=True)
class EmulationOptions(Options):
    """Values of the emulation besides the driver's own: frames per second, and of which number of
    frames one has a line cut (`torn`), or is not sent (`lost`); 0 for none.
    """

    seed: int = option(0, least=0)
    rate: float = option(5.0, above=0, most=1000)
    torn: int = option(0, least=0)
    lost: int = option(0, least=0)


@dataclass(frozen=True)
class EmulatedTmf8828Options(EmulationOptions, Tmf8828Options):
    """Of a TMF8828."""

    bin_ps: float = option(250.0)
    format_lines: ClassVar = staticmethod(format_tmf8828)


@dataclass(frozen=True)
class EmulatedVl53l8Options(EmulationOptions, Vl53l8Options):
    """Of a VL53L8CH."""

    format_lines: ClassVar = staticmethod(format_vl53l8)


EmulatedOptions = EmulatedTmf8828Options | EmulatedVl53l8Options


class EmulatedKit:
    """A kit that sends frames once it has been asked to, or at once where it needs no asking."""

    def __init__(self, options: EmulatedOptions) -> None:
        self._options = options
        self._controller, self._terminal = os.openpty()
        tty.setraw(self._terminal)  # without echo, as a serial port
        self.port = os.ttyname(self._terminal)
        self._closing = threading.Event()
        self._measuring = not options.start
        self.taken = 0
        """Frames taken so far, sent or not."""
        self._thread = threading.Thread(target=self._run, name="emulated kit", daemon=True)
        self._thread.start()

    def draw_counts(self, number: int) -> NDArray[np.uint32]:
        """Return frame `number`'s counts (bins, zones); the same number gives the same frame."""
        options = self._options
        times = options.begin + options.bin_width * (np.arange(options.bins) + 0.5)
        delays = 2 * compute_zone_ranges(options.zones) / SPEED_OF_LIGHT
        off = (times[:, np.newaxis] - delays) / PULSE_S
        light = BACKGROUND_COUNTS + PEAK_COUNTS * np.exp(-(off**2) / 2)
        return np.random.default_rng([options.seed, number]).poisson(light).astype(np.uint32)

    def close(self) -> None:
        self._closing.set()
        self._thread.join(2)
        for end in (self._controller, self._terminal):
            with contextlib.suppress(OSError):
                os.close(end)

    def _run(self) -> None:
        options, began = self._options, time.monotonic()
        while not self._closing.is_set():
            wait_s = 0.0 if self._measuring else 0.02
            asked, _, _ = select.select([self._controller], [], [], wait_s)
            for letter in os.read(self._controller, 64) if asked else b"":
                if options.start and letter in b"ms":
                    self._measuring = letter == b"m"[0]
            if not self._measuring:
                began = time.monotonic() - self.taken / options.rate
                continue
            due = began + self.taken / options.rate
            if self._closing.wait(max(0.0, due - time.monotonic())):
                return
            number, self.taken = self.taken, self.taken + 1
            tick = round((time.monotonic() - began + 1) / TMF_TICK_S) % (1 << 32)
            lines = options.format_lines(self.draw_counts(number), number, tick)
            if options.torn and (number + 1) % options.torn == 0:
                lines[len(lines) // 2] = lines[len(lines) // 2][:20]
            if not (options.lost and (number + 1) % options.lost == 0):
                self._write(b"".join(lines))

    def _write(self, data: bytes) -> None:
        left = memoryview(data)
        while left and not self._closing.is_set():
            _, ready, _ = select.select([], [self._controller], [], 0.05)
            if ready:
                left = left[os.write(self._controller, left[:4096]) :]


def open_tmf8828(uri: Uri) -> StreamSource:
    """Open ``sim+tmf8828://?seed=1&rate=5&bin_ps=250``: an emulated kit that looks at an inclined
    wall. ``torn=N`` and ``lost=N`` cut or lose every Nth frame.
    """
    return _open_emulated(EmulatedTmf8828Options.from_uri(uri))


def open_vl53l8(uri: Uri) -> StreamSource:
    """Open ``sim+vl53l8://?seed=1&rate=5&sub_sample=4``, likewise."""
    return _open_emulated(EmulatedVl53l8Options.from_uri(uri))


def _open_emulated(options: EmulatedOptions) -> StreamSource:
    kit = EmulatedKit(options)
    return open_on(kit, lambda: KitFeed(kit.port, options), options)
