"""`tofclip lidar photons`: from a file of counted photons to ranges, clouds and pictures."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from small_instrument import Run

from apps.cli import main
from devices.counted_photons import find_address, read_photons
from devices.emulation.linospad2 import LASER_PERIOD_S, SimulatedBoard
from devices.emulation.scenes import render_array_delays, simulate_line_light
from devices.linospad2 import BoardCalibration, LinoSpad2Codec
from tofclip.lidar import PointCloud
from tofclip.units import SPEED_OF_LIGHT

BIN = 80e-12
BIN_M = SPEED_OF_LIGHT / 2 * BIN
KEYS = ["pixels", "coverage", "returns", "outlier_share", "seconds", "settings"]
FIELDS = {"range_m", "range_sigma_m", "intensity", "outlier_probability"}


@pytest.fixture(scope="module")
def shot(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, np.ndarray]:
    """A ball before a wall, 6 signal photons a pixel and as many of the background."""
    noise = np.random.default_rng(0)
    y, x = np.mgrid[:40, :56]
    surface = np.where(np.hypot(y - 20, x - 25) < 12, 60.0, 140 + 0.3 * x)
    cube = noise.poisson(6 / 200, (40, 56, 200))
    number = noise.poisson(6, surface.size)
    pixel = np.repeat(np.arange(surface.size), number)
    time = np.rint(surface.ravel()[pixel] + noise.normal(0, 2.1, pixel.size)).astype(int)
    np.add.at(cube.reshape(-1, 200), (pixel, time), 1)
    path = tmp_path_factory.mktemp("photons") / "ball.npy"
    np.save(path, cube.astype(np.uint8))
    return path, surface


def test_a_range_image_with_deviations(run: Run, shot, tmp_path: Path) -> None:
    path, surface = shot
    out = tmp_path / "range.npz"
    words = ["--bin-width-ps", "80", "--pulse-ps", "400", "--json"]
    outcome = run("lidar", "photons", str(path), "--out", str(out), *words)
    assert (outcome.status, outcome.err) == (0, "")
    figures = json.loads(outcome.out)
    assert list(figures) == KEYS
    assert (figures["pixels"], figures["coverage"], figures["returns"]) == (2240, 1.0, 2240)
    assert figures["settings"]["axes"].startswith("yxt, ahead of the next axis by a factor of ")
    with np.load(out) as written:
        assert set(written) == FIELDS
        assert all(written[name].shape == (40, 56) for name in FIELDS)
        assert np.mean(np.abs(written["range_m"] / BIN_M - surface) < 3) > 0.97
        assert np.median(written["range_sigma_m"]) < BIN_M


def test_clouds_pictures_and_single_pixels(run: Run, shot, tmp_path: Path) -> None:
    path, surface = shot
    for name in ("cloud.ply", "picture.png"):
        outcome = run(
            "lidar", "photons", str(path), "--out", str(tmp_path / name), "--bin-width-ps", "80"
        )
        assert (outcome.status, outcome.err) == (0, "")
    cloud = PointCloud.load(tmp_path / "cloud.ply")
    assert len(cloud) == surface.size
    # The pixel in the middle looks straight ahead.
    assert np.min(np.hypot(cloud.xyz[:, 0], cloud.xyz[:, 1])) < 1e-3
    assert (tmp_path / "picture.png").stat().st_size > 1000
    alone = tmp_path / "alone.npz"
    words = ["--bin-width-ps", "80", "--pulse-ps", "400", "--single-pixel"]
    assert run("lidar", "photons", str(path), "--out", str(alone), *words).status == 0
    with np.load(alone) as written:
        seen = np.isfinite(written["range_m"])
        error = np.abs(written["range_m"] / BIN_M - surface)[seen]
    assert 0.3 < seen.mean() < 1
    assert np.mean(error < 5) > 0.95


def test_a_hot_pixel_is_counted_and_changes_nothing(run: Run, shot, tmp_path: Path) -> None:
    path, surface = shot
    cube = np.load(path).astype(np.uint32)
    cube[30, 50, 20] += 1_000_000
    np.save(tmp_path / "hot.npy", cube)
    out = tmp_path / "range.npz"
    for words in ([], ["--single-pixel"]):
        outcome = run(
            *["lidar", "photons", tmp_path / "hot.npy", "--out", out, "--bin-width-ps", "80"],
            *[*words, "--json"],
        )
        assert (outcome.status, outcome.err) == (0, "")
        settings = json.loads(outcome.out)["settings"]
        assert settings["hot_pixels"] == 1
        # learnt from 13,000 photons; 0.4 ps where the hot pixel was listened to
        assert settings["pulse_fwhm_ps"] == pytest.approx(2.3548 * 2.1 * 80, rel=0.15)
        with np.load(out) as written:
            np.testing.assert_array_equal(np.argwhere(written["hot_pixels"]), [[30, 50]])
            found = written["range_m"] / BIN_M
        seen = np.isfinite(found)
        assert seen[30, 50] != bool(words)  # from its neighbours, where these have a say
        assert np.mean(np.abs(found - surface)[seen] < 5) > 0.95


def test_info_says_what_a_file_of_photons_holds(run: Run, shot) -> None:
    outcome = run("info", str(shot[0]), "--json")
    assert (outcome.status, outcome.err) == (0, "")
    found = json.loads(outcome.out)
    assert (found["kind"], found["layout"]) == ("photons", "cube")
    assert found["arrays"] == {"array": "40 x 56 x 200 uint8"}


def test_a_gated_arrays_address_becomes_ranges(tmp_path: Path) -> None:
    """One command from an instrument to ranges on its own time axis."""
    address = (
        "sim+spad512://?seed=1&mode=gated&binning=16&gate_steps=24&gate_step_ps=640"
        "&gate_offset_ps=7000&gate_width_ns=3"
    )
    out = tmp_path / "range.npz"
    words = ["lidar", "photons", address, "--out", str(out)]
    assert main(words) == 0
    found = np.load(out)["range_m"]
    delays = render_array_delays().reshape(32, 16, 32, 16)
    even = delays.max(axis=(1, 3)) - delays.min(axis=(1, 3)) < 1e-11
    error = found[even] - delays.mean(axis=(1, 3))[even] * SPEED_OF_LIGHT / 2
    # Steps are 96 mm; where none of them falls on an edge, the edge may be anywhere between two.
    assert np.median(np.abs(error)) < 0.048
    assert main([*words, "--bin-width-ps", "9"]) == 2


def test_a_recording_of_time_stamps_becomes_ranges(run: Run, tmp_path: Path) -> None:
    """LinoSPAD2's own file and a recording of ours, by their plain names."""
    light = simulate_line_light()
    board = SimulatedBoard(
        light, BoardCalibration.ideal(), LinoSpad2Codec("2212s", 24, True), 300, 3
    )
    stamps = tmp_path / "run.dat"
    stamps.write_bytes(b"".join(board.encode_cycle(number) for number in range(12)))
    stamps.with_suffix(".toml").write_text(
        'firmware = "2212s"\ntimestamps_per_cycle = 24\nabsolute_counter = true\n'
        f"laser_period_ps = {LASER_PERIOD_S * 1e12}\n"
    )
    found = json.loads(run("info", stamps, "--json").out)
    assert (found["kind"], found["attributes"]["firmware"]) == ("photon stamps", "2212s")
    assert found["attributes"]["stamps"] > 1000
    ours = tmp_path / "run.h5"
    words = ["--out", ours, "--seconds", "5", "--overwrite"]
    assert run("record", f"file://{stamps}", *words).status == 0
    assert json.loads(run("info", ours, "--json").out)["kind"] == "recording"
    counts = [read_photons(find_address(str(file)), 250e-12).counts for file in (stamps, ours)]
    assert counts[0].shape == (100, 1, 256)
    np.testing.assert_array_equal(*counts)
    out = tmp_path / "range.npz"
    words = ["--bin-width-ps", "250", "--pulse-ps", "600", "--single-pixel", "--json"]
    outcome = run("lidar", "photons", stamps, "--out", out, *words)
    assert (outcome.status, outcome.err) == (0, "")
    assert json.loads(outcome.out)["settings"]["image_shape"] == [1, 256]
    with np.load(out) as written:
        found = written["range_m"][0]
    # Where one surface sends most of a pixel's light, its delay is the brightest instant's.
    brightest = light.row_times[light.photons.argmax(axis=0)]
    error = found - SPEED_OF_LIGHT / 2 * brightest
    assert np.nanmedian(np.abs(error)) < SPEED_OF_LIGHT / 2 * 250e-12


def test_a_recording_of_a_gated_array_becomes_ranges(run: Run, tmp_path: Path) -> None:
    """SPAD512: one whole scan of a recording, by its address."""
    instrument = (
        "sim+spad512://?seed=1&mode=gated&gate_steps=8&gate_step_ps=1920"
        "&gate_offset_ps=7000&gate_width_ns=3"
    )
    ours, out = tmp_path / "run.h5", tmp_path / "range.npz"
    assert run("record", instrument, "--out", ours, "--seconds", "0.5").status == 0
    found = json.loads(run("info", ours, "--json").out)
    assert found["kind"] == "recording"
    assert found["children"]["calibration"]["kind"] == "gate_scan"
    assert find_address(str(ours)) == f"file://{ours}"
    outcome = run("lidar", "photons", f"file://{ours}?binning=16", "--out", out, "--json")
    assert (outcome.status, outcome.err) == (0, "")
    assert json.loads(outcome.out)["settings"]["image_shape"] == [32, 32]
    with np.load(out) as written:
        found = written["range_m"]
    delays = render_array_delays().reshape(32, 16, 32, 16)
    even = delays.max(axis=(1, 3)) - delays.min(axis=(1, 3)) < 1e-11
    error = found[even] - delays.mean(axis=(1, 3))[even] * SPEED_OF_LIGHT / 2
    # steps are 288 mm, see above
    assert np.median(np.abs(error)) < 0.144
    # A pixel alone: a pulse that hardly more than a bin sees once divided by a rounded zero.
    alone = ("lidar", "photons", f"file://{ours}?binning=16", "--out", out, "--single-pixel")
    assert run(*alone).status == 0


def test_a_given_background_and_cycles_are_used(run: Run, tmp_path: Path) -> None:
    """A ramp whose shape is given is no return; with pile-up corrected, photons are more than
    counted.
    """
    noise = np.random.default_rng(3)
    shape = np.exp(-np.arange(64) / 10)
    cube = noise.poisson(3 * shape, (4, 5, 64))
    cube[0, 0, 40:43] += (10, 25, 10)
    np.save(tmp_path / "cube.npy", cube.astype(np.uint8))
    np.save(tmp_path / "dark.npy", shape)
    words = ["lidar", "photons", tmp_path / "cube.npy", "--bin-width-ps", "80", "--pulse-ps", "160"]
    signal = {}
    for cycles in (None, 120):
        out = tmp_path / "range.npz"
        further = [] if cycles is None else ["--cycles", cycles]
        outcome = run(
            *words, "--single-pixel", "--background", tmp_path / "dark.npy", *further, "--out", out
        )
        assert (outcome.status, outcome.err) == (0, "")
        with np.load(out) as written:
            seen = np.isfinite(written["range_m"])
            signal[cycles] = written["intensity"][0, 0]
            assert written["range_m"][0, 0] == pytest.approx(41 * BIN_M, abs=0.2 * BIN_M)
        # One in a hundred of the 19 others at most; two of them would be one in fifty cases.
        assert seen.sum() <= 2
    assert signal[120] > 1.2 * signal[None]


def test_all_returns_of_a_pixel_are_in_a_range_image(run: Run, tmp_path: Path) -> None:
    """A pane before a wall, 40 photons each: both are in the file, with and without neighbours."""
    noise = np.random.default_rng(5)
    cube = noise.poisson(0.01, (24, 32, 200))
    for surface in (50.0, 140.0):
        pixel = np.repeat(np.arange(24 * 32), noise.poisson(40, 24 * 32))
        time = np.rint(surface + noise.normal(0, 2.1, pixel.size)).astype(int)
        np.add.at(cube.reshape(-1, 200), (pixel, time), 1)
    path, out = tmp_path / "pane.npy", tmp_path / "range.npz"
    np.save(path, cube.astype(np.uint16))
    words = ["lidar", "photons", path, "--out", out, "--bin-width-ps", "80", "--pulse-ps", "400"]
    for further in ([], ["--single-pixel"]):
        outcome = run(*words, "--returns", "3", *further, "--json")
        assert (outcome.status, outcome.err) == (0, "")
        figures = json.loads(outcome.out)
        with np.load(out) as written:
            assert set(written) == FIELDS | {f"returns_{name}" for name in FIELDS}
            found = written["returns_range_m"] / BIN_M
            for name in FIELDS:
                every = written[f"returns_{name}"]
                assert every.shape[:2] == (24, 32)
                np.testing.assert_array_equal(every[..., 0], written[name])
        assert np.isfinite(found).sum() == figures["returns"] > 1.98 * 24 * 32
        for surface in (50, 140):
            assert np.mean((np.abs(found - surface) < 3).any(axis=-1)) > 0.99
