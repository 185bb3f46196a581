"""Book-keeping of records: every change moves records from one account to another, so the accounts
always balance.
"""

from __future__ import annotations

import threading
from dataclasses import asdict, dataclass, replace


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
    def total_records(self) -> int:
        """Records whose fate is known."""
        return self.delivered + self.unread + self.dropped_host + self.lost_device + self.malformed

    @property
    def is_balanced(self) -> bool:
        """Whether acquired = delivered + unread + dropped_host + lost_device + malformed."""
        return self.acquired == self.total_records

    def as_dict(self) -> dict[str, int]:
        """Return the accounts by name."""
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
        """Move records that waited to those that were read.

        `delivered`: records that were sound; `malformed`: records that were not.
        """
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
