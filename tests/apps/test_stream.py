"""Shots to clouds while they come, from the command line: instruments made of software, stacks,
folders.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from time import monotonic, sleep

import numpy as np
import pytest

from apps.cli import main
from devices.emulation.remoteex import EmulatedStreakCamera
from devices.emulation.scenes import EmulatedLight, draw_exposure, simulate_line_light
from devices.transients import read_transient, read_transients
from tofclip.camera import Camera, SkewSweep
from tofclip.io.streaks import save_stack
from tofclip.lidar import PointCloud
from tofclip.sequences.following import SurfacePipeline
from tofclip.sequences.streaming import stream_clouds
from tofclip.shots import Streak
from tofclip.simulate import Instrument, Scene, StreakDetector, make_plate, simulate_shot
from tofclip.simulate.patterns import make_plain_pattern


def shots(number: int) -> list[Streak]:
    light = simulate_line_light()
    return [draw_exposure(light, seed) for seed in range(number)]


def read_report(capsys: pytest.CaptureFixture[str]) -> dict:
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
    figures = read_report(capsys)
    assert figures["clouds"] == 3
    assert figures["method"] == "linear"
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


def test_a_stream_by_a_prior_says_so_and_its_rate(capsys: pytest.CaptureFixture[str]):
    address = "sim+remoteex://?seed=1&scene=small&frame_rate=40"
    assert main(["stream", address, "--shots", "3", "--method", "l1", "--json"]) == 0
    figures = read_report(capsys)
    assert (figures["method"], figures["clouds"]) == ("l1", 3)
    assert figures["clouds_per_second"] > 0
    assert figures["points"] > 0
    assert main(["stream", address, "--shots", "1", "--method", "wavelet"]) == 2
    assert "linear, l1, tv, surfaces, not 'wavelet'" in " ".join(capsys.readouterr().err.split())


def test_a_stream_by_surfaces_is_that_of_its_pipeline(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    centres = 30.0 + 45 * np.arange(4)
    camera = Camera(
        centres,
        np.arctan([0.6, -0.7, 0.3, -0.1]),
        (24, 24),
        200,
        sweep=SkewSweep(centres, np.zeros(4), np.zeros(4)),
        time_zero=-6e-9,
        pulse_fwhm=150e-12,
    )
    plate = make_plate((0.0, 0.0, 1.3), (0.05, 0.05), make_plain_pattern(0.8))
    instrument = Instrument(camera, StreakDetector(80, 50e-12, peak_photons=5e4))
    made = [simulate_shot(Scene((plate,)), instrument, seed).streak for seed in range(3)]
    source, clouds = tmp_path / "shots.h5", tmp_path / "clouds"
    save_stack(made, source)
    camera.save(tmp_path / "camera.h5")
    words = ["stream", str(source), "--camera", str(tmp_path / "camera.h5"), "--out", str(clouds)]
    words += ["--method", "surfaces"]
    assert main([*words, "--json"]) == 0
    figures = read_report(capsys)
    assert (figures["method"], figures["clouds"], figures["dropped"]) == ("surfaces", 3, 0)
    assert figures["clouds_per_second"] > 0
    pipeline = SurfacePipeline.for_shot(made[0])
    for number, one in enumerate(stream_clouds(made, pipeline)):
        cloud = PointCloud.load(clouds / f"cloud_{number:06d}.ply")
        # a PLY keeps coordinates in float32
        np.testing.assert_allclose(cloud.range, one.cloud.range, rtol=1e-6)
        assert np.median(cloud.range) == pytest.approx(1.3, abs=1e-3)
    assert pipeline.searches == 1


def test_a_slow_consumer_gets_the_newest_shot_and_the_truth_about_the_others(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    """200 shots a second, 2 clouds a second: every shot is accounted for as the camera itself
    counts, and clouds are younger than two of them take.
    """
    pause, clouds = 0.5, 5
    pictures = [EmulatedLight.of(simulate_line_light(), 1).draw_frame(n) for n in range(4)]
    monkeypatch.setattr(EmulatedLight, "draw_frame", lambda self, number: pictures[number % 4])
    cameras: list[WatchedCamera] = []

    class WatchedCamera(EmulatedStreakCamera):
        def __init__(self, *arguments: object) -> None:
            self.taken_at: dict[int, float] = {}
            cameras.append(self)
            super().__init__(*arguments)

        def note_taken(self, number: int) -> None:
            self.taken_at[number] = monotonic()

    monkeypatch.setattr("devices.emulation.remoteex.EmulatedStreakCamera", WatchedCamera)
    ages = []

    def save_slowly(self: PointCloud, path: Path) -> None:
        # The file's number is the camera's own: with any other the age would be another.
        number = int(path.stem.removeprefix("cloud_"))
        ages.append(monotonic() - cameras[0].taken_at[number])
        sleep(pause)

    monkeypatch.setattr(PointCloud, "save", save_slowly)
    address = "sim+remoteex://?seed=1&scene=small&frame_rate=200"
    words = ["stream", address, "--shots", str(clouds), "--out", str(tmp_path)]
    assert main([*words, "--json"]) == 0
    figures = read_report(capsys)
    camera = cameras[0]
    assert camera.taken > 100 * pause * clouds  # the emulated camera kept its pace, about
    assert figures["acquired"] == camera.taken
    assert figures["dropped_device"] == camera.taken - camera.sent
    assert figures["dropped_host"] == camera.sent - clouds
    assert figures["delivered"] == clouds
    assert figures["latency_from"] == "instrument"
    assert figures["latency_median_s"] < 2 * pause
    # Stamps are whole milliseconds; the rest is the least delay of a message.
    assert figures["latency_median_s"] == pytest.approx(np.median(ages), abs=0.05)


def test_photons_become_shots_of_so_many(capsys: pytest.CaptureFixture[str]):
    assert main(["stream", "sim+linospad2://?seed=1&cycles=40&records=80000", "--json"]) == 0
    figures = read_report(capsys)
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
    assert read_report(capsys)["clouds"] == 3


@pytest.mark.parametrize("bad", [0, 1, 3])
def test_a_shot_that_cannot_be_used_is_listed_and_the_others_become_clouds(
    bad: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source, clouds = tmp_path / "shots", tmp_path / "clouds"
    source.mkdir()
    made = shots(4)
    made[0].camera.save(tmp_path / "camera.h5")
    for number, shot in enumerate(made):
        replace(shot, camera=None).save(source / f"{number}.h5")
    whole = (source / f"{bad}.h5").read_bytes()
    (source / f"{bad}.h5").write_bytes(whole[: len(whole) // 2])
    words = ["stream", str(source), "--camera", str(tmp_path / "camera.h5"), "--out", str(clouds)]
    assert main([*words, "--json"]) == 1
    said = capsys.readouterr()
    figures = json.loads(said.out)
    counts = ("acquired", "delivered", "dropped_device", "dropped_host", "failed")
    assert [figures[name] for name in counts] == [4, 3, 0, 0, 1]
    assert said.err.count("\n") == 1
    assert said.err.startswith(f"tofclip: failed: shot {bad}: {source / str(bad)}.h5: ")
    names = {f"cloud_{number:06d}.ply" for number in range(4) if number != bad}
    assert {path.name for path in clouds.iterdir()} == names


def test_a_shot_of_another_size_is_listed_too(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first, second, third = shots(3)
    source = tmp_path / "shots"
    source.mkdir()
    first.save(source / "0.h5")
    replace(second, counts=second.counts[:-20], row_times=second.row_times[:-20]).save(
        source / "1.h5"
    )
    third.save(source / "2.h5")
    assert main(["stream", str(source), "--json"]) == 1
    said = capsys.readouterr()
    figures = json.loads(said.out)
    assert [figures[name] for name in ("acquired", "delivered", "failed")] == [3, 2, 1]
    assert said.err.startswith("tofclip: failed: shot 1: ")


def test_a_folder_without_a_shot_that_can_be_read_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("a.tif", "b.tif"):
        (tmp_path / name).write_bytes(b"II*\0")
    assert main(["stream", str(tmp_path), "--json"]) == 2
    said = capsys.readouterr()
    assert (said.out, said.err.count("\n")) == ("", 1)
    assert "a.tif" in said.err


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
