"""How many frames pass each second, and how many a page can take."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

RATE_WINDOW_S = 2.0
"""s over which frames are counted."""

MAX_FRAMES_PER_S = 30.0
MAX_POINTS_PER_S = 2e6
"""What a browser with a software renderer takes without falling behind."""


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
    """Holds frames back so that none pile up in a page: large clouds are sent less often."""

    _next: float = 0.0

    def record_sent(self, now: float, points: int) -> None:
        """Note that a frame was sent.

        Parameters
        ----------
        now : float
            Time in s.
        points : int
            Of the frame.
        """
        self._next = now + max(1 / MAX_FRAMES_PER_S, points / MAX_POINTS_PER_S)

    def can_send(self, now: float) -> bool:
        """Whether the next frame can go at time `now`, s."""
        return now >= self._next
