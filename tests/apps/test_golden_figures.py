"""How good results are, held in one file with what they may differ by.

`golden/figures.json` says for each scene where its tolerances are from; figures are pairs of value
and tolerance. A change that moves one on purpose, for the better or at a price, changes the file.
"""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.io import loadmat
from scipy.ndimage import gaussian_filter1d
from scipy.signal import find_peaks

from nlos import Capture, settings_for
from nlos.known_scenes import HiddenTruth
from tofclip import Camera, Frames, PointCloud, depth, read_streak, recover
from tofclip.camera.focus_pictures import calibrate_views
from tofclip.lidar.photons import PhotonImage, estimate_surface
from tofclip.recovery import open_shot
from tofclip.solvers import Sparse
from tofclip.units import SPEED_OF_LIGHT

pytestmark = pytest.mark.xdist_group("golden")

GOLDEN = json.loads((Path(__file__).parents[1] / "golden" / "figures.json").read_text("utf-8"))


def compare(scene, found):
    kept = GOLDEN[scene]["figures"]
    changed = [
        f"{scene}: {name} is {found[name]:.6g}, was {value:.6g} +- {tolerance:.2g}"
        for name, (value, tolerance) in kept.items()
        if not abs(found[name] - value) <= tolerance
    ]
    assert not changed, "\n".join(["against tests/golden/figures.json:", *changed])


def require(path):
    if not path.is_file():
        pytest.skip(f"no recorded {path}")
    return path


def test_the_demonstration(demonstration, demo_folder):
    found = demonstration
    compare("demo", found)
    written = {"streak.h5", "frames.h5", "cloud.ply", "preview.png"}
    assert {path.name for path in demo_folder.iterdir()} == written
    assert found["points"] == len(PointCloud.load(demo_folder / "cloud.ply"))
    frames, nominal = Frames.load(demo_folder / "frames.h5"), Camera.load(demo_folder / "streak.h5")
    assert frames.provenance["settings"] == {"verb": "demo", "seed": 1}
    # found from the shot, not handed over
    assert nominal.sweep is None
    assert frames.camera.sweep is not None
    np.testing.assert_array_equal(nominal.gains, 1)


def test_the_hidden_letters_on_a_coarser_wall(hidden_letters, letters_folder):
    hybrid, flat = hidden_letters["hybrid"], hidden_letters["flat"]
    assert hybrid["correlation"] > 0.999
    assert flat["correlation"] < 0.95
    assert flat["energy_near_truth"] < hybrid["energy_near_truth"]
    written = {"capture.h5", "hybrid.h5", "backprojection.h5", "nlos_demo.png"}
    assert {path.name for path in letters_folder.iterdir()} == written
    assert HiddenTruth.find(letters_folder / "capture.h5") is not None


@pytest.mark.nightly
def test_the_hidden_letters(shell):
    found = shell.figures("nlos demo --out letters --seed 1")
    methods = {name: entry for name, entry in found.items() if isinstance(entry, dict)}
    compare(
        "nlos demo",
        {f"{name} {key}": value for name, entry in methods.items() for key, value in entry.items()},
    )


def measure_wall(path):
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


@pytest.mark.nightly
def test_the_recorded_letter_n(shared_data):
    compare("LetterN", measure_wall(require(shared_data / "lift" / "nlos_LetterN.npz")))


@pytest.fixture(scope="module")
def clip(shared_data):
    return require(shared_data / "clip" / "scene5.tif").parent


@pytest.fixture(scope="module")
def scene5_camera(clip):
    names = ("LinePattern", "LinePattern_bkg", "DotPattern", "DotPattern_bkg")
    pictures = [read_streak(clip / f"{name}.tif").counts for name in names]
    return calibrate_views(*pictures).camera(time_zero=-10.784e-9)


def sum_energy(frames):
    return frames.values.sum(axis=(1, 2), dtype=np.float64) * frames.times**2


@pytest.fixture(scope="module")
def frames(clip, scene5_camera):
    """Of the recorded shot of letters and shelves."""
    return recover(read_streak(clip / "scene5.tif"), scene5_camera, "linear")


def measure_scene5(frames):
    returns = depth(frames)
    return {
        "relative_residual": frames.figures["relative_residual"],
        "returns": returns.range.size,
        "median_range_m": float(np.median(returns.range)),
        "median_deviation_m": float(np.median(returns.confidence)),
        "brightest_row": int(np.argmax(sum_energy(frames))),
    }


def test_the_recorded_scene5(frames):
    compare("scene5 linear", measure_scene5(frames))


@pytest.mark.nightly
def test_the_recorded_scene5_by_l1(clip, scene5_camera):
    found = recover(read_streak(clip / "scene5.tif"), scene5_camera, "l1")
    compare("scene5 l1", measure_scene5(found))


class TestLetters:
    """The same shot, against what an independent trial found, and the letters in it."""

    PEAK_ROWS = (93, 139, 182, 331, 431, 476, 683)  # of the summed energy times range squared
    SKEW_ROWS = (-16.3, -10.4, -4.8, 0.0, 3.9, 8.2, 12.0)
    FEW_ROWS = slice(50, 230)

    @pytest.fixture(scope="class")
    @classmethod
    def letters(cls, clip, frames):
        """Of a few rows, by a method that sharpens strokes."""
        streak = read_streak(clip / "scene5.tif")
        counts, times = streak.counts[cls.FEW_ROWS], streak.times[cls.FEW_ROWS]
        few = replace(streak, counts=counts, row_times=times, saturated=None)
        return recover(few, frames.camera, Sparse(iterations=25))

    def test_the_views_are_skewed_as_the_trial_found(self, frames):
        found = frames.camera.sweep.raw_position(np.zeros(7), frames.camera.centres_px)[0]
        np.testing.assert_allclose(found - found[3], self.SKEW_ROWS, atol=1.0)

    def test_objects_stand_where_the_trial_found_them(self, frames):
        energy = sum_energy(frames)
        peaks, _ = find_peaks(energy, prominence=0.01 * energy.max())
        distances = [int(np.abs(peaks - row).min()) for row in self.PEAK_ROWS]
        assert max(distances) <= 3, distances

    def test_ranges_use_the_file_s_own_time_axis(self, frames):
        step = np.diff(frames.times)
        assert step[[0, -1]] == pytest.approx([18.78e-12, 20.49e-12], abs=0.02e-12)
        assert SPEED_OF_LIGHT / 2 * frames.times[0] == pytest.approx(1.63, abs=0.02)

    @pytest.mark.parametrize("row", [93, 182], ids=["U", "N"])
    def test_a_letter_s_strokes_are_apart(self, letters, row):
        """U and N have two upright strokes: their middle rows show two maxima with a clear gap
        between them.
        """
        row -= self.FEW_ROWS.start
        letter = letters.values[row - 4 : row + 5].sum(axis=0)
        middle = int(np.argmax(letter.max(axis=1)))
        profile = gaussian_filter1d(letter[middle - 3 : middle + 4].sum(axis=0), 1)
        assert find_peaks(profile, prominence=0.2 * profile.max())[0].size == 2


def measure_face(folder):
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
    # The exposure's own errors: two halves of these photons, pooled over 8 x 8 pixels, both lie so
    # far off it, and 0.2 mm off the surface that is found.
    ratio = error / np.hypot(found.range_sigma[head], 3.2e-3)
    return {
        "share_within_12_mm": float(np.mean(np.abs(error) < 12e-3)),
        "rms_error_m": float(np.sqrt(np.mean(error**2))),
        "range_z": float(1.4826 * np.median(np.abs(ratio - np.median(ratio)))),
    }


def test_the_recorded_face(shared_data):
    folder = require(shared_data / "photons" / "shin2015_face.mat").parent
    compare("face", measure_face(folder))
