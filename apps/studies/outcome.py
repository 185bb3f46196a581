"""What a study of the paper returns: a table of ours beside the paper's figures, and pictures in
the paper's layout.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from apps.studies.best import BestCase
    from apps.studies.cases import Library

Advance = Callable[[int], None]

CROSS_VALIDATED = "chosen by cross-validation with the first seed, without the truth"
"""How most studies choose the weight of the prior; see `Study.weight`."""


@dataclass(frozen=True)
class Row:
    """One figure of a table."""

    labels: tuple[str, ...]  # one for each of the table's columns
    ours: tuple[float, ...]  # one for each seed
    paper: float | None = None  # none: the paper has no such figure

    @property
    def mean(self) -> float:
        """Mean over the seeds."""
        return float(np.mean(self.ours))

    @property
    def spread(self) -> float:
        """Standard deviation over the seeds (of a sample; 0 for a single one)."""
        return float(np.std(self.ours, ddof=1)) if len(self.ours) > 1 else 0.0


@dataclass(frozen=True)
class Panel:
    """A picture (rows, columns) with its title; brightness from 0, or a map of shears in colours."""

    title: str
    picture: NDArray[Any]
    is_map: bool = False


@dataclass(frozen=True)
class Outcome:
    """Rows and pictures of a study."""

    columns: tuple[str, ...]  # what the rows' labels say
    figure: str  # what the rows' figures are, with the unit
    rows: tuple[Row, ...]
    panels: tuple[tuple[Panel, ...], ...]  # pictures as they are laid out: one tuple for each line


@dataclass(frozen=True)
class Study:
    """A table or figure of the paper that can be made again."""

    name: str  # what the user types
    aliases: tuple[str, ...]  # other names: the figures that show the table's pictures
    title: str
    note: str  # what differs from the paper
    weight: str  # how the weight of the prior was chosen: the end of a sentence
    seconds: float  # about what a seed costs on two cores
    steps: int  # advances for each seed
    # (library, seeds, advance) to the outcome; calls `advance` with shares that add up to `steps`
    # per seed
    work: Callable[[Library, int, Advance], Outcome]
    seeded: bool = True  # false: it has no random choices, more seeds change nothing
    # what it needs of the folder of recorded data; without that it cannot be made
    recording: str | None = None
    # rows of the paper that are also solved with the settings of choice
    best: tuple[BestCase, ...] = ()
