"""The lines of text that the kits' public programs send, to histograms (bins, zones).

TMF8828 (ams' Arduino program; single letters are its commands, e.g. ``m`` to measure): the bytes of
each histogram's 128 bins come in three lines ``#Raw,ADDRESS,INDEX,b0,...,b127``. INDEX modulo 10 is
the channel, of which 0 is the reference; 0..9 are the lowest bytes, 10..19 the middle ones, 20..29
the highest, and in 8 x 8 mode 30 more follow for the second half. Then comes
``#Obj,ADDRESS,NUMBER,TEMPERATURE,VALID,TICK,...`` with the sensor's own distances. In 8 x 8 mode
four such captures make a frame; NUMBER modulo 4 is the capture's place.

VL53L8CH (the Arduino library's example of compact histograms): for each zone a line ``Aggregate I,
Ambient: A, Bins: v, v, ...``.

Both are texts of programs that anybody may change, so lengths are checked and nothing is assumed of
lines that are not known.

Histogram kits on a serial port as a source of frames (bins, zones).
"""

from __future__ import annotations

import contextlib
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from time import monotonic
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from devices.address import Uri
from devices.frames import FrameCodec
from devices.source import Gap, Info, Ledger
from devices.stream import (
    STREAM_OPTIONS,
    InstrumentClock,
    StreamSource,
    Transfer,
    parse_buffer_settings,
    parse_seconds,
    retry_connect,
)
from tofclip.errors import (
    DeviceDisconnectedError,
    DeviceNotFoundError,
    DeviceTimeoutError,
    InputError,
    MissingDependencyError,
)
from tofclip.storage import Field, Record

MAX_LINE_BYTES = 1 << 13
TMF_BINS, TMF_CHANNELS, TMF_LANES = 128, 10, 30
TMF_CAPTURES, TMF_NUMBERS = 4, 256
TMF_TICK_S = 2e-7
"""s; the sensor's clock of 5 MHz."""

TMF_ZONES = (64, 9)
VL53_NATIVE_BIN_S = 2 * 37.5348e-3 / 299_792_458
"""s; of the 37.5348 mm that ST gives for a bin."""

VL53_SCALE = 10
"""Counts are sent with one digit after the point."""


@dataclass(frozen=True)
class KitFrame:
    """What was sent for one frame."""

    counts: NDArray[np.uint32] | None  # (bins, zones), none where lines of it are missing
    missing: int = 0  # frames that the kit took before it and never sent
    stamp: float | None = None  # s of the kit's clock


class Parser(Protocol):
    """Puts frames together from lines."""

    @property
    def codec(self) -> FrameCodec:
        """Histograms as pictures of one row for each bin, one column for each zone."""

    @property
    def scale(self) -> float:
        """Photons, or whatever the kit counts, that one stored count stands for."""

    def parse_line(self, line: bytes) -> KitFrame | None:
        """Take the next line; return the frame that it completes, if it does."""


@dataclass
class Tmf8828Parser:
    """See the module's text. Zones are in the order in which they come: captures, then halves, then
    channels; where each of them looks is the optics' matter.
    """

    zones: int = 64  # 64, or 9 for the 3 x 3 mode
    scale: float = field(default=1.0, init=False)

    def __post_init__(self) -> None:
        if self.zones not in TMF_ZONES:
            raise InputError(f"a TMF8828 has 64 zones or 9, not {self.zones}")
        self._captures = TMF_CAPTURES if self.zones == 64 else 1
        self._halves = 2 if self.zones == 64 else 1
        self._last_number: int | None = None
        self._counts = np.zeros((TMF_BINS, self.zones), np.uint32)
        self._complete = 0
        self._begin_capture()

    @property
    def codec(self) -> FrameCodec:
        return FrameCodec(TMF_BINS, self.zones, 32)

    def parse_line(self, line: bytes) -> KitFrame | None:
        if line.startswith(b"#Raw,"):
            self._add_lane(line)
            return None
        return self._end_capture(line) if line.startswith(b"#Obj,") else None

    def _begin_capture(self) -> None:
        self._lanes = np.zeros((self._halves, TMF_LANES, TMF_BINS), np.uint32)
        self._seen = np.zeros((self._halves, TMF_LANES), bool)

    def _add_lane(self, line: bytes) -> None:
        numbers = _parse_integers(line.split(b",")[2:])
        if numbers is None or len(numbers) != TMF_BINS + 1:
            return
        half, lane = divmod(int(numbers[0]), TMF_LANES)
        # Some versions number both halves from 0.
        if half == 0 and self._halves == 2 and self._seen[0, lane]:
            half = 1
        if half < self._halves:
            self._lanes[half, lane] = numbers[1:]
            self._seen[half, lane] = True

    def _end_capture(self, line: bytes) -> KitFrame | None:
        numbers = _parse_integers(line.split(b",")[2:6])
        if numbers is None or len(numbers) != 4:
            return None
        number, tick = int(numbers[0]) % TMF_NUMBERS, int(numbers[3])
        place = number % self._captures
        if self._seen.all():
            lanes = self._lanes.reshape(self._halves, 3, TMF_CHANNELS, TMF_BINS)
            # Counts of 24 bits come as three lines of bytes, the lowest first.
            channels = lanes[:, 0] | lanes[:, 1] << 8 | lanes[:, 2] << 16
            # Channel 0 is the reference that looks at the emitter, not at the scene.
            looking = channels[:, 1 : 1 + self.zones // (self._captures * self._halves)]
            width = self.zones // self._captures
            self._counts[:, place * width : (place + 1) * width] = looking.reshape(width, -1).T
            self._complete |= 1 << place
        self._begin_capture()
        if place != self._captures - 1:
            return None
        return self._end_frame(number // self._captures, tick)

    def _end_frame(self, number: int, tick: int) -> KitFrame:
        is_whole = self._complete == (1 << self._captures) - 1
        self._complete = 0
        missing = 0
        if self._last_number is not None:
            missing = (number - self._last_number - 1) % (TMF_NUMBERS // self._captures)
        self._last_number = number
        counts = self._counts.copy() if is_whole else None
        return KitFrame(counts, missing, tick * TMF_TICK_S if tick else None)


@dataclass
class Vl53l8Parser:
    """See the module's text."""

    zones: int = 16  # as the kit's program was set
    bins: int = 24  # as the kit's program was set
    scale: float = field(default=1 / VL53_SCALE, init=False)

    def __post_init__(self) -> None:
        if not (1 <= self.zones <= 64 and 1 <= self.bins <= 144):
            raise InputError(
                f"a VL53L8CH has up to 64 zones and 144 bins, not {self.zones} and {self.bins}"
            )
        self._counts = np.zeros((self.bins, self.zones), np.uint32)
        self._next = 0

    @property
    def codec(self) -> FrameCodec:
        return FrameCodec(self.bins, self.zones, 32)

    def parse_line(self, line: bytes) -> KitFrame | None:
        if not line.startswith(b"Aggregate "):
            return None
        head, _, tail = line.partition(b"Bins:")
        zone = _parse_integers([head.removeprefix(b"Aggregate ").split(b",")[0]])
        values = _parse_floats([word for word in tail.split(b",") if word.strip()])
        if zone is None:
            return None
        place = int(zone[0])
        if place == 0:
            self._next = 0
        # Behind every value stands a comma: without the last one it may have lost digits.
        is_ended = tail.rstrip().endswith(b",")
        is_sound = is_ended and values is not None and len(values) == self.bins
        is_sound = is_sound and place == self._next
        if values is not None and is_sound:
            # The sensor subtracts the ambient light itself, which may leave less than nothing.
            self._counts[:, place] = np.rint(np.clip(values, 0, 4e8) * VL53_SCALE)
            self._next += 1
        else:
            self._next = -1  # wait for the next beginning
        if place != self.zones - 1:
            return None
        is_whole, self._next = self._next == self.zones, 0
        return KitFrame(self._counts.copy() if is_whole else None)


def _parse_integers(words: list[bytes]) -> NDArray[np.int64] | None:
    if not all(word.strip().isdigit() and len(word) < 12 for word in words):
        return None
    return np.array([int(word) for word in words], np.int64)


def _parse_floats(words: list[bytes]) -> NDArray[np.float64] | None:
    try:
        found = np.array([float(word) for word in words], np.float64)
    except ValueError:
        return None
    return found if np.all(np.isfinite(found)) else None


def format_tmf8828(counts: NDArray[Any], number: int, tick: int) -> list[bytes]:
    """Return the lines that a TMF8828's program sends for a frame; the inverse of `Tmf8828Parser`.

    `counts` (128, zones); `number`: of the frame; `tick`: 0.2 us. Returns with their ends.
    """
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


def format_vl53l8(counts: NDArray[Any]) -> list[bytes]:
    """Return the lines that a VL53L8CH's program sends for a frame of counts (bins, zones)."""
    lines = [b"Ranging Results:\r\n"]
    for zone, column in enumerate(counts.T):
        words = "".join(f"{value / VL53_SCALE:.1f}, " for value in column.tolist())
        lines.append(f"Aggregate {zone}, Ambient: 0.5, Bins: {words}\r\n".encode())
    return lines


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
