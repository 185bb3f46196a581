"""Jobs here and on workers: none is lost, none is done twice, none spoils the others."""

from __future__ import annotations

import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
from odd_jobs import die, meet, refuse, squares, stumble

from tofclip.errors import FileFormatError, InputError, MissingDependencyError, StorageError
from tofclip.files import MAX_HASHED_BYTES
from tofclip.sequences import jobs as jobs_module
from tofclip.sequences.jobs import (
    Failure,
    Job,
    Report,
    connect_workers,
    count_local_workers,
    lock_output_folder,
    run_jobs,
    select_unfinished,
)

pytestmark = pytest.mark.xdist_group("cluster")  # one cluster for all of them

MANY = 60  # many times what two workers are given at once


def contents(folder: Path) -> dict[str, str]:
    return {path.name: path.read_text() for path in folder.iterdir()}


def test_a_failure_is_told_and_stops_nothing(tmp_path):
    jobs = squares(tmp_path, 3)
    refused = Job("refused", tmp_path / "refused.txt", partial(refuse, tmp_path / "refused.txt"))
    stumbling = Job("broken", tmp_path / "broken.txt", stumble)
    seen: list[Report] = []
    summary = run_jobs([refused, *jobs, stumbling], on_report=seen.append)
    assert summary.done == 3
    assert summary.failures == (
        Failure("broken", "unforeseen ZeroDivisionError: a defect"),
        Failure("refused", "refused.txt: is not to be had at any price"),
    )
    assert contents(tmp_path) == {"000.txt": "0", "001.txt": "1", "002.txt": "4"}
    assert [report.figures for report in seen] == [None, 0, 1, 4, None]
    assert summary.processes == 1
    assert summary.peak_bytes > 10e6  # no Python is smaller
    (tmp_path / "001.txt").unlink()
    assert select_unfinished([refused, *jobs]) == [refused, jobs[1]]


def test_workers_do_what_is_done_here_however_many_jobs_there_are(scheduler, tmp_path):
    here, there = tmp_path / "here", tmp_path / "there"
    here.mkdir()
    there.mkdir()
    run_jobs(squares(here, MANY))
    summary = run_jobs(squares(there, MANY), scheduler)
    assert (summary.done, summary.failures) == (MANY, ())
    assert contents(there) == contents(here)
    assert run_jobs([], scheduler).done == 0


def test_the_processes_that_took_part_are_counted(scheduler, tmp_path):
    """Two jobs that wait for each other need two processes, however busy the machine is."""
    one, other = tmp_path / "one.txt", tmp_path / "other.txt"
    jobs = [
        Job("one", one, partial(meet, one, other)),
        Job("other", other, partial(meet, other, one)),
    ]
    summary = run_jobs(jobs, scheduler)
    assert (summary.done, summary.failures, summary.processes) == (2, (), 2)


def test_a_killed_worker_costs_at_most_the_job_that_kills_every_one(scheduler, tmp_path):
    jobs = squares(tmp_path, 30)
    for name, every_time in (("once", False), ("always", True)):
        path = tmp_path / f"{name}.txt"
        jobs.insert(10, Job(name, path, partial(die, path, every_time=every_time)))
    summary = run_jobs(jobs, scheduler)
    assert [failure.name for failure in summary.failures] == ["always"]
    assert "died" in summary.failures[0].problem
    assert summary.done == 31
    found = contents(tmp_path)
    assert found.pop("once.died") == found.pop("always.died") == ""
    assert found == {
        **{f"{n:03d}.txt": str(n**2) for n in range(30)},
        "once.txt": "49",
    }  # and no temporary file
    assert [job.name for job in select_unfinished(jobs)] == ["always"]


def test_leftovers_of_killed_writers_go_and_other_hidden_files_stay(tmp_path):
    (tmp_path / ".000.txt.abcd_123.txt").write_text("half")
    (tmp_path / ".999.txt.abcd_123.txt").write_text("another run's")
    (tmp_path / ".profile").write_text("a user's")
    (tmp_path / ".000.png.abcd_123.png").write_text("half a picture")
    (job,) = squares(tmp_path, 1)
    run_jobs([replace(job, extra_outputs=(tmp_path / "000.png",))])
    assert sorted(contents(tmp_path)) == [".999.txt.abcd_123.txt", ".profile", "000.txt"]


@pytest.mark.parametrize(
    ("where", "number"), [("local:3", 3), ("tcp://host:8786", 0), ("tls://host:1", 0)]
)
def test_names_of_clusters(where, number):
    assert count_local_workers(where) == number


def test_local_alone_means_the_cores(monkeypatch):
    monkeypatch.setenv("TOFCLIP_THREADS", "5")
    assert count_local_workers("local") == 5


@pytest.mark.parametrize(
    "where",
    ["", "local:", "local:0", "local:-1", "local:two", "host:8786", "http://host", "tcp://"],
)
def test_other_names_are_refused(where):
    with pytest.raises(InputError, match="local:N"):
        count_local_workers(where)


def test_a_cluster_that_is_not_there(monkeypatch):
    monkeypatch.setattr("tofclip.sequences.jobs.WAIT_SECONDS", 0.3)
    with (
        pytest.raises(InputError, match="no scheduler answers"),
        connect_workers("tcp://127.0.0.1:9"),
    ):
        pass


def test_without_the_library_it_says_what_to_install(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(MissingDependencyError, match=r"tofclip\[cluster\]"):
        run_jobs(squares(tmp_path, 1), "local:1")


def test_workers_of_another_version_are_refused(scheduler, monkeypatch):
    monkeypatch.setattr("tofclip.sequences.jobs.__version__", "0.0.0-of-the-test")
    with pytest.raises(InputError, match="install the same"), connect_workers(scheduler):
        pass


def test_workers_without_this_program_are_refused(scheduler, monkeypatch):
    def missing() -> str:
        raise ModuleNotFoundError("No module named 'tofclip'")

    monkeypatch.setattr("tofclip.sequences.jobs._version", missing)
    with pytest.raises(InputError, match="have no tofclip"), connect_workers(scheduler):
        pass


def test_a_scheduler_without_workers_is_refused(monkeypatch):
    distributed = pytest.importorskip("distributed", reason="dask.distributed is an extra")
    monkeypatch.setattr("tofclip.sequences.jobs.WAIT_SECONDS", 0.3)
    nobody = distributed.LocalCluster(n_workers=0, dashboard_address="127.0.0.1:0", silence_logs=50)
    with (
        nobody,
        pytest.raises(InputError, match="has no worker"),
        connect_workers(nobody.scheduler_address),
    ):
        pass


def test_workers_that_are_gone_for_good_are_not_waited_for_for_ever(monkeypatch, tmp_path):
    class Finished:
        """A job that was given out, and never comes back."""

        def is_empty(self):
            return False

        has_ready = is_empty

    class Scheduler:
        def nthreads(self):
            return {}

    monkeypatch.setattr(jobs_module, "RECOUNT_INTERVAL_S", 0.01)
    monkeypatch.setattr(jobs_module, "MAX_WORKERLESS_S", 0.1)
    with pytest.raises(InputError, match="no worker for"):
        next(jobs_module._iterate_finished(Scheduler(), Finished()))


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
    lock_output_folder(folder, {"method": "tv", "camera": Path("camera.h5"), "weight": None})
    lock_output_folder(folder, {"method": "tv", "camera": Path("camera.h5"), "weight": None})
    with pytest.raises(InputError, match="method tv instead of l1"):
        lock_output_folder(folder, {"method": "l1", "camera": Path("camera.h5"), "weight": None})
    for text in ("{", "[]"):
        (folder / "settings.json").write_text(text)
        with pytest.raises(FileFormatError):
            lock_output_folder(folder, {})
    (tmp_path / "file").touch()
    with pytest.raises(StorageError):
        lock_output_folder(tmp_path / "file" / "results", {})
