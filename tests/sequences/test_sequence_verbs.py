"""The verbs on sequences: what they write, say and return."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import psutil
import pytest

import tofclip
from apps.cli import main
from nlos import Volume
from nlos.capture import TimeAxis
from nlos.simulate import PointScene
from tofclip import Frames, Streak

pytestmark = pytest.mark.xdist_group("cluster")  # one cluster for all of them

ROOT = Path(tofclip.__file__).parents[1]


@pytest.fixture
def run(capsys):
    """Run the program with the words of a line."""

    def call(line):
        capsys.readouterr()
        return main(line.split()), *capsys.readouterr()

    return call


@pytest.fixture
def few(recorded, tmp_path):
    """Two good shots, and one between them that carries no camera."""
    folder = tmp_path / "shots"
    folder.mkdir()
    for number in (0, 2):
        shutil.copy(recorded / "shots" / f"shot{number}.h5", folder)
    replace(Streak.load(folder / "shot0.h5"), camera=None).save(folder / "shot1.h5")
    return folder


def test_shots_to_frames_to_clouds_on_a_cluster(run, scheduler, few, tmp_path):
    frames, clouds = tmp_path / "frames", tmp_path / "clouds"
    line = f"recover {few} --out {frames} --method linear --cluster {scheduler}"
    status, out, err = run(line)
    assert status == 1
    assert "results                      2" in out
    assert err.splitlines()[-1].startswith("tofclip: failed: shot1: ")
    assert "give one (--camera camera.h5, made by" in err
    assert sorted(path.name for path in frames.glob("*.h5")) == ["shot0.h5", "shot2.h5"]
    shutil.copy(few / "shot0.h5", few / "shot1.h5")
    status, out, _ = run(f"{line} --json")
    reported = json.loads(out)
    assert status == 0
    assert (reported["results"], reported["kept_from_before"], reported["failures"]) == (1, 2, [])
    assert reported["peak_memory_mib_per_process"] > 10
    status, out, _ = run(f"cloud {frames}/*.h5 --out {clouds} --cluster {scheduler} --json")
    assert status == 0
    # two plates of 9 x 9 pixels, three times, thinned by their dark fields
    assert json.loads(out)["points"] > 300
    assert len(list(clouds.glob("*.ply"))) == 3


def test_a_sweep_has_a_folder_for_each_combination(run, recorded, tmp_path):
    line = f"recover {recorded}/shots/shot[0].h5 --out {tmp_path}/out --method l1"
    assert run(f"{line} --sweep iterations=1,2 --sweep weight=1e-3")[0] == 0
    found = {path.parent.name for path in (tmp_path / "out").rglob("shot0.h5")}
    assert found == {"iterations=1,weight=1e-3", "iterations=2,weight=1e-3"}
    assert run(f"{line} --sweep iterations")[0] == 2


@pytest.mark.nightly
def test_workers_look_for_the_device_themselves(run, scheduler, few, tmp_path):
    pytest.importorskip("torch", reason="PyTorch is optional")
    (few / "shot1.h5").unlink()
    line = f"recover {few} --method linear --cluster {scheduler} --json --out {tmp_path}"
    assert run(f"{line}/there --device torch:cpu")[0] == 0
    assert run(f"{line}/here")[0] == 0
    for name in ("shot0.h5", "shot2.h5"):
        there, here = (Frames.load(tmp_path / folder / name) for folder in ("there", "here"))
        assert (there.figures["device"], here.figures["device"]) == ("torch:cpu", "cpu")
        # What is promised; sums in another order differ by some 1e-6.
        assert np.linalg.norm(there.values - here.values) < 1e-4 * np.linalg.norm(here.values)
    status, out, _ = run(f"{line}/nowhere --device torch:cuda:99")
    assert status == 1
    assert [failure["name"] for failure in json.loads(out)["failures"]] == ["shot0", "shot2"]
    assert run(f"{line}/nowhere --device gpu")[0] == 2


@pytest.mark.parametrize(
    "line",
    [
        "recover {shots}/shot0.h5 --out {tmp}/frames.h5 --cluster local:1",
        "recover {shots}/shot0.h5 --out {tmp}/frames.h5 --sweep iterations=1",
        "recover {shots} --out {tmp}/out --cloud {tmp}/cloud.ply",
        "recover {shots} --out {tmp}/out --preview {tmp}/frames.png",
        "recover {shots} --out {tmp}/out --camera {tmp}/absent.h5",
        "recover {shots} --out {tmp}/out --cluster cloud",
        "cloud {shots}/shot0.h5 --out {tmp}/cloud.ply --cluster local:1",
        "cloud {shots} --out {tmp}/out --suffix .xyz",
        "lidar sequence {shots} --out {tmp}/out --cluster elsewhere",
    ],
)
def test_unusable_wishes_end_in_one_line(run, recorded, tmp_path, line):
    status, out, err = run(line.format(shots=recorded / "shots", tmp=tmp_path))
    assert (status, out, err.count("\n")) == (2, "", 1)


def test_ranging_on_a_cluster(run, scheduler, recorded, tmp_path):
    line = f"lidar sequence {recorded}/shots.h5 --out {tmp_path}/out --camera {recorded}/camera.h5"
    status, out, err = run(f"{line} --cluster {scheduler} --json")
    assert (status, err) == (0, "")
    reported = json.loads(out)
    assert (reported["shots"], reported["results"]) == (6, 6)
    # on a busy machine one worker does all before the other starts
    assert reported["processes"] in (1, 2)
    assert reported["jitter_rms_bins"] < 0.15


@pytest.mark.nightly
def test_studies_on_a_cluster(run, scheduler, tmp_path):
    line = f"reproduce table1 --out {tmp_path}/made --seeds 1 --cluster {scheduler} --json"
    folder = tmp_path / "made" / "reproduction"
    folder.mkdir(parents=True)
    (folder / "table1.json").write_text("{")  # damaged: made again
    status, out, err = run(line)
    assert (status, json.loads(out)["results"]) == (0, 1), err
    names = {f"table1.{ending}" for ending in ("md", "csv", "png", "json")}
    assert {path.name for path in folder.iterdir()} == names
    assert "tofclip reproduce table1" in (tmp_path / "made" / "reproduction.md").read_text()
    made = (folder / "table1.json").stat().st_mtime_ns
    reported = json.loads(run(line)[1])
    assert (reported["results"], reported["kept_from_before"]) == (0, 1)
    assert reported["table1"]["rows"] > 0
    assert (folder / "table1.json").stat().st_mtime_ns == made


def test_a_study_that_fails_on_a_cluster(run, scheduler, tmp_path):
    recording = tmp_path / "data" / "diffusercam" / "psf_hand_300x400.npz"
    recording.parent.mkdir(parents=True)
    recording.write_text("no archive")
    line = f"reproduce fig4d --data {tmp_path}/data --out {tmp_path}/made --cluster {scheduler}"
    status, out, _ = run(f"{line} --json")
    assert status == 1
    (failure,) = json.loads(out)["failures"]
    assert failure["name"] == "fig4d"
    assert "psf_hand_300x400.npz" in failure["problem"]


@pytest.mark.nightly
def test_captures_on_a_cluster_are_imaged_as_here(run, scheduler, tmp_path):
    captures = tmp_path / "captures"
    captures.mkdir()
    x, y = np.meshgrid(np.linspace(-0.5, 0.5, 12), np.linspace(-0.5, 0.5, 12))
    wall = np.stack([x, y, 0.1 * x**2], axis=-1)
    axis = TimeAxis(256, 32e-12)
    for number in range(3):
        scene = PointScene([[0.1 * number, 0.0, 0.6]])
        made = scene.simulate_capture(wall, [0.1, 0.0, 0.0], axis, 150e-12)
        made.save(captures / f"{number}.h5")
    (captures / "broken.h5").write_text("no capture")
    line = f"nlos reconstruct {captures} --method hybrid --wavelength-mm 300 --voxel-mm 60"
    here, there = tmp_path / "here", tmp_path / "there"
    assert run(f"{line} --out {here}")[0] == 1
    status, out, err = run(f"{line} --out {there} --cluster {scheduler} --json")
    reported = json.loads(out)
    assert status == 1, err
    assert reported["imaged"][0]["capture"] == "0.h5"
    assert list(reported["failed"]) == ["broken.h5"]
    for number in range(3):
        one, other = (Volume.load(folder / f"{number}.h5") for folder in (here, there))
        # Sums of some hundred float32 numbers, each rounded to 6e-8: processes that have done other
        # things before may add in another order.
        np.testing.assert_allclose(other.values, one.values, rtol=0, atol=1e-5 * one.values.max())
    line = f"nlos reconstruct {captures}/0.h5 --out {tmp_path}/v.h5 --cluster {scheduler}"
    assert run(line)[0] == 2


# While workers start, and while they work.
@pytest.mark.parametrize("after_s", [pytest.param(0.0, marks=pytest.mark.nightly), 1.0])
def test_ctrl_c_ends_the_workers_and_leaves_whole_results(recorded, tmp_path, after_s):
    shots, out = tmp_path / "shots", tmp_path / "out"
    shots.mkdir()
    for number in range(40):
        (shots / f"{number:02d}.h5").symlink_to(recorded / "shots" / "shot0.h5")
    line = (
        f"recover {shots} --out {out} --camera {recorded}/camera.h5 --method tv --iterations 3000 "
        "--focus depth-locked --cluster local:1"
    )
    command = [sys.executable, "-m", "tofclip", *line.split()]
    # A terminal sends Ctrl-C to a whole group of processes.
    options = {"stderr": subprocess.PIPE, "text": True, "start_new_session": True, "cwd": ROOT}
    process = subprocess.Popen(command, **options)
    try:
        # a worker and a tracker
        while process.poll() is None and len(psutil.Process(process.pid).children()) < 2:
            time.sleep(0.05)
        time.sleep(after_s)
        workers = psutil.Process(process.pid).children(recursive=True)
        os.killpg(process.pid, signal.SIGINT)
        _, err = process.communicate(timeout=300)  # a busy machine takes its time
    finally:
        process.kill()
    said = "tofclip: interrupted; no unfinished file was left behind"
    assert err.splitlines() in ([said], ["tofclip: recovering ...", said])
    assert process.returncode == 130
    assert psutil.wait_procs(workers, timeout=10)[1] == []
    assert all(
        path.name == "settings.json" or len(Frames.load(path).times) for path in out.iterdir()
    )
