"""One interface for instruments that are connected, recorded or simulated, and what sources share
whose records come out of bytes, which can be tapped before they are decoded.
"""

from __future__ import annotations

import abc
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from types import TracebackType
from typing import Self

from devices.codec import Codec, Records, as_bytes
from devices.ledger import Ledger, Stats
from devices.ring import Gap, Piece
from tofclip.errors import InputError
from tofclip.storage import Record, Scalar

READ_TIMEOUT_S = 5.0
"""Seconds that an iteration waits for the next batch of a live instrument."""


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
        """Return everything in one mapping."""
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
        `devices.clock.InstrumentClock`); 0 where the instrument does not say.
    """

    records: Records
    first: int = 0
    after_gap: bool = False
    received_at: float = 0.0
    taken_at: float = 0.0

    def __len__(self) -> int:
        return len(self.records)


class Source(abc.ABC):
    """A stream of records: a context manager and an iterator over batches.

    A subclass gives `read`, `close`, `info` and `stats`, and where they differ from the defaults
    the rest. Opening is done by the constructor (or the function in `devices.registry`); leaving
    the context closes.
    """

    @property
    @abc.abstractmethod
    def info(self) -> Info:
        """What is known about the instrument."""

    @property
    @abc.abstractmethod
    def stats(self) -> Stats:
        """Where every record went so far; final after `close`."""

    @property
    def calibration(self) -> Record | None:
        """Tables and constants that turn records into seconds and pixels, None where there are
        none.
        """
        return None

    @property
    def is_live(self) -> bool:
        """Whether the records come from an instrument, real or emulated, and go by if they are not read
        them.
        """
        return False

    @property
    def is_seekable(self) -> bool:
        """Whether `seek` works."""
        return False

    @abc.abstractmethod
    def read(self, timeout: float = READ_TIMEOUT_S) -> Batch | None:
        """Return the next batch, or None at the end of the stream.

        Parameters
        ----------
        timeout : float
            Seconds to wait at most.

        Raises
        ------
        DeviceTimeoutError
            Nothing came in that time; reading on is fine.
        DeviceError
            The instrument failed in another way; what arrived before has been read by now.
        """

    def seek(self, record: int) -> None:
        """Go to record number `record`, so that the next batch begins with it.

        Raises
        ------
        InputError
            The source cannot go back, or has no such record.
        """
        raise InputError("a live source cannot seek; record it and open the recording")

    def stop(self) -> None:
        """Let the instrument register nothing more; what arrived can still be read, up to the None
        at the end.

        Where nothing waits to be read this is the same as `close`.
        """
        self.close()

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

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        fault: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


class DecodedSource(Source):
    """What live and recorded streams have in common, so that both decode alike.

    `ledger`: where the pieces have been entered as unread.
    """

    def __init__(self, codec: Codec, ledger: Ledger) -> None:
        self.codec = codec
        self.tap: Callable[[Piece], None] | None = None
        """Called with every piece right before it is decoded."""
        self._ledger = ledger
        self._state = codec.start

    @property
    def stats(self) -> Stats:
        return self._ledger.stats

    @property
    def is_complete(self) -> bool:
        """Whether nothing is missing beyond what `stats` reports; False for a recording that was
        cut or repaired.
        """
        return True

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
