"""Cameras' pictures as records, each with its number, so that they are buffered, recorded and
replayed like photons.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from devices.codec import ByteView, DecodeResult, Records, as_bytes
from tofclip.errors import InputError
from tofclip.storage import Scalar

MAX_FRAME_BYTES = 1 << 26
"""No camera here has larger pictures: 16 megapixels of 32 bits."""

_NUMBER_DTYPE = np.dtype("<i8")
_PIXEL_DTYPES = {1: "u1", 8: "u1", 16: "<u2", 32: "<u4"}


@dataclass(frozen=True)
class FrameCodec:
    """A picture's number (8 bytes, little-endian) and its pixels as the camera sent them, to
    records and back.

    A frame is malformed if its number is not above that of the one before. Decoding allocates what
    the pixels take, 8 bits for each of those that came as single bits.
    """

    rows: int
    columns: int
    bits: int = 16  # 1 (eight pixels in a byte, the leftmost highest), 8, 16 or 32 (little-endian)
    # counter-clockwise ones that put upright what came; 0 to 3, for square pictures only
    quarter_turns: int = 0

    name: ClassVar[str] = "frames"
    start: ClassVar[int] = -1
    """Number of the last frame."""

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
        return np.dtype(
            [
                ("number", _NUMBER_DTYPE),
                ("counts", _PIXEL_DTYPES[self.bits], (self.rows, self.columns)),
            ]
        )

    @property
    def settings(self) -> Mapping[str, Scalar]:
        """Arguments that build this codec again."""
        shape = {"rows": self.rows, "columns": self.columns, "bits": self.bits}
        return {**shape, "quarter_turns": self.quarter_turns} if self.quarter_turns else shape

    @property
    def pixel_bytes(self) -> int:
        """Bytes of a picture without its number."""
        return self.rows * self.columns * self.bits // 8

    @property
    def frame_bytes(self) -> int:
        """Bytes of a picture and its number."""
        return _NUMBER_DTYPE.itemsize + self.pixel_bytes

    def count_complete_bytes(self, data: ByteView) -> int:
        """Return how many bytes at the front of `data` form whole frames."""
        return len(data) - len(data) % self.frame_bytes

    def count_records(self, data: ByteView) -> int:
        """Return the number of frames in `data`."""
        return len(data) // self.frame_bytes

    def decode(self, data: ByteView, state: Any, after_loss: bool = False) -> DecodeResult:
        """Decode whole frames; `state` is the last one's number.

        `data`: whole frames; `after_loss`: not needed: every frame carries its number.
        """
        words = as_bytes(data)
        if words.size % self.frame_bytes:
            raise InputError(
                f"{words.size} bytes are not a whole number of {self.frame_bytes}-byte frames"
            )
        frames = np.ascontiguousarray(words).reshape(-1, self.frame_bytes)
        numbers = frames[:, : _NUMBER_DTYPE.itemsize].copy().view(_NUMBER_DTYPE)[:, 0]
        # A number that does not exceed all earlier ones was damaged, or belongs to a frame that
        # came already.
        before = np.maximum.accumulate(np.concatenate([[state], numbers]))
        valid = numbers > before[:-1]
        records = np.empty(int(valid.sum()), self.dtype)
        records["number"] = numbers[valid]
        records["counts"] = self._unpack_pixels(frames[valid, _NUMBER_DTYPE.itemsize :])
        return DecodeResult(records, len(numbers) - len(records), int(before[-1]))

    def encode(self, records: Records) -> bytes:
        """Return numbers and pixels as the camera sends them."""
        if records.dtype != self.dtype or records.ndim != 1:
            raise InputError(f"frames must be a one-dimensional array of {self.dtype}")
        if np.any(np.diff(records["number"], prepend=-1) <= 0):
            raise InputError("frames must have rising numbers from 0")
        if self.bits == 1 and records["counts"].max(initial=0) > 1:
            raise InputError("a single bit is 0 or 1")
        frames = np.empty((len(records), self.frame_bytes), np.uint8)
        numbers = np.ascontiguousarray(records["number"])
        frames[:, : _NUMBER_DTYPE.itemsize] = numbers.view(np.uint8).reshape(
            -1, _NUMBER_DTYPE.itemsize
        )
        frames[:, _NUMBER_DTYPE.itemsize :] = self._pack_pixels(records["counts"])
        return frames.tobytes()

    def pack_frame(self, number: int, pixels: bytes) -> bytes:
        """Return a frame's bytes from those of its pixels."""
        return number.to_bytes(_NUMBER_DTYPE.itemsize, "little") + pixels

    def _unpack_pixels(self, data: ByteView) -> Any:
        shape = (len(data), self.rows, self.columns)
        if self.bits == 1:
            pixels = np.unpackbits(data, axis=1).reshape(shape)
        else:
            pixels = np.ascontiguousarray(data).view(_PIXEL_DTYPES[self.bits]).reshape(shape)
        return np.rot90(pixels, self.quarter_turns, axes=(1, 2))

    def _pack_pixels(self, counts: Any) -> Any:
        as_sent = np.rot90(counts, -self.quarter_turns, axes=(1, 2))
        flat = np.ascontiguousarray(as_sent).reshape(len(counts), self.rows * self.columns)
        if self.bits == 1:
            return np.packbits(flat, axis=1)
        return flat.view(np.uint8)
