"""Compiling everything beforehand: what is run is understood, and what fails is said."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from small_instrument import Run
from verb_pages import collect_verbs

from apps.verbs import warm_up
from apps.verbs.nlos_imaging import METHODS


def test_every_step_is_a_command_that_the_program_takes(tmp_path: Path) -> None:
    verbs = collect_verbs()
    steps = [step.replace("@", f"{tmp_path}/").split() for step in warm_up.list_steps()]
    for words in steps:
        for word in words:
            if word.startswith(str(tmp_path)):
                Path(word).mkdir(parents=True, exist_ok=True)
        depth = 1 if words[0] in verbs else 2
        with verbs[" ".join(words[:depth])].make_context("step", words[depth:]) as context:
            assert context.params
    named = {words[words.index("--method") + 1] for words in steps if "--method" in words}
    assert named >= {"tv", "l1", "linear", "adjoint", *METHODS}


def test_it_runs_its_steps(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    steps = [
        "recover @shots/first.h5 --out @frames.h5 --method linear",
        "cloud @frames.h5 --out @cloud.ply",
    ]
    monkeypatch.setattr(warm_up, "list_steps", lambda: steps)
    outcome = run("warm-up", "--json")
    assert (outcome.status, outcome.err) == (0, "")
    found = json.loads(outcome.out)
    assert found["steps"] == 2
    assert found["seconds"] > 0


def test_a_step_that_fails_is_named(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(warm_up, "list_steps", lambda: ["info absent.h5"])
    outcome = run("warm-up")
    assert (outcome.status, outcome.out) == (2, "")
    assert outcome.err == "tofclip: error: info absent.h5 failed: absent.h5: no such file\n"
