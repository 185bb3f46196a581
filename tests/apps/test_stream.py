"""Shots to clouds while they come, from the command line: instruments made of software, stacks,
folders.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from apps.cli import main
from devices.scenes import draw_exposure, simulate_line_light
from devices.transients import read_transient, read_transients
from tofclip.lidar import PointCloud
from tofclip.shots import Streak, save_stack


def shots(number: int) -> list[Streak]:
    light = simulate_line_light()
    return [draw_exposure(light, seed) for seed in range(number)]


def told(capsys: pytest.CaptureFixture[str]) -> dict:
    return json.loads(capsys.readouterr().out)


def test_a_streaming_camera_becomes_clouds(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    words = [
        "stream",
        "sim+remoteex://?seed=1&scene=small&frame_rate=40",
        "--shots",
        "3",
        "--out",
        str(tmp_path),
    ]
    assert main([*words, "--json"]) == 0
    figures = told(capsys)
    assert figures["clouds"] == 3
    assert set(figures["stages_s"]) == {"read", "wait", "rectify", "recover", "range", "place"}
    assert figures["latency_s"]["median"] > 0
    assert figures["clouds_per_second"] > 0
    saved = sorted(tmp_path.iterdir())
    assert len(saved) == 3
    # Named by their shots: a live camera's newest are taken, and those between are left out.
    numbers = [int(path.stem.removeprefix("cloud_")) for path in saved]
    assert [path.name for path in saved] == [f"cloud_{number:06d}.ply" for number in numbers]
    assert numbers[-1] >= 2
    cloud = PointCloud.load(saved[0])
    assert 1.6 < np.median(cloud.range) < 3.3  # where the simulated scene stands


def test_photons_become_shots_of_so_many(capsys: pytest.CaptureFixture[str]):
    assert main(["stream", "sim+linospad2://?seed=1&cycles=40&records=80000", "--json"]) == 0
    figures = told(capsys)
    assert figures["clouds"] == 3  # 40 cycles of about 6000 photons
    assert figures["dropped"] == 0
    assert figures["points"] > 500


def test_shots_of_a_source_add_up_to_its_whole():
    address = "sim+linospad2://?seed=3&cycles=12"
    whole = read_transient(address)
    parts = list(read_transients(f"{address}&records=20000"))
    assert len(parts) == 4  # 12 cycles of about 6000 photons
    # an uneven code is shared between bins, and float32 sums of shares depend on their order
    np.testing.assert_allclose(
        sum(part.counts for part in parts), whole.counts, rtol=1e-5, atol=1e-5
    )
    assert all(19000 < part.counts.sum() < 20001 for part in parts[:-1])
    assert parts[0].camera is not None


def test_pictures_are_added_up_by_so_many():
    coming = read_transients("sim+remoteex://?seed=1&scene=small&frame_rate=100&frames=5")
    single = read_transients("sim+remoteex://?seed=1&scene=small&frame_rate=100")
    five, one = next(coming), next(single)
    coming.close()
    single.close()
    assert five.counts.shape == one.counts.shape
    assert five.counts.sum() > 0


@pytest.mark.parametrize("kind", ["stack", "folder"])
def test_files_are_streamed_too(kind: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    made = shots(3)
    made[0].camera.save(tmp_path / "camera.h5")
    source = tmp_path / "shots.h5"
    if kind == "stack":
        save_stack(made, source)
    else:
        source = tmp_path / "shots"
        source.mkdir()
        for number, shot in enumerate(made):
            replace(shot, camera=None).save(source / f"{number}.h5")
    words = [
        "stream",
        str(source),
        "--camera",
        str(tmp_path / "camera.h5"),
        "--time-zero-ns",
        "-11.0",
    ]
    assert main([*words, "--json"]) == 0
    assert told(capsys)["clouds"] == 3


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["stream", "SHOTS", "--shots", "0"], "--shots must be positive"),
        (["stream", "SHOTS", "--focus", "stack:-1:1:3"], "one focus"),
        (["stream", "SHOTS", "--held", "0"], "holds one entry or more"),
        (["stream", "SHOTS", "--suffix", ".xyz"], "'.xyz'"),
        (["stream", "nowhere"], "nowhere"),
        (["stream", "sim+linospad2://?cycles=3&records=0"], "must be positive"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(
    words: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    save_stack(shots(1), tmp_path / "shots.h5")
    shots(1)[0].camera.save(tmp_path / "camera.h5")
    words = [str(tmp_path / "shots.h5") if word == "SHOTS" else word for word in words]
    assert main([*words, "--camera", str(tmp_path / "camera.h5")]) == 2
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1
