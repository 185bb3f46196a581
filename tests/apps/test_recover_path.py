"""How many of our files one `tofclip recover` passes through, and that it does each thing once."""

from __future__ import annotations

import inspect
import sys
import threading
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any

import pytest

import tofclip

ROOT = Path(tofclip.__file__).parents[1]
OURS = tuple(f"{ROOT / package}/" for package in ("tofclip", "apps", "nlos", "devices"))
MAX_FILES = 30
TIFF_READERS = (
    2  # files of a raw picture's own: its pages, and what the instrument writes into them
)


def count_calls(action: Callable[[], object]) -> Counter[tuple[str, str]]:
    """Count the calls of our functions by (file, name), on all threads."""
    calls: Counter[tuple[str, str]] = Counter()

    def note(frame: FrameType, event: str, _: Any) -> None:
        code = frame.f_code
        is_function = code.co_flags & inspect.CO_OPTIMIZED  # bodies of modules and classes are not
        if event == "call" and is_function and code.co_filename.startswith(OURS):
            calls[code.co_filename.removeprefix(f"{ROOT}/"), code.co_qualname] += 1

    # A trace sees our calls only, a profile those of compiled code as well.
    before = sys.gettrace()
    threading.settrace(note)
    sys.settrace(note)
    try:
        action()
    finally:
        sys.settrace(before)
        threading.settrace(None)  # type: ignore[arg-type]
    return calls


@pytest.mark.parametrize("shot", ["streak.h5", "streak.tif"])
def test_one_recovery_passes_through_few_files_and_does_each_thing_once(run, files, tmp_path, shot):
    words = ["recover", files / shot, "--out", tmp_path / "frames.h5", "--iterations", 3]
    if shot.endswith(".tif"):
        words += ["--camera", files / "camera.h5", "--bin-width-ps", 20]
    assert run(*words).status == 0  # so that imports and compiled loops are there
    calls = count_calls(lambda: run(*words))
    crossed = sorted({file for file, _ in calls})

    most = MAX_FILES + (TIFF_READERS if shot.endswith(".tif") else 0)
    assert len(crossed) <= most, "\n".join(crossed)
    for once in ("open_shot", "plan_recovery", "make_method", "parse_focus", "read_streak"):
        assert sum(number for (_, name), number in calls.items() if name == once) == 1, once
