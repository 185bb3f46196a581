"""`tofclip warm-up`: compile everything once, so that no later run waits for it."""

from __future__ import annotations

import contextlib
import io
import os
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from apps.cli import main
from apps.conventions import JsonOption, report
from apps.help import EXIT_INTERRUPTED
from apps.progress import show_progress
from tofclip.camera import Camera
from tofclip.errors import InputError
from tofclip.shots import Streak
from tofclip.units import PICOSECOND

VIEW_ANGLES_DEG = (-43.0, -26.0, -13.0, 0.5, 23.0, 37.0, 48.0)
VIEW_PITCH_PX, IMAGE_SHAPE = 40.0, (24, 24)
ROWS, PULSE_ROWS, BIN_WIDTH_S = 64, 1.3, 20 * PICOSECOND
IMAGINGS = (
    ("planar", "single", ("rsd", "hybrid", "backprojection", "filtered-backprojection")),
    ("planar", "confocal", ("lct", "fk", "backprojection")),
    ("cylinder", "single", ("hybrid", "backprojection")),
)
"""Walls, scans, and the methods to run on them."""

HIDDEN_SCENE = (
    "--letters",
    "T",
    "--facet-mm",
    "100",
    "--wall-width-m",
    "0.8",
    "--bin-width-ps",
    "16",
)


def warm_up(as_json: JsonOption = False) -> None:
    """Run everything that is compiled on first use once, on small data.

    Compiled code is kept beside the program, or in NUMBA_CACHE_DIR; later runs load it. After an
    update, or on a machine with another processor, it is compiled anew.

    Example: tofclip warm-up
    """
    started = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        steps = list(_list_steps(Path(folder)))
        _save_shots(Path(folder))
        with show_progress("compiling", len(steps)) as advance:
            for words in steps:
                _run_quietly(words)
                advance(1)
    report({"steps": len(steps), "seconds": time.perf_counter() - started}, as_json)


def _list_steps(folder: Path) -> Iterator[Sequence[str]]:
    """Commands that between them call every compiled function."""
    shots, frames = folder / "shots", folder / "frames.h5"
    for method in ("tv", "l1", "linear", "adjoint", "surfaces"):
        options = (
            ("--method", method, "--iterations", "2")
            if method in ("tv", "l1", "surfaces")
            else ("--method", method)
        )
        yield ("recover", str(shots / "first.h5"), "--out", str(frames), *options)
    yield ("cloud", str(frames), "--out", str(folder / "cloud.ply"))
    yield ("lidar", "accuracy", "--trials", "10")
    yield ("lidar", "sequence", str(shots), "--out", str(folder / "clouds"))
    yield ("demo", "--out", str(folder / "demo"))
    for wall, scan, methods in IMAGINGS:
        capture = str(folder / f"{wall}_{scan}.h5")
        scene = ("--wall", wall, "--scan", scan, "--wall-points", "12", *HIDDEN_SCENE)
        yield ("nlos", "simulate", *scene, "--out", capture)
        for method in methods:
            volume = str(folder / f"{method}.h5")
            yield (
                "nlos",
                "reconstruct",
                capture,
                "--method",
                method,
                "--voxel-mm",
                "50",
                "--out",
                volume,
            )


def _save_shots(folder: Path) -> None:
    """Write two small shots of a bright square, whose sweep and gains are not known."""
    centres = VIEW_PITCH_PX * (0.5 + np.arange(len(VIEW_ANGLES_DEG), dtype=np.float64))
    camera = Camera(
        centres,
        np.deg2rad(np.array(VIEW_ANGLES_DEG)),
        IMAGE_SHAPE,
        round(VIEW_PITCH_PX * centres.size),
    )
    frames = np.zeros((*IMAGE_SHAPE, ROWS), np.float32)
    pulse = np.exp(-(((np.arange(ROWS) - ROWS / 2) / PULSE_ROWS) ** 2) / 2)
    frames[8:16, 8:16] = 100 * pulse.astype(np.float32)
    expected = camera.operator()(frames).T + 20
    (folder / "shots").mkdir()
    for seed, name in enumerate(("first", "second")):
        counts = np.random.default_rng(seed).poisson(expected).astype(np.float32)
        streak = Streak(counts, camera=camera).with_bin_width(BIN_WIDTH_S)
        streak.save(folder / "shots" / f"{name}.h5")


def _run_quietly(words: Sequence[str]) -> None:
    """Run a command without its output."""
    messages = io.StringIO()
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(messages):
        status = main(words)
    if status == EXIT_INTERRUPTED:
        raise KeyboardInterrupt
    if status != os.EX_OK:
        last = messages.getvalue().strip().splitlines()[-1:] or ["no message"]
        raise InputError(
            f"{' '.join(words[:2])} failed: {last[0].removeprefix('tofclip: error: ')}"
        )
