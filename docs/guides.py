"""The guides' commands, run as they stand: tests run them on small files, and the guides' own
pictures come from it.

``python docs/guides.py docs/tutorial.md FOLDER`` runs a guide where all files of FOLDER are at
hand, and puts the pictures that the guide shows beside it.
"""

from __future__ import annotations

import contextlib
import os
import re
import shlex
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from apps.cli import PROGRAM, main
from apps.figures.style import store_picture

BLOCK_PATTERN = re.compile(r"^```(sh|python)\n(.*?)^```", re.MULTILINE | re.DOTALL)
PICTURE_PATTERN = re.compile(r"!\[[^\]]*\]\((pictures/[^)]+)\)")


def read_steps(guide: Path) -> list[tuple[str, str]]:
    """Return a guide's steps, in its order: ``("sh", command)`` or ``("python", code)``.

    Blocks called ``console``, whose lines begin with a prompt, need an instrument, a screen or the
    network and are left out.
    """
    found = []
    for language, text in BLOCK_PATTERN.findall(guide.read_text(encoding="utf-8")):
        if language == "python":
            found.append((language, text))
        else:
            found += [
                (language, line) for line in text.replace("\\\n", " ").splitlines() if line.strip()
            ]
    return found


def find_hardware_commands(guide: Path) -> list[str]:
    """Return this program's commands in the blocks that are left out, without their prompt."""
    blocks = re.findall(
        r"^```console\n(.*?)^```", guide.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL
    )
    return [
        line.removeprefix("$ ")
        for block in blocks
        for line in block.splitlines()
        if f"$ {PROGRAM} " in line
    ]


def run_guide(guide: Path) -> Iterator[tuple[str, int]]:
    """Run a guide's steps in the current folder; yield each with its exit status.

    Python blocks share their names, as if typed into one session.
    """
    names: dict[str, Any] = {}
    for language, text in read_steps(guide):
        if language == "python":
            exec(compile(text, guide.name, "exec"), names)
            yield text, 0
        else:
            program, *words = shlex.split(text)
            yield text, main(words) if program == PROGRAM else 127


def find_pictures(guide: Path) -> dict[str, Path]:
    """Return the pictures of a guide's own commands: the name its command wrote, and where the
    guide shows it.
    """
    places = [
        guide.parent / found for found in PICTURE_PATTERN.findall(guide.read_text(encoding="utf-8"))
    ]
    return {place.name: place for place in places if place.parent.name == guide.stem}


def find_written(name: str) -> Path:
    """Return a picture that a guide's commands have written, here or in a folder of theirs.

    Raises
    ------
    FileNotFoundError
        None of them has.
    """
    for path in sorted(Path().rglob(name)):
        return path
    raise FileNotFoundError(f"no command of the guide has written {name}")


def make_pictures(guide: Path, inputs: Path) -> None:
    """Run a guide with the files of a folder, and keep the pictures that it shows, in few colours."""
    guide, inputs = guide.resolve(), inputs.resolve()
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        for file in inputs.iterdir():
            os.symlink(file, file.name)
        for step, status in run_guide(guide):
            if status:
                raise SystemExit(f"{step}: exit status {status}")
        for name, place in find_pictures(guide).items():
            place.parent.mkdir(parents=True, exist_ok=True)
            store_picture(find_written(name), place)


if __name__ == "__main__":
    make_pictures(Path(sys.argv[1]), Path(sys.argv[2]))
