"""A SPAD512S array over TCP as a source of frames.

A command is ASCII without an end: what comes at once is one command. The answers to ``I`` (pictures
of all the light) and ``G`` (pictures behind a gate that moves from step to step) are all pictures
and then the four letters `DONE_MARK`. Pixels may hold those letters as well, so that only the
computed length tells where an answer ends. Instead of pictures, or behind the first of them, may
come a text that ends in `ERROR_MARK`, or begins with it and ends in `DONE_MARK`. Other answers are
texts of no known length, which some versions end with `DONE_MARK`.

Single bits come turned by a quarter, as the vendor's own class knows: ``rot90`` of what came is the
picture that the other depths show.
"""

from __future__ import annotations

import contextlib
import re
from dataclasses import dataclass
from time import monotonic
from typing import Any

from devices.address import Uri, option
from devices.frames import FrameCodec, FrameFeed, GatedOptions
from devices.source import Info
from devices.stream import StreamSource, Transfer
from devices.tcp import TcpLink
from tofclip.errors import (
    DeviceDisconnectedError,
    DeviceError,
    DeviceTimeoutError,
    InputError,
    ProtocolError,
)

DEFAULT_PORT = 9999
DONE_MARK, ERROR_MARK = b"DONE", b"ERROR"
ROWS = 512
BIT_DEPTHS = (1, 4, 6, 7, 8, 9, 10, 11, 12)
GATED_BIT_DEPTHS = BIT_DEPTHS[2:]
IMAGE_WIDTHS_PX = (4, 8, 16, 32, 64, 128, 256, 512)
SINGLE_BIT_QUARTER_TURNS = 1
MAX_TEXT_BYTES = 1 << 13
MAX_IMAGES = 1 << 16
GATE_STEP_PS = 18  # ps by which the gate moves at least
INFORMATION_COMMAND = b"D"
BREAKDOWN_BEGINS, BREAKDOWN_ENDS = "The breakdown calibration process", "The breakdown is around"

_BITS, _COUNT, _NUMBER = rb"(\d{1,2})", rb"(\d{1,6})", rb"(\d+(?:\.\d+)?(?:e[+-]?\d{1,2})?)"
_INTENSITY = re.compile(rb"I,%b,%b,%b,0,[01],0,1(?:,(\d{1,3}))?" % (_BITS, _NUMBER, _COUNT))
_GATED = re.compile(
    rb"G,%b,%b,%b,(\d{1,5}),%b,0,%b,%b,[01],[01],[01],[01]"
    % (_BITS, _NUMBER, _COUNT, _NUMBER, _NUMBER, _NUMBER)
)
_ERROR_TEXT = re.compile(rb"[\t\n\r -~]{0,240}\Z")


@dataclass(frozen=True)
class SpadOptions(GatedOptions):
    """Values of an address that say what pictures to take; the request for them, and what comes."""

    mode: str = option("", choices=("intensity", "gated"))
    gate_step_ps: float = option(252.0, least=GATE_STEP_PS, most=1e9)
    bits: int = option(8)  # depth of a picture; 1, 4, 6..12, behind a gate 6..12
    exposure_us: float = option(1000.0)  # integration time of a picture
    images: int = option(1)  # pictures of one request, or scans of a gate
    # columns, a power of two within 4..512; 512 for single bits and behind a gate
    width: int = option(ROWS)
    # whether the server corrects counts for photons that came in a pixel's dead time; they have 16
    # bits then
    pile_up: bool = option(False)
    timeout_s: float = option(5.0, above=0, most=600)  # for an answer, beyond the exposure

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.bits not in BIT_DEPTHS or self.width not in IMAGE_WIDTHS_PX:
            raise InputError(
                f"a SPAD512 has depths of {BIT_DEPTHS} and widths of {IMAGE_WIDTHS_PX}, not {self.bits}, {self.width}"
            )
        if self.bits == 1 and (self.width != ROWS or self.pile_up):
            raise InputError("single bits come at full width and without correction of pile-up")
        if self.is_gated and (self.bits not in GATED_BIT_DEPTHS or self.width != ROWS):
            raise InputError("pictures behind a gate have full width and 6 to 12 bits")
        if not (0 < self.seconds <= 3600 and self.images >= 1 and self.frames <= MAX_IMAGES):
            raise InputError(
                f"pictures need an exposure within 0..3600 s, and 1..{MAX_IMAGES} of them, got {self}"
            )

    @property
    def seconds(self) -> float:
        return self.exposure_us * 1e-6

    @property
    def frames(self) -> int:
        """Pictures in an answer: behind a gate all steps of the first scan, then of the second."""
        return self.images * self.scan_pictures

    @property
    def codec(self) -> FrameCodec:
        """What the pictures look like: single bits are turned, more than 8 take two bytes."""
        if self.bits == 1:
            return FrameCodec(ROWS, self.width, 1, SINGLE_BIT_QUARTER_TURNS)
        return FrameCodec(ROWS, self.width, 16 if self.bits > 8 or self.pile_up else 8)

    def encode(self) -> bytes:
        amount = f"{self.bits},{self.exposure_us / _find_time_unit_us(self.bits):.9g},{self.images}"
        if not self.is_gated:
            return f"I,{amount},0,1,0,1,{self.width}".encode()
        steps = f"{self.gate_steps},{self.gate_step_ps:.9g}"
        gate = f"{self.gate_width_ns:.9g},{self.gate_offset_ps:.9g}"
        # Even steps; forwards; the laser's own trigger; no reading during exposure; streamed.
        return f"G,{amount},{steps},0,{gate},0,1,0,1".encode()

    def encode_pile_up(self) -> bytes:
        """Return the command that has to be sent before."""
        return f"PU,{int(self.pile_up)}".encode()

    @classmethod
    def decode(cls, line: bytes, pile_up: bool = False) -> SpadOptions:
        """Read a command; `pile_up`: as in the class."""
        found = _INTENSITY.fullmatch(line) or _GATED.fullmatch(line)
        if found is None:
            raise ProtocolError(f"{line[:60]!r} is not a request for pictures")
        bits, time, images, *rest = found.groups()
        known: dict[str, Any] = {"width": int(rest[0] or ROWS)}
        if line.startswith(b"G"):
            names = ("gate_step_ps", "gate_width_ns", "gate_offset_ps")
            known = dict(zip(names, map(float, rest[1:]), strict=True))
            known |= {"mode": "gated", "gate_steps": int(rest[0])}
        known |= {"bits": int(bits), "images": int(images), "pile_up": pile_up}
        try:
            return cls(exposure_us=float(time) * _find_time_unit_us(int(bits)), **known)
        except InputError as fault:
            raise ProtocolError(f"{line[:60]!r} requests pictures that cannot be") from fault


def _find_time_unit_us(bits: int) -> float:
    """Commands for pictures of 1 and 4 bits count us, the others ms."""
    return 1.0 if bits in (1, 4) else 1e3


def find_error_text(data: bytes | bytearray) -> str | None:
    """Return what the server says instead of the rest of its pictures, None where it says nothing.
    To be asked when nothing more comes although pictures are due: pixels may spell anything.
    """
    tail = bytes(data[-256:])
    if tail.endswith(ERROR_MARK):
        begin = 0
    elif tail.rstrip().endswith(DONE_MARK) and ERROR_MARK in tail:
        begin = tail.rindex(ERROR_MARK)
    else:
        return None
    text = _ERROR_TEXT.search(tail, begin)
    return None if text is None else " ".join(text.group().decode("ascii").split())


INSTRUMENT = "SPAD512 array"


_SILENCE_S = 0.2  # Seconds after which a text of unknown length has ended

# Seconds that the server may calibrate itself when it is first asked
BREAKDOWN_CALIBRATION_S = 60.0


class Spad512Feed(FrameFeed):
    """One picture after the other; see `devices.stream.Feed`.

    Pictures are asked for a request at a time, and a request that finds no answer in time is not
    sent again. Behind a gate a picture's number modulo the gate's steps is its step: a scan that
    was cut is never finished, and the next one's numbers begin behind it.
    """

    def __init__(self, host: str, port: int, options: SpadOptions) -> None:
        super().__init__()
        self._place, self._options = (host, port), options
        self._patience, self.codec = options.timeout_s, options.codec
        self.calibration = options.gate_record
        self._frames_due = 0
        self._received = bytearray()
        self._stopped = False
        self._open_link()
        self.info = Info(
            INSTRUMENT,
            self._facts[0].rpartition(":")[2].strip() if self._facts else "",
            {
                "greeting": self._greeting,
                "system": "; ".join(self._facts),
                "bits": options.bits,
                "exposure_s": options.seconds,
                "rows": self.codec.rows,
                "columns": self.codec.columns,
            },
        )

    def pull(self, timeout: float) -> Transfer | None:
        while True:
            if self._frames_due == 0:
                if self._stopped:
                    return None
                self._link.send(self._options.encode(), self._patience)
                self._frames_due = self._options.frames
                self._deadline = monotonic() + self._options.seconds + self._patience
            try:
                return self._read_frame(timeout)
            except DeviceDisconnectedError:
                self._count_truncated()
                self._link.close()
                self._reconnect(self._open_link, self._options.reconnect_s)

    def stop(self) -> None:
        self._stopped = True

    def close(self) -> None:
        self._count_truncated()
        self._link.close()

    def _open_link(self) -> None:
        self._link = link = TcpLink(*self._place, self._patience)
        try:
            self._greeting = self._read_text(self._patience)
            self._facts = self._ask_system()
            link.send(self._options.encode_pile_up(), self._patience)
            self._read_text(self._patience)
        except BaseException:
            link.close()
            raise

    def _ask_system(self) -> list[str]:
        """Ask what the system is, as the vendor's clients do; it may calibrate itself first."""
        self._link.send(INFORMATION_COMMAND, self._patience)
        text = self._read_text(self._patience)
        if BREAKDOWN_BEGINS in text:
            deadline = monotonic() + BREAKDOWN_CALIBRATION_S
            while BREAKDOWN_ENDS not in text:
                if monotonic() > deadline:
                    raise DeviceTimeoutError("the SPAD array does not end its calibration")
                text = self._read_text(BREAKDOWN_CALIBRATION_S)
            return self._ask_system()
        return [line.strip() for line in text.splitlines() if line.strip()]

    def _read_text(self, patience: float) -> str:
        """Return a text of unknown length: what comes up to its mark, or until it is quiet."""
        text = self._link.read_available(MAX_TEXT_BYTES, patience)
        with contextlib.suppress(DeviceTimeoutError):
            while len(text) < MAX_TEXT_BYTES and not text.endswith(DONE_MARK):
                text += self._link.read_available(MAX_TEXT_BYTES - len(text), _SILENCE_S)
        return text.removesuffix(DONE_MARK).decode("ascii", "replace").strip()

    def _read_frame(self, timeout: float) -> Transfer:
        """Return the next picture; with the last one of a request comes the end of the answer."""
        is_last = self._frames_due == 1
        # Pixels may spell DONE: only the computed length tells where an answer ends.
        length = self.codec.pixel_bytes + (len(DONE_MARK) if is_last else 0)
        self._fill_buffer(length, timeout)
        pixels = bytes(self._received[: self.codec.pixel_bytes])
        end = self._received[self.codec.pixel_bytes :]
        if is_last and end != DONE_MARK:
            raise ProtocolError(
                f"the SPAD array's answer ended in {bytes(end)!r}, expected {DONE_MARK!r}; is its width another?"
            )
        self._received.clear()
        self._frames_due -= 1
        self._deadline = monotonic() + self._options.seconds + self._patience
        self._number += 1
        return self._hand_over(self._number - 1, pixels)

    def _fill_buffer(self, length: int, timeout: float) -> None:
        """Wait until `length` bytes came, a computed number; what came in time is kept."""
        deadline = monotonic() + timeout
        while len(self._received) < length:
            try:
                self._received += self._link.read_available(
                    length - len(self._received), max(deadline - monotonic(), 0)
                )
            except DeviceTimeoutError as fault:
                said = find_error_text(self._received)
                if said is not None:
                    raise DeviceError(f"the SPAD array could not take pictures: {said}") from fault
                if monotonic() > self._deadline:
                    raise DeviceDisconnectedError(
                        f"the SPAD array sent nothing for {self._patience:g} s beyond the exposure"
                    ) from fault
                raise

    def _count_truncated(self) -> None:
        """Enter a picture of which a part came; whether the next ones were taken is not known."""
        if self._received:
            self.ledger.truncate()
            self._number += 1
        self._end_scan(self._options)
        self._frames_due = 0
        self._received.clear()


def open_spad512(uri: Uri) -> StreamSource:
    """Open ``spad512://HOST:9999``; `SpadOptions` has its values."""
    options = SpadOptions.from_uri(uri)
    host, port = uri.host_and_port(DEFAULT_PORT)
    return StreamSource(Spad512Feed(host, port, options), options)
