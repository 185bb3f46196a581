"""`tofclip calibrate range`: shots of a plate to a camera file, and everything that uses it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from small_instrument import BACKGROUND, BIN_WIDTH, IMAGE_SHAPE, ROWS, Run

from tofclip.camera import Camera
from tofclip.lidar import PointCloud, compute_ray_directions
from tofclip.lidar.photons import detector, make_pinhole
from tofclip.shots import Streak
from tofclip.units import SPEED_OF_LIGHT

PIXELS = (5, 6)
BINS = 80
BIN = 80e-12
FOCAL_PX = 20.0
LATE_S = 300e-12
PULSE = ["--bin-width-ps", "80", "--pulse-ps", "400"]
PLATE_ROW = 40


@pytest.fixture(autouse=True)
def quick_thresholds(monkeypatch: pytest.MonkeyPatch) -> None:
    """A false-alarm rate within a fifth of itself will do: every return here is far above it."""
    monkeypatch.setattr(detector, "CALIBRATION_HISTOGRAMS", 2000)


def save_plate(path: Path, distance: float, photons: float, seed: int) -> Path:
    """Save the photon cube of a plate, 300 ps late."""
    noise = np.random.default_rng(seed)
    y, x = np.indices(PIXELS).reshape(2, -1)
    cosine = compute_ray_directions(make_pinhole(PIXELS, FOCAL_PX, 400e-12), y, x)[:, 2]
    time = 2 * distance / cosine / SPEED_OF_LIGHT + LATE_S
    cube = noise.poisson(0.02, (y.size, BINS))
    number = noise.poisson(photons * cosine)
    pixel = np.repeat(np.arange(y.size), number)
    arrival = np.rint((time[pixel] + noise.normal(0, 400e-12 / 2.355, pixel.size)) / BIN)
    np.add.at(cube, (pixel, arrival.astype(int)), 1)
    np.save(path, cube.reshape(*PIXELS, BINS).astype(np.uint16))
    return path


def test_photons_of_a_plate_calibrate_a_detector(run: Run, tmp_path: Path) -> None:
    distances, brightness = (0.4, 0.6, 0.8), (120, 50, 20)
    shots = [
        save_plate(tmp_path / f"plate_{number}.npy", distance, photons, number)
        for number, (distance, photons) in enumerate(zip(distances, brightness, strict=True))
    ]
    words = [word for distance in distances for word in ("--target-m", distance)]
    percents = [
        word
        for distance, photons in zip(distances, brightness, strict=True)
        for word in ("--reflectance-percent", 20 * photons / 120 * (distance / 0.4) ** 2)
    ]
    out = tmp_path / "camera.h5"
    outcome = run(
        "calibrate", "range", *words, *percents, *shots, *PULSE, "--focal-length-px", FOCAL_PX,
        "--out", out, "--json",
    )  # fmt: skip
    assert (outcome.status, outcome.err) == (0, "")
    figures = json.loads(outcome.out)
    late, sigma = figures["time_zero_ns"] - 1e9 * LATE_S, figures["time_zero_sigma_ps"]
    assert sigma < 10
    assert abs(late) < 4e-3 * sigma
    assert abs(figures["walk_mm_per_decade"]) < 4 * figures["walk_sigma_mm"]
    assert (tmp_path / "camera.png").stat().st_size > 1000
    # A plate that it never saw comes out at its distance.
    unseen = save_plate(tmp_path / "unseen.npy", 0.5, 100, 9)
    cloud = tmp_path / "cloud.ply"
    outcome = run(
        "lidar", "photons", unseen, *PULSE, "--single-pixel", "--camera", out, "--out", cloud
    )
    assert (outcome.status, outcome.err) == (0, "")
    points = PointCloud.load(cloud)
    scores = (points.xyz[:, 2] - 0.5) / (points.range_sigma * points.xyz[:, 2] / points.range)
    # The root mean square of 30 normal numbers, within three of its deviations.
    assert np.sqrt(np.mean(scores**2)) == pytest.approx(1, abs=3 / np.sqrt(2 * scores.size))


def test_a_streak_shot_of_a_plate_gives_time_zero(run: Run, camera: Camera, tmp_path: Path) -> None:
    """300 ps late, known to a twentieth of a row; ranges of a recovery with it are the plate's."""
    distance = SPEED_OF_LIGHT / 2 * (PLATE_ROW * BIN_WIDTH - LATE_S)
    y, x = np.indices(IMAGE_SHAPE).reshape(2, -1)
    cosine = compute_ray_directions(camera, y, x)[:, 2].reshape(IMAGE_SHAPE)
    row = (2 * distance / cosine / SPEED_OF_LIGHT + LATE_S) / BIN_WIDTH
    rows = np.arange(ROWS)[:, np.newaxis, np.newaxis]
    sigma = camera.pulse_fwhm / BIN_WIDTH / 2.355
    plate = 100 * np.exp(-(((rows - row) / sigma) ** 2) / 2)
    expected = camera.operator()(np.moveaxis(plate, 0, -1).astype(np.float32)).T + BACKGROUND
    counts = np.random.default_rng(0).poisson(expected).astype(np.float32)
    shot = tmp_path / "plate.h5"
    Streak(counts, camera=camera).with_bin_width(BIN_WIDTH).save(shot)
    out = tmp_path / "camera.h5"
    words = ["--target-m", distance, shot, "--method", "linear", "--out", out, "--json"]
    outcome = run("calibrate", "range", *words)
    assert (outcome.status, outcome.err) == (0, "")
    figures = json.loads(outcome.out)
    assert figures["time_zero_ns"] == pytest.approx(1e9 * LATE_S, abs=1e-3)
    assert "3 shots" in figures["walk_note"]
    words = ["recover", shot, "--camera", out, "--method", "linear"]
    cloud = tmp_path / "cloud.npz"
    frames = tmp_path / "frames.h5"
    assert run(*words, "--out", frames, "--cloud", cloud).status == 0
    assert np.median(PointCloud.load(cloud).xyz[:, 2]) == pytest.approx(distance, abs=1.5e-4)
    # Recovered frames do as well as the shot, whatever their time zero was.
    again = ["calibrate", "range", "--target-m", distance, frames, "--out", tmp_path / "again.h5"]
    assert run(*again).status == 0
    late = Camera.load(tmp_path / "again.h5").time_zero
    assert late == pytest.approx(LATE_S, abs=1e-12)


def test_refusals_are_one_line(run: Run, tmp_path: Path) -> None:
    shot = save_plate(tmp_path / "plate.npy", 0.5, 100, 0)
    dark = tmp_path / "dark.npy"
    np.save(dark, np.random.default_rng(0).poisson(0.02, (*PIXELS, BINS)).astype(np.uint8))
    steps = np.random.default_rng(0).poisson(0.02, (*PIXELS, BINS))
    steps[*np.indices(PIXELS), 20 + np.arange(30).reshape(PIXELS)] += 50
    np.save(tmp_path / "steps.npy", steps.astype(np.uint8))
    out = tmp_path / "camera.h5"
    for words, needed in (
        (["--target-m", "0.5", tmp_path / "steps.npy"], "cut the picture to it (--region)"),
        (["--target-m", "0.5", "--target-m", "0.6", shot], "one for each"),
        (["--target-m", "-1", shot], "positive length"),
        (["--target-m", "0.5", "--walk", shot], "3 shots"),
        (["--target-m", "0.5", dark], "no return"),
        (["--target-m", "0.5", shot, "--reflectance-percent", "nan"], "positive percentage"),
        (["--target-m", "0.5", shot, "--region", "0", "9", "0", "6"], "rows 0..5"),
        (["--target-m", "0.5", tmp_path / "absent.h5"], "absent.h5"),
    ):
        outcome = run("calibrate", "range", *words, *PULSE, "--out", out)
        assert outcome.status == 2
        assert needed in outcome.err
        assert outcome.err.count("\n") == 1
    assert not out.exists()


@pytest.mark.nightly
def test_a_recorded_scene_is_no_plate(run: Run, shared_data: Path, tmp_path: Path) -> None:
    """Its corners hold traces of bright letters: a time zero of -11.6, -1.2 or +12.5 ns was stated
    to picoseconds."""
    folder, camera = shared_data / "clip", tmp_path / "camera.h5"
    if not folder.is_dir():
        pytest.skip("no recorded shot")
    pictures = {
        "line": "LinePattern",
        "line-background": "LinePattern_bkg",
        "dot": "DotPattern",
        "dot-background": "DotPattern_bkg",
    }
    words = [
        word for name, stem in pictures.items() for word in (f"--{name}", folder / f"{stem}.tif")
    ]
    assert run("calibrate", *words, "--out", camera).status == 0
    for method in ("tv", "linear"):
        frames = tmp_path / f"{method}.h5"
        words = ["recover", folder / "scene5.tif", "--camera", camera, "--method", method]
        assert run(*words, "--out", frames).status == 0
        for region in ([], [5, 15, 5, 15], [12, 23, 9, 21]):
            words = ["--target-m", 2, frames, "--out", tmp_path / "calibrated.h5"]
            cut = ["--region", *region] if region else []
            outcome = run("calibrate", "range", *words, *cut)
            assert (outcome.status, outcome.err.count("\n")) == (2, 1)
    assert not (tmp_path / "calibrated.h5").exists()
