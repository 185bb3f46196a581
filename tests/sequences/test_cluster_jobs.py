"""Jobs here and on workers: none is lost, none is done twice, none spoils the others."""

import sys
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import pytest
from odd_jobs import die, refuse, squares, stumble

from tofclip.errors import FileFormatError, InputError, MissingDependencyError, StorageError
from tofclip.files import MAX_HASHED_BYTES
from tofclip.sequences import jobs as jobs_module
from tofclip.sequences.jobs import (
    Job,
    connect_workers,
    count_local_workers,
    lock_output_folder,
    run_jobs,
    select_unfinished,
)

pytestmark = pytest.mark.xdist_group("cluster")  # one cluster for all of them

MANY = 60  # many times what two workers are given at once


def contents(folder):
    return {path.name: path.read_text() for path in folder.iterdir()}


def test_a_failure_is_told_and_stops_nothing(tmp_path):
    jobs = squares(tmp_path, 3)
    refused = Job("refused", tmp_path / "refused.txt", partial(refuse, tmp_path / "refused.txt"))
    stumbling = Job("broken", tmp_path / "broken.txt", stumble)
    seen = []
    summary = run_jobs([refused, *jobs, stumbling], on_report=seen.append)
    assert summary.done == 3
    assert [(one.name, one.problem) for one in summary.failures] == [
        ("broken", "unforeseen ZeroDivisionError: a defect"),
        ("refused", "refused.txt: is not to be had at any price"),
    ]
    assert contents(tmp_path) == {"000.txt": "0", "001.txt": "1", "002.txt": "4"}
    assert [report.figures for report in seen] == [None, 0, 1, 4, None]
    assert summary.processes == 1
    assert summary.peak_bytes > 10e6  # no Python is smaller
    (tmp_path / "001.txt").unlink()
    assert select_unfinished([refused, *jobs]) == [refused, jobs[1]]


def test_workers_do_what_is_done_here_however_many_jobs_there_are(scheduler, tmp_path):
    here, there = tmp_path / "here", tmp_path / "there"
    for folder in (here, there):
        folder.mkdir()
    run_jobs(squares(here, MANY))
    summary = run_jobs(squares(there, MANY), scheduler)
    assert (summary.done, summary.failures) == (MANY, ())
    assert contents(there) == contents(here)
    assert run_jobs([], scheduler).done == 0


@pytest.mark.nightly  # five workers start again: 7 s of processor time
def test_a_killed_worker_costs_at_most_the_job_that_kills_every_one(scheduler, tmp_path):
    jobs = squares(tmp_path, 30)
    for name, every_time in (("once", False), ("always", True)):
        path = tmp_path / f"{name}.txt"
        jobs.insert(10, Job(name, path, partial(die, path, every_time=every_time)))
    summary = run_jobs(jobs, scheduler)
    assert [failure.name for failure in summary.failures] == ["always"]
    assert "died" in summary.failures[0].problem
    assert summary.done == 31
    numbers = {f"{n:03d}.txt": str(n**2) for n in range(30)}
    died = {"once.died": "", "always.died": ""}
    assert contents(tmp_path) == {**numbers, "once.txt": "49", **died}  # and no temporary file
    assert [job.name for job in select_unfinished(jobs)] == ["always"]


def test_leftovers_of_killed_writers_go_and_other_hidden_files_stay(tmp_path):
    (tmp_path / ".000.txt.abcd_123.txt").write_text("half")
    (tmp_path / ".999.txt.abcd_123.txt").write_text("another run's")
    (tmp_path / ".profile").write_text("a user's")
    (tmp_path / ".000.png.abcd_123.png").write_text("half a picture")
    (job,) = squares(tmp_path, 1)
    run_jobs([replace(job, extra_outputs=(tmp_path / "000.png",))])
    assert sorted(contents(tmp_path)) == [".999.txt.abcd_123.txt", ".profile", "000.txt"]


def test_names_of_clusters(monkeypatch):
    monkeypatch.setenv("TOFCLIP_THREADS", "5")
    names = {"local": 5, "local:3": 3, "tcp://host:8786": 0, "tls://host:1": 0}
    assert {name: count_local_workers(name) for name in names} == names
    for wrong in "", "local:", "local:0", "local:-1", "local:two", "a:8786", "http://a", "tcp://":
        with pytest.raises(InputError, match="local:N"):
            count_local_workers(wrong)


def test_without_the_library_it_says_what_to_install(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(MissingDependencyError, match=r"tofclip\[cluster\]"):
        run_jobs(squares(tmp_path, 1), "local:1")


def refuse_to_connect(where, problem):
    with pytest.raises(InputError, match=problem), connect_workers(where):
        pass


def test_workers_without_this_program_or_of_another_version_are_refused(scheduler, monkeypatch):
    def missing():
        raise ModuleNotFoundError("No module named 'tofclip'")

    with monkeypatch.context() as patch:
        patch.setattr(jobs_module, "_version", missing)
        refuse_to_connect(scheduler, "have no tofclip")
    monkeypatch.setattr(jobs_module, "__version__", "0.0.0-of-the-test")
    refuse_to_connect(scheduler, "install the same")


def test_a_scheduler_that_is_not_there_or_has_no_workers_is_refused(monkeypatch):
    distributed = pytest.importorskip("distributed", reason="dask.distributed is an extra")
    monkeypatch.setattr(jobs_module, "WAIT_SECONDS", 0.3)
    refuse_to_connect("tcp://127.0.0.1:9", "no scheduler answers")
    nobody = distributed.LocalCluster(n_workers=0, dashboard_address="127.0.0.1:0", silence_logs=50)
    with nobody:
        refuse_to_connect(nobody.scheduler_address, "has no worker")


def test_workers_that_are_gone_for_good_are_not_waited_for_for_ever(monkeypatch):
    # A job that was given out, and never comes back.
    finished = SimpleNamespace(is_empty=lambda: False, has_ready=lambda: False)
    monkeypatch.setattr(jobs_module, "RECOUNT_INTERVAL_S", 0.01)
    monkeypatch.setattr(jobs_module, "MAX_WORKERLESS_S", 0.1)
    with pytest.raises(InputError, match="no worker for"):
        next(jobs_module._iterate_finished(SimpleNamespace(nthreads=dict), finished))


@pytest.mark.parametrize("size", [10, MAX_HASHED_BYTES + 1])
def test_a_folder_belongs_to_the_content_of_its_inputs(tmp_path, size):
    folder, settings = tmp_path / "results", {"method": "tv"}
    shots = {name: tmp_path / f"{name}.tif" for name in ("a", "b")}
    for path in shots.values():
        path.write_bytes(bytes(size))
    lock_output_folder(folder, settings, {"a": shots["a"]})
    lock_output_folder(folder, settings, shots)  # more shots have come
    lock_output_folder(folder, settings, {"b": shots["b"]})
    (folder / "a.h5").touch()
    shots["a"].write_bytes(bytes(size - 1) + b"x")
    with pytest.raises(InputError, match=r"1 have changed since, the first is a\)"):
        lock_output_folder(folder, settings, shots)
    lock_output_folder(folder, settings, {"b": shots["b"]})
    (folder / "a.h5").unlink()  # of a shot without a result, another version may come
    lock_output_folder(folder, settings, shots)


def test_a_folder_belongs_to_its_settings(tmp_path):
    folder = tmp_path / "new" / "results"
    settings = {"method": "tv", "camera": Path("camera.h5"), "weight": None}
    lock_output_folder(folder, settings)
    lock_output_folder(folder, settings)
    with pytest.raises(InputError, match="method tv instead of l1"):
        lock_output_folder(folder, settings | {"method": "l1"})
    for text in ("{", "[]"):
        (folder / "settings.json").write_text(text)
        with pytest.raises(FileFormatError):
            lock_output_folder(folder, {})
    (tmp_path / "file").touch()
    with pytest.raises(StorageError):
        lock_output_folder(tmp_path / "file" / "results", {})
