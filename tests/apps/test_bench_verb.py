"""Benchmarks: every case runs, what is measured is what was done, and the page says it."""

import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from apps.benchmarks import harness
from apps.benchmarks.harness import (
    CASE_TIMEOUT_S,
    PAGE_GROUPS,
    PEER_TIMEOUT_S,
    STUDY_GROUPS,
    Case,
    PeerUnavailableError,
    PreparedCase,
    ask_peer,
    find_cases,
    measure_case,
    render_page,
    run_cases,
)
from tofclip.errors import InputError
from tofclip.solvers.fista import WeightChoice

CASES = find_cases("all")
# Sizes at which a case, or a study that needs nothing but this program, is over at once; 16 where
# none is given.
SMALL = {"recovery": 8, "depth": 200, "streaming": 200, "decode": 1, "recovery-projection": 16}
STUDIES = {"camera": 16, "corner-time": 12, "corner-scattered": 12}


@pytest.fixture
def weight_searches(monkeypatch):
    """Sizes of the measurements for which a weight was looked for; the search itself takes long."""
    searches = []

    def choose_quickly(_, __, measurements, *___, **____):
        searches.append(measurements.size)
        return WeightChoice(2e-3, np.array([1.0]))

    monkeypatch.setattr("tofclip.recovery.light_field.choose_weight", choose_quickly)
    return searches


@pytest.mark.usefixtures("weight_searches")
@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
@pytest.mark.nightly
def test_every_case_runs(case):
    ready = case.prepare(SMALL.get(case.name, SMALL.get(case.group, 16)))
    ready.action()
    ready.floor()
    assert ready.amount > 0
    assert ready.floor_fraction > 0


@pytest.mark.parametrize("name", [*STUDIES, "device-linear"])
def test_every_study_runs(name):
    if name == "device-linear":
        pytest.importorskip("torch", reason="another device than NumPy's is needed")
    for case in find_cases(name):
        ready = case.prepare(STUDIES.get(name, 16))
        ready.action()
        ready.floor()
        assert all(np.isfinite(value) for value in ready.figures().values()), case.name


def test_every_case_has_a_name_and_a_place_on_the_page(shell):
    assert len({case.name for case in CASES}) == len(CASES)
    assert {case.group for case in CASES} == set(PAGE_GROUPS)
    for case in CASES:
        assert case.floor
        assert list(case.sizes) == sorted(set(case.sizes))
        assert len(case.sizes) >= 2  # otherwise there is no growth
    with pytest.raises(InputError, match="recovery, clip"):
        find_cases("nothing")
    # studies are run by name only
    for group in ("camera", "device", "corner"):
        assert {case.group for case in find_cases(group)} == {group}
    told = shell("bench --help").out
    assert all(group in told for group in (*PAGE_GROUPS, *STUDY_GROUPS))


def test_the_choice_of_a_weight_is_part_of_the_work(weight_searches):
    for case in find_cases("clip"):
        timed = case.prepare(24)
        weight_searches.clear()
        timed.action()
        assert len(weight_searches) == (case.name not in ("clip-given", "clip-lensless"))
        # A peer stands beside what does the same work.
        assert list(timed.peers) == (["LenslessPiCam"] if case.name == "clip-lensless" else [])


def made_up(size):
    def absent():
        raise PeerUnavailableError("other: is not here")

    def work():
        np.ones(size << 17)  # so many MiB
        time.sleep(0.04)

    peers = {"other": absent, "twice": lambda: 0.08}
    floor = {"floor_fraction": 0.5, "figures": lambda: {"error_percent": 0.25}}
    return PreparedCase(work, lambda: time.sleep(0.01), 2, peers, **floor)


MADE_UP = Case(
    "decode-made-up", "made up", "MiB", (32, 64), "things", "half as long a sleep", made_up
)


def runs_of(case, peers=None):
    return run_cases([case], peers, lambda _: None)["entries"][0]["runs"]


def test_what_is_measured_is_what_was_done():
    found = measure_case(MADE_UP, 256)
    seconds = found["seconds"]
    assert 0.04 <= seconds["least"] <= seconds["median"] <= seconds["greatest"]
    assert found["per_second"] == pytest.approx(2 / seconds["median"])
    assert found["floor_seconds"] >= 0.02  # half of it takes 10 ms
    assert found["times_floor"] == pytest.approx(seconds["median"] / found["floor_seconds"])
    assert found["own_mib"] <= 257  # less where an earlier test left memory behind
    assert found["peak_mib"] > 256
    assert found["peers"] == {"other": {"absent": "other: is not here"}, "twice": {"seconds": 0.08}}
    assert found["figures"] == {"error_percent": 0.25}


def test_the_time_of_other_programs_does_not_count(monkeypatch):
    """Cubes of 128^3 voxels take them minutes, and ours must be measured all the same."""
    limits = []

    def slow(*_, timeout, **__):
        limits.append(timeout)
        time.sleep(0.02)
        raise subprocess.TimeoutExpired("", timeout)

    monkeypatch.setattr(harness.subprocess, "run", slow)
    monkeypatch.setattr(harness, "TOTAL_TIMEOUT_S", 0.01)
    monkeypatch.setenv("TOFCLIP_THREADS", "1")
    runs_of(MADE_UP, "python")
    assert limits == [PEER_TIMEOUT_S + CASE_TIMEOUT_S] * 2
    limits.clear()
    found = runs_of(MADE_UP)
    # The first size may finish though it takes longer than all may; the second does not begin.
    assert limits == [CASE_TIMEOUT_S]
    assert "left out" in found[1]["problem"]


def test_runs_that_ask_no_other_program_say_nothing_of_it(monkeypatch):
    """With one thread of two nobody is asked: that is not a Python in which a program is missing."""

    def measure(case, extent, peers, clock):
        return {"peers": {"other": {"seconds": 1.0} if peers else {"absent": "no Python"}}}

    monkeypatch.setattr(harness, "_run_process", measure)
    monkeypatch.setenv("TOFCLIP_THREADS", "2")
    runs = runs_of(MADE_UP, "python")
    assert {run["threads"]: list(run["peers"]) for run in runs[-2:]} == {1: [], 2: ["other"]}
    assert all("seconds" in found for run in runs for found in run["peers"].values())
    assert all("absent" in run["peers"]["other"] for run in runs_of(MADE_UP))


def test_the_verb_measures_in_fresh_processes_and_writes_the_page(shell, monkeypatch):
    small = [replace(case, sizes=(1,)) for case in find_cases("decode-tags")]
    monkeypatch.setattr(harness, "find_cases", lambda name: small)
    monkeypatch.setenv("TOFCLIP_THREADS", "1")
    (entry,) = shell.figures("bench decode-tags --page page.md")["entries"]
    (found,) = entry["runs"]
    assert entry["floor"] == "a copy of the same bytes"
    assert (found["size"], found["threads"]) == (1, 1)
    assert found["own_mib"] < found["peak_mib"]
    text = Path("page.md").read_text()
    assert "`tofclip bench decode-tags`" in text
    assert "| time tags into histograms | 1 | 1 | " in text


def test_a_case_that_fails_is_told_and_stops_nothing(monkeypatch):
    monkeypatch.setenv("TOFCLIP_THREADS", "1")
    broken = replace(find_cases("decode-tags")[0], sizes=(-1,))
    figures = run_cases([broken], None, lambda _: None)
    (found,) = figures["entries"][0]["runs"]
    assert "ValueError" in found["problem"]
    assert found["problem"] in render_page(figures, "tofclip bench")
    monkeypatch.setattr(harness, "CASE_TIMEOUT_S", 0.01)
    assert "took more than" in runs_of(broken)[0]["problem"]


def test_the_page_tells_growth_spread_and_peers():
    def result(size, threads, median):
        spread = {"least": 0.9 * median, "greatest": 1.2 * median, "repeats": 5}
        absent = {"absent": "ASTRA: --peers names no Python"}
        return {
            "size": size,
            "threads": threads,
            "seconds": {"median": median, **spread},
            "per_second": 1 / median,
            "peak_mib": 300.2,
            "own_mib": 50.0,
            "floor_seconds": median / 2,
            "times_floor": 2.0,
            "peers": {"y-tal": {"seconds": 3 * median}, "ASTRA": absent},
            "figures": {"error_percent": 0.25},
        }

    words = {"title": "planar", "size": "points", "unit": "volumes", "floor": "FFTs"}
    runs = [result(64, 2, 0.01), result(128, 1, 0.15), result(128, 2, 0.08)]
    entry = {"name": "rsd-x", **words, "runs": runs, "growth": 3.0}
    figures = {"machine": harness.describe_machine(), "entries": [entry]}
    text = render_page(figures, "tofclip bench")
    for words in (
        "| planar | 128 | 2 | 80 ms (72 ms to 96 ms) | 12.5 volumes/s | 300 MiB, own 50 "
        "| 40 ms | 2.00 | 3.0 |",
        "y-tal: 30 ms at 64, 2 threads (3.0 times ours); 450 ms at 128, 1 thread (3.0 times",
        "Not compared: ASTRA: --peers names no Python.",
        "At 64, threads 2: error_percent 0.25.",
        "wanted a core in the minute before: ",
    ):
        assert words in text


def test_peers_that_are_not_there(monkeypatch):
    def ask(script):
        return ask_peer("other", script, numbers=np.arange(3))

    monkeypatch.delenv("TOFCLIP_PEERS", raising=False)
    with pytest.raises(PeerUnavailableError, match="--peers names no Python"):
        ask("")
    monkeypatch.setenv("TOFCLIP_PEERS", sys.executable)
    with pytest.raises(PeerUnavailableError, match="No module named 'no_such_peer'"):
        ask("import no_such_peer")
    seconds, picture = ask(
        "import sys, numpy as np; given = np.load(sys.argv[1])['numbers']\n"
        "np.save(sys.argv[2], 2 * given); print('seconds', 0.25)"
    )
    assert (seconds, picture.tolist()) == (0.25, [0, 2, 4])
    monkeypatch.setattr(harness, "PEER_TIMEOUT_S", 0.01)
    with pytest.raises(PeerUnavailableError, match="takes more than"):
        ask("import time; time.sleep(5)")
