"""Histogram kits made of software, behind a pseudo-terminal."""

from __future__ import annotations

import contextlib
import os
import select
import threading
import time
import tty
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from devices.address import Uri
from devices.histogram_kits import (
    TMF8828_OPTIONS,
    TMF_TICK_S,
    VL53L8_OPTIONS,
    KitFeed,
    KitSettings,
    Parser,
    Tmf8828Parser,
    Vl53l8Parser,
    format_tmf8828,
    format_vl53l8,
    parse_tmf8828,
    parse_vl53l8,
)
from devices.source import Info, Ledger
from devices.stream import StreamSource, parse_buffer_settings
from tofclip.errors import InputError
from tofclip.units import SPEED_OF_LIGHT

LineFormatter = Callable[[NDArray[np.uint32], int, int], list[bytes]]
PEAK_COUNTS, BACKGROUND_COUNTS = 400.0, 4.0
PULSE_BINS = 1.5
"""Standard deviation of the emulated pulse."""


def compute_zone_ranges(zones: int) -> NDArray[np.float64]:
    """Return how far the emulated scene, an inclined wall, is in each zone, m."""
    return 0.5 + 1.0 * np.arange(zones) / zones


class EmulatedKit:
    """A kit that sends frames once it has been asked to, or at once where it needs no asking.

    `settings`: of the driver, but for the port; `parser`: the driver's, for the histograms' shape;
    `format_lines`: from counts, the frame's number and its tick to lines; `rate`: frames per
    second; `torn, lost`: of this number of frames one has a line cut, or is not sent; 0 for none.
    """

    def __init__(
        self,
        settings: KitSettings,
        parser: Parser,
        format_lines: LineFormatter,
        seed: int,
        rate: float,
        torn: int = 0,
        lost: int = 0,
    ) -> None:
        if not 0 < rate <= 1000 or seed < 0 or torn < 0 or lost < 0:
            raise InputError("a kit's rate is within 0..1000 per second, its seed not negative")
        self._settings, self._format = settings, format_lines
        self._rate, self._seed, self._torn, self._lost = rate, seed, torn, lost
        self._bins, self._zones = parser.codec.rows, parser.codec.columns
        self._controller, self._terminal = os.openpty()
        tty.setraw(self._terminal)  # without echo, as a serial port
        self.port = os.ttyname(self._terminal)
        self._closing = threading.Event()
        self._measuring = not settings.start
        self.taken = 0
        """Frames taken so far, sent or not."""
        self._thread = threading.Thread(target=self._run, name="emulated kit", daemon=True)
        self._thread.start()

    def draw_counts(self, number: int) -> NDArray[np.uint32]:
        """Return frame `number`'s counts (bins, zones); the same number gives the same frame."""
        times = self._settings.first_bin + self._settings.bin_width * np.arange(self._bins)
        delays = 2 * compute_zone_ranges(self._zones) / SPEED_OF_LIGHT
        off = (times[:, np.newaxis] - delays) / (PULSE_BINS * self._settings.bin_width)
        light = BACKGROUND_COUNTS + PEAK_COUNTS * np.exp(-(off**2) / 2)
        return np.random.default_rng([self._seed, number]).poisson(light).astype(np.uint32)

    def close(self) -> None:
        """Unplug it."""
        self._closing.set()
        self._thread.join(2)
        for end in (self._controller, self._terminal):
            with contextlib.suppress(OSError):
                os.close(end)

    def _run(self) -> None:
        began = time.monotonic()
        while not self._closing.is_set():
            self._read_commands(0.0 if self._measuring else 0.02)
            if not self._measuring:
                began = time.monotonic() - self.taken / self._rate
                continue
            due = began + self.taken / self._rate
            if self._closing.wait(max(0.0, due - time.monotonic())):
                return
            number, self.taken = self.taken, self.taken + 1
            tick = round((time.monotonic() - began + 1) / TMF_TICK_S) % (1 << 32)
            lines = self._format(self.draw_counts(number), number, tick)
            if self._torn and number % self._torn == self._torn - 1:
                lines[len(lines) // 2] = lines[len(lines) // 2][:20]
            if not (self._lost and number % self._lost == self._lost - 1):
                self._write(b"".join(lines))

    def _read_commands(self, timeout: float) -> None:
        ready, _, _ = select.select([self._controller], [], [], timeout)
        for letter in os.read(self._controller, 64) if ready else b"":
            if self._settings.start and letter in b"ms":
                self._measuring = letter == b"m"[0]

    def _write(self, data: bytes) -> None:
        left = memoryview(data)
        while left and not self._closing.is_set():
            _, ready, _ = select.select([], [self._controller], [], 0.05)
            if ready:
                left = left[os.write(self._controller, left[:4096]) :]


class EmulatedFeed(KitFeed):
    """Frames of an emulated kit, which is unplugged when they are closed."""

    def __init__(self, kit: EmulatedKit, settings: KitSettings, make: Callable[[], Parser]) -> None:
        self._kit = kit
        self.ledger = Ledger()
        super().__init__(replace(settings, port=kit.port), make, self.ledger)

    @property
    def info(self) -> Info:
        known = super().info
        return replace(known, instrument=f"emulated {known.instrument}")

    def close(self) -> None:
        super().close()
        self._kit.close()


def open_tmf8828(uri: Uri) -> StreamSource:
    """Open ``sim+tmf8828://?seed=1&rate=5&bin_ps=250``: an emulated kit that looks at an inclined
    wall. ``torn=N`` and ``lost=N`` cut or lose every Nth frame.
    """
    uri.reject_unknown(*TMF8828_OPTIONS, "seed", "rate", "torn", "lost")
    usual = replace(uri, values={"bin_ps": "250", **uri.values})
    settings, zones = parse_tmf8828(usual, "")
    return _open_emulated(usual, settings, lambda: Tmf8828Parser(zones), format_tmf8828)


def open_vl53l8(uri: Uri) -> StreamSource:
    """Open ``sim+vl53l8://?seed=1&rate=5&sub_sample=4``, likewise."""
    uri.reject_unknown(*VL53L8_OPTIONS, "seed", "rate", "torn", "lost")
    settings, zones, bins = parse_vl53l8(uri, "")
    return _open_emulated(
        uri,
        settings,
        lambda: Vl53l8Parser(zones, bins),
        lambda counts, number, tick: format_vl53l8(counts),
    )


def _open_emulated(
    uri: Uri, settings: KitSettings, make_parser: Callable[[], Parser], format_lines: LineFormatter
) -> StreamSource:
    held = parse_buffer_settings(uri)
    kit = EmulatedKit(
        settings,
        make_parser(),
        format_lines,
        uri.value("seed", int, 0),
        uri.value("rate", float, 5.0),
        uri.value("torn", int, 0),
        uri.value("lost", int, 0),
    )
    try:
        feed = EmulatedFeed(kit, settings, make_parser)
    except BaseException:
        kit.close()
        raise
    return StreamSource(feed, feed.codec, feed.ledger, held)
