"""`tofclip warm-up`: compile everything once, so that no later run waits for it."""

from __future__ import annotations

import contextlib
import io
import os
import tempfile
import time
from pathlib import Path

from apps.help import EXIT_INTERRUPTED
from apps.options import JSON
from apps.progress import show_progress
from apps.report import report
from tofclip.errors import InputError
from tofclip.units import PICOSECOND

VIEW_ANGLES_DEG = (-43.0, -26.0, -13.0, 0.5, 23.0, 37.0, 48.0)
VIEW_PITCH_PX, IMAGE_SHAPE = 40.0, (24, 24)
ROWS, PULSE_ROWS, BIN_WIDTH_S = 64, 1.3, 20 * PICOSECOND
HIDDEN_SCENE = "--letters T --facet-mm 100 --wall-width-m 0.8 --wall-points 12 --bin-width-ps 16"
IMAGINGS = (
    ("planar", "single", ("rsd", "hybrid", "backprojection", "filtered-backprojection")),
    ("planar", "confocal", ("lct", "fk", "backprojection")),
    ("cylinder", "single", ("hybrid", "backprojection")),
)
"""Walls, scans, and the methods to run on them."""


def warm_up(as_json: bool = JSON) -> None:
    """Run everything that is compiled on first use once, on small data.

    Compiled code is kept beside the program, or in NUMBA_CACHE_DIR; later runs load it. After an
    update, or on a machine with another processor, it is compiled anew.

    Example: tofclip warm-up
    """
    started = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        steps = list_steps()
        _save_shots(Path(folder))
        with show_progress("compiling", len(steps)) as advance:
            for step in steps:
                words = [word.replace("@", f"{folder}/") for word in step.split()]
                _run_quietly([*words, "--overwrite"])  # steps write under the same names
                advance(1)
    report({"steps": len(steps), "seconds": time.perf_counter() - started}, as_json)


def list_steps() -> list[str]:
    """Commands that between them call every compiled function; ``@`` stands for a folder."""
    recovery = "recover @shots/first.h5 --out @frames.h5 --method"
    steps = [f"{recovery} {method} --iterations 2" for method in ("tv", "l1", "surfaces")]
    steps += [
        f"{recovery} linear",
        f"{recovery} adjoint",
        "cloud @frames.h5 --out @cloud.ply",
        "lidar accuracy --trials 10",
        "lidar sequence @shots --out @clouds",
        "demo --out @demo",
    ]
    for wall, scan, methods in IMAGINGS:
        capture = f"@{wall}_{scan}.h5"
        steps.append(f"nlos simulate --wall {wall} --scan {scan} {HIDDEN_SCENE} --out {capture}")
        steps += [
            f"nlos reconstruct {capture} --method {method} --voxel-mm 50 --out @{method}.h5"
            for method in methods
        ]
    return steps


def _save_shots(folder: Path) -> None:
    """Write two small shots of a bright square, whose sweep and gains are not known."""
    import numpy as np

    from tofclip.camera import Camera
    from tofclip.shots import Streak

    centres = VIEW_PITCH_PX * (0.5 + np.arange(len(VIEW_ANGLES_DEG), dtype=np.float64))
    angles = np.deg2rad(np.array(VIEW_ANGLES_DEG))
    camera = Camera(centres, angles, IMAGE_SHAPE, round(VIEW_PITCH_PX * centres.size))
    frames = np.zeros((*IMAGE_SHAPE, ROWS), np.float32)
    pulse = np.exp(-(((np.arange(ROWS) - ROWS / 2) / PULSE_ROWS) ** 2) / 2)
    frames[8:16, 8:16] = 100 * pulse.astype(np.float32)
    expected = camera.operator()(frames).T + 20
    (folder / "shots").mkdir()
    for seed, name in enumerate(("first", "second")):
        counts = np.random.default_rng(seed).poisson(expected).astype(np.float32)
        streak = Streak(counts, camera=camera).with_bin_width(BIN_WIDTH_S)
        streak.save(folder / "shots" / f"{name}.h5")


def _run_quietly(words: list[str]) -> None:
    """Run a command without its output."""
    from apps.cli import main

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
