"""How many frames pass each second, and how long they take to the page and back."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

RATE_WINDOW_S = 2.0
"""s over which frames are counted."""

MAX_FRAMES_IN_FLIGHT = 2

ACK_TIMEOUT_S = 1.0
"""s after which a page that does not answer is no longer waited for."""


@dataclass
class RateCounter:
    """Counts events of the last two seconds."""

    _events: deque[float] = field(default_factory=deque)

    def add(self, now: float) -> None:
        """Count an event at time `now`, s."""
        self._events.append(now)

    def per_second(self, now: float) -> float:
        """Return how many there were each second."""
        while self._events and self._events[0] < now - RATE_WINDOW_S:
            self._events.popleft()
        return len(self._events) / RATE_WINDOW_S


@dataclass
class FramePacer:
    """Holds frames back until every page has drawn an earlier one, so that none pile up on a slow
    line.

    Two are on their way at most: while one is drawn, the next travels.
    """

    display_rate: RateCounter = field(default_factory=RateCounter)
    latency: float = float("nan")
    _sent: deque[float] = field(default_factory=deque)
    _pages: int = 0

    def record_sent(self, now: float, pages: int) -> None:
        """Note that a frame was sent to so many pages."""
        self._pages = pages
        self._sent.extend([now] * pages)

    def record_answer(self, now: float) -> None:
        """Note that a page has drawn a frame."""
        if self._sent:
            self.latency = now - self._sent.popleft()
            self.display_rate.add(now)

    def can_send(self, now: float) -> bool:
        """Whether the next frame can go."""
        if self._sent and now - self._sent[0] > ACK_TIMEOUT_S:
            self._sent.clear()
        return len(self._sent) < MAX_FRAMES_IN_FLIGHT * max(1, self._pages)
