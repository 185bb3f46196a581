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
    """A case at one size, ready to run.

    Parameters
    ----------
    action : callable
        What is measured.
    floor : callable
        What it cannot do without, on the same data and threads.
    amount : float
        How much one action does, in the case's unit.
    peers : mapping of str to callable
        The same by other programs, by their names.
    floor_fraction : float
        Part of the floor that `floor` does, where all of it would take too long; above 1 where it
        does more.
    figures : callable
        What else is to be said of this size, by names that end in their unit: errors, latencies.
        Called once, after the times were taken.
    """

    action: Action
    floor: Action
    amount: float
    peers: Mapping[str, Peer] = field(default_factory=dict)
    floor_fraction: float = 1.0
    figures: Callable[[], Mapping[str, float]] = dict


@dataclass(frozen=True)
class Case:
    """Something that is measured at several sizes.

    Parameters
    ----------
    name : str
        ``group-what``, what a user types; the group alone names all of its cases.
    title : str
        What it does, as a row of a table says it.
    size : str
        What its sizes count.
    sizes : tuple of int
        Rising. Growth is from each to the next; threads and floor are reported for the last.
    unit : str
        What `PreparedCase.amount` counts.
    floor : str
        What it is held against, in words.
    prepare : callable
        Makes the inputs of a size.
    """

    name: str
    title: str
    size: str
    sizes: tuple[int, ...]
    unit: str
    floor: str
    prepare: Callable[[int], PreparedCase]

    @property
    def group(self) -> str:
        """The first word of the name."""
        return self.name.partition("-")[0]
