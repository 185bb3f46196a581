"""What cannot be used is refused in one line with exit status 2; no file appears, no input changes.

The table is a text: a line is what a user types and what is said.
"""

import os
import re
import shutil
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
import tifffile
from small_instrument import IMAGE_SHAPE, SLIT_WIDTH_PX, save_plate, two_cards

from tofclip import Frames

TABLE = Path(__file__).with_name("refusals.txt")


def read_table():
    """What is typed, and a piece of what is said."""
    names = {}
    for line in TABLE.read_text("utf-8").splitlines():
        typed, arrow, said = line.partition(" => ")
        if arrow:
            yield re.sub(r"\$(\w+)", lambda found: names[found[1]], typed), said
        elif line and not line.startswith("#"):
            name, _, words = line.partition(" = ")
            names[name] = words


@pytest.fixture(scope="module")
def spoilt(files, streak, camera, tmp_path_factory):
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
    (folder / "shots").mkdir()
    shutil.copy(files / "streak.h5", folder / "shots")
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


@pytest.fixture(scope="module")
def plates(tmp_path_factory):
    """Photon cubes of a plate, of the dark, and of a stair."""
    folder = tmp_path_factory.mktemp("plates")
    save_plate(folder / "plate.npy", 0.5, 100, 0, 300e-12)
    dark = np.random.default_rng(0).poisson(0.02, (5, 6, 80))
    np.save(folder / "dark.npy", dark.astype(np.uint8))
    dark[*np.indices((5, 6)), 20 + np.arange(30).reshape(5, 6)] += 50
    np.save(folder / "steps.npy", dark.astype(np.uint8))
    return folder


@pytest.fixture(scope="module")
def cards(tmp_path_factory):
    folder = tmp_path_factory.mktemp("cards")
    two_cards(folder)
    return folder


def take_stock(*folders):
    stats = {path: path.stat() for folder in folders for path in folder.rglob("*")}
    return {path: (stat.st_size, stat.st_mtime_ns) for path, stat in stats.items()}


@pytest.mark.parametrize(("typed", "said"), [*read_table()])
def test_a_mistake_is_answered_in_a_line(shell, files, spoilt, curved, typed, said):
    before = take_stock(files, spoilt, curved.parent)
    shell.refuses(typed, said, long=300 * "x")
    assert list(Path().iterdir()) == []
    assert take_stock(files, spoilt, curved.parent) == before


def test_a_result_that_exists_survives_a_failure(shell):
    Path("frames.h5").write_text("last week's frames")
    words = "--camera {files}/camera.h5 --out frames.h5"
    shell.refuses(f"recover {{files}}/streak.tif {words}", "exists already")
    shell.refuses(f"recover {{files}}/streak.tif {words} --overwrite", "--bin-width-ps")
    assert Path("frames.h5").read_text() == "last week's frames"


def test_a_time_zero_of_the_wrong_sign_is_named(shell):
    words = "--out frames.h5 --method linear --time-zero-ns 5"
    assert shell(f"recover {{files}}/streak.h5 {words}").status == 0
    said = shell.refuses("cloud frames.h5 --out cloud.ply", "returns have negative ranges (-0.6")
    assert float(re.search(r" to (\S+) m\)", said)[1]) < 0
    assert "check the sign of --time-zero-ns" in said


def test_a_shot_of_one_row_is_a_picture_without_warnings(shell, files, recwarn):
    tifffile.imwrite("row.tif", tifffile.imread(files / "streak.tif")[:1])
    words = "--camera {files}/camera.h5 --bin-width-ps 20 --iterations 2 --out frames.h5"
    outcome = shell(f"recover row.tif {words}")
    assert (outcome.status, outcome.err, len(recwarn)) == (0, "", 0)


@pytest.mark.parametrize(
    "line",
    [
        "convert streak.tif --out out.h5",
        "info camera.h5",
        "cloud frames.h5 --out cloud.ply",
        "lidar photons cube.npy --bin-width-ps 80 --out range.npz",
        "nlos reconstruct capture.h5 --out volume.h5",
    ],
)
def test_a_pipe_is_no_file_and_not_waited_for(shell, line):
    """Files that are nothing, of every format: tests/devices/test_fuzz.py."""
    name = next(word for word in line.split() if "." in word)
    os.mkfifo(name)
    shell.refuses(line)
    assert os.listdir() == [name]
