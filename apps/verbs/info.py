"""`tofclip info`: what a file holds."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from apps.options import JsonOption
from apps.report import report, to_json_value
from devices.recording.reader import read_head_if_recording
from tofclip.errors import FileFormatError
from tofclip.io import read_streak
from tofclip.lidar import PointCloud
from tofclip.lidar.photons.files import describe_photons
from tofclip.loading import HDF5_SIGNATURE
from tofclip.storage import Record, translate_read_errors

if TYPE_CHECKING:
    from tofclip.storage import Field

MAX_LISTED_VALUES = 9  # numbers that are shown one by one
TABLE_SUFFIXES = (".ply", ".pcd", ".csv", ".npz")


def info(
    file: Annotated[
        Path, typer.Argument(metavar="FILE", help="Any file of ours, or a streak image of others.")
    ],
    as_json: JsonOption = False,
) -> None:
    """Say what kind of thing a file holds: shapes, axes, units, text, and how it came about.

    Example: tofclip info frames.h5
    """
    found = to_json_value({"file": file, **_describe_file(file)})
    if as_json:
        report(found, as_json)
    else:
        print("\n".join(_format_tree(found)))


def _describe_file(file: Path) -> dict[str, Any]:
    """Describe our own records and streak images by their values, counted photons by their
    arrays.
    """
    try:
        return _describe_record(_read_record(file))
    except FileFormatError as refusal:
        try:
            return describe_photons(file)
        except FileFormatError:
            # The first refusal names the formats that were expected.
            raise refusal from None


def _read_record(file: Path) -> Record:
    """Read our own records as they are, streak images and point clouds of other formats through
    their readers.
    """
    recording = read_head_if_recording(file)
    if recording is not None:
        return recording  # its pieces do not fit into memory
    with translate_read_errors(file), open(file, "rb") as opened:
        start = opened.read(len(HDF5_SIGNATURE))
    # Decided by content, because suffixes get lost.
    if start == HDF5_SIGNATURE:
        return Record.load(file)
    if file.suffix.lower() not in TABLE_SUFFIXES:
        return read_streak(file).to_record()
    try:
        return PointCloud.load(file).to_record()
    except FileFormatError:
        if file.suffix.lower() != ".npz":
            raise
    return read_streak(file).to_record()  # an archive that is not a point cloud may be a LIFT shot


def _describe_record(record: Record) -> dict[str, Any]:
    found: dict[str, Any] = {"kind": record.kind}
    if record.attributes:
        found["attributes"] = record.attributes
    if record.fields:
        found["fields"] = {name: _describe_field(entry) for name, entry in record.fields.items()}
    if record.children:
        found["children"] = {
            name: _describe_record(child) for name, child in record.children.items()
        }
    if record.provenance:
        found["provenance"] = record.provenance
    return found


def _describe_field(entry: Field) -> dict[str, Any]:
    values = entry.values
    known = {
        "shape": values.shape,
        "type": str(values.dtype),
        "units": entry.units,
        "axes": entry.axes,
    }
    if values.dtype.kind not in "uif":
        return known
    if values.size <= MAX_LISTED_VALUES:
        return {**known, "values": values}
    # NaN marks unknown pixels; it would hide the range of the others.
    finite = values[np.isfinite(values)]
    return {**known, "range": [finite.min(), finite.max()] if finite.size else [None, None]}


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
        else:
            yield f"{lead} {value}"


def _format_field(known: Mapping[str, Any]) -> str:
    shape = " x ".join(map(str, known["shape"])) or "single value"
    axes = f" ({', '.join(known['axes'])})" if known["axes"] else ""
    if "values" in known:
        return f"{shape}{axes} {known['type']}, {_format_values(known['values'])} {known['units']}".rstrip()
    least, most = known.get("range", (None, None))
    spread = "" if least is None else f", {least:.6g} .. {most:.6g}"
    return f"{shape}{axes} {known['type']}{spread} {known['units']}".rstrip()


def _format_values(values: Any) -> str:
    if isinstance(values, list) and any(value is not None for value in values):
        return f"[{', '.join(map(_format_values, values))}]"
    return f"{values:.6g}" if isinstance(values, int | float) else "unknown"
