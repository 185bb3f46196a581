"""One interface for instruments that are connected, recorded or simulated: codecs, accounts of
records, the bounded buffer between an instrument and its reader, and sources.

A codec turns an instrument's bytes into records and back, with no instrument in sight. It never reads
from anywhere and keeps nothing between calls. What a decoder has to remember from one piece of the
stream to the next (how often a counter has wrapped) is an explicit *state* that goes in and comes
out; bytes of a record that is not complete yet stay with the caller, which asks
`Codec.count_complete_bytes` how far the complete ones reach.
"""

from __future__ import annotations

import abc
import enum
import threading
from bisect import bisect_right
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, field, is_dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Literal, NamedTuple, Self

import numpy as np
from numpy.typing import DTypeLike, NDArray

from tofclip.arrays import AnyArray
from tofclip.errors import BufferOverflowError, DeviceTimeoutError, InputError, require
from tofclip.storage import Record, Scalar

Records = AnyArray  # One-dimensional NumPy structured array, one row per record

# One-dimensional bytes. `as_bytes` makes one of anything that holds bytes, without a copy.
ByteView = NDArray[np.uint8]


def as_bytes(data: bytes | bytearray | memoryview | ByteView) -> ByteView:
    """View anything that holds bytes as an array of them, without a copy."""
    return data if isinstance(data, np.ndarray) else np.frombuffer(data, np.uint8)


@dataclass(frozen=True)
class DecodeResult:
    """What became of a piece of the stream.

    Parameters
    ----------
    records : (n,) structured array
    malformed : int
        Records in the piece that cannot be; they are left out of `records`.
    state : object
        What the next call needs to know. Opaque, immutable.
    """

    records: Records
    malformed: int
    state: Any


class Codec(abc.ABC):
    """Bytes to records and back, both vectorised.

    ``decode(encode(x), start).records`` equals ``x`` for every array of valid records. A codec
    raises only exceptions of `tofclip.errors`, whatever the bytes; it allocates no more than a
    stated multiple of the bytes that it was given.
    """

    name: ClassVar[str]  # in `devices.registry.CODECS`; a recording keeps it with `settings`
    start: ClassVar[Any]  # state before the first byte, and after the instrument began anew

    @property
    @abc.abstractmethod
    def dtype(self) -> np.dtype[Any]:
        """Type of a record; `encode` takes and `decode` gives arrays of it."""

    @property
    @abc.abstractmethod
    def unit_bytes(self) -> int:
        """Bytes of a record, or of as many as come together."""

    @property
    def settings(self) -> Mapping[str, Scalar]:
        """Arguments that build this codec again."""
        return asdict(self) if is_dataclass(self) else {}

    def count_complete_bytes(self, data: ByteView) -> int:
        """Return how many bytes at the front of ``data`` form whole records."""
        return len(data) - len(data) % self.unit_bytes

    def count_records(self, data: ByteView) -> int:
        """Return how many records, malformed ones included, are in ``data``, of which
        `count_complete_bytes` is all.
        """
        return len(data) // self.unit_bytes

    @abc.abstractmethod
    def decode(self, data: ByteView, state: Any, after_loss: bool = False) -> DecodeResult:
        """Decode whole records from ``data``; ``state`` is what the decoder remembers, from the call
        before or `start`; ``after_loss`` says that some are missing right before them.

        ``len(decoded.records) + decoded.malformed == count_records(data)``.
        """

    @abc.abstractmethod
    def encode(self, records: Records) -> bytes:
        """Return the bytes that the instrument would have sent for ``records`` (n,)."""

    def _view_units(self, data: ByteView, dtype: DTypeLike = np.uint8) -> AnyArray:
        """Return whole units as rows of words, (units, words)."""
        found = as_bytes(data)
        if found.size % self.unit_bytes:
            raise InputError(
                f"{found.size} bytes are not a whole number of {self.unit_bytes}-byte records"
            )
        words = np.ascontiguousarray(found).view(dtype)
        return words.reshape(-1, self.unit_bytes // words.itemsize)

    def _require_records(self, records: Records) -> None:
        if records.dtype != self.dtype or records.ndim != 1:
            raise InputError(f"records must be a one-dimensional array of {self.dtype}")


@dataclass(frozen=True)
class Stats:
    """A snapshot of a source's accounts, in records.

    Every record that the instrument acquired is in exactly one of the five that follow; see
    `is_balanced`.

    Parameters
    ----------
    acquired : int
        What the instrument registered, as far as it reported or sent.
    delivered : int
        What `Source.read` returned.
    unread : int
        What arrived and still waits in this program's buffer.
    dropped_host : int
        What arrived and was dropped because it was not read in time.
    lost_device : int
        What the instrument registered but never handed over, or the wire swallowed.
    malformed : int
        What arrived and cannot be a record.
    timeouts, reconnects : int
        How often nothing came in time, and how often the instrument had to be found anew.
    """

    acquired: int = 0
    delivered: int = 0
    unread: int = 0
    dropped_host: int = 0
    lost_device: int = 0
    malformed: int = 0
    timeouts: int = 0
    reconnects: int = 0

    @property
    def is_balanced(self) -> bool:
        """Whether acquired = delivered + unread + dropped_host + lost_device + malformed."""
        known = self.delivered + self.unread + self.dropped_host + self.lost_device
        return self.acquired == known + self.malformed

    def as_dict(self) -> dict[str, int]:
        return asdict(self)


class Ledger:
    """The accounts of a running source; safe to use from any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._stats = Stats()

    @property
    def stats(self) -> Stats:
        """The accounts as they stand."""
        # No lock: the snapshot is immutable and replaced as a whole.
        return self._stats

    def receive(self, records: int) -> None:
        """Enter records that arrived and wait to be read."""
        self._add(acquired=records, unread=records)

    def deliver(self, delivered: int, malformed: int) -> None:
        """Move records that waited to those that were read, sound or malformed."""
        self._add(unread=-delivered - malformed, delivered=delivered, malformed=malformed)

    def drop(self, records: int) -> None:
        """Move records that waited to those that were not read in time."""
        self._add(unread=-records, dropped_host=records)

    def truncate(self, records: int = 1) -> None:
        """Enter records of which only a part arrived."""
        self._add(acquired=records, malformed=records)

    def lose(self, records: int) -> None:
        """Enter records that the instrument registered and that never arrived."""
        self._add(acquired=records, lost_device=records)

    def time_out(self) -> None:
        """Count a time that nothing came."""
        self._add(timeouts=1)

    def reconnect(self) -> None:
        """Count a time that the instrument was found anew."""
        self._add(reconnects=1)

    def _add(self, **changes: int) -> None:
        with self._lock:
            now = self._stats
            self._stats = replace(
                now, **{name: getattr(now, name) + change for name, change in changes.items()}
            )


OverflowPolicy = Literal["block", "drop_oldest", "fail"]
OVERFLOW_POLICIES: tuple[OverflowPolicy, ...] = ("block", "drop_oldest", "fail")


class Gap(enum.IntEnum):
    """What is missing right before a piece of a stream."""

    NONE = 0
    LOSS = 1  # Records; the instrument's clock went on
    RESTART = 2  # The instrument itself: it was away and may have begun anew


@dataclass(frozen=True)
class Piece:
    """Whole records as they came, not decoded yet."""

    data: bytes
    records: int  # how many, by the codec's count
    gap: Gap = Gap.NONE
    received_at: float = 0.0  # when it came, s of `time.monotonic`; 0 where that is not known
    # when the instrument took the last of it by its own clock, s of `time.monotonic` (see
    # `devices.stream.InstrumentClock`); 0 where the instrument does not say
    taken_at: float = 0.0


class RingBuffer:
    """A queue of pieces that never holds more than `capacity` bytes (but always at least one
    piece). `capacity`: bytes; `policy`: what happens when it is full: the writer waits (and the
    instrument's own memory fills up), the oldest piece goes, or measurement ends with
    `BufferOverflowError` after what is in the queue; `ledger`: where arrivals and drops are
    entered.
    """

    def __init__(self, capacity: int, policy: OverflowPolicy, ledger: Ledger) -> None:
        self._capacity, self._policy, self._ledger = capacity, policy, ledger
        self._pieces: deque[Piece] = deque()
        self._bytes = 0
        # Entered by itself: Ctrl-C between the lines of a condition's `__enter__` would leave it locked.
        self._lock = threading.RLock()
        self._changed = threading.Condition(self._lock)
        self._ended = False
        self._fault: BaseException | None = None

    def put(self, piece: Piece) -> None:
        """Append a piece; with policy ``"block"``, once there is room or the ring has ended."""
        with self._lock:
            self._ledger.receive(piece.records)
            if self._policy == "block":
                self._changed.wait_for(lambda: self._has_room(piece) or self._ended)
            elif self._policy == "fail" and not self._has_room(piece):
                self._ledger.drop(piece.records)
                self._fault = BufferOverflowError(
                    f"records came faster than they were read and the buffer of {self._capacity} bytes is full; "
                    "read faster, or choose policy=block or policy=drop_oldest"
                )
                raise self._fault
            self._pieces.append(piece)
            self._bytes += len(piece.data)
            self._drop_oldest()
            self._changed.notify_all()

    def get(self, timeout: float) -> Piece | None:
        """Take the oldest piece; None at the end of the stream."""
        with self._lock:
            if not self._changed.wait_for(
                lambda: self._pieces or self._ended or self._fault, timeout
            ):
                raise DeviceTimeoutError(
                    f"the instrument sent nothing for {timeout:g} s; is there light on the detector?"
                )
            if self._pieces:
                piece = self._pieces.popleft()
                self._bytes -= len(piece.data)
                self._changed.notify_all()
                return piece
            if self._fault is not None:
                raise self._fault
            return None

    def keep_newest(self) -> None:
        """From now on, keep only the newest piece, and count the others as dropped."""
        with self._lock:
            self._policy, self._capacity = "drop_oldest", 1
            self._drop_oldest()
            self._changed.notify_all()

    def fail(self, fault: BaseException) -> None:
        """End the stream with an exception; the first one counts."""
        with self._lock:
            # Later faults are mostly consequences of the first.
            self._fault = self._fault or fault
            self._changed.notify_all()

    def end(self) -> None:
        """End the stream; what is in it can still be taken, and no writer waits any more."""
        with self._lock:
            self._ended = True
            self._changed.notify_all()

    def _has_room(self, piece: Piece) -> bool:
        # A piece larger than the ring is taken when the ring is empty; it could never enter
        # otherwise.
        return not self._pieces or self._bytes + len(piece.data) <= self._capacity

    def _drop_oldest(self) -> None:
        """Where the policy says so, take out the oldest pieces while there are too many bytes, and mark
        at the next one that something is missing.
        """
        if self._policy != "drop_oldest":
            return
        while len(self._pieces) > 1 and self._bytes > self._capacity:
            oldest = self._pieces.popleft()
            self._bytes -= len(oldest.data)
            self._ledger.drop(oldest.records)
            gap = max(oldest.gap, Gap.LOSS, self._pieces[0].gap)
            self._pieces[0] = replace(self._pieces[0], gap=gap)


READ_TIMEOUT_S = 5.0  # Seconds that an iteration waits for the next batch of a live instrument


@dataclass(frozen=True)
class Info:
    """What is known about an instrument.

    Parameters
    ----------
    instrument : str
        What it is, in words.
    serial : str
        Its serial number; empty where it has none.
    details : mapping of str to str, int, float or bool
        Firmware, clock and the like; units in the names (``clock_hz``). Where a protocol is not
        public, ``"limits"`` says what that means.
    """

    instrument: str
    serial: str = ""
    details: Mapping[str, Scalar] = field(default_factory=dict)

    def as_dict(self) -> dict[str, Scalar]:
        return {"instrument": self.instrument, "serial": self.serial, **self.details}


@dataclass(frozen=True)
class Batch:
    """Records that were decoded together.

    Parameters
    ----------
    records : (n,) structured array
        Of the codec's `dtype`. May be empty.
    first : int
        Number of the first one among all records that arrived well, from 0; what `Source.seek`
        takes.
    after_gap : bool
        Something is missing right before these records. Where the instrument was away, its clock
        has started anew.
    received_at : float
        When they came from a live instrument, s of `time.monotonic`; 0 otherwise.
    taken_at : float
        When the instrument took the last of them by its own clock, s of `time.monotonic` (see
        `devices.stream.InstrumentClock`); 0 where the instrument does not say.
    """

    records: Records
    first: int = 0
    after_gap: bool = False
    received_at: float = 0.0
    taken_at: float = 0.0

    def __len__(self) -> int:
        return len(self.records)


class Closing(abc.ABC):
    """What is closed where its context is left."""

    @abc.abstractmethod
    def close(self) -> None:
        """Let go of what is held; closing twice is fine."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class Source(Closing):
    """A stream of records: a context manager and an iterator over batches. A subclass gives `read`,
    `close`, `info` and `stats`, and where they differ from the defaults the rest.

    Attributes
    ----------
    info : Info
        What is known about the instrument.
    calibration : Record or None
        Tables and constants that turn records into seconds and pixels, if there are any.
    is_live : bool
        Whether the records come from an instrument, real or emulated, and go by if not read.
    is_seekable : bool
        Whether `seek` works.
    """

    info: Info
    calibration: Record | None = None
    is_live = False
    is_seekable = False

    @property
    @abc.abstractmethod
    def stats(self) -> Stats:
        """Where every record went so far; final after `close`."""

    @abc.abstractmethod
    def read(self, timeout: float = READ_TIMEOUT_S) -> Batch | None:
        """Return the next batch, or None at the end of the stream. `DeviceTimeoutError`: nothing came within
        `timeout` s, and reading on is fine; another `DeviceError`: the instrument failed, and what
        arrived before has been read by now.
        """

    def seek(self, record: int) -> None:
        """Go to record number ``record``, so that the next batch begins with it; `InputError` where the
        source cannot go back, or has no such record.
        """
        raise InputError("a live source cannot seek; record it and open the recording")

    def stop(self) -> None:
        """Let the instrument register nothing more; what arrived can still be read, up to the None
        at the end. Where nothing waits to be read this is the same as `close`.
        """
        self.close()

    def drain(self) -> None:
        """Stop, and read what is left, so that the accounts are final."""
        self.stop()
        while self.read() is not None:
            pass

    @abc.abstractmethod
    def close(self) -> None:
        """Stop the instrument and let go of it; then `read` returns None. Closing twice is fine."""

    def __iter__(self) -> Iterator[Batch]:
        return self

    def __next__(self) -> Batch:
        batch = self.read()
        if batch is None:
            raise StopIteration
        return batch


class DecodedSource(Source):
    """What live and recorded streams have in common, so that both decode alike."""

    is_complete = True
    """Whether nothing is missing beyond `stats`; False for a cut or repaired recording."""

    def __init__(self, codec: Codec, ledger: Ledger) -> None:
        self.codec = codec
        self.tap: Callable[[Piece], None] | None = None
        """Called with every piece right before it is decoded."""
        self._ledger = ledger
        self._state = codec.start

    @property
    def stats(self) -> Stats:
        return self._ledger.stats

    def _decode_piece(self, piece: Piece) -> Batch:
        """Hand a piece to the tap and decode it."""
        if self.tap is not None:
            self.tap(piece)
        has_gap = piece.gap is not Gap.NONE
        # An instrument that began anew counts from zero again, so that what the decoder remembers
        # is wrong.
        if piece.gap is Gap.RESTART:
            self._state = self.codec.start
        found = self.codec.decode(as_bytes(piece.data), self._state, has_gap)
        self._state = found.state
        first = self._ledger.stats.delivered
        self._ledger.deliver(len(found.records), found.malformed)
        return Batch(found.records, first, has_gap, piece.received_at, piece.taken_at)


class Checkpoint(NamedTuple):
    """What the decoder and the accounts were when a piece began."""

    state: Any
    delivered: int
    malformed: int


class SeekableSource(DecodedSource):
    """A number of pieces that can be read again. The accounts are those of the reading; after
    `seek` they are as if everything before had been read.

    `records`: in all pieces; `truncated`: records besides of which only a part is there;
    `checkpoints`: of every piece, and of the end, where they are known; otherwise they are noted
    while reading.
    """

    is_seekable = True

    def __init__(
        self,
        codec: Codec,
        name: Path,
        pieces: int,
        records: int,
        truncated: int = 0,
        checkpoints: list[Checkpoint] | None = None,
    ) -> None:
        super().__init__(codec, Ledger())
        self._name, self._pieces, self._records, self._truncated = name, pieces, records, truncated
        self._checkpoints = checkpoints or [Checkpoint(codec.start, 0, 0)]
        self._next = self._skip = 0
        self._go_to(0)

    @abc.abstractmethod
    def _read_piece(self, number: int) -> Piece:
        """Return a piece, by its number from 0."""

    def read(self, timeout: float = READ_TIMEOUT_S) -> Batch | None:
        if self._next >= self._pieces:
            return None
        batch = self._decode_next()
        skipped, self._skip = self._skip, 0
        return Batch(batch.records[skipped:], batch.first + skipped) if skipped else batch

    def seek(self, record: int) -> None:
        require(record >= 0, f"records are numbered from 0, got {record}")
        marks, tap = self._checkpoints, self.tap
        self.tap = None  # what is stepped over is not read
        try:
            self._go_to(bisect_right(marks, record, key=lambda mark: mark.delivered) - 1)
            while self._next < self._pieces and marks[self._next].delivered <= record:
                self._decode_next()
        finally:
            self.tap = tap
        reached = marks[self._next].delivered
        require(record <= reached, f"{self._name} has only {reached} records, no record {record}")
        if record < reached:
            self._go_to(self._next - 1)
            self._skip = record - marks[self._next].delivered

    def close(self) -> None:
        self._next = self._pieces

    def _decode_next(self) -> Batch:
        """Decode the next piece and note how things are behind it."""
        batch = self._decode_piece(self._read_piece(self._next))
        self._next += 1
        if self._next == len(self._checkpoints):
            stats = self.stats
            self._checkpoints.append(Checkpoint(self._state, stats.delivered, stats.malformed))
        return batch

    def _go_to(self, number: int) -> None:
        """Make the next piece the one with that number, as if all before it had been read."""
        self._next, self._skip = number, 0
        self._state, delivered, malformed = self._checkpoints[number]
        self._ledger = Ledger()
        self._ledger.receive(self._records)
        self._ledger.deliver(delivered, malformed)
        self._ledger.truncate(self._truncated)
