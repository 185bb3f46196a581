"""`tofclip nlos`: every verb on small simulated captures."""

from __future__ import annotations

import os
import shlex
import signal
import subprocess
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hidden_point import POINT, SCENE, object_of
from small_instrument import Run
from test_program import LONGEST_WAIT_S, PROGRAM, ROOT, wait_for
from verb_pages import collect_verbs

from apps.help import split_docstring
from nlos import Capture, Volume
from nlos.export import Mesh
from nlos.illumination import AliasingWarning
from nlos.known_scenes import HiddenTruth
from nlos.method import Plan

PNG = b"\x89PNG"


class TestSimulate:
    def test_the_capture_carries_its_truth_and_its_settings(self, curved: Path) -> None:
        capture, truth = Capture.load(curved), HiddenTruth.load(curved)
        assert truth is not None
        np.testing.assert_array_equal(truth.positions, [POINT])
        assert capture.signal.shape[1:] == (24, 24)
        assert capture.provenance["settings"]["wall"] == "cylinder"
        # The farthest point's light has arrived when the record ends, and no long silence follows.
        last = np.flatnonzero(capture.signal.max(axis=(1, 2)) > 1e-3 * capture.signal.max())[-1]
        assert 0 <= capture.axis.bins - last < 12

    def test_its_settings_give_the_same_capture(self, run: Run, tmp_path: Path) -> None:
        words = [
            "simulate",
            *SCENE,
            "--wall",
            "wavy",
            "--wall-points",
            6,
            "--peak-counts",
            20,
            "--seed",
            3,
        ]
        object_of(run, *words, "--background", 0.5, "--out", tmp_path / "one.h5")
        object_of(
            run, "simulate", "--settings", tmp_path / "one.toml", "--out", tmp_path / "two.h5"
        )
        object_of(
            run,
            "simulate",
            "--settings",
            tmp_path / "one.toml",
            "--seed",
            4,
            "--out",
            tmp_path / "three.h5",
        )
        one, two, three = (
            Capture.load(tmp_path / f"{name}.h5") for name in ("one", "two", "three")
        )
        np.testing.assert_array_equal(one.signal, two.signal)
        assert not np.array_equal(one.signal, three.signal)
        assert np.array_equal(one.signal, np.round(one.signal))  # photons

    def test_letters_before_two_plates(self, run: Run, tmp_path: Path) -> None:
        words = [
            "simulate",
            "--letters",
            "L",
            "--wall",
            "plates",
            "--wall-points",
            9,
            "--facet-mm",
            60,
        ]
        found = object_of(run, *words, "--laser-m", -0.5, 0, "--out", tmp_path / "plates.h5")
        capture = Capture.load(tmp_path / "plates.h5")
        assert (
            found["wall_points"] == np.isfinite(capture.wall[..., 0]).sum() == 72
        )  # the middle column hangs in the gap
        assert any(np.array_equal(capture.laser, point) for point in capture.points)  # on the wall
        assert abs(capture.laser[0] + 0.5) < 0.2
        truth = HiddenTruth.load(tmp_path / "plates.h5")
        assert truth is not None
        corner = truth.positions[np.argmin(truth.positions[:, 0] - truth.positions[:, 1])]
        assert corner[0] < 0 < corner[1]  # the foot of an L is at the lower left, y down
        assert set(truth.positions[:, 2]) == {1.0}

    def test_a_mesh(self, run: Run, tmp_path: Path) -> None:
        corners = np.array([[-0.2, -0.1, 0.8], [-0.2, 0.1, 0.8], [0.2, 0.1, 0.8]], np.float32)
        Mesh(corners, np.array([[0, 1, 2]], np.int32)).save(tmp_path / "triangle.ply")
        words = [
            "simulate",
            "--mesh",
            tmp_path / "triangle.ply",
            "--material",
            "retroreflecting",
            "--wall-points",
            4,
        ]
        assert object_of(run, *words, "--out", tmp_path / "capture.h5")["total"] > 0


class TestInfo:
    def test_a_curved_wall(self, run: Run, curved: Path) -> None:
        found = object_of(run, "info", curved)
        wall = found["wall"]
        assert (wall["points"], wall["shape"], found["truth"]) == (576, "no planar lattice", True)
        assert wall["step_m"] == pytest.approx(0.8 / 23, rel=0.01)
        suits = {name: one["suits"] for name, one in found["methods"].items()}
        assert suits == {
            "rsd": False,
            "hybrid": True,
            "backprojection": True,
            "filtered-backprojection": True,
            "lct": False,
            "fk": False,
        }
        assert "hybrid" in found["methods"]["rsd"]["reason"]
        assert found["resolution_m"]["x"] == pytest.approx(
            1.2 * found["wavelength_mm"]["chosen"] * 0.75e-3, rel=0.5
        )

    def test_a_confocal_scan_suits_every_method(self, run: Run, confocal: Path) -> None:
        found = object_of(run, "info", confocal)
        assert found["laser"] == "confocal"
        assert all(one["suits"] and one["memory_mib"] > 0 for one in found["methods"].values())
        people = run("nlos", "info", confocal)
        assert people.status == 0
        assert "\nhybrid " in people.out

    def test_the_shortest_wavelength_is_just_not_undersampled(
        self, run: Run, curved: Path, tmp_path: Path
    ) -> None:
        chosen = object_of(run, "info", curved)["wavelength_mm"]
        words = ["reconstruct", curved, "--out", tmp_path / "volume.h5", "--voxel-mm", 100]
        object_of(run, *words, "--wavelength-mm", chosen["chosen"])
        shorter = run("nlos", *words, "--wavelength-mm", 0.95 * chosen["shortest"])
        assert shorter.status == 0
        assert shorter.err.startswith("tofclip: warning: wall points 0.0348 m apart are too coarse")
        assert shorter.err.count("\n") == 1

    def test_one_wall_point_and_many_lasers_are_sampled_by_the_lasers(self, confocal: Path) -> None:
        from nlos.analysis import find_sampling_step

        capture = Capture.load(confocal)
        alone = np.broadcast_to(capture.wall[3, 4], capture.wall.shape)
        one_detector = Capture(capture.signal, alone, capture.wall, capture.bin_width)
        assert find_sampling_step(one_detector) == pytest.approx(capture.spacing)
        nowhere = Capture(
            capture.signal[:, 0, 0], capture.wall[0, 0], capture.wall[0, 0], capture.bin_width
        )
        assert find_sampling_step(nowhere) == 0


class TestReconstruct:
    def test_the_point_is_found_without_a_word(
        self, run: Run, curved: Path, tmp_path: Path
    ) -> None:
        found = object_of(run, "reconstruct", curved, "--out", tmp_path / "volume.h5")
        assert found["method"] == "hybrid"
        # A third of the width of its image; the pulse of three waves is as long as the depth is
        # uncertain.
        assert [found["peak_m"][axis] for axis in "xyz"] == pytest.approx(
            POINT, abs=found["wavelength_mm"] / 3000
        )

    @pytest.mark.parametrize("method", ["hybrid", "backprojection", "filtered-backprojection"])
    def test_its_settings_give_the_same_volume(
        self, run: Run, curved: Path, tmp_path: Path, method: str
    ) -> None:
        words = ["reconstruct", curved, "--gate-m", 0.1, "--bins-together", 2, "--voxel-mm", 33.3]
        object_of(run, *words, "--method", method, "--out", tmp_path / "one.h5")
        settings = ["--settings", tmp_path / "one.toml"]
        object_of(run, "reconstruct", curved, *settings, "--out", tmp_path / "two.h5")
        one, two = (Volume.load(tmp_path / f"{name}.h5") for name in ("one", "two"))
        assert one.values.tobytes() == two.values.tobytes()
        for axis in "xyz":
            assert getattr(one.grid, axis).tobytes() == getattr(two.grid, axis).tobytes()
        assert (tmp_path / "one.toml").read_text() == (tmp_path / "two.toml").read_text()

    def test_flags_win(self, run: Run, curved: Path, tmp_path: Path) -> None:
        (tmp_path / "mine.toml").write_text(
            "voxel_mm = 50\nmethod = 'backprojection'\nx_m = [-0.2, 0.3]\n"
        )
        words = [
            "reconstruct",
            curved,
            "--settings",
            tmp_path / "mine.toml",
            "--everywhere",
            "--voxel-mm",
            100,
        ]
        found = object_of(
            run,
            *words,
            "--y-m",
            -0.1,
            0.1,
            "--near-m",
            0.5,
            "--far-m",
            0.6,
            "--out",
            tmp_path / "v.h5",
        )
        assert (found["voxel_mm"], found["method"], found["voxels"]) == (
            100.0,
            "backprojection",
            [2, 3, 6],
        )
        assert tomllib.loads((tmp_path / "v.toml").read_text())["x_m"] == [-0.2, 0.3]

    @pytest.mark.parametrize("method", ["rsd", "lct", "fk"])
    def test_confocal_scans(self, run: Run, confocal: Path, tmp_path: Path, method: str) -> None:
        words = [
            "reconstruct",
            confocal,
            "--method",
            method,
            "--voxel-mm",
            20,
            "--out",
            tmp_path / "volume.h5",
        ]
        found = object_of(run, *words)
        assert [found["peak_m"][axis] for axis in "xyz"] == pytest.approx(POINT, abs=0.04)
        kept = (tmp_path / "volume.toml").read_text()
        assert ("falloff = 4" in kept) == (method in ("lct", "fk"))
        assert "sigma_mm" not in kept

    @pytest.mark.parametrize("method", ["lct", "fk"])
    def test_noise_of_the_farthest_depths_is_not_looked_at(
        self, run: Run, tmp_path: Path, method: str
    ) -> None:
        """With the factor d^4 by which these methods brighten, photons of chance far away outshine
        the point.
        """
        words = [
            "simulate",
            *SCENE,
            "--wall",
            "planar",
            "--scan",
            "confocal",
            "--wall-points",
            24,
            "--seed",
            1,
        ]
        object_of(
            run, *words, "--peak-counts", 10, "--background", 0.5, "--out", tmp_path / "short.h5"
        )
        short = Capture.load(tmp_path / "short.h5")
        later = np.random.default_rng(1).poisson(0.5, (300, *short.signal.shape[1:]))
        replace(short, signal=np.concatenate([short.signal, later])).save(tmp_path / "long.h5")
        words = ["reconstruct", tmp_path / "long.h5", "--method", method, "--voxel-mm", 25]
        found = object_of(run, *words, "--out", tmp_path / "volume.h5")
        assert [found["peak_m"][axis] for axis in "xyz"] == pytest.approx(POINT, abs=0.05)
        # Where the method itself had looked, the box would end at 1.54 m.
        assert Volume.load(tmp_path / "volume.h5").grid.z[-1] < 1.0

    @pytest.mark.parametrize("suffix", [".vti", ".npz", ".exr", ".ply"])
    def test_formats(self, run: Run, curved: Path, tmp_path: Path, suffix: str) -> None:
        starts = {".vti": b"<?xml", ".npz": b"PK", ".exr": b"\x76\x2f\x31\x01", ".ply": b"ply"}
        out = tmp_path / f"volume{suffix}"
        object_of(run, "reconstruct", curved, "--voxel-mm", 60, "--out", out)
        assert out.read_bytes().startswith(starts[suffix])


def test_progress_and_an_interruption(curved: Path, tmp_path: Path) -> None:
    """Some seconds of work are announced on a terminal, and Ctrl-C ends them with nothing written."""
    import pty  # exists only where the test can run

    words = [
        "nlos",
        "reconstruct",
        curved,
        "--method",
        "backprojection",
        "--everywhere",
        "--voxel-mm",
        3,
    ]
    terminal, child_side = pty.openpty()
    process = subprocess.Popen(
        [*PROGRAM, *map(str, words), "--out", tmp_path / "volume.h5"],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=child_side,
        text=True,
    )
    os.close(child_side)
    wait_for(terminal, "imaging")  # the bar is drawn, so the imaging has begun
    process.send_signal(signal.SIGINT)
    out, _ = process.communicate(timeout=LONGEST_WAIT_S)
    assert (process.returncode, out) == (130, "")
    wait_for(terminal, "tofclip: interrupted")
    os.close(terminal)
    assert list(tmp_path.iterdir()) == []


def examples() -> dict[str, list[str]]:
    """Example commands in the help, by verb."""
    verbs = {
        name.partition(" ")[2]: verb
        for name, verb in collect_verbs().items()
        if name.startswith("nlos ")
    }
    return {name: split_docstring(verb.callback.__doc__)[1] for name, verb in verbs.items()}


def test_every_verb_explains_itself_with_an_example(run: Run) -> None:
    for verb, shown in examples().items():
        assert shown
        outcome = run("nlos", verb, "--help")
        assert outcome.status == 0
        for word in ("--json", "Exit status"):
            assert word in outcome.out
    assert set(examples()) == {
        "reconstruct",
        "stream",
        "film",
        "compare",
        "simulate",
        "info",
        "demo",
    }


def test_the_examples_run_one_after_the_other(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for verb in ("simulate", "info", "reconstruct", "film", "compare"):
        for example in examples()[verb]:
            outcome = run(*shlex.split(example)[1:])
            assert (outcome.status, outcome.err) == (0, ""), example
    assert "  near truth " in outcome.out  # compare's columns for people
    assert Path("volume.png").read_bytes().startswith(PNG)


def test_truth_only_where_it_is(tmp_path: Path, files: Path) -> None:
    import h5py

    from tofclip.errors import InputError

    with h5py.File(tmp_path / "foreign.h5", "w") as file:
        file["data"] = [1.0]
    (tmp_path / "text.npz").write_text("no HDF5")
    for path in (tmp_path / "foreign.h5", tmp_path / "text.npz", files / "streak.h5", tmp_path):
        assert HiddenTruth.load(path) is None
    with pytest.raises(InputError, match="reach"):
        HiddenTruth(np.zeros((1, 3)), 0.0).mask_near(
            Volume(np.zeros((1, 1, 1)), _one_voxel()).grid, 0.0
        )


def _one_voxel() -> Any:
    from nlos import Grid

    return Grid([0.0], [0.0], [0.0])


def test_a_recording_under_its_default_settings_warns_of_nothing(shared_data: Path) -> None:
    import warnings

    from nlos.analysis import find_shortest_wavelength
    from nlos.band import Band, VirtualPulse
    from nlos.illumination import warn_of_aliasing
    from nlos.io import read_capture

    capture = read_capture(shared_data / "nlos" / "otoole2018_diffuse_s.npz")
    wavelength = find_shortest_wavelength(capture, 3.0)
    with warnings.catch_warnings():
        warnings.simplefilter("error", AliasingWarning)
        warn_of_aliasing(capture, Band(VirtualPulse(wavelength), capture.axis))
    with pytest.warns(AliasingWarning):
        warn_of_aliasing(capture, Band(VirtualPulse(0.9 * wavelength), capture.axis))


def test_each_plan_is_made_once_per_image(
    run: Run, curved: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made, imaged = [], []
    begin, image = Plan.__init__, Plan.image

    def count_plan(plan: Plan, *arguments: object) -> None:
        made.append(type(plan).__name__)
        begin(plan, *arguments)  # type: ignore[arg-type]

    def count_image(plan: Plan, *arguments: object) -> object:
        imaged.append(type(plan).__name__)
        return image(plan, *arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(Plan, "__init__", count_plan)
    monkeypatch.setattr(Plan, "image", count_image)
    words = ["reconstruct", curved, "--method", "hybrid", "--out", tmp_path / "volume.h5"]
    object_of(run, *words)
    assert len(made) == len(imaged) == 2  # coarse voxels, then the bright part
