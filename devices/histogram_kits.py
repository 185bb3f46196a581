"""Histogram kits on a serial port as a source of frames (bins, zones), from the lines of text that
their public programs send.

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
"""

from __future__ import annotations

import contextlib
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from math import isqrt
from time import monotonic
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from devices.address import Uri, option
from devices.frames import FrameCodec, FrameFeed
from devices.source import Info
from devices.stream import LiveOptions, StreamSource, Transfer
from tofclip.arrays import IntArray
from tofclip.errors import (
    DeviceDisconnectedError,
    DeviceNotFoundError,
    DeviceTimeoutError,
    MissingDependencyError,
    require,
)
from tofclip.storage import Field, Record
from tofclip.units import PICOSECOND, SPEED_OF_LIGHT

MAX_LINE_BYTES = 1 << 13
TMF_BINS, TMF_CHANNELS, TMF_LANES = 128, 10, 30
TMF_CAPTURES, TMF_NUMBERS = 4, 256
TMF_TICK_S = 2e-7  # s; the sensor's clock of 5 MHz
TMF_ZONES = (64, 9)
VL53_NATIVE_BIN_S = 2 * 37.5348e-3 / SPEED_OF_LIGHT  # s; of the 37.5348 mm that ST gives for a bin

VL53_SCALE = 10  # Counts are sent with one digit after the point


def find_tmf_zones(zones: int) -> IntArray:
    """Return the pixel, in raster order, at which each zone looks, in the order in which zones come:
    captures, then halves, then channels. Of 64 zones the maker's own programs put them so; 9 come row
    by row.
    """
    if zones != 64:
        return np.arange(zones)
    capture, half, channel = np.indices((TMF_CAPTURES, 2, 8))
    row = 4 * (1 - channel // 4) + 2 * (1 - channel % 4 // 2) + 1 - capture // 2
    column = 4 * (channel % 2) + 2 * (capture % 2) + half
    return np.asarray(8 * row + column).ravel()


@dataclass(frozen=True)
class KitFrame:
    """What was sent for one frame."""

    counts: NDArray[np.uint32] | None  # (bins, zones), none where lines of it are missing
    missing: int = 0  # frames that the kit took before it and never sent
    stamp: float | None = None  # s of the kit's clock


class Tmf8828Parser:
    """See the module's text."""

    def __init__(self, options: Tmf8828Options) -> None:
        self._zones = find_tmf_zones(options.zones)
        self._captures, self._halves = (TMF_CAPTURES, 2) if options.zones == 64 else (1, 1)
        self._last_frame: int | None = None
        self._counts = np.zeros((TMF_BINS, options.zones), np.uint32)
        self._complete = 0
        self._begin_capture()

    def parse_line(self, line: bytes) -> KitFrame | None:
        """Take the next line; return the frame that it completes, if it does."""
        if line.startswith(b"#Raw,"):
            self._add_lane(line)
            return None
        return self._end_capture(line) if line.startswith(b"#Obj,") else None

    def _begin_capture(self) -> None:
        self._lanes = np.zeros((self._halves, TMF_LANES, TMF_BINS), np.uint32)
        self._seen = np.zeros((self._halves, TMF_LANES), bool)

    def _add_lane(self, line: bytes) -> None:
        numbers = _parse_integers(line.split(b",")[2:], TMF_BINS + 1)
        if not numbers:
            return
        half, lane = divmod(numbers[0], TMF_LANES)
        # Some versions number both halves from 0.
        if half == 0 and self._halves == 2 and self._seen[0, lane]:
            half = 1
        if half < self._halves:
            self._lanes[half, lane] = numbers[1:]
            self._seen[half, lane] = True

    def _end_capture(self, line: bytes) -> KitFrame | None:
        numbers = _parse_integers(line.split(b",")[2:6], 4)
        if not numbers:
            return None
        number, tick = numbers[0] % TMF_NUMBERS, numbers[3]
        place = number % self._captures
        if self._seen.all():
            lanes = self._lanes.reshape(self._halves, 3, TMF_CHANNELS, TMF_BINS)
            # Counts of 24 bits come as three lines of bytes, the lowest first.
            channels = lanes[:, 0] | lanes[:, 1] << 8 | lanes[:, 2] << 16
            # Channel 0 is the reference that looks at the emitter, not at the scene.
            own = np.split(self._zones, self._captures)[place]
            looking = channels[:, 1 : 1 + own.size // self._halves]
            self._counts[:, own] = looking.reshape(own.size, -1).T
            self._complete |= 1 << place
        self._begin_capture()
        if place != self._captures - 1:
            return None
        is_whole, self._complete = self._complete == (1 << self._captures) - 1, 0
        frame, before = number // self._captures, self._last_frame
        missing = 0 if before is None else (frame - before - 1) % (TMF_NUMBERS // self._captures)
        self._last_frame = frame
        counts = self._counts.copy() if is_whole else None
        return KitFrame(counts, missing, tick * TMF_TICK_S if tick else None)


class Vl53l8Parser:
    """See the module's text."""

    def __init__(self, options: Vl53l8Options) -> None:
        self._counts = np.zeros((options.bins, options.zones), np.uint32)
        self._next = 0

    def parse_line(self, line: bytes) -> KitFrame | None:
        if not line.startswith(b"Aggregate "):
            return None
        head, _, tail = line.partition(b"Bins:")
        zone = _parse_integers([head.removeprefix(b"Aggregate ").split(b",")[0]], 1)
        if not zone:
            return None
        place, values = zone[0], np.empty(0)
        with contextlib.suppress(ValueError):
            values = np.array([float(word) for word in tail.split(b",") if word.strip()])
        if place == 0:
            self._next = 0
        # Behind every value stands a comma: without the last one it may have lost digits.
        is_ended = tail.rstrip().endswith(b",")
        bins, zones = self._counts.shape
        is_whole = len(values) == bins and bool(np.all(np.isfinite(values)))
        if is_ended and is_whole and place == self._next:
            # The sensor subtracts the ambient light itself, which may leave less than nothing.
            self._counts[:, place] = np.rint(np.clip(values, 0, 4e8) * VL53_SCALE)
            self._next += 1
        else:
            self._next = -1  # wait for the next beginning
        if place != zones - 1:
            return None
        is_complete, self._next = self._next == zones, 0
        return KitFrame(self._counts.copy() if is_complete else None)


def _parse_integers(words: list[bytes], count: int) -> list[int]:
    """Return so many whole numbers, none where the words are others."""
    is_whole = all(word.strip().isdigit() and len(word) < 12 for word in words)
    return [int(word) for word in words] if is_whole and len(words) == count else []


READ_BYTES = 1 << 16


@dataclass(frozen=True)
class Tmf8828Options(LiveOptions):
    """Values of a TMF8828's address."""

    instrument: ClassVar = "TMF8828 histogram kit"
    parser: ClassVar[Any] = Tmf8828Parser
    bins: ClassVar = TMF_BINS
    begin: ClassVar = 0.0  # of the first bin, s
    scale: ClassVar = 1.0  # what one stored count stands for
    stop: ClassVar = b"s"  # ends measuring, where something began it
    bin_ps: float = option(0.0)  # depends on the kit's settings and has to be given
    baud: int = option(1_000_000)
    # Letters that begin measuring: enable, dump histograms, measure, the state after the reset that
    # opening the port brings. None: the kit's program begins by itself.
    start: str = option("ezm")
    zones: int = option(64)  # 64, or 9 for the 3 x 3 mode

    def __post_init__(self) -> None:
        super().__post_init__()
        require(0 < self.bin_ps < 1e6, "add bin_ps=..., the duration of a bin as the kit was set")
        require(self.zones in TMF_ZONES, f"a TMF8828 has 64 zones or 9, not {self.zones}")

    @property
    def bin_width(self) -> float:
        return self.bin_ps * PICOSECOND


@dataclass(frozen=True)
class Vl53l8Options(LiveOptions):
    """Values of a VL53L8CH's address: as the kit's program was set."""

    instrument: ClassVar = "VL53L8CH histogram kit"
    parser: ClassVar[Any] = Vl53l8Parser
    scale: ClassVar = 1 / VL53_SCALE
    stop: ClassVar = b""
    baud: int = option(460_800)
    start: str = option("")
    zones: int = option(16, least=1, most=64)
    bins: int = option(24, least=1, most=144)
    sub_sample: int = option(4, least=1, most=64)  # of the sensor's own bins, in one
    start_bin: int = option(0, least=0, most=144)

    @property
    def bin_width(self) -> float:
        return self.sub_sample * VL53_NATIVE_BIN_S

    @property
    def begin(self) -> float:
        return self.start_bin * VL53_NATIVE_BIN_S


class KitFeed(FrameFeed):
    """Frames as a kit sends them; see `devices.stream.Feed`.

    Frames of which lines are missing or torn are malformed; those that the kit's numbers show to be
    missing are lost by the instrument. A broken connection needs a new parser: nothing of what came
    before is of use behind it.
    """

    def __init__(self, port: str, options: Tmf8828Options | Vl53l8Options) -> None:
        super().__init__()
        self._name, self._options = port, options
        self._ready: deque[tuple[int, bytes, float]] = deque()
        self._is_stopped = False
        self._open_port()
        # a row for each bin, a column for each zone
        self.codec = FrameCodec(options.bins, options.zones, 32)
        known = {"bins": options.bins, "zones": options.zones, "bin_width_s": options.bin_width}
        limits = "written from public programs; no such kit was at hand"
        self.info = Info(options.instrument, "", {"port": port, **known, "limits": limits})
        # Zones make a square, row by row as they come; other numbers of them a row, where `shape` of
        # an address does not say otherwise.
        side = isqrt(options.zones)
        rows = side if side**2 == options.zones else 1
        times = options.begin + options.bin_width * (np.arange(options.bins) + 0.5)
        fields = {
            "bin_times": Field(times, "s", ("bin",)),
            "image_shape": Field(np.array([rows, options.zones // rows]), "px", ("yx",)),
        }
        self.calibration = Record("histograms", fields, {"count_scale": options.scale})

    def start(self) -> None:
        with self._translate_errors():
            self._port.write(self._options.start.encode())

    def pull(self, timeout: float) -> Transfer | None:
        deadline = monotonic() + timeout
        while not self._ready:
            if self._is_stopped:
                return None
            try:
                data = self._read_available(max(0.0, deadline - monotonic()))
            except DeviceDisconnectedError:
                self._reconnect(self._reopen, self._options.reconnect_s)
                continue
            if data:
                self._parse(data)
            elif monotonic() >= deadline:
                raise DeviceTimeoutError(f"{self._name} sent no histogram; is it the kit's?")
        return self._hand_over(*self._ready.popleft())

    def stop(self) -> None:
        self._is_stopped = True
        with self._translate_errors():
            self._port.write(self._options.stop if self._options.start else b"")
            self._port.flush()

    def close(self) -> None:
        self._port.close()

    def _open_port(self) -> None:
        try:
            import serial
        except ImportError as fault:
            raise MissingDependencyError(
                "histogram kits need pyserial: pip install 'tofclip[serial]'"
            ) from fault
        self._parser = self._options.parser(self._options)
        self._line, self._is_line_too_long = b"", False
        self._clock.reset()
        try:
            self._port = serial.Serial(self._name, self._options.baud, timeout=0)
        except (OSError, ValueError) as fault:
            raise DeviceNotFoundError(
                f"{self._name} cannot be opened ({fault}); is the kit connected?"
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
        self._lose(frame.missing)
        number = self._number + frame.missing
        self._number = number + 1
        if frame.counts is None:
            self.ledger.truncate()
            self._note_gap()
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
            raise DeviceDisconnectedError(f"{self._name}: {fault}") from fault


def open_tmf8828(uri: Uri) -> StreamSource:
    """Open ``tmf8828:///dev/ttyACM0?bin_ps=PS``."""
    return _open_kit(uri, Tmf8828Options.from_uri(uri))


def open_vl53l8(uri: Uri) -> StreamSource:
    """Open ``vl53l8:///dev/ttyACM0``."""
    return _open_kit(uri, Vl53l8Options.from_uri(uri))


def _open_kit(uri: Uri, options: Tmf8828Options | Vl53l8Options) -> StreamSource:
    require(
        uri.location, f"'{uri.text}': name the serial port, as in {uri.scheme}:///dev/ttyACM0?..."
    )
    return StreamSource(KitFeed(uri.location, options), options)
