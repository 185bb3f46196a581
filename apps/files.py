"""Names of files that a verb is about to write, checked before the work begins."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from tofclip.errors import InputError, StorageError
from tofclip.storage import collect_provenance

RECORD_SUFFIXES = (".h5", ".hdf5")
PICTURE_SUFFIXES = (".png", ".pdf", ".svg")


def require_writable(out: Path, *suffixes: str, inputs: tuple[Path, ...] = ()) -> None:
    """Refuse an output that cannot be written, or that would overwrite an input.

    Finding out after minutes of work would be too late. The writing itself is all or nothing in any
    case.

    Parameters
    ----------
    out : Path
    *suffixes : str
        Endings that the name may have; none given: any.
    inputs : tuple of Path
        Files that must survive.

    Raises
    ------
    InputError, StorageError
    """
    if suffixes and out.suffix.lower() not in suffixes:
        raise InputError(f"{out}: the name must end in {' or '.join(suffixes)}")
    if out.is_dir():
        raise StorageError(f"{out}: cannot be written: it is a folder")
    if not out.parent.is_dir():
        raise StorageError(f"{out}: cannot be written: the folder does not exist; create it first")
    if not os.access(out.parent, os.W_OK):
        raise StorageError(f"{out}: cannot be written: writing is not permitted there")
    for path in inputs:
        if out.exists() and path.exists() and out.samefile(path):
            raise InputError(
                f"{out}: is an input too; choose another name, so that it is not overwritten"
            )


def build_provenance(
    settings: Mapping[str, Any], *inputs: Path, earlier: Mapping[str, Any] | None = None
) -> dict[str, Any]:
    """Describe how a result came about, with what is known about its input's own past.

    Parameters
    ----------
    settings : mapping
        Options by name.
    *inputs : Path
        Files whose checksums are recorded.
    earlier : mapping, optional
        Provenance of the input.

    Returns
    -------
    dict
        Plain values only, for JSON.
    """
    described = collect_provenance(
        {name: _to_plain_value(value) for name, value in settings.items()}, *inputs
    )
    if earlier:
        described["earlier"] = dict(earlier)
    return described


def _to_plain_value(value: Any) -> Any:
    return str(value) if isinstance(value, Path) else value


def make_folder(folder: Path) -> None:
    """Make a folder for results, with its parents."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as fault:
        raise StorageError(f"{folder}: cannot be made: {fault.strerror or fault}") from fault
    if not os.access(folder, os.W_OK):
        raise StorageError(f"{folder}: writing is not permitted there")
