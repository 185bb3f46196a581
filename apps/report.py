"""What every verb does before its work and after it: outputs are checked, figures printed."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import re
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextvars import ContextVar
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from tofclip.errors import StorageError
from tofclip.files import PICTURE_SUFFIXES, require_apart, require_suffix

if TYPE_CHECKING:
    from tofclip.shots import Frames

Result = TypeVar("Result")

SETTINGS_SUFFIX = ".toml"
RECORD_SUFFIXES = (".h5", ".hdf5")
MAX_LISTED_VALUES = 12  # of a list that are printed one by one
MAX_TABLE_WIDTH = 100  # columns of a terminal for several things side by side
UNITS = {"m", "mm", "s", "ns", "ps", "px"}
ARGUMENT_IN_MESSAGE = re.compile(r"`(?P<name>[a-z_]+)(?:=\"?(?P<value>[^`\"]*)\"?)?`")
OPTIONS_OF_ARGUMENTS = {
    name: f"--{name.replace('_', '-')}"
    for name in ["axes", "device", "focus", "method", "overwrite", "region", "set", "single_pixel"]
} | {
    "bin_width": "--bin-width-ps",
    "camera": "--camera camera.h5",
    "gate": "--gate-m",
    "pulse": "--pulse-ps",
    "target": "--target-m",
    "time_zero": "--time-zero-ns",
}
"""The command line's option for an argument that the libraries' messages name."""


REPLACES = ContextVar("replaces", default=True)
"""Whether results that exist are made again: from Python, as any library does."""

PRINTS_JSON = ContextVar("prints_json", default=False)
"""Whether `report` prints an object for programs."""


@contextlib.contextmanager
def holding(switch: ContextVar[bool], is_on: bool) -> Iterator[None]:
    """Have one of the above on or off for a while."""
    before = switch.set(is_on)
    try:
        yield
    finally:
        switch.reset(before)


def require_new(*results: Path) -> None:
    """Refuse to write over results that exist, unless that is allowed."""
    for result in results:
        if result.exists() and not REPLACES.get():
            raise StorageError(f"{result}: exists already; name another, or give --overwrite")


def require_writable(out: Path, *suffixes: str, inputs: Iterable[str | Path | None] = ()) -> None:
    """Refuse an output that exists, that cannot be written, or that would overwrite an input: finding
    out after minutes of work would be too late. The writing itself is all or nothing in any case.
    `*suffixes`: endings that the name may have; none given: any; `inputs`: what must survive, see
    `tofclip.files.require_apart`.
    """
    if not out.name or out.is_dir():
        raise StorageError(f"{out}: cannot be written: it is a folder; name a file")
    if suffixes:
        require_suffix(out, *suffixes)
    if not out.parent.is_dir():
        missing = "the folder does not exist; create it first"
        said = "its folder is a file" if out.parent.exists() else missing
        raise StorageError(f"{out}: cannot be written: {said}")
    if not os.access(out.parent, os.W_OK):
        raise StorageError(f"{out}: cannot be written: writing is not permitted there")
    require_apart([out], inputs)
    if out.suffix != SETTINGS_SUFFIX:  # settings belong to the result that they lie beside
        require_new(out)


def place_settings(out: Path, *suffixes: str, inputs: Sequence[str | Path | None]) -> Path:
    """Return where the settings of a result go, and refuse either that cannot be written."""
    require_writable(out, *suffixes, inputs=inputs)
    settings = out.with_suffix(SETTINGS_SUFFIX)
    require_writable(settings, inputs=inputs)
    return settings


def choose_preview(out: Path, preview: Path | None, inputs: Sequence[str | Path | None]) -> Path:
    """Return where the picture of a result goes, and refuse either that cannot be written."""
    require_writable(out, *RECORD_SUFFIXES, inputs=inputs)
    preview = preview or out.with_suffix(".png")
    require_writable(preview, *PICTURE_SUFFIXES, inputs=inputs)
    return preview


def make_folder(folder: Path) -> None:
    """Make a folder for results, with its parents."""
    if folder.exists() and not folder.is_dir():
        raise StorageError(f"{folder}: cannot be made: it is a file; name a folder")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as fault:
        raise StorageError(f"{folder}: cannot be made: {fault.strerror or fault}") from fault
    if not os.access(folder, os.W_OK):
        raise StorageError(f"{folder}: writing is not permitted there")


def build_provenance(
    settings: Mapping[str, Any], *inputs: Path, earlier: Mapping[str, Any] | None = None
) -> dict[str, Any]:
    """Describe how a result came about: options, checksums of the inputs, and their own past."""
    from tofclip.storage import collect_provenance

    plain = {
        name: str(value) if isinstance(value, Path) else value for name, value in settings.items()
    }
    described = collect_provenance(plain, *inputs)
    return described | {"earlier": dict(earlier)} if earlier else described


def with_past(result: Result, settings: Mapping[str, Any], *inputs: Path) -> Result:
    """Return a result that knows how it came about, and what it knew of its own past."""
    made: Any = result
    past = build_provenance(settings, *inputs, earlier=made.provenance)
    return dataclasses.replace(made, provenance=past)


def say(what: str, text: object) -> None:
    """Say in a line on standard error what is a ``warning``, or has ``failed``."""
    print(f"tofclip: {what}: {text}", file=sys.stderr)


def describe_ranges(frames: Frames) -> str:
    """Return what has to be said about the ranges of frames; empty where they have a time zero."""
    note = frames.time_zero_note
    return f"ranges are right{note} (--time-zero-ns of recover)" if note else ""


def report(
    figures: Mapping[str, Any],
    written: Sequence[Path] = (),
    note: str = "",
    json_only: Sequence[str] = (),
) -> None:
    """Print the figures of a run, numbers, strings, and lists or mappings of these by name: a table,
    which leaves out what is not known, or with `PRINTS_JSON` an object on one line (NaN becomes null).
    `written`: files to name below the table; `note`: what has to be known about its figures;
    `json_only`: figures that are for programs.
    """
    plain = to_plain(figures)
    if PRINTS_JSON.get():
        print(json.dumps(plain, allow_nan=False))
        return
    plain = {
        name: value
        for name, value in plain.items()
        if value not in (None, "", [], {}) and name not in json_only
    }
    width = max(map(len, plain), default=0)
    compared = _find_compared(plain)
    for name, value in plain.items():
        entries = _list_alike_entries(value)
        if name in compared[1:]:
            continue  # in the table of the first
        if name in compared:
            print(_format_compared({column: plain[column] for column in compared}))
        elif entries:
            print(f"{_format_name(name)}\n{_format_rows(entries)}")
        else:
            line = f"{_format_name(name):<{width}}  {_format_value(value)}"
            if isinstance(value, dict) and len(line) > MAX_TABLE_WIDTH:
                cells = [[f"  {_format_name(one)}", _format_value(value[one])] for one in value]
                line = f"{_format_name(name)}\n{_align_columns(cells)}"
            print(line)
    if note:
        print(f"note: {note}")
    for path in written:
        print(f"wrote {path}")


def to_plain(figures: Mapping[str, Any]) -> dict[str, Any]:
    """Turn NumPy's numbers and arrays, paths and NaN into what JSON knows."""
    from pydantic_core import to_jsonable_python

    plain: dict[str, Any] = to_jsonable_python(
        dict(figures), inf_nan_mode="null", fallback=lambda one: one.tolist()
    )
    return plain


def _find_compared(figures: Mapping[str, Any]) -> list[str]:
    """Return the names of mappings that say the same of several things, such as methods."""
    rows = {name: tuple(value) for name, value in figures.items() if isinstance(value, dict)}
    kinds = list(rows.values())
    shared = next((keys for keys in kinds if len(keys) > 1 and kinds.count(keys) > 1), ())
    return [name for name, keys in rows.items() if shared and keys == shared]


def _list_alike_entries(value: Any) -> dict[str, dict[str, Any]]:
    """Return the entries of a list or mapping that say the same of several things; else none."""
    if isinstance(value, list):
        value = {str(number): entry for number, entry in enumerate(value, start=1)}
    if not isinstance(value, dict) or len(value) < 2:
        return {}
    kinds = {tuple(entry) if isinstance(entry, dict) else () for entry in value.values()}
    return value if len(kinds) == 1 and kinds != {()} else {}


def _format_compared(things: Mapping[str, Mapping[str, Any]]) -> str:
    """Put things side by side where they fit, and below each other where there are too many."""
    cells = [["", *map(_format_name, things)]]
    cells += [
        [_format_name(figure), *(_format_value(thing[figure]) for thing in things.values())]
        for figure in next(iter(things.values()))
    ]
    text = _align_columns(cells)
    return text if _measure_width(text) <= MAX_TABLE_WIDTH else _format_rows(things)


def _format_rows(things: Mapping[str, Mapping[str, Any]]) -> str:
    """Put many things with few figures below each other: a line for each, indented; or a column,
    where lines are too long and columns are not as long.
    """
    cells = [["  ", *map(_format_name, next(iter(things.values())))]]
    cells += [
        [f"  {_format_name(name)}", *map(_format_value, thing.values())]
        for name, thing in things.items()
    ]
    rows, columns = _align_columns(cells), _align_columns([*zip(*cells, strict=True)])
    return (
        rows if _measure_width(rows) <= MAX_TABLE_WIDTH else min(rows, columns, key=_measure_width)
    )


def _measure_width(text: str) -> int:
    return max(map(len, text.splitlines()))


def _align_columns(cells: Sequence[Sequence[str]]) -> str:
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    rows = ("  ".join(map(str.ljust, row, widths)) for row in cells)
    return "\n".join(row.rstrip() for row in rows)


def _format_name(name: str) -> str:
    return name.replace("_", " ")


def _format_entry(name: str, value: Any) -> str:
    """Put one of several figures of a line into words, its unit behind it."""
    *words, last = name.split("_")
    if last not in UNITS:
        return f"{_format_name(name)} {_format_value(value)}"
    return " ".join([*words, _format_value(value), last])


def summarise_list(values: Sequence[Any]) -> str:
    """Return how many values there are, the first and the last, as a person reads a long list.

    Examples
    --------
    >>> summarise_list([1.5, *range(58), 0.25])
    '60 values, 1.5 ... 0.25'
    """
    return f"{len(values)} values, {_format_value(values[0])} ... {_format_value(values[-1])}"


def _format_value(value: Any) -> str:
    if isinstance(value, list):
        long = len(value) > MAX_LISTED_VALUES and not isinstance(value[0], str)
        return summarise_list(value) if long else ", ".join(map(_format_value, value))
    if isinstance(value, dict):
        known = {name: entry for name, entry in value.items() if entry not in (None, "")}
        return ", ".join(_format_entry(name, entry) for name, entry in known.items())
    if isinstance(value, float):
        return f"{value:.4g}" if abs(value) < 1000 else f"{value:.0f}"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return "-" if value in (None, "") else str(value)


def name_options(message: str) -> str:
    """Put the options of the command line in the place of arguments that a message of the libraries
    names as in Python.

    Examples
    --------
    >>> name_options('give `bin_width`, or use `device="cpu"`')
    'give --bin-width-ps, or use --device cpu'
    """

    def name_option(found: re.Match[str]) -> str:
        option = OPTIONS_OF_ARGUMENTS.get(found["name"], found[0])
        is_named = option != found[0] and found["value"] not in (None, "True")
        return f"{option} {found['value']}" if is_named else option

    return ARGUMENT_IN_MESSAGE.sub(name_option, message)
