"""A bounded channel between two threads."""

from __future__ import annotations

from collections import deque
from threading import Condition
from typing import Generic, Literal, TypeVar

from tofclip.errors import InputError

Policy = Literal["block", "drop_oldest"]
"""What happens to a full channel: the producer waits, or what has waited longest is dropped."""

POLICIES: tuple[Policy, ...] = ("block", "drop_oldest")

Entry = TypeVar("Entry")


class ChannelClosedError(Exception):
    """No consumer takes entries any more."""


class Channel(Generic[Entry]):
    """Hands entries from one thread to another, in order.

    Parameters
    ----------
    capacity : int
        Entries held at most.
    policy : "block" or "drop_oldest"

    Raises
    ------
    InputError
        A capacity below one, or another policy.
    """

    def __init__(self, capacity: int, policy: Policy = "block") -> None:
        if capacity < 1:
            raise InputError(f"a channel holds one entry or more, not {capacity}")
        if policy not in POLICIES:
            raise InputError(
                f"a full channel's policy is one of {', '.join(POLICIES)}, not '{policy}'"
            )
        self._capacity, self._policy = capacity, policy
        self._entries: deque[Entry] = deque()
        # One lock for all fields; every change wakes both sides, which test again in a loop.
        self._changed = Condition()
        self._finished = self._closed = False
        self._fault: BaseException | None = None
        self.dropped = 0

    def put(self, entry: Entry) -> None:
        """Hand one entry over.

        Raises
        ------
        ClosedError
            The channel was closed.
        """
        with self._changed:
            while len(self._entries) >= self._capacity and not self._closed:
                if self._policy == "drop_oldest":
                    self._entries.popleft()
                    self.dropped += 1
                else:
                    self._changed.wait()
            if self._closed:
                raise ChannelClosedError
            self._entries.append(entry)
            self._changed.notify_all()

    def wait_for_room(self) -> None:
        """Wait until an entry can be put without waiting or dropping, or the channel is closed."""
        with self._changed:
            while len(self._entries) >= self._capacity and not self._closed:
                self._changed.wait()

    def finish(self, fault: BaseException | None = None) -> None:
        """Say that no further entry will come, because of a fault or because that was all."""
        with self._changed:
            self._finished, self._fault = True, fault
            self._changed.notify_all()

    def get(self) -> Entry | None:
        """Return the next entry, or None behind the last one; there a fault is raised."""
        with self._changed:
            while not self._entries and not self._finished and not self._closed:
                self._changed.wait()
            if self._entries and not self._closed:
                entry = self._entries.popleft()
                self._changed.notify_all()
                return entry
            # Raised only when the queue is empty, so that what came before the fault is still
            # delivered.
            if self._fault is not None:
                raise self._fault
            return None

    def close(self) -> None:
        """Let go of everything; `put` fails from now on and `get` returns None."""
        with self._changed:
            self._closed = True
            # Cleared so that memory is freed even while a thread still holds the channel.
            self._entries.clear()
            self._changed.notify_all()
