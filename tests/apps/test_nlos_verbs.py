"""`tofclip nlos`: every verb on small simulated captures."""

from __future__ import annotations

import json
import os
import shlex
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from small_instrument import Outcome, Run

from apps import cli
from apps.help import told as told_by
from apps.nlos_truth import HiddenTruth
from apps.verbs.nlos import app
from nlos import Capture, Volume
from nlos.export import Mesh
from nlos.sampling import AliasingWarning
from tofclip.storage import SIGNATURE

PNG = b"\x89PNG"
POINT = (0.1, -0.05, 0.6)
SCENE = ["--points", "0.1,-0.05,0.6", "--wall-width-m", 0.8, "--bin-width-ps", 16, "--jitter-ps", 15]


def object_of(run: Run, *words: object) -> dict[str, Any]:
    """Run a verb with --json; standard output must hold the object and nothing else."""
    outcome = run("nlos", *words, "--json")
    assert (outcome.status, outcome.err) == (0, "")
    found: dict[str, Any] = json.loads(outcome.out)
    return found


@pytest.fixture(scope="module")
def curved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A hidden point before a curved wall of 24 x 24 points."""
    path = tmp_path_factory.mktemp("curved") / "capture.h5"
    assert cli.main([str(word) for word in ("nlos", "simulate", *SCENE, "--wall-points", 24, "--out", path)]) == 0
    return path


@pytest.fixture(scope="module")
def confocal(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same point before a planar wall, scanned confocally."""
    path = tmp_path_factory.mktemp("confocal") / "capture.h5"
    words = ("nlos", "simulate", *SCENE, "--wall", "planar", "--scan", "confocal", "--wall-points", 32, "--out", path)
    assert cli.main([str(word) for word in words]) == 0
    return path


class TestSimulate:
    def test_the_capture_carries_its_truth_and_its_settings(self, curved: Path) -> None:
        capture, truth = Capture.load(curved), HiddenTruth.inside(curved)
        assert truth is not None
        np.testing.assert_array_equal(truth.positions, [POINT])
        assert capture.signal.shape[1:] == (24, 24)
        assert capture.provenance["settings"]["wall"] == "cylinder"
        # The farthest point's light has arrived when the record ends, and no long silence follows.
        last = np.flatnonzero(capture.signal.max(axis=(1, 2)) > 1e-3 * capture.signal.max())[-1]
        assert 0 <= capture.axis.bins - last < 12

    def test_its_settings_give_the_same_capture(self, run: Run, tmp_path: Path) -> None:
        words = ["simulate", *SCENE, "--wall", "wavy", "--wall-points", 6, "--peak-counts", 20, "--seed", 3]
        object_of(run, *words, "--background", 0.5, "--out", tmp_path / "one.h5")
        object_of(run, "simulate", "--settings", tmp_path / "one.toml", "--out", tmp_path / "two.h5")
        object_of(run, "simulate", "--settings", tmp_path / "one.toml", "--seed", 4, "--out", tmp_path / "three.h5")
        one, two, three = (Capture.load(tmp_path / f"{name}.h5") for name in ("one", "two", "three"))
        np.testing.assert_array_equal(one.signal, two.signal)
        assert not np.array_equal(one.signal, three.signal)
        assert np.array_equal(one.signal, np.round(one.signal))  # photons

    def test_letters_before_two_plates(self, run: Run, tmp_path: Path) -> None:
        words = ["simulate", "--letters", "L", "--wall", "plates", "--wall-points", 9, "--facet-mm", 60]
        found = object_of(run, *words, "--laser-m", -0.5, 0, "--out", tmp_path / "plates.h5")
        capture = Capture.load(tmp_path / "plates.h5")
        assert (
            found["wall_points"] == np.isfinite(capture.wall[..., 0]).sum() == 72
        )  # the middle column hangs in the gap
        assert any(np.array_equal(capture.laser, point) for point in capture.points)  # on the wall
        assert abs(capture.laser[0] + 0.5) < 0.2
        truth = HiddenTruth.inside(tmp_path / "plates.h5")
        assert truth is not None
        corner = truth.positions[np.argmin(truth.positions[:, 0] - truth.positions[:, 1])]
        assert corner[0] < 0 < corner[1]  # the foot of an L is at the lower left, y down
        assert set(truth.positions[:, 2]) == {1.0}

    def test_a_mesh(self, run: Run, tmp_path: Path) -> None:
        corners = np.array([[-0.2, -0.1, 0.8], [-0.2, 0.1, 0.8], [0.2, 0.1, 0.8]], np.float32)
        Mesh(corners, np.array([[0, 1, 2]], np.int32)).save(tmp_path / "triangle.ply")
        words = ["simulate", "--mesh", tmp_path / "triangle.ply", "--material", "retroreflecting", "--wall-points", 4]
        assert object_of(run, *words, "--out", tmp_path / "capture.h5")["total"] > 0
        refused = run("nlos", *words, "--out", tmp_path / "triangle.h5")
        assert refused.status == 0
        assert b"ply" in (tmp_path / "triangle.ply").read_bytes()[:3]


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
        assert found["resolution_m"]["x"] == pytest.approx(1.2 * found["wavelength_mm"]["chosen"] * 0.75e-3, rel=0.5)

    def test_a_confocal_scan_suits_every_method(self, run: Run, confocal: Path) -> None:
        found = object_of(run, "info", confocal)
        assert found["laser"] == "confocal"
        assert all(one["suits"] and one["memory_mib"] > 0 for one in found["methods"].values())
        people = run("nlos", "info", confocal)
        assert people.status == 0
        assert "\nhybrid " in people.out

    def test_the_shortest_wavelength_is_just_not_undersampled(self, run: Run, curved: Path, tmp_path: Path) -> None:
        chosen = object_of(run, "info", curved)["wavelength_mm"]
        words = ["reconstruct", curved, "--out", tmp_path / "volume.h5", "--voxel-mm", 100]
        object_of(run, *words, "--wavelength-mm", chosen["chosen"])
        shorter = run("nlos", *words, "--wavelength-mm", 0.95 * chosen["shortest"])
        assert shorter.status == 0
        assert shorter.err.startswith("tofclip: warning: wall points 0.0348 m apart are too coarse")
        assert shorter.err.count("\n") == 1

    def test_one_wall_point_and_many_lasers_are_sampled_by_the_lasers(self, confocal: Path) -> None:
        from apps.nlos_imaging import sampling_step

        capture = Capture.load(confocal)
        alone = np.broadcast_to(capture.wall[3, 4], capture.wall.shape)
        one_detector = Capture(capture.signal, alone, capture.wall, capture.bin_width)
        assert sampling_step(one_detector) == pytest.approx(capture.spacing)
        nowhere = Capture(capture.signal[:, 0, 0], capture.wall[0, 0], capture.wall[0, 0], capture.bin_width)
        assert sampling_step(nowhere) == 0


class TestReconstruct:
    def test_the_point_is_found_without_a_word(self, run: Run, curved: Path, tmp_path: Path) -> None:
        found = object_of(run, "reconstruct", curved, "--out", tmp_path / "volume.h5")
        assert found["method"] == "hybrid"
        # A third of the width of its image; the pulse of three waves is as long as the depth is uncertain.
        assert [found["peak_m"][axis] for axis in "xyz"] == pytest.approx(POINT, abs=found["wavelength_mm"] / 3000)

    @pytest.mark.parametrize("method", ["hybrid", "backprojection", "filtered-backprojection"])
    def test_its_settings_give_the_same_volume(self, run: Run, curved: Path, tmp_path: Path, method: str) -> None:
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
        (tmp_path / "mine.toml").write_text("voxel_mm = 50\nmethod = 'backprojection'\nx_m = [-0.2, 0.3]\n")
        words = ["reconstruct", curved, "--settings", tmp_path / "mine.toml", "--everywhere", "--voxel-mm", 100]
        found = object_of(run, *words, "--y-m", -0.1, 0.1, "--near-m", 0.5, "--far-m", 0.6, "--out", tmp_path / "v.h5")
        assert (found["voxel_mm"], found["method"], found["voxels"]) == (100.0, "backprojection", [2, 3, 6])
        assert "x_m = [-0.2, 0.3]" in (tmp_path / "v.toml").read_text()

    @pytest.mark.parametrize("method", ["rsd", "lct", "fk"])
    def test_confocal_scans(self, run: Run, confocal: Path, tmp_path: Path, method: str) -> None:
        words = ["reconstruct", confocal, "--method", method, "--voxel-mm", 20, "--out", tmp_path / "volume.h5"]
        found = object_of(run, *words)
        assert [found["peak_m"][axis] for axis in "xyz"] == pytest.approx(POINT, abs=0.04)
        kept = (tmp_path / "volume.toml").read_text()
        assert ("falloff = 4" in kept) == (method in ("lct", "fk"))
        assert "sigma_mm" not in kept

    @pytest.mark.parametrize("suffix", [".vti", ".npz", ".exr", ".ply"])
    def test_formats(self, run: Run, curved: Path, tmp_path: Path, suffix: str) -> None:
        starts = {".vti": b"<?xml", ".npz": b"PK", ".exr": b"\x76\x2f\x31\x01", ".ply": b"ply"}
        out = tmp_path / f"volume{suffix}"
        object_of(run, "reconstruct", curved, "--voxel-mm", 60, "--out", out, "--png", tmp_path / "views.png")
        assert out.read_bytes().startswith(starts[suffix])
        assert (tmp_path / "views.png").read_bytes().startswith(PNG)


class TestFolders:
    @pytest.fixture
    def folder(self, curved: Path, tmp_path: Path) -> Path:
        folder = tmp_path / "captures"
        folder.mkdir()
        for name in ("a.h5", "c.h5"):
            shutil.copy(curved, folder / name)
        (folder / "b.h5").write_bytes(SIGNATURE + b"and nothing more")
        (folder / "notes.txt").write_text("no capture")
        return folder

    @staticmethod
    def words(folder: Path) -> list[object]:
        return ["reconstruct", folder, "--out", folder.parent / "out", "--voxel-mm", 60]

    def test_the_broken_one_is_listed_and_the_others_are_whole(self, run: Run, folder: Path) -> None:
        outcome = run("nlos", *self.words(folder), "--suffix", ".h5", "--suffix", ".vti", "--json")
        assert outcome.status == 1
        assert outcome.err.startswith("tofclip: failed: b.h5: ")
        found = json.loads(outcome.out)
        assert [one["capture"] for one in found["imaged"]] == ["a.h5", "c.h5"]
        assert list(found["failed"]) == ["b.h5"]
        expected = {f"{name}{suffix}" for name in "ac" for suffix in (".h5", ".vti", ".png", ".toml")}
        assert {path.name for path in (folder.parent / "out").iterdir()} == expected | {".settings.toml"}
        assert Volume.load(folder.parent / "out" / "a.h5").provenance["inputs"][0]["name"] == "a.h5"

    def test_what_is_finished_is_skipped(self, run: Run, folder: Path, curved: Path) -> None:
        run("nlos", *self.words(folder))
        out = folder.parent / "out"
        before = (out / "a.h5").stat().st_mtime_ns
        shutil.copy(curved, folder / "b.h5")
        (out / "c.toml").unlink()  # as if interrupted before it was finished
        found = object_of(run, *self.words(folder))
        assert (found["skipped"], [one["capture"] for one in found["imaged"]]) == (["a.h5"], ["b.h5", "c.h5"])
        assert (out / "a.h5").stat().st_mtime_ns == before
        later = (out / "a.toml").stat().st_mtime + 10
        os.utime(folder / "a.h5", (later, later))  # the capture was written anew
        assert [one["capture"] for one in object_of(run, *self.words(folder))["imaged"]] == ["a.h5"]

    def test_results_of_other_settings_are_not_mixed_in(self, run: Run, folder: Path) -> None:
        (folder / "b.h5").unlink()
        object_of(run, *self.words(folder))
        refused = run("nlos", *self.words(folder), "--cycles", 4)
        assert refused.status == 2
        assert "made with cycles = 3.0, now it is 4.0" in refused.err

    def test_an_interruption_leaves_whole_results(
        self, run: Run, folder: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        from apps.verbs.nlos import reconstruct

        original: Callable[..., dict[str, Any]] = reconstruct._reconstructed

        def interrupted(source: Path, *others: Any) -> dict[str, Any]:
            if source.name == "c.h5":
                raise KeyboardInterrupt
            return original(source, *others)

        monkeypatch.setattr(reconstruct, "_reconstructed", interrupted)
        outcome = run("nlos", *self.words(folder))
        assert (outcome.status, outcome.out) == (130, "")
        assert {path.name for path in (folder.parent / "out").iterdir()} == {
            ".settings.toml",
            "a.h5",
            "a.png",
            "a.toml",
        }


class TestCompare:
    def test_a_curved_wall(self, run: Run, curved: Path, tmp_path: Path) -> None:
        out, volumes = tmp_path / "compare.png", tmp_path / "volumes"
        found = object_of(run, "compare", curved, "--voxel-mm", 25, "--out", out, "--volumes", volumes)
        methods = found["methods"]
        assert list(methods) == ["hybrid", "backprojection", "filtered-backprojection"]
        assert set(found["left_out"]) == {"rsd", "lct", "fk"}
        assert methods["hybrid"]["correlation"] == pytest.approx(1)
        assert methods["backprojection"]["correlation"] > 0.999
        assert methods["filtered-backprojection"]["correlation"] < 0.999
        for name, figures in methods.items():
            stored = Volume.load(volumes / f"{name}.h5")
            assert stored.grid.shape == tuple(found["voxels"])
            assert figures["seconds"] > 0
            assert figures["sharpness"] > 1
            # The ball about the point is a small part of the box, and holds more than that part of the energy: by the
            # unsharpest method 2.5 times as much.
            share = HiddenTruth(np.array([POINT]), 0.0).near(stored.grid, figures["truth_reach_m"]).mean()
            assert figures["energy_near_truth"] > 2 * share
            assert figures["contrast_to_truth"] > 2
        assert out.read_bytes().startswith(PNG)

    def test_its_settings_give_the_same_comparison(self, run: Run, confocal: Path, tmp_path: Path) -> None:
        words = ["compare", confocal, "--methods", "lct,fk,rsd", "--voxel-mm", 40]
        one = object_of(run, *words, "--out", tmp_path / "one.png")
        two = object_of(run, "compare", confocal, "--settings", tmp_path / "one.toml", "--out", tmp_path / "two.png")
        for figures in (*one["methods"].values(), *two["methods"].values()):
            del figures["seconds"], figures["peak_mib"]
        assert one == two

    def test_for_people(self, run: Run, curved: Path, tmp_path: Path) -> None:
        words = ["compare", curved, "--methods", "hybrid", "--voxel-mm", 60, "--out", tmp_path / "compare.png"]
        outcome = run("nlos", *words)
        assert outcome.status == 0
        assert "energy_near_truth" in outcome.out

    def test_memory_is_that_of_the_method(self) -> None:
        from apps.nlos_measure import _memory_from_now, measured
        from nlos import Grid

        if _memory_from_now() is None:
            pytest.skip("this system does not tell how much memory a program took")

        class Greedy:
            """Takes 64 MiB for a moment."""

            def supports(self, *_: object) -> Any:
                from nlos.method import Support

                return Support()

            def reconstruct(self, capture: Capture, grid: Grid, *_: object) -> Volume:
                taken = np.ones(64 << 17)
                return Volume(np.full(grid.shape, taken.mean(), np.float32), grid)

        capture = Capture(np.zeros((4, 2)), np.array([[0.0, 0, 0], [1, 0, 0]]), np.zeros(3), 1e-11)
        found = measured("greedy", Greedy(), capture, Grid([0.0], [0.0], [1.0]))
        assert found.peak_bytes is not None
        # The allocator may reuse memory that it holds already, and threads may take a little for themselves.
        assert 48 << 20 < found.peak_bytes < 96 << 20


def test_the_demonstration(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As it is, with a coarser wall and fewer voxels."""
    from apps.verbs.nlos import demo

    for name, value in {"WALL_POINTS": 24, "FACET": 0.06, "WAVELENGTH": 0.34, "VOXEL": 0.06}.items():
        monkeypatch.setattr(demo, name, value)
    found = object_of(run, "demo", "--out", tmp_path / "demo", "--png", tmp_path / "picture.png")
    assert found["hybrid"]["correlation"] > 0.999
    assert found["flat"]["correlation"] < 0.95
    assert found["flat"]["energy_near_truth"] < found["hybrid"]["energy_near_truth"]
    assert (tmp_path / "picture.png").read_bytes().startswith(PNG)
    assert {path.name for path in (tmp_path / "demo").iterdir()} == {"capture.h5", "hybrid.h5", "backprojection.h5"}
    assert HiddenTruth.inside(tmp_path / "demo" / "capture.h5") is not None


def examples() -> dict[str, list[str]]:
    """Example commands in the help, by verb."""
    return {
        str(verb.callback.__name__): told_by(verb.callback.__doc__)[1]
        for verb in app.registered_commands
        if verb.callback is not None
    }


def test_every_verb_explains_itself_with_an_example(run: Run) -> None:
    for verb, shown in examples().items():
        assert shown
        outcome = run("nlos", verb, "--help")
        assert outcome.status == 0
        for word in ("--json", "Exit status"):
            assert word in outcome.out
    assert set(examples()) == {"reconstruct", "compare", "simulate", "info", "demo"}


def test_the_examples_run_one_after_the_other(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for verb in ("simulate", "info", "reconstruct", "compare"):
        for example in examples()[verb]:
            outcome = run(*shlex.split(example)[1:])
            assert (outcome.status, outcome.err) == (0, ""), example


def refused(outcome: Outcome, complaint: str) -> None:
    assert (outcome.status, outcome.out, outcome.err.count("\n")) == (2, "", 1)
    assert complaint in outcome.err


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["--method", "guess"], "unknown method 'guess'; choose from rsd, hybrid"),
        (["--method", "rsd,hybrid"], "nlos compare takes several"),
        (["--method", "rsd"], "use the hybrid method"),
        (["--method", "hybrid", "--sigma-mm", "3"], "sigma_mm is a setting of filtered-backprojection"),
        (["--point-fraction", "2"], "point_fraction is a share"),
        (["--cycles", "0"], "cycles"),
        (["--voxel-mm", "-1"], "voxel"),
        (["--bins-together", "0"], "cannot be put together by 0"),
        (["--gate-m", "-1"], "margin"),
        (["--x-m", "1", "0"], "side x of the box"),
        (["--tolerance", "7"], "tolerance"),
        (["--voxel-mm", "abc"], "(see --help)"),
    ],
)
def test_imaging_that_makes_no_sense(run: Run, curved: Path, tmp_path: Path, words: list[str], complaint: str) -> None:
    refused(run("nlos", "reconstruct", curved, "--out", tmp_path / "v.h5", *words), complaint)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["--letters", "A", "--points", "0,0,1"], "letters and points cannot be hidden together"),
        (["--points", "0,0"], "points are told as X,Y,Z"),
        (["--points", "0,0,x"], "points are told as X,Y,Z"),
        (["--wall", "cave"], "no wall is called 'cave'"),
        (["--scan", "spiral"], "no scan is called 'spiral'"),
        (["--material", "velvet"], "no material is called 'velvet'"),
        (["--background", "1"], "tell the peak counts as well"),
        (["--bin-width-ps", "0"], "bin width must be a positive number"),
        (["--jitter-ps", "0"], "jitter must be a positive number"),
        (["--facet-mm", "0"], "facets need a positive size"),
        (["--mesh", "absent.ply"], "no such file"),
    ],
)
def test_scenes_that_make_no_sense(run: Run, tmp_path: Path, words: list[str], complaint: str) -> None:
    refused(run("nlos", "simulate", "--wall-points", 3, "--out", tmp_path / "c.h5", *words), complaint)
    assert list(tmp_path.iterdir()) == []


def test_names_that_cannot_be_written(run: Run, curved: Path, tmp_path: Path) -> None:
    (tmp_path / "mine.toml").write_text("voxel_mm = 100\n")
    source = shutil.copy(curved, tmp_path / "wall.h5")
    settings = ["--settings", tmp_path / "mine.toml"]
    reconstruct, compare = ["nlos", "reconstruct", source], ["nlos", "compare", source]
    refused(run(*reconstruct, "--out", source), "is an input too")
    refused(run(*reconstruct, *settings, "--out", tmp_path / "mine.h5"), "mine.toml: is an input too")
    refused(run(*reconstruct, "--out", tmp_path / "v.stl"), "the name must end in .h5")
    refused(run(*compare, *settings, "--out", tmp_path / "mine.png"), "mine.toml: is an input too")
    refused(run(*compare, "--out", tmp_path / "c.bmp"), "must end in .png")
    refused(run(*compare, "--out", tmp_path / "c.png", "--methods", "fk"), "fk does not suit this capture")
    refused(run(*compare, "--out", tmp_path / "c.png", "--methods", "hybrid,hybrid"), "named twice")
    refused(run("nlos", "info", tmp_path / "mine.toml"), "is no capture of a known format")
    (tmp_path / "captures").mkdir()
    folder = ["nlos", "reconstruct", tmp_path / "captures"]
    refused(run(*folder, "--out", tmp_path / "captures"), "choose another one for the results")
    refused(run(*folder, "--out", tmp_path / "results"), "no capture is in there")
    refused(run(*folder, "--out", source), "is a file; a folder of captures needs a folder")
    refused(run(*folder, "--out", tmp_path / "results", "--suffix", ".stl"), "no format of volumes is called '.stl'")
    (tmp_path / "captures" / "a.h5").touch()
    (tmp_path / "captures" / "a.npz").touch()
    refused(run(*folder, "--out", tmp_path / "results"), "a.h5 and a.npz would have results of one name")


def test_truth_only_where_it_is(tmp_path: Path, files: Path) -> None:
    import h5py

    from tofclip.errors import InputError

    with h5py.File(tmp_path / "foreign.h5", "w") as file:
        file["data"] = [1.0]
    (tmp_path / "text.npz").write_text("no HDF5")
    for path in (tmp_path / "foreign.h5", tmp_path / "text.npz", files / "streak.h5", tmp_path):
        assert HiddenTruth.inside(path) is None
    with pytest.raises(InputError, match="reach"):
        HiddenTruth(np.zeros((1, 3)), 0.0).near(Volume(np.zeros((1, 1, 1)), _one_voxel()).grid, 0.0)


def _one_voxel() -> Any:
    from nlos import Grid

    return Grid([0.0], [0.0], [0.0])


def test_a_recording_under_its_default_settings_warns_of_nothing(shared_data: Path) -> None:
    import warnings

    from apps.nlos_imaging import shortest_wavelength
    from nlos.band import Band, VirtualPulse
    from nlos.io import read_capture
    from nlos.sampling import warn_of_aliasing

    capture = read_capture(shared_data / "nlos" / "otoole2018_diffuse_s.npz")
    wavelength = shortest_wavelength(capture, 3.0)
    with warnings.catch_warnings():
        warnings.simplefilter("error", AliasingWarning)
        warn_of_aliasing(capture, Band(VirtualPulse(wavelength), capture.axis))
    with pytest.warns(AliasingWarning):
        warn_of_aliasing(capture, Band(VirtualPulse(0.9 * wavelength), capture.axis))
