"""What cannot be used is refused in one line with exit status 2; no file appears, no input changes.

The table is a text: a line is what a user types and what is said.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
import tifffile
from small_instrument import IMAGE_SHAPE, SLIT_WIDTH_PX, Outcome, Run

from tofclip import Camera, Frames, Streak

TABLE = Path(__file__).with_name("refusals.txt")


def read_table() -> Iterator[tuple[str, str]]:
    """What is typed, and a piece of what is said."""
    names: dict[str, str] = {}
    for line in TABLE.read_text("utf-8").splitlines():
        typed, arrow, said = line.partition(" => ")
        if arrow:
            yield re.sub(r"\$(\w+)", lambda found: names[found[1]], typed), said
        elif line and not line.startswith("#"):
            name, _, words = line.partition(" = ")
            names[name] = words


@pytest.fixture(scope="module")
def spoilt(
    files: Path, streak: Streak, camera: Camera, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """Folder with inputs of which nothing can be made."""
    folder = tmp_path_factory.mktemp("spoilt")
    shape = (96, SLIT_WIDTH_PX)
    pictures = {
        "zero": np.zeros(shape, np.uint16),
        "saturated": np.full(shape, 65535, np.uint16),
        "nan": np.full(shape, np.nan, np.float32),
        "negative": np.full(shape, -3, np.int16),
        "narrow": np.arange(96 * 200, dtype=np.uint16).reshape(96, 200),
        "dark": np.full(shape, 7, np.uint16),
    }
    for name, counts in pictures.items():
        tifffile.imwrite(folder / f"{name}.tif", counts)
    for suffix in (".tif", ".h5"):
        whole = (files / f"streak{suffix}").read_bytes()
        (folder / f"cut{suffix}").write_bytes(whole[: len(whole) // 2])
    (folder / "empty.tif").touch()
    (folder / "letter.tif").write_text("a letter to a friend")
    (folder / "taken").write_text("a file")
    (folder / "mine.toml").write_text("voxel_mm = 100\n")
    for name in ("nothing/x", "captures/a.h5", "alike/a.h5", "alike/a.npz"):
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).touch()
    (folder / "nothing" / "x").unlink()
    for name in ("off", "huge"):
        (folder / f"{name}.h5").write_bytes((files / "camera.h5").read_bytes())
    with h5py.File(folder / "off.h5", "r+") as file:
        file["centres"][6] = SLIT_WIDTH_PX + 20.0
    with h5py.File(folder / "huge.h5", "r+", libver="latest") as file:
        huge = file.create_dataset("huge", (1 << 38,), np.float32, chunks=(1 << 20,))
        huge.attrs["units"] = huge.attrs["axes"] = ""
    for name, value in {"kind": np.zeros(3), "provenance": "[" * 60000}.items():
        (folder / f"{name}.h5").write_bytes((files / "streak.h5").read_bytes())
        with h5py.File(folder / f"{name}.h5", "r+") as file:
            file.attrs[name] = value
    # A camera of another instrument, as wide by chance: its views look where there is no light.
    moved = camera.centres_px.copy()
    moved[6] = 299.0
    other = camera.replace(centres_px=moved, sweep=None)
    replace(streak, camera=other).save(folder / "moved.h5")
    dark = np.zeros((8, *IMAGE_SHAPE), np.float32)
    Frames(dark, np.arange(8) * 20e-12, camera).save(folder / "frames.h5")
    cube = np.random.default_rng(1).poisson(0.5, (6, 6, 32))
    cube[:, :, 9:13] += (10, 25, 25, 10)  # a pulse that can be learnt
    np.save(folder / "cube.npy", cube)
    return folder


def assert_refused(outcome: Outcome, said: str) -> None:
    assert (outcome.status, outcome.out) == (2, "")
    assert outcome.err.startswith("tofclip: error: ")
    assert outcome.err.count("\n") == 1
    assert said in outcome.err


def take_stock(*folders: Path) -> dict[Path, tuple[int, int]]:
    found = (path.stat() for folder in folders for path in folder.rglob("*"))
    paths = (path for folder in folders for path in folder.rglob("*"))
    return {path: (one.st_size, one.st_mtime_ns) for path, one in zip(paths, found, strict=True)}


@pytest.mark.parametrize(("typed", "said"), read_table())
def test_a_mistake_is_answered_in_a_line(
    run: Run,
    files: Path,
    spoilt: Path,
    curved: Path,
    confocal: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    typed: str,
    said: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    before = take_stock(files, spoilt, curved.parent)
    typed = typed.format(files=files, spoilt=spoilt, wall=curved, scan=confocal, long=300 * "x")
    assert_refused(run(*shlex.split(typed)), said)
    assert list(tmp_path.iterdir()) == []
    assert take_stock(files, spoilt, curved.parent) == before


def test_a_result_that_exists_survives_a_failure(run: Run, files: Path, tmp_path: Path) -> None:
    (tmp_path / "frames.h5").write_text("last week's frames")
    words = ("recover", files / "streak.tif", "--camera", files / "camera.h5")
    assert_refused(run(*words, "--out", tmp_path / "frames.h5"), "--bin-width-ps")
    assert (tmp_path / "frames.h5").read_text() == "last week's frames"


def test_a_time_zero_of_the_wrong_sign_is_named(run: Run, files: Path, tmp_path: Path) -> None:
    words = ["recover", files / "streak.h5", "--out", tmp_path / "frames.h5", "--method", "linear"]
    assert run(*words, "--time-zero-ns", "5").status == 0
    outcome = run("cloud", tmp_path / "frames.h5", "--out", tmp_path / "cloud.ply")
    assert_refused(outcome, "returns have negative ranges (-0.6")
    highest = re.search(r" to (\S+) m\)", outcome.err)
    assert highest is not None
    assert float(highest[1]) < 0
    assert "check the sign of --time-zero-ns" in outcome.err


def test_a_shot_of_one_row_is_a_picture_without_warnings(
    run: Run, files: Path, tmp_path: Path, recwarn: pytest.WarningsRecorder
) -> None:
    shot = tmp_path / "row.tif"
    tifffile.imwrite(shot, tifffile.imread(files / "streak.tif")[:1])
    words = ["recover", shot, "--camera", files / "camera.h5", "--bin-width-ps", 20]
    outcome = run(*words, "--iterations", 2, "--out", tmp_path / "frames.h5")
    assert (outcome.status, outcome.err, len(recwarn)) == (0, "", 0)
