"""What a verb says when it is done: figures for people, or one JSON object for programs."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

MAX_LISTED_VALUES = 12
"""Values of a list that are printed one by one."""


def report(figures: Mapping[str, Any], as_json: bool, written: Sequence[Path] = ()) -> None:
    """Print the figures of a run.

    Parameters
    ----------
    figures : mapping
        Names to numbers, strings, and lists or mappings of these. NumPy's numbers and arrays are
        understood.
    as_json : bool
        One JSON object on one line (NaN becomes null) instead of a table.
    written : sequence of Path
        Files to name in the table.
    """
    plain = to_json_value(figures)
    if as_json:
        print(json.dumps(plain, allow_nan=False))
        return
    width = max(map(len, plain), default=0)
    for name, value in plain.items():
        print(f"{name.replace('_', ' '):<{width}}  {_format_value(value)}")
    for path in written:
        print(f"wrote {path}")


def to_json_value(value: Any) -> Any:
    """Turn NumPy's numbers and arrays, paths and NaN into what JSON knows."""
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, Mapping):
        return {str(name): to_json_value(entry) for name, entry in value.items()}
    if isinstance(value, list | tuple):
        return [to_json_value(entry) for entry in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return str(value) if isinstance(value, Path) else value


def summarise_list(values: Sequence[Any]) -> str:
    """Return how many values there are, the first and the last, as a person reads a long list.

    Parameters
    ----------
    values : sequence
        Not empty.

    Examples
    --------
    >>> summarise_list([1.5, *range(58), 0.25])
    '60 values, 1.5 ... 0.25'
    """
    return f"{len(values)} values, {_format_value(values[0])} ... {_format_value(values[-1])}"


def _format_value(value: Any) -> str:
    if isinstance(value, list):
        if len(value) > MAX_LISTED_VALUES:
            return summarise_list(value)
        return ", ".join(map(_format_value, value))
    if isinstance(value, dict):
        return ", ".join(f"{name} {_format_value(entry)}" for name, entry in value.items())
    if isinstance(value, float):
        return f"{value:.4g}" if abs(value) < 1000 else f"{value:.0f}"
    return "unknown" if value is None else str(value)
