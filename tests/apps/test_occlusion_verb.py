"""`tofclip occlusion` on its own."""

from __future__ import annotations

import json
from pathlib import Path

import matplotlib.image
import pytest
from small_instrument import Run


def test_the_inactive_length_of_the_papers_experiment(run: Run, tmp_path: Path) -> None:
    words = ("--baseline-mm", 15, "--width-mm", 6, "--distance-mm", 50, "--out", tmp_path / "region.png")
    outcome = run("occlusion", "region", *words, "--json")
    assert outcome.status == 0
    assert json.loads(outcome.out)["inactive_length_m"] == pytest.approx(0.1 / 3)
    assert matplotlib.image.imread(tmp_path / "region.png").std() > 0.05


def test_a_wide_occluder_promises_nothing_and_says_so(run: Run) -> None:
    told = json.loads(run("occlusion", "region", "--width-mm", 15, "--json").out)
    assert told["inactive_length_m"] is None
    assert "nothing" in told["promised"]


def test_lengths_that_make_no_sense_are_refused(run: Run, tmp_path: Path) -> None:
    for words in (("--width-mm", 0), ("--distance-mm", -3), ("--out", tmp_path / "region.txt")):
        outcome = run("occlusion", "region", *words)
        assert (outcome.status, outcome.out, outcome.err.count("\n")) == (2, "", 1)
    assert list(tmp_path.iterdir()) == []


def test_alone_it_shows_its_verbs(run: Run) -> None:
    assert "region" in run("occlusion").out
