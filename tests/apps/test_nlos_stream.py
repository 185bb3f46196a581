"""`tofclip nlos stream`: captures of a moving scene by one plan."""

from __future__ import annotations

import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hidden_point import object_of
from small_instrument import Run

import nlos.phasor.plan
from apps.verbs.nlos_stream import VolumeStream
from nlos import Capture, Volume
from nlos import preparation as moveout
from nlos.capture import TimeAxis
from nlos.simulate import PointScene, build_relay_wall

BOX = ["--x-m", -0.3, 0.3, "--y-m", -0.3, 0.3, "--near-m", 0.5, "--far-m", 0.9]
WORDS = [*BOX, "--voxel-mm", 50, "--wavelength-mm", 400]


def moving(number: int) -> Capture:
    """A point that goes to the right."""
    place = [-0.2 + 0.1 * number, 0.05, 0.7]
    wall = build_relay_wall("planar", 16, 1.2)
    return PointScene([place]).simulate_capture(wall, [0.0, 0.0, 0.0], TimeAxis(160, 50e-12), 5e-11)


def test_every_capture_becomes_a_volume_by_one_plan(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "in").mkdir()
    for number in range(4):
        moving(number).save(tmp_path / "in" / f"{number}.h5")
    grids, plan = [], nlos.phasor.plan.PlanarRSD.plan
    monkeypatch.setattr(
        nlos.phasor.plan.PlanarRSD,
        "plan",
        lambda self, capture, grid: grids.append(grid.size) or plan(self, capture, grid),
    )
    out = tmp_path / "out"
    found = object_of(run, "stream", tmp_path / "in", "--out", out, *WORDS)
    counts = [found[name] for name in ("acquired", "delivered", "dropped", "failed")]
    assert counts == [4, 4, 0, 0]
    assert found["volumes_per_second"] > 0
    assert 0 < found["plan_run_median_s"] <= found["latency_median_s"] <= found["latency_p95_s"]
    # one that finds the method, and one for all captures
    assert grids.count(int(np.prod(found["voxels"]))) <= 2
    for number in range(4):
        x, y, z = Volume.load(out / f"{number}.h5").find_brightest()
        assert (x, y, z) == pytest.approx((-0.2 + 0.1 * number, 0.05, 0.7), abs=0.06)
    again = object_of(
        run, "stream", tmp_path / "in", "--out", tmp_path / "b", "--settings", out / "stream.toml"
    )
    assert again["voxels"] == found["voxels"]


def test_pairs_are_joined_by_one_plan(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    wall = build_relay_wall("planar", 16, 1.2)
    capture = PointScene([[0.0, 0.05, 0.7]]).simulate_capture(
        wall, wall + np.array([0.1, 0.0, 0.0]), TimeAxis(160, 50e-12), 5e-11
    )
    (tmp_path / "in").mkdir()
    for number in range(3):
        capture.save(tmp_path / "in" / f"{number}.h5")
    found, before = [], []
    path_of, run_stream = moveout._path_of, VolumeStream.run
    monkeypatch.setattr(moveout, "_path_of", lambda *a: found.append(1) or path_of(*a))
    monkeypatch.setattr(VolumeStream, "run", lambda s: before.append(len(found)) or run_stream(s))
    words = ["--out", tmp_path / "out", *WORDS[:-1], 700]  # paths are as if confocal
    assert object_of(run, "stream", tmp_path / "in", *words)["delivered"] == 3
    assert before == [len(found)] != [0]


def test_captures_that_cannot_be_imaged_are_counted(run: Run, tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    for number in range(2):
        moving(number).save(tmp_path / "in" / f"{number}.h5")
    replace(moving(2), start=0.1).save(tmp_path / "in" / "2.h5")
    (tmp_path / "in" / "3.h5").write_bytes(b"nothing")
    outcome = run("nlos", "stream", tmp_path / "in", "--out", tmp_path / "out", *WORDS, "--json")
    assert outcome.status == 1
    assert '"acquired": 4, "delivered": 2, "dropped": 0, "failed": 2' in outcome.out
    assert "failed: 2: planned for" in outcome.err
    assert "failed: 3:" in outcome.err


def test_captures_of_nothing_leave_no_folder(run: Run, tmp_path: Path) -> None:
    dark = moving(0)
    replace(dark, signal=np.zeros_like(dark.signal)).save(tmp_path / "dark.h5")
    outcome = run("nlos", "stream", tmp_path / "dark.h5", "--out", tmp_path / "out", *WORDS)
    assert (outcome.status, outcome.err.count("\n")) == (2, 1)
    assert [path.name for path in tmp_path.iterdir()] == ["dark.h5"]


def test_a_folder_is_followed_and_its_accounts_balance(run: Run, tmp_path: Path) -> None:
    """Captures come faster than they can be imaged, perhaps: none is lost without being counted."""
    folder = tmp_path / "in"
    folder.mkdir()
    moving(0).save(folder / "0.h5")
    capture = moving(1)

    def write() -> None:
        for number in range(1, 8):
            capture.save(folder / f"{number}.h5")

    writer = threading.Thread(target=write)
    writer.start()
    found = object_of(
        run, "stream", folder, "--out", tmp_path / "out", *WORDS, "--follow-s", 1, "--captures", 8
    )
    writer.join()
    assert found["acquired"] == 8
    assert found["delivered"] + found["dropped"] + found["failed"] == 8
    assert found["delivered"] == len(list((tmp_path / "out").glob("?.h5"))) >= 1


def test_a_half_written_capture_is_tried_again(run: Run, tmp_path: Path) -> None:
    folder = tmp_path / "in"
    folder.mkdir()
    moving(0).save(folder / "0.h5")
    moving(1).save(tmp_path / "whole.h5")
    whole = (tmp_path / "whole.h5").read_bytes()
    (folder / "1.h5").write_bytes(whole[: len(whole) // 2])
    (folder / "2.h5").write_bytes(b"never whole")
    (folder / "3.h5").write_bytes(b"a name for the time of writing")

    def finish() -> None:
        time.sleep(0.3)  # it has been tried meanwhile; if not, this test shows nothing
        with open(folder / "1.h5", "ab") as file:
            file.write(whole[len(whole) // 2 :])
        (folder / "3.h5").unlink()

    writer = threading.Thread(target=finish)
    writer.start()
    words = ["--out", tmp_path / "out", *WORDS, "--follow-s", 1.5, "--json"]
    outcome = run("nlos", "stream", folder, *words)
    writer.join()
    assert outcome.status == 1
    assert '"acquired": 3, "delivered": 2, "dropped": 0, "failed": 1' in outcome.out
    assert outcome.err.startswith("tofclip: failed: 2: ")
    assert outcome.err.count("\n") == 1
    x, y, z = Volume.load(tmp_path / "out" / "1.h5").find_brightest()
    assert (x, y, z) == pytest.approx((-0.1, 0.05, 0.7), abs=0.06)


def test_an_unreadable_first_capture_is_counted(run: Run, tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "0.h5").write_bytes(b"nothing")
    moving(1).save(tmp_path / "in" / "1.h5")
    outcome = run("nlos", "stream", tmp_path / "in", "--out", tmp_path / "out", *WORDS, "--json")
    assert outcome.status == 1
    assert '"acquired": 2, "delivered": 1, "dropped": 0, "failed": 1' in outcome.out


def test_far_depths_are_averaged_over_captures(run: Run, tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    for number in range(3):
        moving(number).save(tmp_path / "in" / f"{number}.h5")
    volumes = {}
    for average in (1, 3):
        out = tmp_path / str(average)
        words = ["--out", out, *WORDS, "--average", average]
        assert object_of(run, "stream", tmp_path / "in", *words)["delivered"] == 3
        volumes[average] = Volume.load(out / "2.h5")
    alone, averaged = (volumes[average].values for average in (1, 3))
    # Two captures at 0.5 m, three at 0.9 m: none is as it was, and a trail of the point is there.
    assert averaged[0].max() < alone[0].max()
    row = volumes[1].grid.find_nearest((-0.2, 0.05, 0.9))
    assert averaged[row] > 1.2 * alone[row]
