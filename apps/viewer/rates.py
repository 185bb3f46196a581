"""How many frames pass each second, and how long they take to the page and back."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

WINDOW = 2.0
"""s over which frames are counted."""

LONGEST_WAIT = 0.5
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
    """Holds the next frame back until every page has drawn the last one, so that none piles up on a slow line."""

    drawn: Rate = field(default_factory=Rate)
    latency: float = float("nan")
    _sent: float = float("-inf")
    _waiting: int = 0

    def sent(self, now: float, pages: int) -> None:
        """Note that a frame was sent to so many pages."""
        self._sent, self._waiting = now, pages

    def answered(self, now: float) -> None:
        """Note that a page has drawn the last frame."""
        if self._waiting > 0:
            self._waiting -= 1
            self.latency = now - self._sent
            self.drawn.add(now)

    def may_send(self, now: float) -> bool:
        """Whether the next frame can go."""
        return self._waiting <= 0 or now - self._sent > LONGEST_WAIT
