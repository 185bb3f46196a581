"""`tofclip info` and `tofclip convert`: what a file holds, and a streak image as HDF5 of ours."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from apps.options import STREAK_IMAGE, arg, opt
from apps.report import (
    MAX_LISTED_VALUES,
    PRINTS_JSON,
    RECORD_SUFFIXES,
    report,
    require_writable,
    summarise_list,
    to_plain,
)
from tofclip.errors import FileFormatError

if TYPE_CHECKING:
    from tofclip.storage import Field, Record


def convert(
    streak: Path = arg("STREAK", f"{STREAK_IMAGE}.", read=True),
    out: Path = opt("H5", "The file to write.", ...),
    bin_width: float | None = opt(
        "PS", "Duration of a row in ps, where the file does not say it.", name="--bin-width-ps"
    ),
) -> None:
    """Turn a streak image into this program's HDF5, with its time axis, camera, text and relay wall
    inside.

    Example: tofclip convert wall.npz --out wall.h5
    """
    from tofclip.io import read_streak

    require_writable(out, *RECORD_SUFFIXES, inputs=(streak,))
    shot = read_streak(streak, bin_width)
    shot.save(out)
    figures = {
        "rows": shot.counts.shape[0],
        "columns": shot.counts.shape[1],
        "has_time_axis": shot.row_times is not None,
        "has_camera": shot.camera is not None,
        "attachments": list(shot.attachments),
    }
    report(figures, [out])


def info(
    file: Path = arg(
        "FILE", "Any file of ours, or a streak image or ROS 2 bag of others.", read=True
    ),
) -> None:
    """Say what kind of thing a file holds: shapes, axes, units, text, and how it came about.

    Values are not read, but for arrays of up to nine: a file larger than the memory is described as
    quickly as a small one.

    Example: tofclip info frames.h5
    """
    found = to_plain({"file": file, **describe_file(file)})
    if PRINTS_JSON.get():
        report(found)
    else:
        print("\n".join(_format_tree(found)))


def describe_file(file: Path) -> dict[str, Any]:
    """Describe a file of any kind by its header: its values may not fit into memory."""
    from devices.linospad2 import LinoSpad2File
    from devices.transients import STAMPS_SUFFIX
    from tofclip.lidar import ros
    from tofclip.lidar.photons.files import PHOTON_SUFFIXES, describe_photons
    from tofclip.loading import outline
    from tofclip.storage import Record, is_own_file

    if ros.is_bag(file):
        return ros.outline_bag(file)
    if file.suffix.lower() == STAMPS_SUFFIX:
        with LinoSpad2File(file) as source:
            known = {"instrument": source.info.instrument, **source.info.details}
            known["stamps"] = source.stats.acquired
            return _describe_record(Record("photon stamps", attributes=known))
    try:
        return _describe_record(outline(file))
    except FileFormatError as refusal:
        if is_own_file(file):
            raise  # a damaged record, not counted photons
        try:
            return describe_photons(file)
        except FileFormatError:
            if file.suffix.lower() in PHOTON_SUFFIXES:
                raise  # it names the arrays that were found
            # The first refusal names the formats that were expected.
            raise refusal from None


def _describe_record(record: Record) -> dict[str, Any]:
    parts = {
        "attributes": record.attributes,
        "fields": {name: _describe_field(entry) for name, entry in record.fields.items()},
        "children": {name: _describe_record(child) for name, child in record.children.items()},
        "provenance": record.provenance,
    }
    return {"kind": record.kind, **{name: part for name, part in parts.items() if part}}


def _describe_field(entry: Field) -> dict[str, Any]:
    from tofclip.storage import MAX_OUTLINE_VALUES, is_stand_in

    values = entry.values
    known = {
        "shape": values.shape,
        "type": str(values.dtype),
        "units": entry.units,
        "axes": entry.axes,
    }
    # another package's reader may give all of them
    is_listed = values.size <= MAX_OUTLINE_VALUES and values.dtype.kind in "uif"
    return known | {"values": values} if is_listed and not is_stand_in(values) else known


def _format_tree(found: Mapping[str, Any], depth: int = 0) -> Iterator[str]:
    """Indent a tree; what has no branches of its own stays on one line."""
    for name, value in found.items():
        lead = f"{'  ' * depth}{name}:"
        if isinstance(value, list) and value and isinstance(value[0], Mapping):
            yield from _format_tree({name: dict(enumerate(value, start=1))}, depth)
        elif isinstance(value, Mapping) and "shape" in value:
            shape = " x ".join(map(str, value["shape"])) or "single value"
            axes = f" ({', '.join(value['axes'])})" if value["axes"] else ""
            values = f", {_format_plain(value['values'])}" if "values" in value else ""
            yield f"{lead} {shape}{axes} {value['type']}{values} {value['units']}".rstrip()
        elif isinstance(value, Mapping):
            yield lead
            yield from _format_tree(value, depth + 1)
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
    return "-" if value is None else str(value)
