"""Each plan is made once per image, and a reconstruction crosses few of our files."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from hidden_point import object_of
from small_instrument import Run

from nlos.method import Plan

MAX_FILES = 41

COUNT_FILES = """
import inspect, sys, threading
from pathlib import Path
root = Path({root!r})
seen = set()
def note(frame, event, _):
    # Of all code only functions are optimised: modules and classes are run by being imported.
    if event == "call" and frame.f_code.co_flags & inspect.CO_OPTIMIZED:
        seen.add(frame.f_code.co_filename)
import apps.verbs.nlos.reconstruct  # what is called while modules are imported is not its path
from apps.cli import main
sys.argv = {words!r}
threading.settrace(note)  # what other threads pass through is on the path as well
sys.settrace(note)  # sees calls of Python only: cheaper than a profile
try:
    main()
except SystemExit:
    pass
sys.settrace(None)
print(sorted(str(Path(one).relative_to(root)) for one in seen if one.startswith(str(root))
      and ".venv" not in one), file=sys.stderr)
"""


def test_each_plan_is_made_once_per_image(
    run: Run, curved: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made, imaged = [], []
    begin, image = Plan.__init__, Plan.image

    def count_plan(plan: Plan, *arguments: object) -> None:
        made.append(type(plan).__name__)
        begin(plan, *arguments)  # type: ignore[arg-type]

    def count_image(plan: Plan, *arguments: object) -> object:
        imaged.append(type(plan).__name__)
        return image(plan, *arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(Plan, "__init__", count_plan)
    monkeypatch.setattr(Plan, "image", count_image)
    words = ["reconstruct", curved, "--method", "hybrid", "--out", tmp_path / "volume.h5"]
    object_of(run, *words)
    assert len(made) == len(imaged) == 2  # coarse voxels, then the bright part


def test_a_reconstruction_crosses_few_files(curved: Path, tmp_path: Path) -> None:
    root = Path(__file__).parents[2]
    words = ["tofclip", "nlos", "reconstruct", str(curved), "--method", "hybrid", "--json"]
    program = COUNT_FILES.format(root=str(root), words=[*words, "--out", str(tmp_path / "v.h5")])
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=root, capture_output=True, text=True, check=True
    )
    files = done.stderr.strip().splitlines()[-1]
    assert files.count(".py") <= MAX_FILES, files
