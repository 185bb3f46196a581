"""Where a result came from."""

from __future__ import annotations

import datetime
import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from tofclip.storage.files import reading
from tofclip.version import __version__


def provenance(settings: Mapping[str, Any], *inputs: str | Path) -> dict[str, Any]:
    """Describe how a result came about: program version, time, settings, and a hash of every input file."""
    return {
        "software": f"tofclip {__version__}",
        "created": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "settings": dict(settings),
        "inputs": [{"name": Path(path).name, "sha256": sha256_of(path)} for path in inputs if Path(path).is_file()],
    }


def sha256_of(path: str | Path) -> str:
    """Hexadecimal SHA-256 of a file."""
    with reading(path), open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
