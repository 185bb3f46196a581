"""The verb that measures ranging against its theoretical limit."""

from __future__ import annotations

import json

from small_instrument import Run


def test_accuracy_prints_the_figures_of_the_contract(run: Run) -> None:
    words = "--photons 100 --background 0.1 --pulse-ps 60 --bin-width-ps 20 --trials 200 --seed 0 --json"
    outcome = run("lidar", "accuracy", *words.split())
    assert (outcome.status, outcome.err) == (0, "")
    figures = json.loads(outcome.out)
    assert list(figures) == ["rms_m", "bound_m", "ratio", "detection_rate", "false_alarm_rate"]
    assert 3.9e-4 < figures["bound_m"] < 4.1e-4  # c/2 * 26.1 ps (pulse and bin) / root 100, and a little background
    assert 0.8 < figures["ratio"] < 1.2  # 200 trials: 5 percent


def test_a_tail_costs_accuracy(run: Run) -> None:
    plain, tailed = (
        json.loads(run("lidar", "accuracy", "--trials", "20", *tail, "--json").out)["bound_m"]
        for tail in ((), ("--decay-ps", "200"))
    )
    assert tailed > 1.5 * plain


def test_unusable_numbers_end_in_one_line(run: Run) -> None:
    for words in (("--photons", "0"), ("--background=-1",), ("--bins", "5"), ("--trials", "0"), ("--pulse-ps", "nan")):
        outcome = run("lidar", "accuracy", *words)
        assert outcome.status == 2
        assert outcome.err.startswith("tofclip: error: ")
        assert outcome.err.count("\n") == 1


def test_alone_it_explains_itself(run: Run) -> None:
    assert "accuracy" in run("lidar").out
