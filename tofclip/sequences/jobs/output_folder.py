"""A folder of results belongs to one set of settings, so that no run goes on with the results of
another.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from tofclip.errors import FileFormatError, InputError, StorageError
from tofclip.storage import atomic_path, translate_read_errors

SETTINGS_NAME = "settings.json"


def lock_output_folder(folder: Path, settings: Mapping[str, Any]) -> None:
    """Make a folder for the results of a run, or check that the one there holds results of the same
    settings.

    Parameters
    ----------
    folder : Path
        Made with its parents if it is missing.
    settings : mapping
        Whatever a result depends on, besides its input: names to strings, numbers and None.

    Raises
    ------
    InputError
        The folder belongs to other settings.
    StorageError, FileFormatError
        It cannot be made, read or written.
    """
    path = folder / SETTINGS_NAME
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as fault:
        raise StorageError(f"{folder}: cannot be made: {fault.strerror or fault}") from fault
    wanted = {
        name: str(value) if isinstance(value, Path) else value for name, value in settings.items()
    }
    if not path.exists():
        with atomic_path(path) as temporary:
            temporary.write_text(json.dumps(wanted, indent=1) + "\n", encoding="utf-8")
        return
    known = _read_settings(path)
    # Settings that only one side knows count as None on the other, so that a new setting with the
    # default None fits folders written before it.
    names = [name for name in {**known, **wanted} if known.get(name) != wanted.get(name)]
    if names:
        told = ", ".join(
            f"{name} {known.get(name)} instead of {wanted.get(name)}" for name in names
        )
        raise InputError(
            f"{folder}: holds results of other settings ({told}); choose another folder or remove it"
        )


def _read_settings(path: Path) -> dict[str, Any]:
    try:
        with translate_read_errors(path):
            found = json.loads(path.read_text("utf-8"))
    except ValueError as fault:
        raise FileFormatError(
            path, "is not JSON; remove it if the results beside it are to be made again"
        ) from fault
    if not isinstance(found, dict):
        raise FileFormatError(
            path, "holds no settings; remove it if the results beside it are to be made again"
        )
    return found
