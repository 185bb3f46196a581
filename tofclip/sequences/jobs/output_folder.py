"""A folder of results belongs to one set of settings, so that no run goes on with the results of
another.
"""

from __future__ import annotations

import glob
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from tofclip.errors import FileFormatError, InputError, StorageError
from tofclip.files import atomic_path, identify_file, translate_read_errors

SETTINGS_NAME = "settings.json"
INPUTS_KEY = "inputs"


def lock_output_folder(
    folder: Path, settings: Mapping[str, Any], inputs: Mapping[str, Path] | None = None
) -> None:
    """Make a folder for the results of a run, or check that the one there holds results of the same
    settings and inputs.

    Parameters
    ----------
    folder : Path
        Made with its parents if it is missing.
    settings : mapping
        Whatever a result depends on, besides its input: names to strings, numbers and None.
    inputs : mapping of str to Path, optional
        Files by the names of their results. The folder may hold results of more, or of less.

    Raises
    ------
    InputError
        The folder belongs to other settings, or a file has changed since its result was made.
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
    marks = _identify_files(inputs or {})
    if not path.exists():
        _write_settings(path, wanted, marks)
        return
    known = _read_settings(path)
    noted = known.pop(INPUTS_KEY, {})
    # Settings that only one side knows count as None on the other, so that a new setting with the
    # default None fits folders written before it.
    names = [name for name in {**known, **wanted} if known.get(name) != wanted.get(name)]
    if names:
        reported = ", ".join(
            f"{name} {known.get(name)} instead of {wanted.get(name)}" for name in names
        )
        raise InputError(
            f"{folder}: holds results of other settings ({reported}); choose another folder or remove it"
        )

    # A file without a result may change: a damaged shot is replaced, and its run goes on.
    changed = [
        name
        for name, mark in marks.items()
        if noted.get(name, mark) != mark and any(folder.glob(f"{glob.escape(name)}.*"))
    ]
    if changed:
        raise InputError(
            f"{folder}: holds results of other inputs ({len(changed)} have changed since, the first "
            f"is {changed[0]}); choose another folder or remove it"
        )
    if any(noted.get(name) != mark for name, mark in marks.items()):
        _write_settings(path, known, {**noted, **marks})


def _identify_files(inputs: Mapping[str, Path]) -> dict[str, str]:
    # the shots of a stack share a file, which is read once
    marks = {file: identify_file(file) for file in set(inputs.values())}
    return {name: marks[file] for name, file in inputs.items()}


def _write_settings(path: Path, settings: Mapping[str, Any], marks: Mapping[str, str]) -> None:
    content = {**settings, INPUTS_KEY: dict(marks)} if marks else dict(settings)
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


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
