"""What a file holds, by its headers: for `tofclip info`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from devices.counted_photons import STAMPS_SUFFIX
from devices.linospad2 import LinoSpad2File
from tofclip.errors import FileFormatError
from tofclip.lidar.photons.files import describe_photons
from tofclip.loading import outline
from tofclip.storage import Record, is_own_file, is_stand_in

if TYPE_CHECKING:
    from tofclip.storage import Field


PHOTON_SUFFIXES = {".npy", ".mat", ".ptu", ".sdt"}
"""Of files that hold counted photons or nothing of ours."""


def describe_file(file: Path) -> dict[str, Any]:
    """Describe our own records, streak images, point clouds and counted photons by their headers."""
    try:
        return _describe_record(_read_outline(file))
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


def _read_outline(file: Path) -> Record:
    """Read what a file says about its arrays, not their values, which may not fit into memory."""
    if file.suffix.lower() == STAMPS_SUFFIX:
        with LinoSpad2File(file) as source:
            known = {"instrument": source.info.instrument, **source.info.details}
            return Record("photon stamps", attributes=known | {"stamps": source.stats.acquired})
    return outline(file)


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
    if values.dtype.kind not in "uif" or is_stand_in(values):
        return known
    return {**known, "values": values}
