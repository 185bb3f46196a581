"""One property of all points, as files hold it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from numpy.typing import NDArray


@dataclass(frozen=True)
class Column:
    """One property of all points.

    Parameters
    ----------
    name : str
    unit : str
        SI unit, or empty for a pure number.
    values : (n,) array
        float32, float64 or uint8.
    """

    name: str
    unit: str
    values: NDArray[Any]

    @property
    def label(self) -> str:
        """Name with its unit, as it heads a column."""
        return f"{self.name}_{self.unit}" if self.unit else self.name


Columns = Sequence[Column]
Table = dict[str, NDArray[Any]]
