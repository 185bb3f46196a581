"""The bounded buffer between the thread that empties an instrument and the reader of records."""

from __future__ import annotations

import enum
import threading
from collections import deque
from dataclasses import dataclass, replace
from typing import Literal

from devices.ledger import Ledger
from tofclip.errors import BufferOverflowError, DeviceTimeoutError

OverflowPolicy = Literal["block", "drop_oldest", "fail"]
OVERFLOW_POLICIES: tuple[OverflowPolicy, ...] = ("block", "drop_oldest", "fail")


class Gap(enum.IntEnum):
    """What is missing right before a piece of a stream."""

    NONE = 0
    LOSS = 1
    """Records; the instrument's clock went on."""
    RESTART = 2
    """The instrument itself: it was away and may have begun anew."""


@dataclass(frozen=True)
class Piece:
    """Whole records as they came, not decoded yet."""

    data: bytes
    records: int  # how many, by the codec's count
    gap: Gap = Gap.NONE
    received_at: float = 0.0  # when it came, s of `time.monotonic`; 0 where that is not known
    # when the instrument took the last of it by its own clock, s of `time.monotonic` (see
    # `devices.clock.InstrumentClock`); 0 where the instrument does not say
    taken_at: float = 0.0


class RingBuffer:
    """A queue of pieces that never holds more than `capacity` bytes (but always at least one
    piece).

    `capacity`: bytes; `policy`: what happens when it is full: the writer waits (and the
    instrument's own memory fills up), the oldest piece goes, or measurement ends with
    `BufferOverflowError` after what is in the queue; `ledger`: where arrivals and drops are
    entered.
    """

    def __init__(self, capacity: int, policy: OverflowPolicy, ledger: Ledger) -> None:
        self._capacity, self._policy, self._ledger = capacity, policy, ledger
        self._pieces: deque[Piece] = deque()
        self._bytes = 0
        self._changed = threading.Condition()
        self._ended = False
        self._fault: BaseException | None = None
        self._lost_before_next = Gap.NONE

    def put(self, piece: Piece) -> None:
        """Append a piece. With policy ``"block"`` this waits until there is room or the ring has
        ended.
        """
        with self._changed:
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
            while not self._has_room(piece) and self._policy == "drop_oldest":
                self._drop_oldest()
            # What was dropped while the ring was empty is marked at the next piece.
            self._pieces.append(replace(piece, gap=max(piece.gap, self._lost_before_next)))
            self._bytes += len(piece.data)
            self._lost_before_next = Gap.NONE
            self._changed.notify_all()

    def get(self, timeout: float) -> Piece | None:
        """Take the oldest piece; None at the end of the stream."""
        with self._changed:
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
        with self._changed:
            self._policy = "drop_oldest"
            self._capacity = 1
            while len(self._pieces) > 1:
                self._drop_oldest()
            self._changed.notify_all()

    def fail(self, fault: BaseException) -> None:
        """End the stream with an exception; the first one counts."""
        with self._changed:
            # Later faults are mostly consequences of the first.
            self._fault = self._fault or fault
            self._changed.notify_all()

    def end(self) -> None:
        """End the stream; what is in it can still be taken, and a writer that waits for room waits
        no more.
        """
        with self._changed:
            self._ended = True
            self._changed.notify_all()

    def _has_room(self, piece: Piece) -> bool:
        # A piece larger than the ring is taken when the ring is empty; it could never enter
        # otherwise.
        return not self._pieces or self._bytes + len(piece.data) <= self._capacity

    def _drop_oldest(self) -> None:
        """Take out the oldest piece and remember, at the next one, that something is missing."""
        oldest = self._pieces.popleft()
        self._bytes -= len(oldest.data)
        self._ledger.drop(oldest.records)
        gap = max(oldest.gap, Gap.LOSS)
        if self._pieces:
            self._pieces[0] = replace(self._pieces[0], gap=max(self._pieces[0].gap, gap))
        else:
            self._lost_before_next = max(self._lost_before_next, gap)
