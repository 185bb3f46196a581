"""What the program writes, `tofclip.load`, `info` and `view` open, whatever the kind and suffix."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from small_instrument import Run

import tofclip
from apps.cli import main
from tofclip.storage import Record

CLOUDS = ("ply", "pcd", "csv", "npz", "las", "laz", "e57", "h5")

# Kind of every file, and whether it is something to look at.
KINDS = {
    "camera.h5": ("camera", False),
    "streak.h5": ("streak", True),
    "frames.h5": ("frames", True),
    "range.npz": ("range image", True),
    "returns.npz": ("range image", True),
    "depth.exr": ("depth picture", True),
    "cloud_depth.exr": ("depth picture", True),
    "photons.ply": ("cloud", True),
    "run.h5": ("recording", False),
    "capture.h5": ("capture", False),
    "volume.h5": ("volume", True),
    "volume.toml": ("settings", False),
    **{f"cloud.{one}": ("cloud", True) for one in CLOUDS},
}


@pytest.fixture(scope="module")
def written(files: Path, confocal: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with a small output of every verb."""
    folder = tmp_path_factory.mktemp("written")
    cube = np.random.default_rng(0).poisson(0.05, (12, 16, 64)).astype(np.uint8)
    cube[:, :, 30:32] += 4
    np.save(folder / "cube.npy", cube)

    def write(*words: object) -> None:
        assert main([str(word) for word in words]) == 0

    photons = ("lidar", "photons", folder / "cube.npy", "--bin-width-ps", 80, "--pulse-ps", 150)
    for name in ("range.npz", "depth.exr", "photons.ply"):
        write(*photons, "--out", folder / name)
    write(*photons, "--returns", 2, "--out", folder / "returns.npz")
    write("convert", files / "streak.tif", "--bin-width-ps", 20, "--out", folder / "streak.h5")
    tofclip.load(files / "streak.h5").save(folder / "streak.h5")  # with its camera
    tofclip.load(files / "camera.h5").save(folder / "camera.h5")
    recover = ("recover", files / "streak.h5", "--method", "linear", "--time-zero-ns", -5)
    write(*recover, "--out", folder / "frames.h5")
    for name in (*(f"cloud.{one}" for one in CLOUDS), "cloud_depth.exr"):
        write("cloud", folder / "frames.h5", "--out", folder / name)
    write("record", "sim+spad512://?seed=1", "--seconds", 0.2, "--out", folder / "run.h5")
    (folder / "capture.h5").write_bytes(confocal.read_bytes())
    write("nlos", "reconstruct", confocal, "--out", folder / "volume.h5")
    return folder


@pytest.mark.parametrize("name", KINDS)
def test_every_output_is_opened(run: Run, written: Path, tmp_path: Path, name: str) -> None:
    kind, is_shown = KINDS[name]
    file = written / name
    outcome = run("info", file, "--json")
    assert (outcome.status, outcome.err) == (0, "")
    assert json.loads(outcome.out)["kind"] == kind
    loaded = tofclip.load(file)
    assert kind == (loaded.kind if isinstance(loaded, Record) else loaded.to_record().kind)
    outcome = run("view", file, "--png", tmp_path / "view.png")
    if is_shown:
        assert outcome.status == 0, outcome.err
        assert (tmp_path / "view.png").stat().st_size > 1000
    else:
        assert (outcome.status, outcome.out, outcome.err.count("\n")) == (2, "", 1)
        assert any(word in outcome.err for word in ("camera", kind, "is not a TIFF"))


def test_a_range_image_keeps_its_ranges(written: Path) -> None:
    loaded = tofclip.load(written / "range.npz")
    with np.load(written / "range.npz") as expected:
        np.testing.assert_array_equal(loaded.fields["range_m"].values, expected["range_m"])
    assert loaded.fields["range_m"].units == "m"
    seen = loaded.fields["range_m"].values
    depth = tofclip.load(written / "depth.exr").fields["Z"].values
    row, column = seen.shape[0] // 2, seen.shape[1] // 2  # on the optical axis
    assert depth[row, column] == pytest.approx(seen[row, column], rel=1e-6)
