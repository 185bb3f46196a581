"""The verbs as the README uses them, on the files of a small instrument."""

from pathlib import Path

import numpy as np
import pytest
import tifffile
from small_instrument import ANGLES, CENTRES_PX, ROWS, SQUARE_ROWS

from nlos import Volume
from tofclip import Camera, Frames, PointCloud, Streak, recover

PNG = b"\x89PNG\r\n\x1a\n"


@pytest.fixture(scope="session")
def frames_file(files, streak):
    """Frames of the small shot, recovered through the library."""
    path = files / "known-frames.h5"
    recover(streak, method="l1").save(path)
    return path


class TestCalibrate:
    LINE = (
        "calibrate --line {files}/line.tif --line-background {files}/line_background.tif"
        " --dot {files}/dot.tif --dot-background {files}/dot_background.tif --out camera.h5"
    )

    def test_angles_and_centres_in_json_and_file(self, shell):
        found = shell.figures(self.LINE)
        # Pictures of 900 counts above 100 with lines 1.5 px wide fix a centre to some 0.05 px, an
        # angle to 0.1 degree.
        np.testing.assert_allclose(found["angles_deg"], np.rad2deg(ANGLES), atol=0.5)
        np.testing.assert_allclose(found["centres_px"], CENTRES_PX, atol=0.2)
        assert 0 < max(found["centre_uncertainty_px"]) < 0.2
        camera = Camera.load("camera.h5")
        np.testing.assert_allclose(camera.centres_px, found["centres_px"])
        assert camera.time_zero == 0
        assert Path("camera.png").read_bytes().startswith(PNG)

    def test_what_pictures_cannot_show_and_table(self, shell):
        known = "--time-zero-ns -10.784 --focal-length-px 411.5 --pulse-ps 45"
        outcome = shell(f"{self.LINE} {known} --preview fits.png")
        assert outcome.status == 0
        camera = Camera.load("camera.h5")
        assert camera.time_zero == pytest.approx(-10.784e-9)
        assert camera.focal_length_px == 411.5
        assert camera.pulse_fwhm == pytest.approx(45e-12)
        lines = outcome.out.splitlines()
        assert all(line.count(", ") == 6 for line in lines[:-2])  # a figure of each view
        assert lines[-2:] == ["wrote camera.h5", "wrote fits.png"]


class TestRecover:
    def test_contract_of_json_and_files(self, shell):
        found = shell.figures("recover {files}/streak.h5 --out frames.h5")
        assert (found["frames"], found["image_shape"]) == (ROWS, [32, 32])
        assert found["method"] == "surfaces"
        assert found["frames_per_second"] > found["frames_per_second_overall"]
        assert found["frames_per_second_overall"] < ROWS / found["seconds"]
        assert (len(found["view_gains"]), found["time_shift_bins"]) == (7, [0.0] * 7)
        # About 10 photons rms per reading of noise against some 300 of signal, and the prior's
        # bias.
        assert found["relative_residual"] < 0.15
        frames = Frames.load("frames.h5")
        energy = frames.values.sum(axis=(1, 2))
        for row in SQUARE_ROWS:
            assert abs(int(np.argmax(energy[row - 10 : row + 10])) - 10) <= 1
        assert Path("frames.png").read_bytes().startswith(PNG)
        assert frames.provenance["settings"]["verb"] == "recover"
        assert "data_term=LeastSquares, " in frames.provenance["settings"]["method"]
        assert frames.provenance["inputs"][0]["name"] == "streak.h5"

    def test_a_direct_method(self, shell):
        found = shell.figures("recover {files}/streak.h5 --out f.h5 --method adjoint")
        assert (found["method"], found["iterations"]) == ("adjoint", 0)
        assert found["stopped_because"] == "direct method"

    def test_time_axis_flags_override_the_file(self, shell):
        words = (
            "--camera {files}/camera.h5 --out frames.h5 --preview look.png --bin-width-ps 10"
            " --time-zero-ns -2.5 --method l1 --iterations 3"
        )
        outcome = shell(f"recover {{files}}/streak.tif {words}")
        assert outcome.status == 0, outcome.err
        frames = Frames.load("frames.h5")
        np.testing.assert_allclose(frames.times, 2.5e-9 + np.arange(ROWS) * 10e-12)
        assert frames.figures["iterations"] == 3
        assert Path("look.png").exists()
        assert not Path("frames.png").exists()
        assert "wrote look.png" in outcome.out


class TestCloud:
    def test_points_are_told_and_know_their_past(self, shell):
        """Where they lie: see `tests/lidar/test_known_scenes.py`."""
        found = shell.figures("cloud {frames_file} --out scene.h5")
        cloud = PointCloud.load("scene.h5")
        assert len(cloud) == found["points"] > 50  # the squares cover 36 + 49 pixels
        assert found["returns_per_pixel_mean"] == pytest.approx(found["points"] / 32**2)
        np.testing.assert_allclose(found["range_m"], [cloud.range.min(), cloud.range.max()])
        assert cloud.provenance["settings"] == {"verb": "cloud"}
        assert cloud.provenance["inputs"][0]["name"] == "known-frames.h5"


class TestConvertAndNlos:
    def test_tiff_with_a_bin_width_becomes_hdf5(self, shell, files):
        found = shell.figures("convert {files}/streak.tif --out streak.h5 --bin-width-ps 20")
        assert (found["rows"], found["columns"]) == (96, 300)
        assert (found["has_time_axis"], found["has_camera"]) == (True, False)
        streak = Streak.load("streak.h5")
        np.testing.assert_array_equal(streak.counts, tifffile.imread(files / "streak.tif"))
        assert streak.provenance["inputs"][0]["name"] == "streak.tif"

    def test_a_wall_goes_from_streak_to_volume(self, shell):
        found = shell.figures("convert {files}/wall.h5 --out wall.h5")
        assert found["attachments"] == ["relay_wall"]
        assert shell("recover wall.h5 --out frames.h5 --method linear").status == 0
        words = "--out volume.h5 --png mip.png --voxel-mm 40 --far-m 0.4"
        found = shell.figures(f"nlos reconstruct frames.h5 {words}")
        # What the wall's own light leaves of a room with nothing in it; a hidden point has 8 or more.
        assert found["evidence"] < 3
        stored = Volume.load("volume.h5")
        assert list(stored.values.shape) == found["voxels"]
        assert found["wall_points"] == 144
        assert stored.find_brightest() == pytest.approx([found["peak_m"][axis] for axis in "xyz"])
        assert Path("mip.png").read_bytes().startswith(PNG)
        assert stored.provenance["settings"]["verb"] == "nlos reconstruct"


class TestInfo:
    def test_kinds_and_shapes(self, shell, files):
        for name in ("streak.h5", "streak.tif"):
            found = shell.figures(f"info {{files}}/{name}")
            assert (found["file"], found["kind"]) == (str(files / name), "streak")
            counts = found["fields"]["counts"]
            assert (counts["shape"], counts["axes"]) == ([96, 300], ["time", "column"])
        fields = shell.figures("info {files}/camera.h5")["fields"]
        assert fields["angles"]["units"] == "rad"
        np.testing.assert_allclose(fields["centres"]["values"], CENTRES_PX)

    def test_outline_for_people(self, shell):
        lines = shell("info {frames_file}").out.splitlines()
        assert "kind: frames" in lines
        assert any(line.startswith("  values: 96 x 32 x 32 (time, y, x) float32") for line in lines)
        assert "    kind: camera" in lines
        assert "  angle_uncertainty: -" not in lines
        (residual,) = (line for line in lines if line.startswith("  relative_residual: "))
        assert len(residual.split(": ")[1]) <= 11  # six digits, a sign and an exponent
        assert not any(line.endswith((": None", ": []")) for line in lines)

    def test_recorded_shots(self, shell, shared_data):
        found = shell.figures("info {shared_data}/clip/scene5.tif")
        assert found["children"]["metadata"]["attributes"]["Streak camera/Time Range"] == "20 ns"
        found = shell.figures("info {shared_data}/lift/nlos_LetterN.npz")
        assert found["children"]["relay_wall"]["fields"]["wall"]["units"] == "m"
