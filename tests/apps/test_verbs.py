"""The verbs as the README uses them, on the files of a small instrument."""

from __future__ import annotations

import itertools
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from small_instrument import ANGLES, BIN_WIDTH, CENTRES_PX, ROWS, SQUARE_ROWS, Run

from nlos import Capture, Volume
from tofclip import Camera, Frames, PointCloud, Streak
from tofclip.units import SPEED_OF_LIGHT

PNG = b"\x89PNG\r\n\x1a\n"


def object_of(run: Run, *words: object) -> dict[str, Any]:
    """Run a verb with --json; standard output must hold the object and nothing else."""
    outcome = run(*words, "--json")
    assert (outcome.status, outcome.err) == (0, "")
    found: dict[str, Any] = json.loads(outcome.out)
    return found


@pytest.fixture(scope="session")
def frames_file(files: Path, streak: Streak) -> Path:
    """Frames of the small shot, recovered through the library."""
    from tofclip import recover

    path = files / "known-frames.h5"
    recover(streak, method="l1").save(path)
    return path


class TestCalibrate:
    def words(self, files: Path, out: Path) -> list[object]:
        pictures = ("line", "line_background", "dot", "dot_background")
        flags = [[f"--{name.replace('_', '-')}", files / f"{name}.tif"] for name in pictures]
        return ["calibrate", *itertools.chain(*flags), "--out", out]

    def test_angles_and_centres_in_json_and_file(
        self, run: Run, files: Path, tmp_path: Path
    ) -> None:
        found = object_of(run, *self.words(files, tmp_path / "camera.h5"))
        assert list(found) == ["angles_deg", "centres_px", "centre_uncertainty_px"]
        # Pictures of 900 counts above 100 with lines 1.5 px wide fix a centre to some 0.05 px, an
        # angle to 0.1 degree.
        np.testing.assert_allclose(found["angles_deg"], np.rad2deg(ANGLES), atol=0.5)
        np.testing.assert_allclose(found["centres_px"], CENTRES_PX, atol=0.2)
        assert 0 < max(found["centre_uncertainty_px"]) < 0.2
        camera = Camera.load(tmp_path / "camera.h5")
        np.testing.assert_allclose(camera.centres_px, found["centres_px"])
        assert camera.time_zero == 0
        assert (tmp_path / "camera.png").read_bytes().startswith(PNG)

    def test_what_pictures_cannot_show_and_table(
        self, run: Run, files: Path, tmp_path: Path
    ) -> None:
        out, picture = tmp_path / "camera.h5", tmp_path / "fits.png"
        known = ("--time-zero-ns", "-10.784", "--focal-length-px", "411.5", "--pulse-ps", "45")
        outcome = run(*self.words(files, out), *known, "--preview", picture)
        assert outcome.status == 0
        camera = Camera.load(out)
        assert camera.time_zero == pytest.approx(-10.784e-9)
        assert camera.focal_length_px == 411.5
        assert camera.pulse_fwhm == pytest.approx(45e-12)
        lines = outcome.out.splitlines()
        assert len(lines) == 1 + 7 + 2  # heading, views, two files
        assert lines[-2:] == [f"wrote {out}", f"wrote {picture}"]


class TestRecover:
    def test_contract_of_json_and_files(self, run: Run, files: Path, tmp_path: Path) -> None:
        out = tmp_path / "frames.h5"
        found = object_of(run, "recover", files / "streak.h5", "--out", out)
        assert list(found) == [
            "frames",
            "image_shape",
            "method",
            "iterations",
            "relative_residual",
            "seconds",
            "frames_per_second",
            "frames_per_second_overall",
            "view_gains",
            "time_shift_bins",
            "stopped_because",
            "device",
        ]
        assert (found["frames"], found["image_shape"], found["method"]) == (ROWS, [32, 32], "tv")
        assert found["frames_per_second"] > found["frames_per_second_overall"]
        assert found["frames_per_second_overall"] < ROWS / found["seconds"]
        assert (len(found["view_gains"]), found["time_shift_bins"]) == (7, [0.0] * 7)
        # About 10 photons rms per reading of noise against some 300 of signal, and the prior's
        # bias.
        assert found["relative_residual"] < 0.15
        frames = Frames.load(out)
        energy = frames.values.sum(axis=(1, 2))
        for row in SQUARE_ROWS:
            assert abs(int(np.argmax(energy[row - 10 : row + 10])) - 10) <= 1
        assert (tmp_path / "frames.png").read_bytes().startswith(PNG)
        assert frames.provenance["settings"]["verb"] == "recover"
        assert "data_term=LeastSquares, " in frames.provenance["settings"]["method"]
        assert frames.provenance["inputs"][0]["name"] == "streak.h5"

    def test_skew_is_found_where_the_camera_has_no_sweep(
        self, run: Run, files: Path, camera: Camera, tmp_path: Path
    ) -> None:
        camera.replace(sweep=None).save(tmp_path / "nominal.h5")
        words = [
            "recover",
            files / "streak.h5",
            "--camera",
            tmp_path / "nominal.h5",
            "--out",
            tmp_path / "frames.h5",
        ]
        found = object_of(run, *words, "--method", "l1")
        # The shot has no skew; the estimate is good to about a tenth of a row at this brightness.
        np.testing.assert_allclose(found["time_shift_bins"], 0, atol=0.5)
        np.testing.assert_allclose(found["view_gains"], 1, atol=0.1)
        assert 0 < found["duality_gap"] < 1

    @pytest.mark.parametrize("method", ["linear", "adjoint"])
    def test_direct_methods(self, run: Run, files: Path, tmp_path: Path, method: str) -> None:
        found = object_of(
            run, "recover", files / "streak.h5", "--out", tmp_path / "f.h5", "--method", method
        )
        assert (found["method"], found["iterations"], found["stopped_because"]) == (
            method,
            0,
            "direct method",
        )

    def test_time_axis_flags_override_the_file(self, run: Run, files: Path, tmp_path: Path) -> None:
        out, picture = tmp_path / "frames.h5", tmp_path / "look.png"
        words = [
            "recover",
            files / "streak.tif",
            "--camera",
            files / "camera.h5",
            "--out",
            out,
            "--preview",
            picture,
        ]
        outcome = run(
            *words,
            "--bin-width-ps",
            10,
            "--time-zero-ns",
            "-2.5",
            "--method",
            "l1",
            "--iterations",
            3,
        )
        assert outcome.status == 0, outcome.err
        frames = Frames.load(out)
        np.testing.assert_allclose(frames.times, 2.5e-9 + np.arange(ROWS) * 10e-12)
        assert frames.figures["iterations"] == 3
        assert picture.exists()
        assert not (tmp_path / "frames.png").exists()
        assert f"wrote {picture}" in outcome.out


class TestCloud:
    def test_points_lie_where_the_squares_are(
        self, run: Run, frames_file: Path, streak: Streak, tmp_path: Path
    ) -> None:
        found = object_of(run, "cloud", frames_file, "--out", tmp_path / "scene.ply")
        assert list(found) == ["points", "range_m", "returns_per_pixel_mean", "device"]
        cloud = PointCloud.load(tmp_path / "scene.ply")
        assert len(cloud) == found["points"] > 50  # the squares cover 36 + 49 pixels
        assert found["returns_per_pixel_mean"] == pytest.approx(found["points"] / 32**2)
        # A return is placed to a fraction of a bin; its pulse is 3 bins wide.
        truth = [SPEED_OF_LIGHT * row * BIN_WIDTH / 2 for row in SQUARE_ROWS]
        np.testing.assert_allclose(found["range_m"], truth, atol=SPEED_OF_LIGHT * BIN_WIDTH / 2)
        near = cloud.xyz[cloud.range < np.mean(truth)]
        assert (
            near[:, :2].mean(axis=0).max() < 0
        )  # the first square is at the upper left: x and y negative

    def test_provenance_reaches_back_to_the_frames(
        self, run: Run, frames_file: Path, tmp_path: Path
    ) -> None:
        assert run("cloud", frames_file, "--out", tmp_path / "scene.h5").status == 0
        past = PointCloud.load(tmp_path / "scene.h5").provenance
        assert past["settings"] == {"verb": "cloud"}
        assert past["inputs"][0]["name"] == frames_file.name


class TestConvertAndNlos:
    def test_tiff_with_a_bin_width_becomes_hdf5(
        self, run: Run, files: Path, tmp_path: Path
    ) -> None:
        out = tmp_path / "streak.h5"
        found = object_of(run, "convert", files / "streak.tif", "--out", out, "--bin-width-ps", 20)
        assert (found["rows"], found["columns"], found["has_time_axis"], found["has_camera"]) == (
            96,
            300,
            True,
            False,
        )
        np.testing.assert_array_equal(
            Streak.load(out).counts, tifffile.imread(files / "streak.tif")
        )
        assert Streak.load(out).provenance["inputs"][0]["name"] == "streak.tif"

    def test_a_wall_goes_from_streak_to_volume(self, run: Run, files: Path, tmp_path: Path) -> None:
        copy, frames, volume = (tmp_path / name for name in ("wall.h5", "frames.h5", "volume.h5"))
        assert object_of(run, "convert", files / "wall.h5", "--out", copy)["attachments"] == [
            "relay_wall"
        ]
        assert run("recover", copy, "--out", frames, "--method", "linear").status == 0
        words = ["nlos", "reconstruct", frames, "--out", volume, "--png", tmp_path / "mip.png"]
        outcome = run(*words, "--voxel-mm", 40, "--far-m", 0.4, "--json")
        found = json.loads(outcome.out)
        # Nothing is hidden there: the brightest voxel is the wall's own light, which is said.
        assert outcome.status == 0
        assert found["brightest_on_wall"] == ("lies on the wall" in outcome.err)
        stored = Volume.load(volume)
        assert list(stored.values.shape) == found["voxels"]
        assert found["wall_points"] == 144
        assert stored.find_brightest() == pytest.approx([found["peak_m"][axis] for axis in "xyz"])
        assert (tmp_path / "mip.png").read_bytes().startswith(PNG)
        assert stored.provenance["settings"]["verb"] == "nlos reconstruct"

    def test_a_capture_is_taken_as_it_is(self, run: Run, tmp_path: Path) -> None:
        x, y = np.meshgrid(np.linspace(-0.3, 0.3, 48), np.linspace(-0.3, 0.3, 48))
        wall = np.stack(
            [x, y, 0 * x], axis=-1
        )  # spaced by less than half the pulse's shortest wave: no grating lobes
        hidden = np.array([0.1, -0.05, 0.3])
        path = np.linalg.norm(hidden) + np.linalg.norm(wall - hidden, axis=-1)
        bins = np.arange(200)[:, np.newaxis, np.newaxis]
        signal = np.exp(-(((bins - path / (SPEED_OF_LIGHT * 10e-12)) / 2) ** 2) / 2)
        Capture(signal, wall, np.zeros(3), 10e-12).save(tmp_path / "capture.h5")
        words = [
            "nlos",
            "reconstruct",
            tmp_path / "capture.h5",
            "--out",
            tmp_path / "volume.h5",
            "--everywhere",
        ]
        found = object_of(run, *words, "--voxel-mm", 20, "--wavelength-mm", 60)
        # Within a voxel across; along z the pulse of three cycles is 18 cm of path long, peaked
        # within a voxel.
        assert [found["peak_m"][axis] for axis in "xyz"] == pytest.approx(hidden, abs=0.025)
        for method in ("rsd", "hybrid"):
            again = object_of(
                run, *words, "--voxel-mm", 20, "--wavelength-mm", 60, "--method", method
            )
            assert (again["method"], again["peak_m"]) == (method, found["peak_m"])
        refused = run(*words, "--method", "lct")
        assert refused.status == 2
        assert "confocal" in refused.err


class TestInfo:
    @pytest.mark.parametrize(
        ("name", "kind"),
        [("streak.h5", "streak"), ("streak.tif", "streak"), ("camera.h5", "camera")],
    )
    def test_kind_and_shapes(self, run: Run, files: Path, name: str, kind: str) -> None:
        found = object_of(run, "info", files / name)
        assert (found["file"], found["kind"]) == (str(files / name), kind)
        if kind == "streak":
            counts = found["fields"]["counts"]
            assert (counts["shape"], counts["axes"]) == ([96, 300], ["time", "column"])
        else:
            assert found["fields"]["angles"]["units"] == "rad"
            np.testing.assert_allclose(found["fields"]["centres"]["values"], CENTRES_PX)

    @pytest.mark.parametrize(
        "name", ["scene.ply", "scene.pcd", "scene.csv", "scene.npz", "scene.h5"]
    )
    def test_clouds_of_every_format(
        self, run: Run, frames_file: Path, tmp_path: Path, name: str
    ) -> None:
        points = object_of(run, "cloud", frames_file, "--out", tmp_path / name)["points"]
        found = object_of(run, "info", tmp_path / name)
        assert found["kind"] == "cloud"
        assert found["fields"]["xyz"]["shape"] == [points, 3]

    def test_outline_for_people(self, run: Run, frames_file: Path) -> None:
        lines = run("info", frames_file).out.splitlines()
        assert "kind: frames" in lines
        assert any(line.startswith("  values: 96 x 32 x 32 (time, y, x) float32") for line in lines)
        assert "    kind: camera" in lines
        assert "  angle_uncertainty: unknown" not in lines
        (residual,) = (line for line in lines if line.startswith("  relative_residual: "))
        assert len(residual.split(": ")[1]) <= 11  # six digits, a sign and an exponent
        assert not any(line.endswith((": None", ": []")) for line in lines)


def test_recorded_shots_can_be_described(run: Run, shared_data: Path) -> None:
    found = object_of(run, "info", shared_data / "clip" / "scene5.tif")
    assert found["children"]["metadata"]["attributes"]["Streak camera/Time Range"] == "20 ns"
    found = object_of(run, "info", shared_data / "lift" / "nlos_LetterN.npz")
    assert found["children"]["relay_wall"]["fields"]["wall"]["units"] == "m"


def test_the_recorded_focus_pictures(run: Run, shared_data: Path, tmp_path: Path) -> None:
    names = {"line": "LinePattern", "line-background": "LinePattern_bkg", "dot": "DotPattern"}
    flags = [(f"--{flag}", shared_data / "clip" / f"{name}.tif") for flag, name in names.items()]
    words = [
        *itertools.chain(*flags),
        "--dot-background",
        shared_data / "clip" / "DotPattern_bkg.tif",
    ]
    found = object_of(run, "calibrate", *words, "--out", tmp_path / "camera.h5")
    # An independent trial on the same pictures; half a degree and half a pixel is what the two may
    # differ by.
    np.testing.assert_allclose(
        found["angles_deg"], [-43.3, -25.7, -12.7, 0.6, 22.9, 37.5, 48.0], atol=0.5
    )
    trial = [147.7, 320.0, 490.2, 664.1, 835.5, 1011.5, 1192.3]
    np.testing.assert_allclose(found["centres_px"], trial, atol=0.5)
