"""Sources whose instrument pushes bytes: one thread empties the instrument, `Source.read` decodes.

::

    instrument -> Feed -> [thread: whole records] -> Ring -> (tap) -> Codec -> Batch
"""

from __future__ import annotations

import abc
import atexit
import contextlib
import threading
from collections.abc import Callable
from dataclasses import dataclass
from math import inf
from time import monotonic, sleep
from typing import TypeVar
from weakref import WeakSet

from devices.address import Options, option
from devices.source import (
    OVERFLOW_POLICIES,
    READ_TIMEOUT_S,
    Batch,
    Codec,
    DecodedSource,
    Gap,
    Info,
    Ledger,
    OverflowPolicy,
    Piece,
    RingBuffer,
    as_bytes,
)
from tofclip.errors import (
    DeviceBusyError,
    DeviceDisconnectedError,
    DeviceError,
    DeviceNotFoundError,
    DevicePermissionError,
    DeviceTimeoutError,
)
from tofclip.storage import Record

# s of the computer's clock after which old messages say nothing any more: two quartzes part by some
# 3 ms a minute
WINDOW_S = 30.0


class InstrumentClock:
    """Maps stamps of an instrument's clock to `time.monotonic`, by the least delay seen.

    No message arrives before it was sent, so arrival minus stamp is the difference of the two
    clocks plus a delay, and the least of these over the last half minute is the best estimate of
    the difference. It still holds the least delay itself (a network's, and what the instrument
    needs between its stamp and its first byte), which no computer can measure from outside:
    estimated times are too late by that much, and latencies computed from them too short. They are
    never later than the arrival, so waiting in any buffer behind it counts in full.
    """

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget everything: the instrument began anew."""
        self._last_stamp = self._window_began = -inf
        self._least = self._least_before = inf

    def observe(self, stamp: float, arrived_at: float) -> None:
        """Note when a stamped message arrived; a stamp that goes back means a clock begun anew."""
        if stamp < self._last_stamp:
            self.reset()
        self._last_stamp = stamp
        if arrived_at - self._window_began > WINDOW_S:
            self._window_began = arrived_at
            self._least, self._least_before = inf, self._least
        self._least = min(self._least, arrived_at - stamp)

    def to_host(self, stamp: float) -> float:
        """Return the time of a stamp, s of `time.monotonic`; 0 where nothing was observed yet."""
        offset = min(self._least, self._least_before)
        return stamp + offset if offset < inf else 0.0


# Seconds after which the thread looks whether it should stop, though nothing came
POLL_INTERVAL_S = 0.1
# Seconds in which a stopped instrument must have handed over what it still holds
DRAIN_TIMEOUT_S = 3.0
# Seconds that `StreamSource.close` waits for the thread, which never takes so long
STOP_TIMEOUT_S = 15.0
RETRY_INTERVAL_S = 0.1  # Most seconds between two attempts to reach an instrument that went away
_MEBIBYTE = 1 << 20
# Not there yet, or there before the system has given this user the right to it
AWAY = (
    *(DeviceNotFoundError, DeviceDisconnectedError, DeviceTimeoutError),
    *(DeviceBusyError, DevicePermissionError),
)
_Connected = TypeVar("_Connected")


@dataclass(frozen=True)
class Transfer:
    """What one transfer brought."""

    data: memoryview  # valid until the next `Feed.pull`
    # what is missing before it. After a gap the data begins with a whole record
    gap: Gap = Gap.NONE
    # when the instrument took the last of it by its own clock, s of `time.monotonic`; 0 where it
    # does not say
    taken_at: float = 0.0


class Feed(abc.ABC):
    """Where a stream's bytes come from. Every method is called from one thread, never two at once."""

    codec: Codec  # what reads its bytes
    ledger: Ledger  # where the feed enters losses and reconnections
    info: Info  # what is known about the instrument
    calibration: Record | None = None  # what turns records into seconds and pixels

    def start(self) -> None:  # noqa: B027 - some instruments run since they were connected
        """Let the instrument send."""

    @abc.abstractmethod
    def pull(self, timeout: float) -> Transfer | None:
        """Return what came next, None at the end; DeviceTimeoutError if nothing came."""

    @abc.abstractmethod
    def stop(self) -> None:
        """Let the instrument register nothing more; what it holds can still be pulled."""

    def close(self) -> None:  # noqa: B027 - some hold nothing
        """Enter what the instrument says that it lost, and let go of it."""


@dataclass(frozen=True)
class StreamOptions(Options):
    """How much a stream holds for a slow reader, and what happens then; see `RingBuffer`."""

    buffer_mib: float = option(64.0, above=0, most=65536)
    policy: OverflowPolicy = option("", choices=OVERFLOW_POLICIES)  # noqa: RUF009 - declares a field


@dataclass(frozen=True)
class LiveOptions(StreamOptions):
    """Seconds to wait for an instrument that went away."""

    reconnect_s: float = option(5.0, least=0, most=600)


class StreamSource(DecodedSource):
    """A live source. Memory: the buffer's capacity, one transfer and one decoded piece. `release`: called
    once the feed has been closed.
    """

    is_live = True

    def __init__(
        self,
        feed: Feed,
        options: StreamOptions | None = None,
        release: Callable[[], None] = lambda: None,
    ) -> None:
        options = options or StreamOptions()
        super().__init__(feed.codec, feed.ledger)
        self._feed, self._release = feed, release
        self._rest, self._gap = b"", Gap.NONE
        capacity = int(options.buffer_mib * _MEBIBYTE)
        self._ring = RingBuffer(capacity, options.policy, feed.ledger)
        self._stopping, self._closed = threading.Event(), False
        self._owned = threading.Lock()  # the feed, by the thread that uses it up to its end
        self._thread = threading.Thread(target=self._run_reader, name="device reader", daemon=True)
        try:
            feed.start()
            # Asked before the thread starts, because a feed is used by one thread at a time.
            self.info, self.calibration = feed.info, feed.calibration
            _open_sources.add(self)
            self._thread.start()
        except BaseException:
            # Also a signal to end: nothing else could switch the instrument off now, unless the
            # thread runs already. What fails meanwhile must not hide why this ended.
            if self._owned.acquire(blocking=False):
                with contextlib.suppress(DeviceError):
                    feed.close()
            else:
                self.close()
            raise

    def read(self, timeout: float = READ_TIMEOUT_S) -> Batch | None:
        piece = None if self._closed else self._ring.get(timeout)
        return None if piece is None else self._decode_piece(piece)

    def keep_newest(self) -> None:
        """From now on, a late reader gets the newest piece; the others count as dropped."""
        self._ring.keep_newest()

    def stop(self) -> None:
        self._stopping.set()

    def close(self) -> None:
        self._closed = True
        self._stopping.set()
        self._ring.end()
        # The collector may close a forgotten source on any thread, its own reader's among them.
        if self._thread is not threading.current_thread():
            self._thread.join(STOP_TIMEOUT_S)
        _open_sources.discard(self)

    def _run_reader(self) -> None:
        """Move bytes from the instrument into the ring until the end; the thread's whole life.
        Whatever goes wrong here, `read` raises it: a thread that ended without a word would look
        like an instrument in the dark.
        """
        if not self._owned.acquire(blocking=False):
            return
        # The feed is closed even if reading failed, and on the thread that used it.
        for step in (self._pull_all, self._count_truncated, self._feed.close, self._release):
            try:
                step()
            except BaseException as fault:
                self._ring.fail(fault)
        self._ring.end()

    def _pull_all(self) -> None:
        """Pull until the end of the stream, or until a stopped instrument has nothing left."""
        while not self._stopping.is_set():
            try:
                arrival = self._feed.pull(POLL_INTERVAL_S)
            except DeviceTimeoutError:
                self._ledger.time_out()
                continue
            if arrival is None:
                break
            self._enqueue(arrival)
        self._feed.stop()
        deadline = monotonic() + DRAIN_TIMEOUT_S
        with contextlib.suppress(DeviceTimeoutError):
            while monotonic() < deadline and (rest := self._feed.pull(POLL_INTERVAL_S)):
                self._enqueue(rest)

    def _enqueue(self, arrival: Transfer) -> None:
        """Cut what came into whole records."""
        # A record cut by a gap never gets its end.
        if arrival.gap is not Gap.NONE:
            self._count_truncated()
            self._gap = max(self._gap, arrival.gap)
        data = self._rest + arrival.data
        end = self.codec.count_complete_bytes(as_bytes(data))
        whole, self._rest = data[:end], data[end:]
        if whole:
            records = self.codec.count_records(as_bytes(whole))
            self._ring.put(Piece(whole, records, self._gap, monotonic(), arrival.taken_at))
            self._gap = Gap.NONE

    def _count_truncated(self) -> None:
        """Enter a record of which the end never came."""
        if self._rest:
            self._ledger.truncate()
            self._rest = b""


_open_sources: WeakSet[StreamSource] = WeakSet()


@atexit.register
def _close_open_sources() -> None:
    """Switch off what a program leaves open when it ends, whether it forgot or was interrupted."""
    for source in list(_open_sources):
        source.close()


def retry_connect(connect: Callable[[], _Connected], seconds: float) -> _Connected:
    """Return what `connect` returns, which is called again while the instrument does not answer."""
    deadline = monotonic() + seconds
    while True:
        try:
            return connect()
        except AWAY as fault:
            # Looked at after the attempt, so that there is always one.
            if monotonic() > deadline:
                raise DeviceDisconnectedError(
                    f"the connection broke and no answer came for {seconds:g} s ({fault})"
                ) from fault
            sleep(min(RETRY_INTERVAL_S, seconds / 10))
