"""`tofclip lidar photons` and `calibrate range`: from counted photons to ranges, clouds and pictures,
and a plate to a camera file.
"""

import os
from pathlib import Path

import numpy as np
import pytest
from small_instrument import BACKGROUND, BIN_WIDTH, IMAGE_SHAPE, ROWS, save_plate

from devices.emulation.linospad2 import LASER_PERIOD_S, SimulatedBoard
from devices.emulation.scenes import render_array_delays, simulate_light
from devices.linospad2 import BoardCalibration, LinoSpad2Codec
from devices.transients import find_address, read_photons
from tofclip.camera import Camera
from tofclip.lidar import PointCloud, compute_ray_directions
from tofclip.lidar.photons import detector
from tofclip.shots import Streak
from tofclip.units import SPEED_OF_LIGHT

BIN = 80e-12
BIN_M = SPEED_OF_LIGHT / 2 * BIN
FIELDS = {"range_m", "range_sigma_m", "intensity", "outlier_probability"}
PULSE = "--bin-width-ps 80 --pulse-ps 400"


def load(name="range.npz"):
    with np.load(name) as written:
        return dict(written)


def add_photons(cube, surface, photons, noise):
    """Add a pulse of 2.1 bins about each pixel's bin."""
    pixel = np.repeat(np.arange(surface.size), noise.poisson(photons, surface.size))
    time = np.rint(surface.ravel()[pixel] + noise.normal(0, 2.1, pixel.size)).astype(int)
    np.add.at(cube.reshape(surface.size, -1), (pixel, time), 1)


@pytest.fixture(scope="module")
def surface():
    """Bins of a ball before a wall."""
    y, x = np.mgrid[:40, :56]
    return np.where(np.hypot(y - 20, x - 25) < 12, 60.0, 140 + 0.3 * x)


@pytest.fixture(scope="module")
def ball(surface, tmp_path_factory):
    """File with 6 signal photons a pixel and as many of the background."""
    noise = np.random.default_rng(0)
    cube = noise.poisson(6 / 200, (40, 56, 200))
    add_photons(cube, surface, 6, noise)
    path = tmp_path_factory.mktemp("photons") / "ball.npy"
    np.save(path, cube.astype(np.uint8))
    return path


def test_a_range_image_with_deviations(shell):
    """How true they are: see `tests/lidar/test_photon_truth.py`."""
    figures = shell.figures(f"lidar photons {{ball}} --out range.npz {PULSE}")
    assert (figures["pixels"], figures["coverage"], figures["returns"]) == (2240, 1.0, 2240)
    assert figures["settings"]["axes"].startswith("yxt, ahead of the next axis by a factor of ")
    written = load()
    assert set(written) == FIELDS
    assert all(values.shape == (40, 56) for values in written.values())


def test_clouds_pictures_and_single_pixels(shell, surface):
    for name in ("cloud.ply", "picture.png"):
        shell.figures(f"lidar photons {{ball}} --out {name} --bin-width-ps 80")
    cloud = PointCloud.load("cloud.ply")
    assert len(cloud) == surface.size
    # The pixel in the middle looks straight ahead.
    assert np.min(np.hypot(cloud.xyz[:, 0], cloud.xyz[:, 1])) < 1e-3
    assert Path("picture.png").stat().st_size > 1000
    alone = shell.figures(f"lidar photons {{ball}} --out range.npz {PULSE} --single-pixel")
    assert 0.3 < alone["coverage"] == np.isfinite(load()["range_m"]).mean() < 1


def test_a_hot_pixel_is_counted_and_left_out(shell, ball):
    cube = np.load(ball).astype(np.uint32)
    cube[30, 50, 20] += 1_000_000
    np.save("hot.npy", cube)
    for words in ("", "--single-pixel"):
        line = f"lidar photons hot.npy --overwrite --out range.npz --bin-width-ps 80 {words}"
        settings = shell.figures(line)["settings"]
        assert settings["hot_pixels"] == 1
        # learnt from 13,000 photons; 0.4 ps where the hot pixel was listened to
        assert settings["pulse_fwhm_ps"] == pytest.approx(2.3548 * 2.1 * 80, rel=0.15)
        written = load()
        np.testing.assert_array_equal(np.argwhere(written["hot_pixels"]), [[30, 50]])
        # from its neighbours, where these have a say
        assert np.isfinite(written["range_m"][30, 50]) != bool(words)


def assert_gates_show_the_scene(bound_m):
    """Median error of a gated array of 32 x 32 where a pixel sees one distance."""
    delays = render_array_delays().reshape(32, 16, 32, 16)
    even = delays.max(axis=(1, 3)) - delays.min(axis=(1, 3)) < 1e-11
    error = load()["range_m"][even] - delays.mean(axis=(1, 3))[even] * SPEED_OF_LIGHT / 2
    assert np.median(np.abs(error)) < bound_m


GATED = "sim+spad512://?seed=1&mode=gated&gate_offset_ps=7000&gate_width_ns=3"


def test_a_recording_of_a_gated_array_becomes_ranges(shell):
    """SPAD512: one whole scan of a recording, by its address."""
    line = f"record {GATED}&gate_steps=8&gate_step_ps=1920 --out run.h5 --seconds 2"
    assert shell(line).status == 0
    found = shell.figures("info run.h5")
    assert found["kind"] == "recording"
    assert found["children"]["calibration"]["kind"] == "gate_scan"
    assert find_address("run.h5") == "file://run.h5"
    line = "lidar photons file://run.h5?binning=16 --out range.npz"
    assert shell.figures(line)["settings"]["image_shape"] == [32, 32]
    assert_gates_show_the_scene(0.144)  # steps are 288 mm, see above
    # A pixel alone: a pulse that hardly more than a bin sees once divided by a rounded zero.
    assert shell(f"{line} --single-pixel --overwrite").status == 0


def test_a_recording_of_time_stamps_becomes_ranges(shell):
    """LinoSPAD2's own file and a recording of ours, by their plain names."""
    light, codec = simulate_light("small"), LinoSpad2Codec("2212s", 24, True)
    board = SimulatedBoard(light, BoardCalibration.ideal(), codec, 300, 3)
    Path("run.dat").write_bytes(b"".join(board.encode_cycle(number) for number in range(12)))
    Path("run.toml").write_text(
        'firmware = "2212s"\ntimestamps_per_cycle = 24\nabsolute_counter = true\n'
        f"laser_period_ps = {LASER_PERIOD_S * 1e12}\n"
    )
    found = shell.figures("info run.dat")
    assert (found["kind"], found["attributes"]["firmware"]) == ("photon stamps", "2212s")
    assert found["attributes"]["stamps"] > 1000
    line = f"record file://{os.getcwd()}/run.dat --out run.h5 --seconds 5 --overwrite"
    assert shell(line).status == 0
    assert shell.figures("info run.h5")["kind"] == "recording"
    counts = [read_photons(find_address(name), 250e-12).counts for name in ("run.dat", "run.h5")]
    assert counts[0].shape == (100, 1, 256)
    np.testing.assert_array_equal(*counts)
    words = "--out range.npz --bin-width-ps 250 --pulse-ps 600 --single-pixel"
    settings = shell.figures(f"lidar photons run.dat {words}")["settings"]
    assert settings["image_shape"] == [1, 256]
    # Where one surface sends most of a pixel's light, its delay is the brightest instant's.
    brightest = light.row_times[light.photons.argmax(axis=0)]
    error = load()["range_m"][0] - SPEED_OF_LIGHT / 2 * brightest
    assert np.nanmedian(np.abs(error)) < SPEED_OF_LIGHT / 2 * 250e-12


def test_a_given_background_and_cycles_are_used(shell):
    """A ramp whose shape is given is no return; with pile-up corrected, photons are more than
    counted.
    """
    shape = np.exp(-np.arange(64) / 10)
    cube = np.random.default_rng(3).poisson(3 * shape, (4, 5, 64))
    cube[0, 0, 40:43] += (10, 25, 10)
    np.save("cube.npy", cube.astype(np.uint8))
    np.save("dark.npy", shape)
    line = "lidar photons cube.npy --bin-width-ps 80 --pulse-ps 160 --single-pixel"
    signal = {}
    for cycles in ("", "--cycles 120"):
        shell.figures(f"{line} --background dark.npy {cycles} --out range.npz --overwrite")
        written = load()
        signal[cycles] = written["intensity"][0, 0]
        assert written["range_m"][0, 0] == pytest.approx(41 * BIN_M, abs=0.2 * BIN_M)
        # One in a hundred of the 19 others at most; two of them would be one in fifty cases.
        assert np.isfinite(written["range_m"]).sum() <= 2
    assert signal["--cycles 120"] > 1.2 * signal[""]


def test_all_returns_of_a_pixel_are_in_a_range_image(shell):
    """A pane before a wall, 40 photons each: both are in the file, with and without neighbours. The
    cube lies in a folder, with a file for each row.
    """
    noise = np.random.default_rng(5)
    cube = noise.poisson(0.01, (24, 32, 200))
    for place in (50.0, 140.0):
        add_photons(cube, np.full((24, 32), place), 40, noise)
    Path("pane").mkdir()
    for row, histograms in enumerate(cube.astype(np.uint16)):
        np.save(f"pane/{row}.npy", histograms)
    for words in ("", "--single-pixel"):
        line = f"lidar photons pane --overwrite --out range.npz {PULSE} --returns 3 {words}"
        figures, written = shell.figures(line), load()
        assert set(written) == FIELDS | {f"returns_{name}" for name in FIELDS}
        for name in FIELDS:
            every = written[f"returns_{name}"]
            assert every.shape[:2] == (24, 32)
            np.testing.assert_array_equal(every[..., 0], written[name])
        found = written["returns_range_m"] / BIN_M
        assert np.isfinite(found).sum() == figures["returns"] > 1.98 * 24 * 32
        for place in (50, 140):
            assert np.mean((np.abs(found - place) < 3).any(axis=-1)) > 0.99


LATE_S = 300e-12


def test_photons_of_a_plate_calibrate_a_detector(shell, monkeypatch):
    # A false-alarm rate within a fifth of itself will do: every return here is far above it.
    monkeypatch.setattr(detector, "CALIBRATION_HISTOGRAMS", 2000)
    words = ""
    for distance, photons in ((0.4, 120), (0.6, 50), (0.8, 20)):
        save_plate(Path(f"plate_{distance}.npy"), distance, photons, int(5 * distance) - 2, LATE_S)
        percent = 20 * photons / 120 * (distance / 0.4) ** 2
        words += f" --target-m {distance} --reflectance-percent {percent} plate_{distance}.npy"
    line = f"calibrate range {words} {PULSE} --focal-length-px 20 --out camera.h5"
    figures = shell.figures(line)
    late, sigma = figures["time_zero_ns"] - 1e9 * LATE_S, figures["time_zero_sigma_ps"]
    assert sigma < 10
    assert abs(late) < 4e-3 * sigma
    assert abs(figures["walk_mm_per_decade"]) < 4 * figures["walk_sigma_mm"]
    assert Path("camera.png").stat().st_size > 1000
    # A plate that it never saw comes out at its distance.
    save_plate(Path("unseen.npy"), 0.5, 100, 9, LATE_S)
    words = f"{PULSE} --single-pixel --camera camera.h5 --out cloud.ply"
    shell.figures(f"lidar photons unseen.npy {words}")
    points = PointCloud.load("cloud.ply")
    scores = (points.xyz[:, 2] - 0.5) / (points.range_sigma * points.xyz[:, 2] / points.range)
    # The root mean square of 30 normal numbers, within three of its deviations.
    assert np.sqrt(np.mean(scores**2)) == pytest.approx(1, abs=3 / np.sqrt(2 * scores.size))


def test_a_region_leaves_out_what_stands_beside_the_plate(shell, monkeypatch):
    monkeypatch.setattr(detector, "CALIBRATION_HISTOGRAMS", 2000)
    save_plate(Path("plate.npy"), 0.5, 100, 0, LATE_S)
    cube = np.load("plate.npy")
    cube[:, 4:] = np.roll(cube[:, 4:], 20, axis=-1)  # columns of something farther away
    np.save("plate.npy", cube)
    line = f"calibrate range --target-m 0.5 plate.npy {PULSE} --focal-length-px 20 --out c.h5"
    figures = shell.figures(f"{line} --region 0 5 0 4")
    assert figures["target_share"] == 1
    late = 1e3 * figures["time_zero_ns"] - 1e12 * LATE_S
    assert abs(late) < 4 * figures["time_zero_sigma_ps"] < 100


def test_a_streak_shot_of_a_plate_gives_time_zero(shell, camera):
    """300 ps late, known to a twentieth of a row; ranges of a recovery with it are the plate's."""
    distance = SPEED_OF_LIGHT / 2 * (40 * BIN_WIDTH - LATE_S)
    y, x = np.indices(IMAGE_SHAPE).reshape(2, -1)
    cosine = compute_ray_directions(camera, y, x)[:, 2].reshape(IMAGE_SHAPE)
    row = (2 * distance / cosine / SPEED_OF_LIGHT + LATE_S) / BIN_WIDTH
    rows = np.arange(ROWS)[:, np.newaxis, np.newaxis]
    sigma = camera.pulse_fwhm / BIN_WIDTH / 2.355
    plate = 100 * np.exp(-(((rows - row) / sigma) ** 2) / 2)
    expected = camera.operator()(np.moveaxis(plate, 0, -1).astype(np.float32)).T + BACKGROUND
    counts = np.random.default_rng(0).poisson(expected).astype(np.float32)
    Streak(counts, camera=camera).with_bin_width(BIN_WIDTH).save("plate.h5")
    line = f"calibrate range --target-m {distance}"
    figures = shell.figures(f"{line} plate.h5 --method linear --out camera.h5")
    assert figures["time_zero_ns"] == pytest.approx(1e9 * LATE_S, abs=1e-3)
    assert "3 shots" in figures["walk_note"]
    words = "--camera camera.h5 --method linear --out frames.h5 --cloud cloud.npz"
    assert shell(f"recover plate.h5 {words}").status == 0
    found = np.median(PointCloud.load("cloud.npz").xyz[:, 2])
    assert found == pytest.approx(distance, abs=1.5e-4)
    # Recovered frames do as well as the shot, whatever their time zero was.
    assert shell(f"{line} frames.h5 --out again.h5").status == 0
    assert Camera.load("again.h5").time_zero == pytest.approx(LATE_S, abs=1e-12)


@pytest.mark.nightly
def test_a_recorded_scene_is_no_plate(shell, shared_data):
    """Its corners hold traces of bright letters: a time zero of -11.6, -1.2 or +12.5 ns was stated
    to picoseconds."""
    folder = shared_data / "clip"
    if not folder.is_dir():
        pytest.skip("no recorded shot")
    pictures = (
        "--line {clip}/LinePattern.tif --line-background {clip}/LinePattern_bkg.tif"
        " --dot {clip}/DotPattern.tif --dot-background {clip}/DotPattern_bkg.tif"
    )
    assert shell(f"calibrate {pictures} --out camera.h5", clip=folder).status == 0
    for method in ("tv", "linear"):
        words = f"--camera camera.h5 --method {method} --out {method}.h5"
        assert shell(f"recover {{clip}}/scene5.tif {words}", clip=folder).status == 0
        for cut in ("", "--region 5 15 5 15", "--region 12 23 9 21"):
            shell.refuses(f"calibrate range --target-m 2 {method}.h5 --out c.h5 {cut}")
    assert not Path("c.h5").exists()
