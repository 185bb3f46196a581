"""How old a shot is when something has been made of it, and what became of all others."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass

from devices.transients import LiveShot, ShotStamp, TransientStream
from tofclip.errors import TofclipError

MAX_STAMPS = 10_000  # Shots on their way whose stamps are kept


@dataclass(frozen=True)
class ShotAccounts:
    """What became of every shot."""

    acquired: int  # shots that the instrument took, or that were read from a file
    delivered: int
    dropped_device: int  # lost by the instrument or on the wire, or damaged when they came
    # came and were dropped for newer ones, by the driver's buffer or between the stages, or waited
    # still when the stream was ended
    dropped_host: int
    failed: int = 0  # could not be read, or no cloud could be made of them

    @property
    def dropped(self) -> int:
        """All that were taken and lost or left out, without those that failed."""
        return self.dropped_device + self.dropped_host


class TrackedShots(Iterator[LiveShot | TofclipError]):
    """Shots on their way into stages, each with its stamp, so that the consumer behind the stages
    can say how old a shot is and where the others went. `shots`: a `devices.transients.TransientStream`, or shots from
    files: in the place of one that cannot be read its error.
    """

    def __init__(self, shots: Iterator[LiveShot] | Iterator[LiveShot | TofclipError]) -> None:
        self._shots = shots
        self._stream = shots if isinstance(shots, TransientStream) else None
        self._stamps: dict[int, ShotStamp] = {}
        self._count = self._first_number = 0
        self._peeked: deque[LiveShot | TofclipError] = deque()

    @property
    def is_live(self) -> bool:
        """Whether an instrument is read, so that what comes too late is dropped."""
        return self._stream is not None and self._stream.is_live

    @property
    def is_file(self) -> bool:
        """Whether a recording is read, which waits."""
        return self._stream is not None and not self._stream.is_live

    def peek(self) -> LiveShot | None:
        """Return the next shot that can be read, which is still to come; None at the end."""
        while not self._peeked or isinstance(self._peeked[-1], TofclipError):
            try:
                self._peeked.append(self._take())
            except StopIteration:
                return None
        return self._peeked[-1]

    def __next__(self) -> LiveShot | TofclipError:
        return self._peeked.popleft() if self._peeked else self._take()

    def _take(self) -> LiveShot | TofclipError:
        shot = next(self._shots)
        stamp = (self._stream and self._stream.stamp) or ShotStamp(self._count)
        self._stamps[self._count] = stamp
        if self._count == 0:
            self._first_number = stamp.number
        self._stamps.pop(self._count - MAX_STAMPS, None)
        self._count += 1
        return shot

    def get_stamp(self, place: int) -> ShotStamp:
        """Return the stamp of shot number `place` from 0; asked once for each, in order."""
        for earlier in [known for known in list(self._stamps) if known < place]:
            del self._stamps[earlier]  # they were dropped
        return self._stamps.pop(place, ShotStamp(place))

    def count_dropped(self, stamp: ShotStamp, delivered: int) -> int:
        """Return how many shots up to a delivered one were lost, wherever that was. Those behind it
        are not known yet. `stamp`: the newest delivered one's; `delivered`: shots delivered so far,
        this one included.
        """
        missing = stamp.number - self._first_number + 1 - delivered
        if self._stream is not None and not self._stream.is_numbered:
            missing += self._stream.shots_lost
        return missing

    def count_shots(self, delivered: int, failed: int = 0) -> ShotAccounts:
        """Return what became of every shot; final once the stream has been closed."""
        acquired, lost = self._count, 0
        if self._stream is not None and self._stream.is_live:
            # The instrument knows of shots that never reached this program.
            acquired = max(self._stream.shots_acquired, self._count)
            lost = self._stream.shots_lost
        dropped = acquired - lost - delivered - failed
        return ShotAccounts(acquired, delivered, lost, dropped, failed)

    def close(self) -> None:
        """Close the source; not while another thread waits for a shot."""
        getattr(self._shots, "close", lambda: None)()
