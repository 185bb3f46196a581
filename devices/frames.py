"""Cameras' pictures as records, each with its number, so that they are buffered, recorded and
replayed like photons; what drivers of cameras share; and a gate that opens later from picture to
picture, which turns a camera's frames into photons counted in time.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, Self

import numpy as np

from devices.address import Uri, option
from devices.source import ByteView, Codec, DecodeResult, Gap, Ledger, Records
from devices.stream import Feed, InstrumentClock, LiveOptions, Transfer, retry_connect
from tofclip.arrays import FloatArray
from tofclip.camera import Camera
from tofclip.errors import InputError, require
from tofclip.storage import Field, Record


@dataclass(frozen=True)
class GatedOptions(LiveOptions):
    """Values of cameras that may stand behind a gate, or be one: ``mode=gated&gate_steps=...``. A
    picture's number modulo `scan_pictures` is its step in a scan.
    """

    mode: str = option("", choices=("free", "gated"))
    gate_steps: int = option(72, least=2, most=4096)  # pictures of one scan
    # how much later the gate opens from one to the next
    gate_step_ps: float = option(252.0, least=1, most=1e9)
    gate_width_ns: float = option(5.0, above=0, most=1e6)  # how long it is open
    # when it opens in the first one, after the laser's pulse
    gate_offset_ps: float = option(5000.0, least=0, most=1e9)

    @property
    def is_gated(self) -> bool:
        return self.mode == "gated"

    @property
    def scan_pictures(self) -> int:
        """Pictures of a scan, 1 where there is no gate."""
        return self.gate_steps if self.is_gated else 1

    @property
    def opening_times(self) -> FloatArray:
        """When the gate opens in each picture of a scan, s after the laser's pulse."""
        steps = np.arange(self.gate_steps, dtype=np.float64)
        return (self.gate_offset_ps + self.gate_step_ps * steps) * 1e-12

    @property
    def gate_record(self) -> Record | None:
        """The calibration that `devices.transients.read_photons` reads; None where there is no gate."""
        times = {"gate_times": Field(self.opening_times, "s", ("gate_step",))}
        width = {"gate_width_s": self.gate_width_ns * 1e-9}
        return Record("gate_scan", times, width) if self.is_gated else None

    @classmethod
    def from_uri(cls, uri: Uri) -> Self:
        found = super().from_uri(uri)
        if not found.is_gated and any(name.startswith("gate_") for name in uri.values):
            raise InputError(f"'{uri.text}': a gate needs mode=gated")
        return found


def make_streak_calibration(times: FloatArray, camera: Camera | None = None) -> Record:
    """Return what is known of streak pictures whose rows are at these times, s, and of the camera
    before them.
    """
    children = {} if camera is None else {"camera": camera.to_record()}
    return Record(
        "streak_calibration", {"row_times": Field(times, "s", ("row",))}, children=children
    )


MAX_FRAME_BYTES = 1 << 26  # No camera here has larger pictures: 16 megapixels of 32 bits
_NUMBER_DTYPE = np.dtype("<i8")
_PIXEL_DTYPES = {1: "u1", 8: "u1", 16: "<u2", 32: "<u4"}


@dataclass(frozen=True)
class FrameCodec(Codec):
    """A picture's number (8 bytes, little-endian) and its pixels as the camera sent them, to
    records and back. A frame is malformed if its number is not above that of the one before.
    Decoding allocates what the pixels take, 8 bits for each of those that came as single bits.
    """

    rows: int
    columns: int
    bits: int = 16  # 1 (eight pixels in a byte, the leftmost highest), 8, 16 or 32 (little-endian)
    # counter-clockwise ones that put upright what came; 0 to 3, for square pictures only
    quarter_turns: int = 0

    name: ClassVar[str] = "frames"
    start: ClassVar[int] = -1  # Number of the last frame

    def __post_init__(self) -> None:
        if self.bits not in _PIXEL_DTYPES:
            raise InputError(
                f"pixels have {', '.join(map(str, _PIXEL_DTYPES))} bits, not {self.bits}"
            )
        total = self.rows * self.columns * self.bits
        if (
            self.rows < 1
            or self.columns < 1
            or total > 8 * MAX_FRAME_BYTES
            or self.columns * self.bits % 8
            or not 0 <= self.quarter_turns <= 3
            or (self.quarter_turns and self.rows != self.columns)
        ):
            raise InputError(
                f"pictures of {self.rows} x {self.columns} pixels of {self.bits} bits cannot be"
            )

    @cached_property
    def dtype(self) -> np.dtype[Any]:
        """`number` and `counts` (rows, columns)."""
        counts = ("counts", _PIXEL_DTYPES[self.bits], (self.rows, self.columns))
        return np.dtype([("number", _NUMBER_DTYPE), counts])

    @property
    def pixel_bytes(self) -> int:
        """Bytes of a picture without its number."""
        return self.rows * self.columns * self.bits // 8

    @property
    def unit_bytes(self) -> int:
        return _NUMBER_DTYPE.itemsize + self.pixel_bytes

    def decode(self, data: ByteView, state: Any, after_loss: bool = False) -> DecodeResult:
        """Decode whole frames; `state` is the last one's number."""
        frames = self._view_units(data)
        numbers = frames[:, : _NUMBER_DTYPE.itemsize].copy().view(_NUMBER_DTYPE)[:, 0]
        # A number that does not exceed all earlier ones was damaged, or belongs to a frame that
        # came already.
        before = np.maximum.accumulate(np.concatenate([[state], numbers]))
        valid = numbers > before[:-1]
        records = np.empty(int(valid.sum()), self.dtype)
        records["number"] = numbers[valid]
        pixels = frames[valid, _NUMBER_DTYPE.itemsize :]
        if self.bits == 1:
            pixels = np.unpackbits(pixels, axis=1)
        else:
            pixels = np.ascontiguousarray(pixels).view(_PIXEL_DTYPES[self.bits])
        pictures = pixels.reshape(len(records), self.rows, self.columns)
        records["counts"] = np.rot90(pictures, self.quarter_turns, axes=(1, 2))
        return DecodeResult(records, len(numbers) - len(records), int(before[-1]))

    def encode(self, records: Records) -> bytes:
        self._require_records(records)
        numbers, counts = np.ascontiguousarray(records["number"]), records["counts"]
        if np.any(np.diff(numbers, prepend=-1) <= 0):
            raise InputError("frames must have rising numbers from 0")
        require(not (self.bits == 1 and counts.max(initial=0) > 1), "a single bit is 0 or 1")
        as_sent = np.rot90(counts, -self.quarter_turns, axes=(1, 2))
        flat = np.ascontiguousarray(as_sent).reshape(len(records), self.rows * self.columns)
        pixels = np.packbits(flat, axis=1) if self.bits == 1 else flat.view(np.uint8)
        stamps = numbers[:, np.newaxis].view(np.uint8)
        return np.concatenate([stamps, pixels], axis=1).tobytes()

    def pack_frame(self, number: int, pixels: bytes) -> bytes:
        """Return a frame's bytes from those of its pixels."""
        return number.to_bytes(_NUMBER_DTYPE.itemsize, "little") + pixels


class FrameFeed(Feed):
    """What the drivers of cameras share: the number of the next picture, what is missing before it,
    and the accounts; see `devices.stream.Feed`.
    """

    codec: FrameCodec

    def __init__(self) -> None:
        self.ledger = Ledger()
        self._clock = InstrumentClock()
        self._number, self._gap = 0, Gap.NONE

    def _hand_over(self, number: int, pixels: bytes, taken_at: float = 0.0) -> Transfer:
        """Return a picture, with the gap before it."""
        gap, self._gap = self._gap, Gap.NONE
        return Transfer(memoryview(self.codec.pack_frame(number, pixels)), gap, taken_at)

    def _note_gap(self, gap: Gap = Gap.LOSS) -> None:
        """Remember, at the next picture, that something is missing before it."""
        self._gap = max(self._gap, gap)

    def _lose(self, frames: int) -> None:
        """Enter pictures that the instrument took and will not send."""
        if frames > 0:
            self.ledger.lose(frames)
            self._note_gap()

    def _reconnect(self, connect: Callable[[], object], seconds: float) -> None:
        retry_connect(connect, seconds)
        self.ledger.reconnect()
        self._gap = Gap.RESTART

    def _end_scan(self, options: GatedOptions) -> None:
        """Count up to the beginning of the next scan: one that was cut is never finished."""
        self._number += -self._number % options.scan_pictures
