"""`tofclip info`: what a file holds."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from apps.conventions import (
    MAX_LISTED_VALUES,
    JsonOption,
    report,
    summarise_list,
    to_json_value,
)


def info(
    file: Annotated[
        Path, typer.Argument(metavar="FILE", help="Any file of ours, or a streak image of others.")
    ],
    as_json: JsonOption = False,
) -> None:
    """Say what kind of thing a file holds: shapes, axes, units, text, and how it came about.

    Values are not read, but for arrays of up to nine: a file larger than the memory is described as
    quickly as a small one.

    Example: tofclip info frames.h5
    """
    from apps.outline import describe_file

    found = to_json_value({"file": file, **describe_file(file)})
    if as_json:
        report(found, as_json)
    else:
        print("\n".join(_format_tree(found)))


def _format_tree(found: Mapping[str, Any], depth: int = 0) -> Iterator[str]:
    """Indent a tree; what has no branches of its own stays on one line."""
    for name, value in found.items():
        lead = f"{'  ' * depth}{name}:"
        if isinstance(value, Mapping) and "shape" in value:
            yield f"{lead} {_format_field(value)}"
        elif isinstance(value, Mapping):
            yield lead
            yield from _format_tree(value, depth + 1)
        elif isinstance(value, list) and value and isinstance(value[0], Mapping):
            yield lead
            for number, entry in enumerate(value, start=1):
                yield from _format_tree({f"{number}": entry}, depth + 1)
        elif isinstance(value, list) and len(value) > MAX_LISTED_VALUES:
            yield f"{lead} {summarise_list(value)}"
        else:
            yield f"{lead} {_format_plain(value)}"


def _format_plain(value: Any) -> str:
    """Six digits tell a person enough; --json has all."""
    if isinstance(value, list):
        return f"[{', '.join(map(_format_plain, value))}]" if value else "none"
    if isinstance(value, float):
        return f"{value:.6g}"
    return "not known" if value is None else str(value)


def _format_field(known: Mapping[str, Any]) -> str:
    shape = " x ".join(map(str, known["shape"])) or "single value"
    axes = f" ({', '.join(known['axes'])})" if known["axes"] else ""
    if "values" in known:
        return f"{shape}{axes} {known['type']}, {_format_values(known['values'])} {known['units']}".rstrip()
    return f"{shape}{axes} {known['type']} {known['units']}".rstrip()


def _format_values(values: Any) -> str:
    if isinstance(values, list) and any(value is not None for value in values):
        return f"[{', '.join(map(_format_values, values))}]"
    return f"{values:.6g}" if isinstance(values, int | float) else "unknown"
