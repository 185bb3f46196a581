"""LinoSPAD2's stream (S. Burri et al., Instruments 2018, 2, 28; layout as the authors' and daplis'
readers have it).

A stream is a row of *cycles*, little-endian words of 32 bits: where the option is on, two words of
an absolute counter (low word first, ticks of 7.5 ns), then N words of each of 65 time-to-digital
converters, of which the last serves no pixels. A word::

    bit 31      it holds a time stamp
    bits 29-28  which of the converter's four pixels
    bits 27-0   code: 140 codes for each 2500 ps since the cycle began

The stream says neither N, nor which firmware numbered the pixels, nor whether there is a counter.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from devices.codec import ByteView, DecodeResult, Records, as_bytes
from devices.linospad2.words import (
    ADDRESSES,
    CODE_MASK,
    CONVERTERS,
    COUNTERS_DIFFER,
    OUT_OF_ORDER,
    OVERFULL,
    PIXEL_CONVERTERS,
)
from tofclip.errors import InputError
from tofclip.storage import Scalar
from tofclip.threads import run_blocks

PIXELS = PIXEL_CONVERTERS * ADDRESSES
FIRMWARES = ("2212b", "2212s")
MAX_TIMESTAMPS = 1 << 14
"""Time stamps per converter and cycle at most; the boards' memory ends far below."""

STAMP_DTYPE = np.dtype([("cycle", "<u4"), ("code", "<u4"), ("pixel", "<u4")])
"""`cycle`: from 0. `code`: time since the cycle began, 140 for each 2500 ps. `pixel`: place
on the line, 0..255.
"""

STAMP_WITH_COUNTER_DTYPE = np.dtype([("counter", "<u8"), *STAMP_DTYPE.descr])
"""As `STAMP_DTYPE`, with the absolute time at which the cycle began, in ticks of 7.5 ns."""

COUNTER_WORDS = 2
_WORD_DTYPE = np.dtype("<u4")
_MAX_ENCODED_BYTES = 1 << 30
_BLOCK_BYTES = 1 << 21
_ENCODE_ERRORS = {
    OUT_OF_ORDER: "time stamps must be in order of cycle and converter; sort_stamps brings them there",
    OVERFULL: "a converter has more time stamps in a cycle than it can hold",
    COUNTERS_DIFFER: "all time stamps of a cycle must have the same counter",
}


@dataclass(frozen=True)
class LinoSpad2Codec:
    """Bytes of LinoSPAD2 to time stamps and back.

    A valid word of the converter that serves no pixels is malformed. Decoding allocates at most 5
    bytes for each byte of the stream: rows for the valid words only.
    """

    # ``"2212b"`` (blocks: pixel = 4 * converter + address) or ``"2212s"`` (skipping: converter + 64
    # * address)
    firmware: str = "2212b"
    timestamps: int = 512  # words per converter and cycle
    counter: bool = False  # whether every cycle begins with the absolute counter

    name: ClassVar[str] = "linospad2"
    start: ClassVar[int] = 0
    """Cycles decoded so far."""

    def __post_init__(self) -> None:
        if self.firmware not in FIRMWARES:
            raise InputError(
                f"LinoSPAD2's firmware must be {' or '.join(FIRMWARES)}, got '{self.firmware}'"
            )
        if not 1 <= self.timestamps <= MAX_TIMESTAMPS:
            raise InputError(
                f"time stamps per cycle must be within 1..{MAX_TIMESTAMPS}, got {self.timestamps}"
            )

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of a time stamp."""
        return STAMP_WITH_COUNTER_DTYPE if self.counter else STAMP_DTYPE

    @property
    def settings(self) -> Mapping[str, Scalar]:
        """Arguments that build this codec again."""
        return {"firmware": self.firmware, "timestamps": self.timestamps, "counter": self.counter}

    @property
    def header(self) -> int:
        """Words of a cycle before the first converter's."""
        return COUNTER_WORDS if self.counter else 0

    @property
    def cycle_words(self) -> int:
        """Words of a cycle."""
        return self.header + CONVERTERS * self.timestamps

    @property
    def cycle_bytes(self) -> int:
        """Bytes of a cycle."""
        return self.cycle_words * _WORD_DTYPE.itemsize

    @cached_property
    def pixel_of(self) -> NDArray[np.uint32]:
        """Pixel of each converter's addresses, (64, 4)."""
        converter, address = np.indices((PIXEL_CONVERTERS, ADDRESSES), np.uint32)
        # 2212b puts four neighbours on a converter, 2212s every 64th pixel.
        if self.firmware == "2212b":
            return ADDRESSES * converter + address
        return converter + PIXEL_CONVERTERS * address

    @cached_property
    def address_of(self) -> NDArray[np.uint32]:
        """Converter * 4 + address of each pixel, (256,)."""
        return np.argsort(self.pixel_of, axis=None).astype(np.uint32)

    def count_complete_bytes(self, data: ByteView) -> int:
        """Return how many bytes at the front of `data` form whole cycles."""
        return len(data) - len(data) % self.cycle_bytes

    def count_records(self, data: ByteView) -> int:
        """Return how many words of `data` are valid."""
        kept, malformed = self._count_per_cycle(self._view_cycles(data))
        return int(kept.sum()) + malformed

    def count_valid(self, data: ByteView) -> int:
        """Return how many records `decode` would make of `data`."""
        kept, _ = self._count_per_cycle(self._view_cycles(data))
        return int(kept.sum())

    def decode(self, data: ByteView, state: Any, after_loss: bool = False) -> DecodeResult:
        """Decode whole cycles; `state` is how many came before. Cycles that were lost are not
        counted.

        `data`: whole cycles; `after_loss`: not needed: cycles do not depend on each other.
        """
        from devices.linospad2.kernels import decode_stamps

        cycles = self._view_cycles(data)
        kept, malformed = self._count_per_cycle(cycles)
        # Counted first: each block then knows which rows of the result are its own, and threads
        # need no lock.
        ends = np.cumsum(kept)
        total = int(ends[-1]) if len(ends) else 0
        records = np.empty(total, self.dtype)
        # Records are whole words, so that the kernel sees them as rows of words.
        rows = records.view(_WORD_DTYPE).reshape(total, self.dtype.itemsize // _WORD_DTYPE.itemsize)

        def work(block: slice) -> None:
            first, last = (
                (int(ends[block.start - 1]) if block.start else 0),
                int(ends[block.stop - 1]),
            )
            decode_stamps(
                cycles[block], self.header, state + block.start, self.pixel_of, rows[first:last]
            )

        run_blocks(work, len(cycles), max(1, _BLOCK_BYTES // self.cycle_bytes))
        return DecodeResult(records, malformed, state + len(cycles))

    def encode(self, records: Records) -> bytes:
        """Return the bytes of all cycles from 0 up to that of the last time stamp."""
        from devices.linospad2.kernels import encode_stamps

        self._require_valid(records)
        if len(records) == 0:
            return b""
        cycles = np.zeros((int(records["cycle"].max()) + 1, self.cycle_words), _WORD_DTYPE)
        rows = np.ascontiguousarray(records).view(_WORD_DTYPE).reshape(len(records), -1)
        outcome = encode_stamps(rows, self.header, self.address_of, cycles)
        if outcome in _ENCODE_ERRORS:
            raise InputError(_ENCODE_ERRORS[outcome])
        return cycles.tobytes()

    def sort_stamps(self, records: Records) -> Records:
        """Return time stamps in the order of the stream: by cycle, then converter, else as they
        were.
        """
        converter = self.address_of[records["pixel"]] // ADDRESSES
        return records[np.lexsort([converter, records["cycle"]])]

    def _view_cycles(self, data: ByteView) -> NDArray[np.uint32]:
        words = as_bytes(data)
        if words.size % self.cycle_bytes:
            raise InputError(
                f"{words.size} bytes are not a whole number of {self.cycle_bytes}-byte cycles"
            )
        return np.ascontiguousarray(words).view(_WORD_DTYPE).reshape(-1, self.cycle_words)

    def _count_per_cycle(self, cycles: NDArray[np.uint32]) -> tuple[NDArray[np.int64], int]:
        """Count the time stamps of each cycle, and all malformed words."""
        from devices.linospad2.kernels import count_stamps

        kept = np.empty(len(cycles), np.int64)
        strays: list[int] = []  # appending is safe on several threads

        def work(block: slice) -> None:
            strays.append(count_stamps(cycles[block], self.header, kept[block]))

        run_blocks(work, len(cycles), max(1, _BLOCK_BYTES // self.cycle_bytes))
        return kept, sum(strays)

    def _require_valid(self, records: Records) -> None:
        if records.dtype != self.dtype or records.ndim != 1:
            raise InputError(f"time stamps must be a one-dimensional array of {self.dtype}")
        if np.any(records["pixel"] >= PIXELS) or np.any(records["code"] > CODE_MASK):
            raise InputError(f"a time stamp has a pixel below {PIXELS} and a code below 2**28")
        cycles = int(records["cycle"].max(initial=0)) + 1
        if cycles * self.cycle_bytes > _MAX_ENCODED_BYTES:
            raise InputError(
                f"{cycles} cycles take more than {_MAX_ENCODED_BYTES} bytes; encode them in pieces"
            )
