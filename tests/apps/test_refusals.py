"""What cannot be used is refused in one line with exit status 2; no file appears, no input changes.

The table is a text: a line is what a user types and what is said.
"""

import os
import re
import resource
import shutil
import signal
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
import scipy.io
import tifffile
from small_instrument import IMAGE_SHAPE, SLIT_WIDTH_PX, save_plate, two_cards

from tofclip import Frames, point_cloud
from tofclip.shots import Returns

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


# A hundred inputs that are nothing: ten kinds of files, each with the verb that reads it, and each
# spoilt in ten ways.
MAX_BYTES, MAX_SECONDS = 4 << 30, 60
KINDS = {
    "streak.tif": "convert --bin-width-ps 20",
    "streak.h5": "convert",
    "camera.h5": "info",
    "cube.npy": "lidar photons --bin-width-ps 80",
    "cube.npz": "lidar photons --bin-width-ps 80",
    "cube.mat": "lidar photons --bin-width-ps 80",
    "cloud.ply": "info",
    "cloud.pcd": "info",
    "frames.h5": "cloud",
    "capture.h5": "nlos reconstruct",
}


def noise(size):
    return np.random.default_rng(size).bytes(size)


DAMAGES = {
    "empty": lambda content: b"",
    "one byte": lambda content: content[:1],
    "the signature alone": lambda content: content[:8],
    "a tenth": lambda content: content[: len(content) // 10],
    "half": lambda content: content[: len(content) // 2],
    "noise": lambda content: noise(len(content)),
    "noise behind the signature": lambda content: content[:8] + noise(len(content)),
    "zeros behind the signature": lambda content: content[:8] + bytes(len(content)),
    "a letter": lambda content: b"Dear friend,\n" * 99,
    "a pipe": lambda content: b"",
}


@pytest.fixture(scope="module")
def sound(files, camera, confocal, tmp_path_factory):
    """Folder with a sound file of every kind."""
    folder = tmp_path_factory.mktemp("sound")
    for name in ("streak.tif", "streak.h5", "camera.h5"):
        shutil.copy(files / name, folder)
    shutil.copy(confocal, folder / "capture.h5")
    cube = np.random.default_rng(0).poisson(0.1, (8, 9, 32)).astype(np.uint8)
    np.save(folder / "cube.npy", cube)
    np.savez(folder / "cube.npz", cube=cube)
    scipy.io.savemat(folder / "cube.mat", {"cube": cube})
    values = np.ones((20, *camera.image_shape), np.float32)
    Frames(values, np.arange(20) * 20e-12 + 5e-9, camera).save(folder / "frames.h5")
    pixels, ones = np.arange(30, dtype=np.int32), np.ones(30, np.float32)
    returns = Returns(pixels, pixels, 2 * ones, ones, ones, ones.astype(np.uint8), ones, camera)
    for suffix in ("ply", "pcd"):
        point_cloud(returns).save(folder / f"cloud.{suffix}")
    return folder


@pytest.fixture
def _bounded():
    """Give this process 4 GiB more, and a minute."""
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    before = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (used + MAX_BYTES, before[1]))
    signal.alarm(MAX_SECONDS)
    yield
    signal.alarm(0)
    resource.setrlimit(resource.RLIMIT_AS, before)


@pytest.mark.usefixtures("_bounded")
@pytest.mark.parametrize("damage", DAMAGES)
@pytest.mark.parametrize("kind", KINDS)
def test_a_file_that_is_nothing_is_refused(shell, sound, kind, damage):
    if damage == "a pipe":
        os.mkfifo(kind)
    else:
        Path(kind).write_bytes(DAMAGES[damage]((sound / kind).read_bytes()))
    verb = KINDS[kind]
    out = {"info": "", "lidar": "--out out.npz"}.get(verb.split()[0], "--out out.h5")
    shell.refuses(f"{verb} {kind} {out}")
    assert os.listdir() == [kind]
