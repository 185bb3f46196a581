"""From an instrument's own clock to the computer's."""

from __future__ import annotations

WINDOW_S = 30.0
"""s of the computer's clock after which old messages say nothing any more: two quartzes part by
some 3 ms a minute.
"""


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
        self._last_stamp: float | None = None
        self._window_began = float("-inf")
        self._least = self._least_before = float("inf")

    def observe(self, stamp: float, arrived_at: float) -> None:
        """Note when a stamped message arrived.

        A stamp that goes back means that the instrument's clock began anew.

        `stamp`: s of the instrument's clock; `arrived_at`: s of `time.monotonic`.
        """
        if self._last_stamp is not None and stamp < self._last_stamp:
            self.reset()
        self._last_stamp = stamp
        if arrived_at - self._window_began > WINDOW_S:
            self._window_began = arrived_at
            self._least, self._least_before = float("inf"), self._least
        self._least = min(self._least, arrived_at - stamp)

    def to_host(self, stamp: float) -> float:
        """Return the time of a stamp, s of `time.monotonic`; 0 where nothing was observed yet."""
        offset = min(self._least, self._least_before)
        return stamp + offset if offset < float("inf") else 0.0
