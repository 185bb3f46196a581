"""Where every record went."""

from __future__ import annotations

from dataclasses import asdict, dataclass


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
