"""What a sequence consists of: files of a folder or a glob pattern, or the shots of an HDF5 stack."""

from __future__ import annotations

import glob
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from tofclip.errors import FileFormatError, InputError, StorageError, require
from tofclip.io import read_streak
from tofclip.io.streaks import StreakStack
from tofclip.sequences.jobs import SETTINGS_NAME
from tofclip.shots import Streak
from tofclip.storage import is_own_file, read_outline

RESULT_SUFFIXES = (".png", ".pdf", ".svg", ".ply", ".toml", ".json")


@dataclass(frozen=True)
class Shot:
    """A streak image in the file `path`, of a stack that of a `number`, of which no other is read;
    calling it reads it. `bin_width`: duration of a row, s, which overrides the file's time axis.
    """

    path: Path
    bin_width: float | None = None
    number: int | None = None

    def __call__(self) -> Streak:
        """Read the shot."""
        if self.number is None:
            return read_streak(self.path, self.bin_width)
        shot = StreakStack(self.path).read_shot(self.number)
        return shot if self.bin_width is None else shot.with_bin_width(self.bin_width)


def is_sequence(source: str | Path) -> bool:
    """Return whether `source` is a folder, a glob pattern or an HDF5 stack of streak images, and no
    single file.
    """
    text, path = str(source), Path(source)
    # The address of an instrument, which may hold characters that a pattern uses.
    if "://" in text:
        return False
    # A file whose name contains * or [ is that file, not a pattern.
    return path.is_dir() or (StreakStack.is_one(path) if path.exists() else glob.has_magic(text))


def list_shots(source: str | Path, bin_width: float | None = None) -> dict[str, Shot]:
    """Return the shots of a sequence by name, in order: of a `source`, folder, glob pattern or
    HDF5 stack (`tofclip.io.StreakStack`). Cameras, frames and pictures that lie beside the
    shots of a folder are left out. `bin_width`: duration of a row, s, which overrides time
    axes. `InputError`, `StorageError` or `FileFormatError` where there is none.
    """
    path = Path(source)
    if path.is_dir() or not path.exists():
        files = list_files(source, _may_be_shot)
        return {name: Shot(file, bin_width) for name, file in files.items()}
    import h5py

    if not h5py.is_hdf5(path):
        raise FileFormatError(
            path,
            "is one file and no sequence: shots come in a folder, by a pattern such as 'shots/*.tif', "
            "or in an HDF5 stack",
        )
    path = path.absolute()
    numbers = range(len(StreakStack(path)))
    return {f"{path.stem}_{number:06d}": Shot(path, bin_width, number) for number in numbers}


def _may_be_shot(path: Path) -> bool:
    """Whether a file of a folder is not one that this program makes of shots, or for them."""
    if path.suffix.lower() in RESULT_SUFFIXES:
        return False
    try:
        return not is_own_file(path) or read_outline(path).kind == Streak.RECORD_KIND
    except FileFormatError:
        return True  # a damaged one is reported


def list_files(
    source: str | Path, accept: Callable[[Path], bool] = lambda path: True
) -> dict[str, Path]:
    """Return the files of a `source`, a folder or a glob pattern, by name, in the order of their names. `accept`:
    which files of a folder count; those of a pattern all do.

    A file's name is its path from the folder that they have in common, without the ending. Paths
    are absolute: a cluster's workers run in other folders. Hidden files are left out, and the settings
    that a run leaves beside its results. `InputError` where there is no file, or two have the same
    name, `StorageError` where there is no such folder.
    """
    folder = Path(source)
    if folder.is_dir():
        found = [path for path in folder.iterdir() if path.name != SETTINGS_NAME and accept(path)]
    elif glob.has_magic(str(source)):
        found = [Path(name) for name in glob.glob(str(source), recursive=True)]
    else:
        raise StorageError(f"{source}: no such folder or pattern")
    files = sorted(
        path.absolute() for path in found if path.is_file() and not path.name.startswith(".")
    )
    require(files, f"{source}: there is no file")
    common = Path(os.path.commonpath([path.parent for path in files]))
    named: dict[str, Path] = {}
    for path in files:
        name = path.relative_to(common).with_suffix("").as_posix()
        if name in named:
            raise InputError(
                f"{named[name]} and {path.name} have one name; choose some by a pattern such as '*{path.suffix}'"
            )
        named[name] = path
    return named
