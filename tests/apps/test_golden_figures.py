"""How good results are, held in one file with what they may differ by.

`golden/figures.json` says for each scene where its tolerances are from; figures are pairs of value
and tolerance. A change that moves one on purpose, for the better or at a price, changes the file.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.io import loadmat

from nlos import Capture, settings_for
from tofclip import Camera, depth, read_streak, recover
from tofclip.camera.focus_pictures import calibrate_views
from tofclip.lidar.photons import PhotonImage, estimate_surface
from tofclip.recovery import open_shot
from tofclip.units import SPEED_OF_LIGHT

pytestmark = pytest.mark.xdist_group("golden")

GOLDEN = json.loads((Path(__file__).parents[1] / "golden" / "figures.json").read_text("utf-8"))


def compare(scene: str, found: Mapping[str, Any]) -> None:
    kept = GOLDEN[scene]["figures"]
    changed = [
        f"{scene}: {name} is {found[name]:.6g}, was {value:.6g} +- {tolerance:.2g}"
        for name, (value, tolerance) in kept.items()
        if not abs(found[name] - value) <= tolerance
    ]
    assert not changed, "\n".join(["against tests/golden/figures.json:", *changed])


def require(path: Path) -> Path:
    if not path.is_file():
        pytest.skip(f"no recorded {path}")
    return path


def test_the_demonstration(demonstration: dict[str, Any]) -> None:
    compare("demo", demonstration)


def test_the_hidden_letters(hidden_letters: dict[str, Any]) -> None:
    methods = {name: entry for name, entry in hidden_letters.items() if isinstance(entry, dict)}
    compare(
        "nlos demo",
        {f"{name} {key}": value for name, entry in methods.items() for key, value in entry.items()},
    )


def measure_wall(path: Path) -> dict[str, float]:
    """A recorded letter around the corner, by the linear inverse and the settings that suit it."""
    frames = recover(open_shot(path).streak, method="linear")
    capture = Capture.from_frames(frames)
    settings = settings_for(capture, voxel=0.03)
    volume = settings.make_method().reconstruct(settings.prepare(capture), settings.grid())
    picture = volume.maximum_projection().brightness
    x, y, z = volume.find_brightest()
    return {
        "relative_residual": frames.figures["relative_residual"],
        "peak_x_m": x,
        "peak_y_m": y,
        "peak_z_m": z,
        "share_above_half": float(np.mean(picture > picture.max() / 2)),
    }


def test_the_recorded_letter_n(shared_data: Path) -> None:
    compare("LetterN", measure_wall(require(shared_data / "lift" / "nlos_LetterN.npz")))


def calibrate(folder: Path) -> Camera:
    names = ("LinePattern", "LinePattern_bkg", "DotPattern", "DotPattern_bkg")
    pictures = [read_streak(folder / f"{name}.tif").counts for name in names]
    return calibrate_views(*pictures).camera(time_zero=-10.784e-9)


def measure_scene5(folder: Path, method: str) -> dict[str, float]:
    """The recorded shot of letters and shelves."""
    frames = recover(read_streak(folder / "scene5.tif"), calibrate(folder), method)
    returns = depth(frames)
    energy = frames.values.sum(axis=(1, 2), dtype=np.float64) * frames.times**2
    return {
        "relative_residual": frames.figures["relative_residual"],
        "returns": returns.range.size,
        "median_range_m": float(np.median(returns.range)),
        "median_deviation_m": float(np.median(returns.confidence)),
        "brightest_row": int(np.argmax(energy)),
    }


@pytest.mark.parametrize("method", ["linear", pytest.param("l1", marks=pytest.mark.nightly)])
def test_the_recorded_scene5(method: str, shared_data: Path) -> None:
    folder = require(shared_data / "clip" / "scene5.tif").parent
    compare(f"scene5 {method}", measure_scene5(folder, method))


def measure_face(folder: Path) -> dict[str, float]:
    """Share of the head within 12 mm, error and truth of deviations, against a long exposure."""
    cells = loadmat(folder / "shin2015_face.mat")["Ts"]
    number = np.array([cell.size for cell in cells.ravel()])
    times = np.concatenate([cell.ravel() for cell in cells.ravel()])
    pixel = np.repeat(np.arange(number.size), number)
    truth = loadmat(folder / "shin2015_face_truth.mat")["D_true"][:340, 3:343]
    truth = np.array([[float(cell.item()) for cell in row] for row in truth])
    head = truth < 3990  # what is further away has no true range
    found = estimate_surface(PhotonImage.from_events(pixel, times, cells.shape, 8e-12))
    error = found.range[head] - truth[head] * SPEED_OF_LIGHT / 2 * 8e-12
    error -= np.median(error)
    ratio = error / found.range_sigma[head]
    return {
        "share_within_12_mm": float(np.mean(np.abs(error) < 12e-3)),
        "rms_error_m": float(np.sqrt(np.mean(error**2))),
        "range_z": float(1.4826 * np.median(np.abs(ratio - np.median(ratio)))),
    }


def test_the_recorded_face(shared_data: Path) -> None:
    folder = require(shared_data / "photons" / "shin2015_face.mat").parent
    compare("face", measure_face(folder))
