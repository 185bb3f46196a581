"""LinoSPAD2's recordings as a source of time stamps: its stream, what a board's calibration knows, and
what recordings do not say themselves, in a small TOML file beside each of them.

The stream (S. Burri et al., Instruments 2018, 2, 28; layout as the authors' and daplis'
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

import contextlib
import os
from collections.abc import Iterator
from dataclasses import MISSING, dataclass, field, fields
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, get_type_hints

import numpy as np
from numpy.typing import NDArray

from devices.address import Options, Uri
from devices.linospad2_kernels import (
    ADDRESSES,
    CODE_MASK,
    CONVERTERS,
    PIXEL_CONVERTERS,
    VALID_BIT,
)
from devices.source import (
    ByteView,
    Checkpoint,
    Codec,
    DecodeResult,
    Info,
    Piece,
    Records,
    SeekableSource,
    as_bytes,
)
from tofclip.arrays import FloatArray, IntArray
from tofclip.errors import FileFormatError, InputError, ShapeError, StorageError, require
from tofclip.files import guard, read_toml, suggest_name, translate_read_errors
from tofclip.storage import Record, Storable, stored_array
from tofclip.threads import run_blocks

PIXELS = PIXEL_CONVERTERS * ADDRESSES
FIRMWARES = ("2212b", "2212s")
# Time stamps per converter and cycle at most; the boards' memory ends far below
MAX_TIMESTAMPS = 1 << 14
# `cycle`: from 0. `code`: time since the cycle began, 140 for each 2500 ps. `pixel`: place on the
# line, 0..255.
STAMP_DTYPE = np.dtype([("cycle", "<u4"), ("code", "<u4"), ("pixel", "<u4")])
# As `STAMP_DTYPE`, with the absolute time at which the cycle began, in ticks of 7.5 ns
STAMP_WITH_COUNTER_DTYPE = np.dtype([("counter", "<u8"), *STAMP_DTYPE.descr])
COUNTER_WORDS = 2
_WORD_DTYPE = np.dtype("<u4")
_MAX_ENCODED_BYTES = 1 << 30
_BLOCK_BYTES = 1 << 21


@dataclass(frozen=True)
class LinoSpad2Codec(Codec):
    """Bytes of LinoSPAD2 to time stamps and back. A valid word of the converter that serves no
    pixels is malformed. Decoding allocates at most 5 bytes for each byte of the stream: rows for
    the valid words only.
    """

    # ``"2212b"`` (blocks: pixel = 4 * converter + address) or ``"2212s"`` (skipping: converter + 64
    # * address)
    firmware: str = "2212b"
    timestamps: int = 512  # words per converter and cycle
    counter: bool = False  # whether every cycle begins with the absolute counter

    name: ClassVar[str] = "linospad2"
    start: ClassVar[int] = 0  # Cycles decoded so far

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
        return STAMP_WITH_COUNTER_DTYPE if self.counter else STAMP_DTYPE

    @property
    def header(self) -> int:
        """Words of a cycle before the first converter's."""
        return COUNTER_WORDS if self.counter else 0

    @property
    def cycle_words(self) -> int:
        return self.header + CONVERTERS * self.timestamps

    @property
    def unit_bytes(self) -> int:
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

    def count_records(self, data: ByteView) -> int:
        return sum(self.count_stamps(data))

    def count_stamps(self, data: ByteView) -> tuple[int, int]:
        """Return how many records `decode` would make of `data`, and how many are malformed."""
        kept, malformed = self._count_per_cycle(self._view_units(data, _WORD_DTYPE))
        return int(kept.sum()), malformed

    def decode(self, data: ByteView, state: Any, after_loss: bool = False) -> DecodeResult:
        """Decode whole cycles; `state` is how many came before, without those that were lost."""
        from devices.linospad2_kernels import decode_stamps

        cycles = self._view_units(data, _WORD_DTYPE)
        kept, malformed = self._count_per_cycle(cycles)
        # Counted first: each block then knows which rows of the result are its own, and threads
        # need no lock.
        ends = np.cumsum(kept)
        total = int(ends[-1]) if len(ends) else 0
        records = np.empty(total, self.dtype)
        # Records are whole words, so that the kernel sees them as rows of words.
        rows = records.view(_WORD_DTYPE).reshape(total, self.dtype.itemsize // _WORD_DTYPE.itemsize)

        def work(block: slice) -> None:
            first = int(ends[block.start - 1]) if block.start else 0
            own = rows[first : int(ends[block.stop - 1])]
            decode_stamps(cycles[block], self.header, state + block.start, self.pixel_of, own)

        run_blocks(work, len(cycles), max(1, _BLOCK_BYTES // self.unit_bytes))
        return DecodeResult(records, malformed, state + len(cycles))

    def encode(self, records: Records) -> bytes:
        """Return the bytes of all cycles from 0 up to that of the last time stamp."""
        self._require_records(records)
        if np.any(records["pixel"] >= PIXELS) or np.any(records["code"] > CODE_MASK):
            raise InputError(f"a time stamp has a pixel below {PIXELS} and a code below 2**28")
        if len(records) == 0:
            return b""
        cycle = records["cycle"].astype(np.int64)
        if (cycle.max() + 1) * self.unit_bytes > _MAX_ENCODED_BYTES:
            raise InputError(
                f"{cycle.max() + 1} cycles take more than {_MAX_ENCODED_BYTES} bytes; encode them in pieces"
            )
        converter, address = np.divmod(self.address_of[records["pixel"]], np.uint32(ADDRESSES))
        queue = cycle * CONVERTERS + converter
        if np.any(np.diff(queue) < 0):
            raise InputError(
                "time stamps must be in order of cycle and converter; sort_stamps brings them there"
            )
        slot = np.arange(len(queue)) - np.searchsorted(queue, queue)
        if slot.max() >= self.timestamps:
            raise InputError("a converter has more time stamps in a cycle than it can hold")
        cycles = np.zeros((cycle[-1] + 1, self.cycle_words), _WORD_DTYPE)
        if self.counter:
            counter = np.ascontiguousarray(records["counter"])
            if np.any(counter != counter[np.searchsorted(cycle, cycle)]):
                raise InputError("all time stamps of a cycle must have the same counter")
            cycles[cycle, :COUNTER_WORDS] = counter.view(_WORD_DTYPE).reshape(-1, COUNTER_WORDS)
        place = self.header + converter * self.timestamps + slot
        cycles[cycle, place] = VALID_BIT | address << np.uint32(28) | records["code"]
        return cycles.tobytes()

    def sort_stamps(self, records: Records) -> Records:
        """Return time stamps in the order of the stream: by cycle, then by converter."""
        converter = self.address_of[records["pixel"]] // ADDRESSES
        return records[np.lexsort([converter, records["cycle"]])]

    def _count_per_cycle(self, cycles: NDArray[np.uint32]) -> tuple[IntArray, int]:
        """Count the time stamps of each cycle, and all malformed words."""
        from devices.linospad2_kernels import count_stamps

        kept = np.empty(len(cycles), np.int64)
        strays: list[int] = []  # appending is safe on several threads

        def work(block: slice) -> None:
            strays.append(count_stamps(cycles[block], self.header, kept[block]))

        run_blocks(work, len(cycles), max(1, _BLOCK_BYTES // self.unit_bytes))
        return kept, sum(strays)


CODES_PER_PERIOD = 140  # Codes in one period of the board's clock
CLOCK_PERIOD_S = 2500e-12  # Period of the board's clock, s
_MAX_FILE_BYTES = 1 << 23
_ROUNDING_S = 1e-6 * CLOCK_PERIOD_S


@dataclass(frozen=True)
class BoardCalibration(Storable):
    """Tables that turn a pixel's codes into seconds: `code_ends` (256, 140), the instant at which each
    code of a pixel ends, s since the clock's tick, because the converters' steps are uneven; `offsets`
    (256,), s, added to a pixel's times; and `hot_pixels` (k,), those that count without light.

    A table that has another shape, is not finite, goes back or leaves the clock's period is refused.
    """

    RECORD_KIND = "linospad2_calibration"

    code_ends: FloatArray = field(metadata=stored_array("s", "pixel", "code"))
    offsets: FloatArray = field(metadata=stored_array("s", "pixel"))
    hot_pixels: IntArray = field(
        default_factory=lambda: np.empty(0, np.int64),
        metadata=stored_array("px", "hot", dtype=np.int64, optional=True, skip_empty=True),
    )

    def __post_init__(self) -> None:
        for name, shape in (("code_ends", (PIXELS, CODES_PER_PERIOD)), ("offsets", (PIXELS,))):
            table = np.ascontiguousarray(getattr(self, name), np.float64)
            object.__setattr__(self, name, table)
            if table.shape != shape:
                raise ShapeError(f"LinoSPAD2's {name}", shape, table.shape)
            require(np.all(np.isfinite(table)), f"LinoSPAD2's {name} must be finite")
        ends = self.code_ends
        if (
            np.any(np.diff(ends, axis=1) < 0)
            or ends.min() < -_ROUNDING_S
            or ends.max() > CLOCK_PERIOD_S + _ROUNDING_S
        ):
            raise InputError(
                "LinoSPAD2's code_ends must not go back, and stay within the clock's 2.5 ns"
            )
        if np.any((self.hot_pixels < 0) | (self.hot_pixels >= PIXELS)):
            raise InputError(f"LinoSPAD2's hot pixels must lie within 0..{PIXELS - 1}")

    @classmethod
    def ideal(cls) -> BoardCalibration:
        """Return a board of even codes and pixels that are all in step."""
        ends = np.arange(1, CODES_PER_PERIOD + 1) * (CLOCK_PERIOD_S / CODES_PER_PERIOD)
        return cls(np.tile(ends, (PIXELS, 1)), np.zeros(PIXELS))

    @property
    def code_begins(self) -> FloatArray:
        """Instant at which each code begins, s since the clock's tick, (256, 140)."""
        return np.pad(self.code_ends[:, :-1], ((0, 0), (1, 0)))

    def times(self, records: Records) -> FloatArray:
        """Return when each photon came, s since its cycle began: the end of its code. ``time =
        (code - code % 140) * 2500 ps / 140 + code_ends[pixel, code % 140] + offsets[pixel]``.
        """
        periods, code = np.divmod(records["code"], CODES_PER_PERIOD)
        found: FloatArray = periods * CLOCK_PERIOD_S
        found += self.code_ends[records["pixel"], code]
        found += self.offsets[records["pixel"]]
        return found


def load_calibration(
    code_table: str | Path, offset_table: str | Path, hot_pixels: str | Path | None = None
) -> BoardCalibration:
    """Read tables as the board's makers and daplis write them. `code_table`: CSV, ps: a line of
    code numbers, then for each pixel its number and 140 ends of codes; `offset_table`: NPY with 256
    numbers, ps; `hot_pixels`: text with one pixel number in each line.
    """
    picosecond = 1e-12
    with _guard_table(code_table):
        table = np.loadtxt(code_table, delimiter=",", skiprows=1, ndmin=2)
    # Mapped, not read: a header that claims more than the file holds is refused before memory is
    # taken.
    with _guard_table(offset_table):
        mapped = np.load(offset_table, mmap_mode="r", allow_pickle=False)
        offsets = np.asarray(mapped, np.float64)
    hot = np.empty(0)
    if hot_pixels is not None:
        with _guard_table(hot_pixels):
            words = Path(hot_pixels).read_text("ascii").split()
            hot = np.array([int(word) for word in words], np.float64)
        if np.any((hot < 0) | (hot >= PIXELS)):
            raise FileFormatError(hot_pixels, f"names pixels beyond 0..{PIXELS - 1}")
    if table.ndim != 2 or table.shape[1] != CODES_PER_PERIOD + 1:
        raise FileFormatError(
            code_table, f"must have {CODES_PER_PERIOD + 1} columns, found shape {table.shape}"
        )
    return BoardCalibration(table[:, 1:] * picosecond, offsets * picosecond, hot.astype(np.int64))


@contextlib.contextmanager
def _guard_table(path: str | Path) -> Iterator[None]:
    with guard(path, "holds no table of numbers"):
        size = Path(path).stat().st_size
        if size > _MAX_FILE_BYTES:
            raise FileFormatError(path, f"is larger than any table of LinoSPAD2: {size} bytes")
        yield


def make_calibration_record(
    board: BoardCalibration, laser_period: float | None, camera: Record | None
) -> Record:
    """Return a board's tables, the laser's period (s) and the camera as one record."""
    record = board.to_record()
    attributes = {} if laser_period is None else {"laser_period_s": laser_period}
    children = {} if camera is None else {"camera": camera}
    return Record(record.kind, record.fields, attributes, children)


@dataclass(frozen=True)
class Sidecar:
    """What the TOML file beside a recording says; names of files are relative to it."""

    firmware: str  # "2212b" or "2212s"
    timestamps_per_cycle: int
    absolute_counter: bool
    board: str = ""  # which board it was
    code_table: str = ""
    offset_table: str = ""
    hot_pixels: str = ""
    laser_period_ps: float = 0.0  # where pulses were locked to the board's clock
    camera: str = ""  # file of the camera in front of the line
    folder: Path = Path()

    @property
    def codec(self) -> LinoSpad2Codec:
        return LinoSpad2Codec(self.firmware, self.timestamps_per_cycle, self.absolute_counter)

    @property
    def laser_period(self) -> float | None:
        return self.laser_period_ps * 1e-12 or None

    @cached_property
    def calibration(self) -> BoardCalibration:
        """The board's tables; `BoardCalibration.ideal` where none are named."""
        if bool(self.code_table) != bool(self.offset_table):
            raise InputError("code_table and offset_table belong together: give both or neither")
        if self.hot_pixels and not self.code_table:
            raise InputError("hot_pixels needs code_table and offset_table as well")
        if not self.code_table:
            return BoardCalibration.ideal()
        hot = self.folder / self.hot_pixels if self.hot_pixels else None
        return load_calibration(self.folder / self.code_table, self.folder / self.offset_table, hot)


def read_sidecar(recording: str | Path) -> Sidecar:
    """Read the TOML file that lies beside `recording` and has its name: the fields of `Sidecar`."""
    path = Path(recording).with_suffix(".toml")
    kinds = get_type_hints(Sidecar)
    del kinds["folder"]
    required = [one.name for one in fields(Sidecar) if one.default is MISSING]
    if not path.exists():
        raise StorageError(
            f"{recording}: its format is not in the file itself; write {', '.join(required)} into "
            f"{path.name} beside it"
        )
    found = read_toml(path, "a recording")
    for key in required:
        if key not in found:
            raise FileFormatError(path, f"lacks the key '{key}'")
    for key, value in found.items():
        if key not in kinds:
            raise FileFormatError(path, f"has the unknown key '{key}'; {suggest_name(key, kinds)}")
        kind = kinds[key]
        # TOML distinguishes 50000 from 50000.0, which people do not. By exact type, because bool is
        # an int in Python.
        if type(value) is not kind and not (kind is float and type(value) is int):
            raise FileFormatError(path, f"{key} must be a {kind.__name__}, found {value!r}")
    period = found.get("laser_period_ps")
    if period is not None and not 0 < period < float("inf"):
        raise FileFormatError(path, f"laser_period_ps must be a positive number, found {period}")
    sidecar = Sidecar(**found, folder=path.parent)
    try:
        _ = sidecar.codec, sidecar.calibration
    except InputError as fault:
        raise FileFormatError(path, str(fault)) from fault
    return sidecar


LIMITATION = "LinoSPAD2's USB commands are not public: its recordings are read, no board is driven"
PIECE_BYTES = 1 << 20  # Bytes that are read and decoded at once, or one cycle where that is longer


class LinoSpad2File(SeekableSource):
    """A recording, with the TOML file beside it that says how to read it.

    Opening counts the time stamps of the whole recording, which takes about a second for two
    gigabytes: the file has no index. A last cycle that is incomplete counts as one record that
    cannot be read.

    Memory: one piece of 1 MiB, or one cycle, and what it decodes to; 100 bytes for each piece of
    the recording.
    """

    codec: LinoSpad2Codec

    def __init__(self, path: str | Path) -> None:
        known = read_sidecar(path)
        codec = known.codec
        camera = Record.load(known.folder / known.camera, "camera") if known.camera else None
        with translate_read_errors(path):
            self._file = open(path, "rb")  # noqa: SIM115 - closed by `close`
        size = os.fstat(self._file.fileno()).st_size
        if size < codec.unit_bytes:
            self._file.close()
            raise FileFormatError(path, f"holds {size} bytes; one cycle takes {codec.unit_bytes}")
        total, rest = divmod(size, codec.unit_bytes)
        cycles = max(1, PIECE_BYTES // codec.unit_bytes)
        self._piece_bytes, self._whole_bytes = cycles * codec.unit_bytes, size - rest
        pieces = -(-total // cycles)
        counts = [codec.count_stamps(as_bytes(self._read_bytes(one))) for one in range(pieces)]
        sums = np.cumsum([(0, 0), *counts], axis=0).tolist()
        marks = [Checkpoint(number * cycles, *known) for number, known in enumerate(sums)]
        records = marks[-1].delivered + marks[-1].malformed
        super().__init__(codec, Path(path), pieces, records, int(rest > 0), marks)
        details = {"limits": LIMITATION, **codec.settings}
        self.info = Info("LinoSPAD2 recording", known.board, details)
        self.calibration = make_calibration_record(known.calibration, known.laser_period, camera)

    def close(self) -> None:
        super().close()
        self._file.close()

    def _read_piece(self, number: int) -> Piece:
        data = self._read_bytes(number)
        return Piece(data, self.codec.count_records(as_bytes(data)))

    def _read_bytes(self, number: int) -> bytes:
        begin = number * self._piece_bytes
        self._file.seek(begin)
        return self._file.read(min(self._piece_bytes, self._whole_bytes - begin))


def open_recording(uri: Uri) -> LinoSpad2File:
    """Open ``linospad2://run.dat`` or ``file://run.dat``."""
    Options.from_uri(uri)
    require(uri.location, f"'{uri.text}': name a recording; {LIMITATION}")
    return LinoSpad2File(uri.location)
