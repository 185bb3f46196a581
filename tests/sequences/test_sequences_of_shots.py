"""Folders, patterns and stacks of shots: the same results here, on workers and one by one."""

import json
import shutil
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from odd_jobs import on_a_full_disk

from tofclip import Frames
from tofclip.camera import Camera
from tofclip.errors import InputError, StorageError
from tofclip.lidar import PointCloud
from tofclip.sequences import (
    CloudSettings,
    RangingSettings,
    RecoverySettings,
    expand_sweep,
    is_sequence,
    list_files,
    list_shots,
)
from tofclip.sequences.jobs import run_jobs, select_unfinished
from tofclip.storage import Record

pytestmark = pytest.mark.xdist_group("cluster")  # one cluster for all of them

SHOTS = 6


@pytest.fixture
def linear(recorded):
    return RecoverySettings("linear", camera=recorded / "camera.h5")


def test_recovery_on_workers_is_bit_for_bit_recovery_here_and_of_single_shots(
    scheduler, recorded, linear, tmp_path
):
    shots = list_shots(recorded / "shots.h5")
    assert next(iter(shots)) == "shots_000000"
    here, there = (linear.jobs(shots, tmp_path / place) for place in ("here", "there"))
    assert run_jobs(here).done == SHOTS
    assert run_jobs(there, scheduler).done == SHOTS
    for one, other, shot in zip(here, there, shots.values(), strict=True):
        frames = Frames.load(one.result)
        np.testing.assert_array_equal(Frames.load(other.result).values, frames.values)
        alone = linear.plan(shot()).run().values
        # the linear algebra of a single shot may use several threads, which round differently:
        # float32
        np.testing.assert_allclose(frames.values, alone, atol=1e-5 * alone.max())
        assert frames.provenance["settings"]["verb"] == "recover"


@pytest.mark.parametrize("method", ["l1", "tv", "adjoint"])
def test_kept_operators_change_nothing(recorded, method, tmp_path):
    settings = {} if method == "adjoint" else {"iterations": 3}
    camera = recorded / "camera.h5"
    recovery = RecoverySettings(method, camera=camera, focus="depth-locked", **settings)
    shots = dict(list(list_shots(recorded / "shots.h5").items())[:2])
    jobs = recovery.jobs(shots, tmp_path / "out")
    assert run_jobs(jobs).failures == ()
    for job, shot in zip(jobs, shots.values(), strict=True):
        alone = recovery.plan(shot()).run().values
        np.testing.assert_array_equal(Frames.load(job.result).values, alone)


def test_a_corrupt_shot_and_a_full_disk_spoil_only_their_own_result(
    scheduler, recorded, linear, tmp_path
):
    shots = tmp_path / "shots"
    shutil.copytree(recorded / "shots", shots)
    whole = (shots / "shot2.h5").read_bytes()
    (shots / "shot2.h5").write_bytes(whole[: len(whole) // 2])
    jobs = linear.jobs(list_shots(shots), tmp_path / "out")
    jobs[4] = replace(jobs[4], work=partial(on_a_full_disk, jobs[4].work))
    summary = run_jobs(jobs, scheduler)
    assert summary.done == SHOTS - 2
    corrupt, full = summary.failures
    assert "shot2.h5: is damaged" in corrupt.problem
    assert "the disk is full" in full.problem
    present = {path.name for path in (tmp_path / "out").iterdir()}
    assert present == {"settings.json", "shot0.h5", "shot1.h5", "shot3.h5", "shot5.h5"}
    (shots / "shot2.h5").write_bytes(whole)
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "out").glob("shot*")}
    missing = select_unfinished(linear.jobs(list_shots(shots), tmp_path / "out"))
    assert [job.name for job in missing] == ["shot2", "shot4"]
    assert run_jobs(missing, scheduler).done == 2
    assert all(path.stat().st_mtime_ns == time for path, time in before.items())


def test_ranging_on_workers_is_bit_for_bit_ranging_here(scheduler, recorded, tmp_path):
    ranging = RangingSettings(recorded / "camera.h5", focus="depth-locked", average=2)
    shots = list_shots(recorded / "shots.h5")
    here, there = (ranging.jobs(shots, tmp_path / place, ".npz") for place in ("here", "there"))
    reports = []
    assert run_jobs(here, on_report=reports.append).done == SHOTS // 2
    assert run_jobs(there, scheduler).done == SHOTS // 2
    for one, other, (points, late) in zip(here, there, (r.figures for r in reports), strict=True):
        cloud = PointCloud.load(one.result)
        np.testing.assert_array_equal(PointCloud.load(other.result).xyz, cloud.xyz)
        assert len(cloud) == points > 0
        # the shots are not late; see the tests of jitter for the tolerance
        assert np.abs(late).max() < 0.15
    plan = (tmp_path / "here" / "plan.h5").stat().st_mtime_ns
    assert select_unfinished(ranging.jobs(shots, tmp_path / "here", ".npz")) == []
    assert (tmp_path / "here" / "plan.h5").stat().st_mtime_ns == plan
    with pytest.raises(InputError, match="average 2 instead of 3"):
        replace(ranging, average=3).jobs(shots, tmp_path / "here", ".npz")
    for unusable in ({"focus": "stack:0:1:3"}, {"average": 0}):
        with pytest.raises(InputError):
            RangingSettings(**unusable)
    # Of six shots, four are averaged and then two: none is lost.
    reports.clear()
    jobs = replace(ranging, average=4).jobs(shots, tmp_path / "four", ".ply")
    assert run_jobs(jobs, on_report=reports.append).done == 2
    assert [len(report.figures[1]) for report in reports] == [4, 2]
    assert all(job.result.is_file() for job in jobs)


def test_a_sweep_that_is_not_known_is_found_from_the_first_shot(recorded, camera, tmp_path):
    camera.replace(sweep=None, time_zero=0.0).save(tmp_path / "camera.h5")
    ranging = RangingSettings(tmp_path / "camera.h5", time_zero=-6e-9)
    (job, *_) = ranging.jobs(list_shots(recorded / "shots"), tmp_path / "out", ".ply")
    assert run_jobs([job]).failures == ()
    plan = Record.load(tmp_path / "out" / "plan.h5", "ranging")
    found = Camera.from_record(plan.child("camera", "camera"))
    assert found.time_zero == -6e-9
    late, _ = found.sweep.raw_position(np.zeros(5), found.centres_px)
    # within the third of a row to which a single noisy shot of two small plates tells it
    np.testing.assert_allclose(late - late[2], [-2, 1, 0, 0.5, 3], atol=0.35)


def test_clouds_of_many_frames(scheduler, recorded, linear, tmp_path):
    run_jobs(linear.jobs(list_shots(str(recorded / "shots" / "shot[01].h5")), tmp_path / "frames"))
    frames = list_files(tmp_path / "frames" / "*.h5")
    here, there = (
        CloudSettings(voxel=0.01).jobs(frames, tmp_path / place, ".npz")
        for place in ("here", "there")
    )
    assert run_jobs(here).failures == run_jobs(there, scheduler).failures == ()
    for jobs in zip(here, there, strict=True):
        np.testing.assert_array_equal(*(PointCloud.load(job.result).xyz for job in jobs))
    assert run_jobs(CloudSettings().jobs(frames, tmp_path / "depth", ".exr")).done == 2


def test_every_combination_of_a_sweep(linear):
    swept = expand_sweep(
        replace(linear, method="tv"), {"method": ["l1", "tv"], "iterations": ["2", "4"]}
    )
    assert list(swept) == [f"method={name},iterations={n}" for name in ("l1", "tv") for n in (2, 4)]
    assert swept["method=l1,iterations=4"] == replace(linear, method="l1", iterations=4)
    assert expand_sweep(linear, {}) == {"": linear}
    wrong = {"colour": "red", "iterations": "many", "method": "magic", "weight": "1e-3"}
    for name, value in wrong.items():
        with pytest.raises(InputError):
            expand_sweep(linear, {name: [value]})
    assert json.loads(json.dumps(linear.settings()))["method"] == "linear"


def test_names_of_inputs(recorded, tmp_path):
    for name in ("a/one.h5", "b/one.h5", "b/two.tif", ".hidden"):
        path = tmp_path / "days" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    pattern = str(tmp_path / "days" / "**" / "*.*")
    assert list(list_files(pattern)) == ["a/one", "b/one", "b/two"]
    assert list(list_files(tmp_path / "days" / "b")) == ["one", "two"]
    (tmp_path / "days" / "link.h5").symlink_to(tmp_path / "days" / "b" / "one.h5")
    assert list(list_files(tmp_path / "days")) == ["link"]
    (tmp_path / "days" / "link.h5").unlink()
    (tmp_path / "days" / "b" / "two.h5").touch()
    with pytest.raises(InputError, match="have one name"):
        list_files(pattern)
    for empty in (tmp_path / "days", str(tmp_path / "*.png")):
        with pytest.raises(InputError, match="no file"):
            list_files(empty)
    with pytest.raises(StorageError):
        list_files(tmp_path / "absent")
    for sequence in (recorded / "shots", recorded / "shots.h5", "*.h5"):
        assert is_sequence(sequence)
    files = recorded / "camera.h5", recorded / "shots" / "shot0.h5", __file__
    for single in (*files, "absent", "sim+timetag://?seed=1"):
        assert not is_sequence(single)


def test_results_keep_the_folders_of_their_inputs(recorded, linear, tmp_path):
    for day in ("a", "b"):
        (tmp_path / "days" / day).mkdir(parents=True)
        shutil.copy(recorded / "shots" / "shot0.h5", tmp_path / "days" / day)
    shots = list_shots(str(tmp_path / "days" / "*" / "*.h5"), bin_width=50e-12)
    assert run_jobs(linear.jobs(shots, tmp_path / "out")).done == 2
    assert (tmp_path / "out" / "b" / "shot0.h5").exists()
