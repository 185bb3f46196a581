"""The verb that measures ranging against its theoretical limit."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
from small_instrument import Run

from tofclip.camera import Camera, SkewSweep
from tofclip.io.streaks import save_stack
from tofclip.shots import Frames
from tofclip.simulate import (
    Instrument,
    Scene,
    StreakDetector,
    make_plate,
    render_true_frames,
    simulate_shot,
)
from tofclip.simulate.bodies import Body
from tofclip.simulate.patterns import make_checkerboard

CENTRES = 40.0 + 60 * np.arange(5)
CAMERA = Camera(
    CENTRES,
    np.arctan([0.5, -0.8, 0.9, -0.4, 0.1]),
    (32, 32),
    320,
    sweep=SkewSweep(CENTRES, np.zeros(5), np.zeros(5)),
    time_zero=-2e-9,
    pulse_fwhm=300e-12,
    focal_length_px=100.0,
    lenslet_pitch=10e-3,
    focus_distance=1.3,
)


def plate(distance: float, place_px: float) -> Body:
    pixel = distance / 100.0
    return make_plate(
        (place_px * pixel, place_px * pixel, distance),
        (9 * pixel, 9 * pixel),
        make_checkerboard(3, 0.1, 0.9),
    )


def test_accuracy_prints_the_figures_of_the_contract(run: Run) -> None:
    words = "--photons 100 --background 0.1 --pulse-ps 60 --bin-width-ps 20 --trials 200 --seed 0 --json"
    outcome = run("lidar", "accuracy", *words.split())
    assert (outcome.status, outcome.err) == (0, "")
    figures = json.loads(outcome.out)
    assert list(figures) == ["rms_m", "bound_m", "ratio", "detection_rate", "false_alarm_rate"]
    assert (
        3.9e-4 < figures["bound_m"] < 4.1e-4
    )  # c/2 * 26.1 ps (pulse and bin) / root 100, and a little background
    assert 0.8 < figures["ratio"] < 1.2  # 200 trials: 5 percent


def test_a_tail_costs_accuracy(run: Run) -> None:
    plain, tailed = (
        json.loads(run("lidar", "accuracy", "--trials", "1", *tail, "--json").out)["bound_m"]
        for tail in ((), ("--decay-ps", "200"))
    )
    assert tailed > 1.5 * plain


def test_alone_it_explains_itself(run: Run) -> None:
    assert "accuracy" in run("lidar").out


def test_parallax_makes_the_camera_that_depth_locked_recovery_needs(
    run: Run, tmp_path: Path
) -> None:
    scene = Scene(
        tuple(plate(distance, place) for distance, place in ((0.8, -9), (1.3, 0), (4.0, 9)))
    )
    shot = simulate_shot(
        scene, Instrument(CAMERA, StreakDetector(360, 100e-12, peak_photons=2e5)), seed=0
    )
    replace(shot.streak, camera=CAMERA.replace(lenslet_pitch=0.0)).save(tmp_path / "shot.h5")
    locked = (
        "recover",
        tmp_path / "shot.h5",
        "--out",
        tmp_path / "frames.h5",
        "--method",
        "l1",
        "--iterations",
        "5",
    )
    refused = run(*locked, "--focus", "depth-locked")
    assert refused.status == 2
    assert "lenslet pitch" in refused.err
    words = (
        "lidar",
        "parallax",
        tmp_path / "shot.h5",
        "--out",
        tmp_path / "camera.h5",
        "--gates",
        "4",
        "--json",
    )
    found = run(*words, "--shears", "-1.5", "0.9", "9")
    assert found.status == 0, found.err
    figures = json.loads(found.out)
    assert len(figures["shear_px"]) == len(figures["range_m"]) == 4
    assert abs(figures["strength_px_m"] - 1.0) < 0.3  # 100 px * 10 mm; small pictures of 32 px
    assert run(*locked, "--camera", tmp_path / "camera.h5", "--focus", "depth-locked").status == 0
    assert Frames.load(tmp_path / "frames.h5").figures["focus"] == "depth-locked"


def test_clouds_are_tidied_and_become_depth_pictures(run: Run, tmp_path: Path) -> None:
    scene = Scene((plate(1.3, 0),))
    shot = simulate_shot(
        scene, Instrument(CAMERA, StreakDetector(150, 100e-12, peak_photons=2e5)), seed=0
    )
    render_true_frames(scene, Instrument(CAMERA, StreakDetector(150, 100e-12)), shot.exposure).save(
        tmp_path / "frames.h5"
    )
    whole, thin = (
        json.loads(
            run("cloud", tmp_path / "frames.h5", "--out", tmp_path / name, "--json", *words).out
        )["points"]
        for name, words in (("a.laz", ()), ("b.ply", ("--voxel-mm", "30", "--drop-outliers")))
    )
    assert 0 < thin < whole / 2
    assert run("cloud", tmp_path / "frames.h5", "--out", tmp_path / "depth.exr").status == 0
    assert (tmp_path / "depth.exr").read_bytes()[:4] == b"\x76\x2f\x31\x01"
    assert (
        run("cloud", tmp_path / "frames.h5", "--out", tmp_path / "c.ply", "--voxel-mm", "0").status
        == 2
    )


def test_a_sequence_is_made_and_goes_on(run: Run, tmp_path: Path) -> None:
    shots, out = tmp_path / "shots", tmp_path / "clouds"
    shots.mkdir()
    made = Instrument(CAMERA, StreakDetector(150, 100e-12, peak_photons=2e4))
    streaks = [simulate_shot(Scene((plate(1.3, 0),)), made, seed).streak for seed in range(3)]
    for number, streak in enumerate(streaks):
        streak.save(shots / f"{number}.h5")
    first = run("lidar", "sequence", shots, "--out", out, "--focus", "depth-locked", "--json")
    assert first.status == 0, first.err
    assert json.loads(first.out)["shots"] == 3
    assert sorted(path.name for path in out.glob("*.ply")) == ["0.ply", "1.ply", "2.ply"]
    (out / "2.ply").unlink()
    again = json.loads(
        run("lidar", "sequence", shots, "--out", out, "--focus", "depth-locked", "--json").out
    )
    assert (again["shots"], again["results"], again["kept_from_before"]) == (1, 1, 2)
    assert run("lidar", "sequence", shots, "--out", out).status == 2  # another focus
    save_stack(streaks, tmp_path / "stack.h5")
    CAMERA.save(tmp_path / "camera.h5")
    words = (
        "lidar",
        "sequence",
        tmp_path / "stack.h5",
        "--out",
        tmp_path / "more",
        "--average",
        "2",
        "--suffix",
        ".npz",
    )
    assert run(*words).status == 2  # a stack carries no camera
    assert run(*words, "--camera", tmp_path / "camera.h5", "--bin-width-ps", "100").status == 0
    assert sorted(path.name for path in (tmp_path / "more").glob("*.npz")) == [
        "stack_000000-stack_000001.npz",
        "stack_000002.npz",
    ]
    (tmp_path / "empty").mkdir()
    for unusable in (
        (tmp_path / "empty",),
        (shots, "--suffix", ".xyz"),
        (shots, "--focus", "stack:0:1:3"),
    ):
        assert run("lidar", "sequence", *unusable, "--out", out).status == 2


def test_a_scene_is_listed_and_drawn(run: Run, tmp_path: Path) -> None:
    made = Instrument(CAMERA, StreakDetector(150, 100e-12))
    render_true_frames(Scene((plate(1.1, -9), plate(1.6, 9))), made, 1e4).save(
        tmp_path / "frames.h5"
    )
    words = ("lidar", "scene", tmp_path / "frames.h5", "--out", tmp_path / "scene.png")
    found = run(*words, "--reach-mm", "60", "--json")
    assert found.status == 0, found.err
    first, second = json.loads(found.out)["objects"]
    assert abs(first["range_m"] - 1.12) < 0.02  # beside the axis the way is longer than the depth
    assert abs(second["range_m"] - 1.62) < 0.02
    assert abs(first["width_m"] - 0.09) < 0.03
    assert 0 < first["range_sigma_m"] == first["confidence_m"] < 0.02
    assert (tmp_path / "scene.png").read_bytes()[:4] == b"\x89PNG"
    assert run(*words, "--fewest-points", "9999").status == 2
    listed = run(*words, "--reach-mm", "60").out
    assert "object 2" in listed
    # ranges without a time zero are right up to a constant, which is said wherever they are
    missing = "note: ranges are right up to a constant, no time zero given"
    assert (missing in listed) == (CAMERA.time_zero == 0)
    cloud = ("cloud", tmp_path / "frames.h5", "--out", tmp_path / "cloud.ply")
    assert (missing in run(*cloud).out) == (CAMERA.time_zero == 0)
    frames = Frames.load(tmp_path / "frames.h5")
    other = frames.camera.replace(time_zero=0.0 if frames.camera.time_zero else -1e-9)
    replace(frames, camera=other).save(tmp_path / "frames.h5")
    assert (missing in run(*words, "--reach-mm", "60").out) == (other.time_zero == 0)
    assert (missing in run(*cloud).out) == (other.time_zero == 0)
    assert "note" not in json.loads(run(*cloud, "--json").out)
