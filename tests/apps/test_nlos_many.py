"""Many captures: `tofclip nlos reconstruct FOLDER`, some broken and some done already, and `nlos
stream`, a moving scene by one plan.
"""

import os
import shutil
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import nlos.phasor.plan
from apps.options import load_settings, save_settings
from apps.verbs import nlos as verbs
from apps.verbs.nlos import ReconstructSettings, ResultFiles, note_content
from apps.verbs.nlos_stream import VolumeStream
from nlos import Volume, preparation
from nlos.capture import TimeAxis
from nlos.simulate import PointScene, build_relay_wall
from tofclip.storage import HDF5_SIGNATURE

FOLDER = "nlos reconstruct captures --out out --voxel-mm 60"


@pytest.fixture
def captures(shell, curved, tmp_path):
    folder = tmp_path / "captures"
    folder.mkdir()
    for name in ("a.h5", "c.h5"):
        shutil.copy(curved, folder / name)
    (folder / "b.h5").write_bytes(HDF5_SIGNATURE + b"and nothing more")
    (folder / "notes.txt").write_text("no capture")
    return folder


@pytest.fixture
def _imaging_is_quick(monkeypatch):
    """Which captures are imaged is what matters here, not what comes out."""

    def pretend(_, results, *_others):
        for path in results.paths:
            path.write_text("a result")
        return {}

    monkeypatch.setattr(verbs, "reconstruct_single", pretend)


def imaged(figures):
    return [one["capture"] for one in figures["imaged"]]


class TestFolder:
    def test_the_broken_one_is_listed_and_the_others_are_whole(self, shell, captures):
        line = f"{FOLDER} --suffix .h5 --suffix .vti"
        found = shell.figures(line, status=1, said="tofclip: failed: b.h5: ")
        assert imaged(found) == ["a.h5", "c.h5"]
        assert list(found["failed"]) == ["b.h5"]
        expected = {f"{name}.{suffix}" for name in "ac" for suffix in ("h5", "vti", "png", "toml")}
        assert {*os.listdir("out")} == expected | {".settings.toml"}
        assert Volume.load("out/a.h5").provenance["inputs"][0]["name"] == "a.h5"

    @pytest.mark.usefixtures("_imaging_is_quick")
    def test_what_is_finished_is_skipped_and_other_settings_are_not_mixed_in(self, shell, captures):
        shell.figures(FOLDER)
        out = Path("out")
        before = (out / "a.h5").stat().st_mtime_ns
        (out / "b.png").unlink()
        (out / "c.toml").unlink()  # as if interrupted before it was finished
        found = shell.figures(FOLDER)
        assert (found["skipped"], imaged(found)) == (["a.h5"], ["b.h5", "c.h5"])
        assert (out / "a.h5").stat().st_mtime_ns == before
        later = (out / "a.toml").stat().st_mtime + 10
        os.utime(captures / "a.h5", (later, later))  # the capture was written anew
        assert imaged(shell.figures(FOLDER)) == ["a.h5"]
        shell.refuses(f"{FOLDER} --cycles 4", "made with cycles = 3.0, now it is 4.0")

    def test_a_result_belongs_to_the_capture_s_content_not_to_its_age(self, tmp_path):
        source, settings = tmp_path / "a.h5", tmp_path / "out.toml"
        source.write_bytes(b"one capture")
        results = ResultFiles([tmp_path / "out.h5"], None)
        results.volumes[0].write_text("a result")
        save_settings(ReconstructSettings(), settings, f"a heading\n{note_content(source)}")
        assert load_settings(ReconstructSettings, settings, {}) == ReconstructSettings()
        later, earlier = (settings.stat().st_mtime + sign * 100 for sign in (1, -1))
        os.utime(source, (later, later))  # copied, or touched
        assert results.is_up_to_date(source)
        source.write_bytes(b"another one")
        os.utime(source, (earlier, earlier))  # put in its place with its own, older time
        assert not results.is_up_to_date(source)
        settings.write_text("# of a version that noted no content\n")
        assert results.is_up_to_date(source)

    def test_a_folder_of_renderings_is_known_by_all_that_is_in_it(self, tmp_path):
        for name in ("geometry.toml", "views/one.exr"):
            (tmp_path / name).parent.mkdir(exist_ok=True)
            (tmp_path / name).write_text(name)
        before = note_content(tmp_path)
        assert note_content(tmp_path) == before
        (tmp_path / "views" / "one.exr").write_text("another")
        assert note_content(tmp_path) != before

    @pytest.mark.usefixtures("captures")
    def test_an_interruption_leaves_whole_results(self, shell, monkeypatch):
        original = verbs.reconstruct_single

        def interrupt(source, *others):
            if source.name == "c.h5":
                raise KeyboardInterrupt
            return original(source, *others)

        monkeypatch.setattr(verbs, "reconstruct_single", interrupt)
        outcome = shell(FOLDER)
        assert (outcome.status, outcome.out) == (130, "")
        assert {*os.listdir("out")} == {".settings.toml", "a.h5", "a.png", "a.toml"}


BOX = "--x-m -0.3 0.3 --y-m -0.3 0.3 --near-m 0.5 --far-m 0.9 --voxel-mm 50"
STREAM = f"nlos stream in --out out {BOX} --wavelength-mm 400"


def moving(number):
    """A point that goes to the right."""
    place = [-0.2 + 0.1 * number, 0.05, 0.7]
    wall = build_relay_wall("planar", 16, 1.2)
    return PointScene([place]).simulate_capture(wall, [0.0, 0.0, 0.0], TimeAxis(160, 50e-12), 5e-11)


@pytest.fixture
def folder(shell, tmp_path):
    (tmp_path / "in").mkdir()
    return tmp_path / "in"


def save(folder, *numbers):
    for number in numbers:
        moving(number).save(folder / f"{number}.h5")


def assert_accounts(figures, **expected):
    counts = {"acquired": sum(expected.values()), "delivered": 0, "dropped": 0, "failed": 0}
    assert {name: figures[name] for name in counts} == counts | expected


def assert_point_at(number):
    expected = (-0.2 + 0.1 * number, 0.05, 0.7)
    found = Volume.load(f"out/{number}.h5").find_brightest()
    assert tuple(found) == pytest.approx(expected, abs=0.06)


class TestStream:
    def test_every_capture_becomes_a_volume_by_one_plan(self, shell, folder, monkeypatch):
        save(folder, *range(4))
        grids, plan = [], nlos.phasor.plan.PlanarRSD.plan
        monkeypatch.setattr(
            nlos.phasor.plan.PlanarRSD,
            "plan",
            lambda self, capture, grid: grids.append(grid.size) or plan(self, capture, grid),
        )
        found = shell.figures(STREAM)
        assert_accounts(found, delivered=4)
        assert found["volumes_per_second"] > 0
        assert 0 < found["plan_run_median_s"] <= found["latency_median_s"] <= found["latency_p95_s"]
        # one that finds the method, and one for all captures
        assert grids.count(int(np.prod(found["voxels"]))) <= 2
        for number in range(4):
            assert_point_at(number)
        again = shell.figures("nlos stream in --out b --settings out/stream.toml")
        assert again["voxels"] == found["voxels"]

    def test_pairs_are_joined_by_one_plan(self, shell, folder, monkeypatch):
        wall = build_relay_wall("planar", 16, 1.2)
        capture = PointScene([[0.0, 0.05, 0.7]]).simulate_capture(
            wall, wall + np.array([0.1, 0.0, 0.0]), TimeAxis(160, 50e-12), 5e-11
        )
        for number in range(3):
            capture.save(folder / f"{number}.h5")
        found, before = [], []
        path_of, run_stream = preparation._path_of, VolumeStream.run
        monkeypatch.setattr(preparation, "_path_of", lambda *a: found.append(1) or path_of(*a))
        monkeypatch.setattr(
            VolumeStream, "run", lambda s: before.append(len(found)) or run_stream(s)
        )
        # paths are as if confocal
        assert_accounts(
            shell.figures(f"nlos stream in --out out {BOX} --wavelength-mm 700"), delivered=3
        )
        assert before == [len(found)] != [0]

    def test_captures_that_cannot_be_imaged_are_counted(self, shell, folder):
        save(folder, 0, 1)
        replace(moving(2), start=0.1).save(folder / "2.h5")
        (folder / "3.h5").write_bytes(b"nothing")
        assert_accounts(
            shell.figures(STREAM, status=1, said="failed: 2: planned for"), delivered=2, failed=2
        )

    def test_an_unreadable_first_capture_is_counted(self, shell, folder):
        (folder / "0.h5").write_bytes(b"nothing")
        save(folder, 1)
        assert_accounts(shell.figures(STREAM, status=1, said="failed: 0:"), delivered=1, failed=1)

    def test_captures_of_nothing_leave_no_folder(self, shell, folder):
        dark = moving(0)
        replace(dark, signal=np.zeros_like(dark.signal)).save(folder / "dark.h5")
        shell.refuses(STREAM)
        assert not Path("out").exists()

    def test_a_folder_is_followed_and_its_accounts_balance(self, shell, folder):
        """Captures come faster than they can be imaged, perhaps: none is lost without being
        counted.
        """
        save(folder, 0)
        capture = moving(1)

        def write():
            for number in range(1, 8):
                capture.save(folder / f"{number}.h5")

        writer = threading.Thread(target=write)
        writer.start()
        found = shell.figures(f"{STREAM} --follow-s 1 --captures 8")
        writer.join()
        assert found["acquired"] == 8
        assert found["delivered"] + found["dropped"] + found["failed"] == 8
        assert found["delivered"] == len(list(Path("out").glob("?.h5"))) >= 1

    def test_a_half_written_capture_is_tried_again(self, shell, folder, tmp_path):
        save(folder, 0)
        moving(1).save(tmp_path / "whole.h5")
        whole = (tmp_path / "whole.h5").read_bytes()
        (folder / "1.h5").write_bytes(whole[: len(whole) // 2])
        (folder / "2.h5").write_bytes(b"never whole")
        (folder / "3.h5").write_bytes(b"a name for the time of writing")

        def finish():
            time.sleep(0.3)  # it has been tried meanwhile; if not, this test shows nothing
            with open(folder / "1.h5", "ab") as file:
                file.write(whole[len(whole) // 2 :])
            (folder / "3.h5").unlink()

        writer = threading.Thread(target=finish)
        writer.start()
        found = shell.figures(f"{STREAM} --follow-s 1.5", status=1, said="tofclip: failed: 2: ")
        writer.join()
        assert_accounts(found, delivered=2, failed=1)
        assert_point_at(1)

    def test_far_depths_are_averaged_over_captures(self, shell, folder):
        save(folder, *range(3))
        volumes = {}
        for average in (1, 3):
            assert_accounts(shell.figures(f"{STREAM} --average {average}"), delivered=3)
            volumes[average] = Volume.load("out/2.h5")
            shutil.rmtree("out")
        alone, averaged = (volumes[average].values for average in (1, 3))
        # Two captures at 0.5 m, three at 0.9 m: none is as it was, and a trail of the point is there.
        assert averaged[0].max() < alone[0].max()
        row = volumes[1].grid.find_nearest((-0.2, 0.05, 0.9))
        assert averaged[row] > 1.2 * alone[row]
