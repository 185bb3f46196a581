"""Histogram kits on a serial port as a source of frames (bins, zones)."""

from __future__ import annotations

import contextlib
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from time import monotonic
from typing import Any

import numpy as np

from devices.clock import InstrumentClock
from devices.histogram_kits.protocol import (
    MAX_LINE_BYTES,
    VL53_NATIVE_BIN_S,
    KitFrame,
    Parser,
    Tmf8828Parser,
    Vl53l8Parser,
)
from devices.ledger import Ledger
from devices.ring import Gap
from devices.source import Info
from devices.stream import (
    STREAM_OPTIONS,
    StreamSource,
    Transfer,
    parse_buffer_settings,
    parse_seconds,
    retry_connect,
)
from devices.uri import Uri
from tofclip.errors import (
    DeviceDisconnectedError,
    DeviceNotFoundError,
    DeviceTimeoutError,
    InputError,
    MissingDependencyError,
)
from tofclip.storage import Field, Record

COMMON_OPTIONS = ("baud", "start", "zones", "reconnect_s", *STREAM_OPTIONS)
TMF8828_OPTIONS = ("bin_ps", *COMMON_OPTIONS)
VL53L8_OPTIONS = ("bins", "sub_sample", "start_bin", *COMMON_OPTIONS)
TMF8828_BAUD, VL53L8_BAUD = 1_000_000, 460_800
TMF8828_START = "ezm"
"""Enable, dump histograms, measure: the state after the reset that opening the port brings."""

READ_BYTES = 1 << 16
PICOSECOND_S = 1e-12


@dataclass(frozen=True)
class KitSettings:
    """How to talk to a kit."""

    instrument: str  # what it is, in words
    port: str  # of the operating system, e.g. ``/dev/ttyACM0``
    baud: int
    # commands that begin and end measuring; empty for programs that measure by themselves
    start: bytes
    # commands that begin and end measuring; empty for programs that measure by themselves
    stop: bytes
    bin_width: float  # duration of a bin and middle of the first one, s
    first_bin: float  # duration of a bin and middle of the first one, s
    reconnect: float  # s to wait for a kit that went away


class KitFeed:
    """Frames as a kit sends them; see `devices.stream.Feed`.

    Frames of which lines are missing or torn are malformed; those that the kit's numbers show to be
    missing are lost by the instrument.

    `make_parser`: returns a new parser: nothing of what came before a broken connection is of use
    behind it.
    """

    def __init__(
        self, settings: KitSettings, make_parser: Callable[[], Parser], ledger: Ledger
    ) -> None:
        self._settings, self._make_parser, self._ledger = settings, make_parser, ledger
        self._clock = InstrumentClock()
        self._number, self._gap = 0, Gap.NONE
        self._ready: deque[tuple[int, bytes, float]] = deque()
        self._is_stopped = False
        self._open_port()
        self.codec = self._parser.codec

    @property
    def info(self) -> Info:
        settings, codec = self._settings, self.codec
        shape = {"bins": codec.rows, "zones": codec.columns, "bin_width_s": settings.bin_width}
        limits = "written from public programs; no such kit was at hand"
        return Info(settings.instrument, "", {"port": settings.port, **shape, "limits": limits})

    @property
    def calibration(self) -> Record | None:
        """Middle of each bin, s, and what a stored count stands for."""
        times = self._settings.first_bin + self._settings.bin_width * np.arange(self.codec.rows)
        return Record(
            "histograms",
            {"bin_times": Field(times, "s", ("bin",))},
            {"count_scale": self._parser.scale},
        )

    def start(self) -> None:
        with self._translate_errors():
            self._port.write(self._settings.start)

    def pull(self, timeout: float) -> Transfer | None:
        deadline = monotonic() + timeout
        while not self._ready:
            if self._is_stopped:
                return None
            try:
                data = self._read_available(max(0.0, deadline - monotonic()))
            except DeviceDisconnectedError:
                retry_connect(self._reopen, self._settings.reconnect)
                self._ledger.reconnect()
                self._gap = Gap.RESTART
                continue
            if data:
                self._parse(data)
            elif monotonic() >= deadline:
                raise DeviceTimeoutError(
                    f"{self._settings.port} sent no histogram; is it the kit's?"
                )
        number, pixels, taken_at = self._ready.popleft()
        gap, self._gap = self._gap, Gap.NONE
        return Transfer(memoryview(self.codec.pack_frame(number, pixels)), gap, taken_at)

    def stop(self) -> None:
        self._is_stopped = True
        with self._translate_errors():
            self._port.write(self._settings.stop)
            self._port.flush()

    def close(self) -> None:
        self._port.close()

    def _open_port(self) -> None:
        serial = _import_serial()
        self._parser = self._make_parser()
        self._line, self._is_line_too_long = b"", False
        self._clock.reset()
        try:
            self._port = serial.Serial(self._settings.port, self._settings.baud, timeout=0)
        except (OSError, ValueError) as fault:
            raise DeviceNotFoundError(
                f"{self._settings.port} cannot be opened ({fault}); is the kit connected?"
            ) from fault

    def _reopen(self) -> None:
        self._port.close()
        self._open_port()
        self.start()

    def _read_available(self, timeout: float) -> bytes:
        with self._translate_errors():
            self._port.timeout = timeout
            data: bytes = self._port.read(1)
            if data:
                self._port.timeout = 0
                data += self._port.read(READ_BYTES)
            return data

    def _parse(self, data: bytes) -> None:
        *lines, self._line = (self._line + data).split(b"\n")
        for line in lines:
            # The rest of a line that was too long is no line.
            whole, self._is_line_too_long = not self._is_line_too_long, False
            frame = self._parser.parse_line(line.strip(b"\r")) if whole else None
            if frame is not None:
                self._take_frame(frame)
        if len(self._line) > MAX_LINE_BYTES:
            self._line, self._is_line_too_long = b"", True

    def _take_frame(self, frame: KitFrame) -> None:
        if frame.missing:
            self._ledger.lose(frame.missing)
            self._number += frame.missing
            self._gap = max(self._gap, Gap.LOSS)
        number, self._number = self._number, self._number + 1
        if frame.counts is None:
            self._ledger.truncate()
            self._gap = max(self._gap, Gap.LOSS)
            return
        taken_at = 0.0
        if frame.stamp is not None:
            self._clock.observe(frame.stamp, monotonic())
            taken_at = self._clock.to_host(frame.stamp)
        self._ready.append((number, frame.counts.astype("<u4").tobytes(), taken_at))

    @contextlib.contextmanager
    def _translate_errors(self) -> Iterator[None]:
        try:
            yield
        except OSError as fault:  # pyserial's own are such
            raise DeviceDisconnectedError(f"{self._settings.port}: {fault}") from fault


def _import_serial() -> Any:
    try:
        import serial
    except ImportError as fault:
        raise MissingDependencyError(
            "histogram kits need pyserial: pip install 'tofclip[serial]'"
        ) from fault
    return serial


def open_tmf8828(uri: Uri) -> StreamSource:
    """Open ``tmf8828:///dev/ttyACM0?bin_ps=PS&zones=64&baud=1000000&start=ezm``.

    The duration of a bin depends on the kit's settings and has to be given. ``start`` are the
    letters that begin measuring; none for a program that measures by itself.
    """
    uri.reject_unknown(*TMF8828_OPTIONS)
    settings, zones = parse_tmf8828(uri, _find_port(uri))
    return _open_kit(uri, settings, lambda: Tmf8828Parser(zones))


def open_vl53l8(uri: Uri) -> StreamSource:
    """Open ``vl53l8:///dev/ttyACM0?zones=16&bins=24&sub_sample=4&start_bin=0&baud=460800``, as the
    kit's program was set.
    """
    uri.reject_unknown(*VL53L8_OPTIONS)
    settings, zones, bins = parse_vl53l8(uri, _find_port(uri))
    return _open_kit(uri, settings, lambda: Vl53l8Parser(zones, bins))


def _open_kit(uri: Uri, settings: KitSettings, make_parser: Callable[[], Parser]) -> StreamSource:
    held, ledger = parse_buffer_settings(uri), Ledger()
    feed = KitFeed(settings, make_parser, ledger)
    return StreamSource(feed, feed.codec, ledger, held)


def parse_tmf8828(uri: Uri, port: str) -> tuple[KitSettings, int]:
    """Read the values of a TMF8828's address; return how to talk to it, and its zones."""
    width = uri.value("bin_ps", float, 0.0)
    if not 0 < width < 1e6:
        raise InputError(f"'{uri.text}': add bin_ps=..., the duration of a bin as the kit was set")
    start = uri.value("start", str, TMF8828_START).encode()
    settings = KitSettings(
        "TMF8828 histogram kit",
        port,
        uri.value("baud", int, TMF8828_BAUD),
        start,
        b"s" if start else b"",
        width * PICOSECOND_S,
        width * PICOSECOND_S / 2,
        parse_seconds(uri, "reconnect_s", 5.0),
    )
    return settings, uri.value("zones", int, 64)


def parse_vl53l8(uri: Uri, port: str) -> tuple[KitSettings, int, int]:
    """Read the values of a VL53L8CH's address; return how to talk to it, its zones and bins."""
    merged, first = uri.value("sub_sample", int, 4), uri.value("start_bin", int, 0)
    if not (1 <= merged <= 64 and 0 <= first <= 144):
        raise InputError(f"'{uri.text}': sub_sample is within 1..64, start_bin within 0..144")
    start = uri.value("start", str, "").encode()
    width = merged * VL53_NATIVE_BIN_S
    settings = KitSettings(
        "VL53L8CH histogram kit",
        port,
        uri.value("baud", int, VL53L8_BAUD),
        start,
        b"",
        width,
        first * VL53_NATIVE_BIN_S + width / 2,
        parse_seconds(uri, "reconnect_s", 5.0),
    )
    return settings, uri.value("zones", int, 16), uri.value("bins", int, 24)


def _find_port(uri: Uri) -> str:
    if not uri.location:
        raise InputError(
            f"'{uri.text}': name the serial port, as in {uri.scheme}:///dev/ttyACM0?..."
        )
    return uri.location
