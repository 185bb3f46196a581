"""Benchmarks: every case runs, what is measured is what was done, and the page says it."""

from __future__ import annotations

import json
import subprocess
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from small_instrument import Run

from apps.benchmarks import harness
from apps.benchmarks.harness import (
    CASE_TIMEOUT_S,
    PAGE_GROUPS,
    PEER_TIMEOUT_S,
    STUDY_GROUPS,
    Case,
    PeerUnavailableError,
    PreparedCase,
    describe_machine,
    find_cases,
    measure_case,
    render_page,
    run_cases,
    run_peer,
)
from apps.benchmarks.light_fields import render_scene
from tofclip.errors import InputError
from tofclip.solvers.cross_validation import WeightChoice

CASES = find_cases("all")
SMALL = {"recovery": 8, "clip": 16, "depth": 200, "streaming": 200, "decode": 1}
"""Sizes at which a case is over at once; 16 where none is given."""


@pytest.fixture
def weight_searches(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Sizes of the measurements for which a weight was looked for; the search itself takes long."""
    searches: list[int] = []

    def choose_quickly(
        _: object, __: object, measurements: np.ndarray, ___: int, **____: object
    ) -> WeightChoice:
        searches.append(measurements.size)
        return WeightChoice(2e-3, np.array([2e-3]), np.array([1.0]))

    monkeypatch.setattr("tofclip.recovery.light_field.choose_weight", choose_quickly)
    return searches


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_every_case_runs(case: Case, weight_searches: list[int]) -> None:
    ready = case.prepare(16 if case.name == "recovery-projection" else SMALL.get(case.group, 16))
    ready.action()
    ready.floor()
    assert ready.amount > 0
    assert ready.floor_fraction > 0


def test_every_case_has_a_place_on_the_page() -> None:
    names = [case.name for case in CASES]
    assert len(set(names)) == len(names)
    assert {case.group for case in CASES} == set(PAGE_GROUPS)
    for case in CASES:
        assert case.floor
        assert list(case.sizes) == sorted(set(case.sizes))
        assert len(case.sizes) >= 2  # otherwise there is no growth


def test_light_fields_are_rendered_and_their_weight_is_part_of_the_work(
    weight_searches: list[int],
) -> None:
    pictures = render_scene(24).pictures
    assert np.abs(pictures[0] - pictures[-1]).max() > 0.1  # views see different sides of a scene
    for case in find_cases("clip"):
        timed = case.prepare(24)
        weight_searches.clear()
        timed.action()
        is_given = case.name in ("clip-given", "clip-lensless")
        assert len(weight_searches) == (0 if is_given else 1)
        # A peer stands beside what does the same work.
        assert list(timed.peers) == (["LenslessPiCam"] if case.name == "clip-lensless" else [])


def test_the_time_of_other_programs_does_not_count(monkeypatch: pytest.MonkeyPatch) -> None:
    """Cubes of 128^3 voxels take them minutes, and ours must be measured all the same."""
    limits: list[float] = []

    def slow(*_: object, timeout: float, **__: object) -> None:
        limits.append(timeout)
        time.sleep(0.02)
        raise subprocess.TimeoutExpired("", timeout)

    monkeypatch.setattr("apps.benchmarks.harness.subprocess.run", slow)
    monkeypatch.setattr("apps.benchmarks.harness.TOTAL_TIMEOUT_S", 0.01)
    monkeypatch.setenv("TOFCLIP_THREADS", "1")
    run_cases([MADE_UP], "python", lambda _: None)
    assert limits == [PEER_TIMEOUT_S + CASE_TIMEOUT_S] * 2
    limits.clear()
    found = run_cases([MADE_UP], None, lambda _: None)["entries"][0]["runs"]
    # The first size may finish though it takes longer than all may; the second does not begin.
    assert limits == [CASE_TIMEOUT_S]
    assert "left out" in found[1]["problem"]


def test_runs_that_ask_no_other_program_say_nothing_of_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """With one thread of two nobody is asked: that is not a Python in which a program is missing."""

    def measure(case: Case, extent: tuple[int, int], peers: str | None, clock: object) -> object:
        return {"peers": {"other": {"seconds": 1.0} if peers else {"absent": "no Python"}}}

    monkeypatch.setattr("apps.benchmarks.harness._run_process", measure)
    monkeypatch.setenv("TOFCLIP_THREADS", "2")
    runs = run_cases([MADE_UP], "python", lambda _: None)["entries"][0]["runs"]
    assert {run["threads"]: list(run["peers"]) for run in runs[-2:]} == {1: [], 2: ["other"]}
    assert all("seconds" in found for run in runs for found in run["peers"].values())
    unnamed = run_cases([MADE_UP], None, lambda _: None)["entries"][0]["runs"]
    assert all("absent" in run["peers"]["other"] for run in unnamed)


def made_up(size: int) -> PreparedCase:
    def absent() -> float:
        raise PeerUnavailableError("other: is not here")

    def work() -> None:
        np.ones(size << 17)  # so many MiB
        time.sleep(0.04)

    return PreparedCase(
        work,
        lambda: time.sleep(0.01),
        2,
        {"other": absent, "twice": lambda: 0.08},
        floor_fraction=0.5,
    )


MADE_UP = Case(
    "decode-made-up", "made up", "MiB", (32, 64), "things", "half as long a sleep", made_up
)


def test_what_is_measured_is_what_was_done() -> None:
    np.ones(1)
    found = measure_case(MADE_UP, 256)
    assert found["seconds"]["least"] >= 0.04
    assert found["seconds"]["least"] <= found["seconds"]["median"] <= found["seconds"]["greatest"]
    assert found["per_second"] == pytest.approx(2 / found["seconds"]["median"])
    assert found["floor_seconds"] >= 0.02  # half of it takes 10 ms
    assert found["times_floor"] == pytest.approx(
        found["seconds"]["median"] / found["floor_seconds"]
    )
    assert found["own_mib"] <= 257  # less where an earlier test left memory behind
    assert found["peak_mib"] > 256
    assert found["peers"] == {"other": {"absent": "other: is not here"}, "twice": {"seconds": 0.08}}


def test_the_verb_measures_in_fresh_processes_and_writes_the_page(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    small = [replace(case, sizes=(1,)) for case in find_cases("decode-tags")]
    monkeypatch.setattr(
        harness, "find_cases", lambda name: small if "tags" in name else find_cases(name)
    )
    monkeypatch.setenv("TOFCLIP_THREADS", "1")
    outcome = run("bench", "decode-tags", "--page", tmp_path / "page.md", "--json")
    assert outcome.status == 0, outcome.err
    (entry,) = json.loads(outcome.out)["entries"]
    (found,) = entry["runs"]
    assert entry["floor"] == "a copy of the same bytes"
    assert (found["size"], found["threads"]) == (1, 1)
    assert found["own_mib"] < found["peak_mib"]
    text = (tmp_path / "page.md").read_text()
    assert "`tofclip bench decode-tags`" in text
    assert "| time tags into histograms | 1 | 1 | " in text


def test_a_case_that_fails_is_told_and_stops_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TOFCLIP_THREADS", "1")
    broken = replace(find_cases("decode-tags")[0], sizes=(-1,))
    figures = run_cases([broken], None, lambda _: None)
    (found,) = figures["entries"][0]["runs"]
    assert "ValueError" in found["problem"]
    assert figures["entries"][0]["growth"] is None
    assert found["problem"] in render_page(figures, "tofclip bench")
    monkeypatch.setattr("apps.benchmarks.harness.CASE_TIMEOUT_S", 0.01)
    figures = run_cases([broken], None, lambda _: None)
    assert "took more than" in figures["entries"][0]["runs"][0]["problem"]
    monkeypatch.setattr("apps.benchmarks.harness.TOTAL_TIMEOUT_S", 0)
    figures = run_cases([broken], None, lambda _: None)
    assert "left out" in figures["entries"][0]["runs"][0]["problem"]


def test_the_page_tells_growth_spread_and_peers() -> None:
    def result(size: int, threads: int, median: float) -> dict[str, object]:
        return {
            "size": size,
            "threads": threads,
            "seconds": {
                "median": median,
                "least": 0.9 * median,
                "greatest": 1.2 * median,
                "repeats": 5,
            },
            "per_second": 1 / median,
            "peak_mib": 300.2,
            "own_mib": 50.0,
            "floor_seconds": median / 2,
            "times_floor": 2.0,
            "peers": {
                "y-tal": {"seconds": 3 * median},
                "ASTRA": {"absent": "ASTRA: --peers names no Python"},
            },
        }

    runs = [result(64, 2, 0.01), result(128, 1, 0.15), result(128, 2, 0.08)]
    entry = {
        "name": "rsd-planar",
        "title": "planar",
        "size": "points",
        "unit": "volumes",
        "floor": "FFTs",
    }
    text = render_page(
        {"machine": describe_machine(), "entries": [{**entry, "runs": runs, "growth": 3.0}]},
        "tofclip bench",
    )
    assert (
        "| planar | 128 | 2 | 80 ms (72 ms to 96 ms) | 12.5 volumes/s | 300 MiB, own 50 | 40 ms | 2.00 | 3.0 |"
        in text
    )
    assert (
        "y-tal: 30 ms at 64, 2 threads (3.0 times ours); 450 ms at 128, 1 thread (3.0 times ours);"
        in text
    )
    assert "Not compared: ASTRA: --peers names no Python." in text
    assert "cores" in text
    assert "wanted a core in the minute before: " in text


def test_peers_that_are_not_there(monkeypatch: pytest.MonkeyPatch) -> None:
    import sys

    monkeypatch.delenv("TOFCLIP_PEERS", raising=False)
    with pytest.raises(PeerUnavailableError, match="--peers names no Python"):
        run_peer("", "other")
    monkeypatch.setenv("TOFCLIP_PEERS", sys.executable)
    with pytest.raises(PeerUnavailableError, match="No module named 'no_such_peer'"):
        run_peer("import no_such_peer", "other")
    assert run_peer("print('seconds', 0.25)", "other") == 0.25
    monkeypatch.setattr("apps.benchmarks.harness.PEER_TIMEOUT_S", 0.01)
    with pytest.raises(PeerUnavailableError, match="takes more than"):
        run_peer("import time; time.sleep(5)", "other")


def test_names(run: Run) -> None:
    assert [case.name for case in find_cases("clip")] == [
        "clip-1d",
        "clip-0d",
        "clip-2d",
        "clip-given",
        "clip-lensless",
    ]
    told = run("bench", "--help").out
    assert all(group in told for group in PAGE_GROUPS)
    with pytest.raises(InputError, match="recovery, clip"):
        find_cases("nothing")


STUDY_SIZES = {"camera": 16, "corner-time": 12, "corner-scattered": 12, "driver": 1}
"""Sizes at which studies that need nothing but this program are over at once."""


@pytest.mark.parametrize("name", [*STUDY_SIZES, "device-linear"])
def test_every_study_runs(name: str) -> None:
    if name == "device-linear":
        pytest.importorskip("torch", reason="another device than NumPy's is needed")
    for case in find_cases(name):
        ready = case.prepare(STUDY_SIZES.get(name, 16))
        ready.action()
        ready.floor()
        assert all(np.isfinite(value) for value in ready.figures().values()), case.name


def test_studies_have_a_place_on_the_page_and_are_run_by_name_only(run: Run) -> None:
    assert not {case.group for case in CASES} & set(STUDY_GROUPS)
    told = run("bench", "--help").out
    assert all(group in told for group in STUDY_GROUPS)
    for group in ("camera", "quality", "accuracy", "device", "corner", "driver"):
        assert {case.group for case in find_cases(group)} == {group}


def test_what_else_a_case_says_is_in_its_figures_and_on_the_page() -> None:
    def prepare(size: int) -> PreparedCase:
        return replace(made_up(size), figures=lambda: {"error_percent": 0.25})

    found = measure_case(replace(MADE_UP, prepare=prepare), 1)
    assert found["figures"] == {"error_percent": 0.25}
    assert "figures" not in measure_case(MADE_UP, 1)
    run = {"size": 1, "threads": 1, **found}
    entry = {"name": "decode-x", "title": "x", "size": "MB", "unit": "MB", "floor": "a copy"}
    entries = [{**entry, "runs": [run], "growth": None}]
    text = render_page({"machine": describe_machine(), "entries": entries}, "tofclip bench")
    assert "At 1, threads 1: error_percent 0.25." in text


def test_the_load_is_that_before_anything_is_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    events: list[str] = []

    def describe() -> dict[str, float]:
        events.append("load")
        return {"load": 0.0}

    def measure(*_: object) -> dict[str, object]:
        events.append("case")
        return {"problem": "made up"}

    monkeypatch.setattr("apps.benchmarks.harness.describe_machine", describe)
    monkeypatch.setattr("apps.benchmarks.harness._run_process", measure)
    run_cases([MADE_UP], None, lambda _: None)
    assert events[0] == "load"
    assert events.count("case") >= 2
