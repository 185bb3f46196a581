"""How many frames pass each second, and how long they take to the page and back."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

WINDOW = 2.0
"""s over which frames are counted."""

ON_THE_WAY = 2

LONGEST_WAIT = 1.0
"""s after which a page that does not answer is no longer waited for."""


@dataclass
class Rate:
    """Counts events of the last two seconds."""

    _events: deque[float] = field(default_factory=deque)

    def add(self, now: float) -> None:
        """Count an event at time `now`, s."""
        self._events.append(now)

    def per_second(self, now: float) -> float:
        """Return how many there were each second."""
        while self._events and self._events[0] < now - WINDOW:
            self._events.popleft()
        return len(self._events) / WINDOW


@dataclass
class Pace:
    """Holds frames back until every page has drawn an earlier one, so that none pile up on a slow line.

    Two are on their way at most: while one is drawn, the next travels.
    """

    drawn: Rate = field(default_factory=Rate)
    latency: float = float("nan")
    _sent: deque[float] = field(default_factory=deque)
    _pages: int = 0

    def sent(self, now: float, pages: int) -> None:
        """Note that a frame was sent to so many pages."""
        self._pages = pages
        self._sent.extend([now] * pages)

    def answered(self, now: float) -> None:
        """Note that a page has drawn a frame."""
        if self._sent:
            self.latency = now - self._sent.popleft()
            self.drawn.add(now)

    def may_send(self, now: float) -> bool:
        """Whether the next frame can go."""
        if self._sent and now - self._sent[0] > LONGEST_WAIT:
            self._sent.clear()
        return len(self._sent) < ON_THE_WAY * max(1, self._pages)
