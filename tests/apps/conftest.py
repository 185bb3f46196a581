"""Run the program in this process, on the files of a small instrument."""

from __future__ import annotations

import contextlib
import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from hidden_point import confocal_capture, curved_capture
from small_instrument import (
    ANGLES,
    BACKGROUND,
    BIN_WIDTH,
    CENTRES_PX,
    IMAGE_SHAPE,
    ROWS,
    SLIT_WIDTH_PX,
    SQUARE_ROWS,
    Outcome,
    Run,
    focus_pictures,
    wall_shot,
)

from apps.cli import main
from tofclip.camera import Camera, SkewSweep
from tofclip.shots import Streak


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Run:
    """Run the program in this process."""

    def call(*words: object) -> Outcome:
        capsys.readouterr()
        status = main([str(word) for word in words])
        return Outcome(status, *capsys.readouterr())

    return call


@pytest.fixture(scope="session")
def camera() -> Camera:
    """Camera without skew, whose numbers made the small streak image."""
    at_rest = SkewSweep(CENTRES_PX, np.zeros(7), np.zeros(7))
    return Camera(
        CENTRES_PX, ANGLES, IMAGE_SHAPE, SLIT_WIDTH_PX, sweep=at_rest, focal_length_px=140.0
    )


@pytest.fixture(scope="session")
def scene() -> np.ndarray:
    """Frames (time, y, x): a square at the upper left, later one at the lower right, each as long
    as a pulse.
    """
    frames = np.zeros((ROWS, *IMAGE_SHAPE), np.float32)
    sigma_bins = 60e-12 / BIN_WIDTH / 2.355
    for row, place in zip(SQUARE_ROWS, (np.s_[8:14, 9:15], np.s_[18:25, 17:24]), strict=True):
        pulse = np.exp(-(((np.arange(ROWS) - row) / sigma_bins) ** 2) / 2)
        frames[:, place[0], place[1]] += 100 * pulse[:, np.newaxis, np.newaxis].astype(np.float32)
    return frames


@pytest.fixture(scope="session")
def streak(camera: Camera, scene: np.ndarray) -> Streak:
    """The shot of the scene, with Poisson noise."""
    expected = camera.operator()(np.moveaxis(scene, 0, -1)).T + BACKGROUND
    counts = np.random.default_rng(3).poisson(expected).astype(np.float32)
    return Streak(counts, camera=camera).with_bin_width(BIN_WIDTH)


@pytest.fixture(scope="session")
def files(tmp_path_factory: pytest.TempPathFactory, camera: Camera, streak: Streak) -> Path:
    """Folder with what a user would have: streak images, a camera file and four focus pictures."""
    folder = tmp_path_factory.mktemp("instrument")
    streak.save(folder / "streak.h5")
    camera.save(folder / "camera.h5")
    tifffile.imwrite(folder / "streak.tif", streak.counts.astype(np.uint16))
    wall_shot(streak).save(folder / "wall.h5")
    for name, picture in focus_pictures().items():
        tifffile.imwrite(folder / f"{name}.tif", picture)
    return folder


@pytest.fixture(scope="session")
def curved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A hidden point before a curved wall."""
    return curved_capture(tmp_path_factory.mktemp("curved") / "capture.h5")


@pytest.fixture(scope="session")
def confocal(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same point before a planar wall, scanned confocally."""
    return confocal_capture(tmp_path_factory.mktemp("confocal") / "capture.h5")


def run_demo(verb: str, out: Path) -> dict[str, Any]:
    printed, said = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(said):
        status = main([*verb.split(), "--out", str(out), "--seed", "1", "--json"])
    assert (status, said.getvalue()) == (0, "")
    figures: dict[str, Any] = json.loads(printed.getvalue())
    return figures


@pytest.fixture(scope="session")
def demo_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the demonstration puts its files."""
    return tmp_path_factory.mktemp("demo") / "new" / "demo"


@pytest.fixture(scope="session")
def demonstration(demo_folder: Path) -> dict[str, Any]:
    """Figures of `tofclip demo`; who asks for it is in the group ``golden``."""
    return run_demo("demo", demo_folder)


@pytest.fixture(scope="session")
def hidden_letters(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Figures of `tofclip nlos demo`; who asks for it is in the group ``golden``."""
    return run_demo("nlos demo", tmp_path_factory.mktemp("hidden-letters"))
