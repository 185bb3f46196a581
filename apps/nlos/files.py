"""Captures on disk and what is written of them: one capture, or a folder of them."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from apps.conventions import PICTURE_SUFFIXES, RECORD_SUFFIXES, build_provenance, require_writable
from nlos.export import POINT_SUFFIXES, WRITERS
from tofclip.errors import InputError
from tofclip.files import identify_file

if TYPE_CHECKING:
    from nlos import Volume

CAPTURE_SUFFIXES = (".h5", ".hdf5", ".npz", ".mat")
SURFACE_SUFFIXES = (".ply",)
GEOMETRY_FILE = "geometry.toml"
"""Makes a folder of renderings one capture; see `nlos.io`."""


CONTENT_MARK = "# the capture's content: "
"""In the settings beside a volume: what the capture was that it was made of."""


def list_volume_suffixes() -> tuple[str, ...]:
    """List the endings of files that a volume can be written to."""
    return (*RECORD_SUFFIXES, *WRITERS, *POINT_SUFFIXES)


def note_content(source: Path) -> str:
    """Return a comment for a TOML file by which a capture, or a folder of renderings, is known
    again, whatever it is called and however old it is.
    """
    if not source.is_dir():
        return CONTENT_MARK + identify_file(source)
    files = sorted(path for path in source.rglob("*") if path.is_file())
    marks = "\n".join(f"{path.relative_to(source)} {identify_file(path)}" for path in files)
    return CONTENT_MARK + hashlib.sha256(marks.encode()).hexdigest()


@dataclass(frozen=True)
class ResultFiles:
    """Names of what is written of one capture."""

    volumes: Sequence[Path]  # the volume, in the format that each suffix names
    picture: Path | None
    settings: Path  # written last: where it stands, the others are whole
    surface: Path | None = None  # the front surface with normals

    @property
    def paths(self) -> list[Path]:
        """Every file, in the order of writing."""
        others = [one for one in (self.picture, self.surface) if one is not None]
        return [*self.volumes, *others, self.settings]

    def require_writable(self, *inputs: Path | None) -> None:
        """Refuse names that cannot be written, or that would overwrite an input."""
        for volume in self.volumes:
            require_writable(volume, *list_volume_suffixes(), inputs=inputs)
        if self.picture is not None:
            require_writable(self.picture, *PICTURE_SUFFIXES, inputs=inputs)
        if self.surface is not None:
            require_writable(self.surface, *SURFACE_SUFFIXES, inputs=inputs)
            if self.surface.resolve() in [volume.resolve() for volume in self.volumes]:
                raise InputError(f"{self.surface}: volume and surface need names of their own")
        require_writable(self.settings, inputs=inputs)

    def is_up_to_date(self, source: Path) -> bool:
        """Whether all are there and came from the capture as it is now.

        Results of versions that did not note the capture's content have to be younger than it.
        """
        if not all(path.is_file() for path in self.paths):
            return False
        text = self.settings.read_text("utf-8", errors="replace")
        if CONTENT_MARK not in text:
            return self.settings.stat().st_mtime >= source.stat().st_mtime
        return note_content(source) in text.splitlines()


def is_capture_folder(source: Path) -> bool:
    """Whether a path names a folder, and one that is not itself a capture."""
    return source.is_dir() and not (source / GEOMETRY_FILE).is_file()


def list_captures(folder: Path) -> list[Path]:
    """List the captures of a folder: files that may hold one, and folders of renderings."""
    found = sorted(
        path
        for path in folder.iterdir()
        if not path.name.startswith(".")
        and (path.suffix.lower() in CAPTURE_SUFFIXES or (path / GEOMETRY_FILE).is_file())
    )
    if not found:
        raise InputError(
            f"{folder}: no capture is in there ({', '.join(CAPTURE_SUFFIXES)}, or folders of renderings)"
        )
    names: dict[str, Path] = {}
    for path in found:
        other = names.setdefault(path.stem, path)
        if other is not path:
            raise InputError(
                f"{folder}: {other.name} and {path.name} would have results of one name; rename one"
            )
    return found


def write_volume(volume: Volume, path: Path, fraction: float) -> None:
    """Write a volume in the format that the suffix names.

    `fraction`: which voxels become points: those with at least this fraction of the brightest.
    """
    if path.suffix.lower() in RECORD_SUFFIXES:
        volume.save(path)
    else:
        volume.export(path, fraction)


def add_provenance(volume: Volume, source: Path, settings: dict[str, object]) -> Volume:
    """Record in a volume's provenance which file it was made of, and how."""
    return replace(volume, provenance=build_provenance(settings, source, earlier=volume.provenance))
