"""Simulated captures of one hidden point, which the tests of `tofclip nlos` share."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from small_instrument import Run

from apps import cli

POINT = (0.1, -0.05, 0.6)
SCENE = (
    "--points",
    "0.1,-0.05,0.6",
    "--wall-width-m",
    "0.8",
    "--bin-width-ps",
    "16",
    "--jitter-ps",
    "15",
)


def curved_capture(path: Path) -> Path:
    """Simulate the point before a curved wall of 24 x 24 points."""
    assert cli.main(["nlos", "simulate", *SCENE, "--wall-points", "24", "--out", str(path)]) == 0
    return path


def confocal_capture(path: Path) -> Path:
    """Simulate the point before a planar wall of 32 x 32 points, scanned confocally."""
    scan = ("--wall", "planar", "--scan", "confocal", "--wall-points", "32")
    assert cli.main(["nlos", "simulate", *SCENE, *scan, "--out", str(path)]) == 0
    return path


def object_of(run: Run, *words: object) -> dict[str, Any]:
    """Run a verb of nlos with --json; standard output must hold the object and nothing else."""
    outcome = run("nlos", *words, "--json")
    assert (outcome.status, outcome.err) == (0, "")
    found: dict[str, Any] = json.loads(outcome.out)
    return found
