"""What a benchmark consists of."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

Action = Callable[[], object]
Peer = Callable[[], float]
"""Does the same with another program, and returns the seconds of its work alone; raises
`PeerUnavailableError`.
"""


class PeerUnavailableError(Exception):
    """The other program cannot be had here, and why."""


@dataclass(frozen=True)
class PreparedCase:
    """A case at one size, ready to run."""

    action: Action  # what is measured
    floor: Action  # what it cannot do without, on the same data and threads
    amount: float  # how much one action does, in the case's unit
    # the same by other programs, by their names
    peers: Mapping[str, Peer] = field(default_factory=dict)
    # part of the floor that `floor` does, where all of it would take too long; above 1 where it
    # does more
    floor_fraction: float = 1.0
    # what else is to be said of this size, by names that end in their unit: errors, latencies.
    # Called once, after the times were taken
    figures: Callable[[], Mapping[str, float]] = dict


@dataclass(frozen=True)
class Case:
    """Something that is measured at several sizes."""

    name: str  # ``group-what``, what a user types; the group alone names all of its cases
    title: str  # what it does, as a row of a table says it
    size: str  # what its sizes count
    # rising. Growth is from each to the next; threads and floor are reported for the last
    sizes: tuple[int, ...]
    unit: str  # what `PreparedCase.amount` counts
    floor: str  # what it is held against, in words
    prepare: Callable[[int], PreparedCase]  # makes the inputs of a size

    @property
    def group(self) -> str:
        """The first word of the name."""
        return self.name.partition("-")[0]
