"""`tofclip nlos`: captures simulated, described, imaged, refined and traced to surfaces."""

import shlex
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from small_instrument import HIDDEN_POINT, HIDDEN_SCENE

from apps.cli import split_docstring, walk_verbs
from nlos import Capture, Grid, Volume
from nlos.analysis import find_sampling_step
from nlos.export import Mesh
from nlos.imaging import MAX_DECOYS
from nlos.known_scenes import HiddenTruth
from nlos.method import Plan
from tofclip.errors import InputError

BOX = "--x-m -0.15 0.25 --y-m -0.2 0.2 --near-m 0.4 --far-m 0.7 --everywhere"


def peak(figures):
    return [figures["peak_m"][axis] for axis in "xyz"]


def pair(kind=Volume):
    return kind.load("one.h5"), kind.load("two.h5")


class TestSimulate:
    def test_the_capture_carries_its_truth_and_its_settings(self, curved):
        capture, truth = Capture.load(curved), HiddenTruth.find(curved)
        np.testing.assert_array_equal(truth.positions, [HIDDEN_POINT])
        assert capture.signal.shape[1:] == (24, 24)
        assert capture.provenance["settings"]["wall"] == "cylinder"
        # The farthest point's light has arrived when the record ends, and no long silence follows.
        last = np.flatnonzero(capture.signal.max(axis=(1, 2)) > 1e-3 * capture.signal.max())[-1]
        assert 0 <= capture.axis.bins - last < 12

    def test_its_settings_give_the_same_capture(self, shell):
        counts = "--wall wavy --wall-points 6 --peak-counts 20 --seed 3 --background 0.5"
        shell.figures(f"nlos simulate {HIDDEN_SCENE} {counts} --out one.h5")
        shell.figures("nlos simulate --settings one.toml --out two.h5")
        shell.figures("nlos simulate --settings one.toml --seed 4 --out three.h5")
        (one, two), three = pair(Capture), Capture.load("three.h5")
        np.testing.assert_array_equal(one.signal, two.signal)
        assert not np.array_equal(one.signal, three.signal)
        assert np.array_equal(one.signal, np.round(one.signal))  # photons

    def test_letters_before_two_plates(self, shell):
        words = "--letters L --wall plates --wall-points 9 --facet-mm 60 --laser-m -0.5 0"
        found = shell.figures(f"nlos simulate {words} --out plates.h5")
        capture, truth = Capture.load("plates.h5"), HiddenTruth.find(Path("plates.h5"))
        # the middle column hangs in the gap
        assert found["wall_points"] == np.isfinite(capture.wall[..., 0]).sum() == 72
        assert any(np.array_equal(capture.laser, point) for point in capture.points)  # on the wall
        assert abs(capture.laser[0] + 0.5) < 0.2
        corner = truth.positions[np.argmin(truth.positions[:, 0] - truth.positions[:, 1])]
        assert corner[0] < 0 < corner[1]  # the foot of an L is at the lower left, y down
        assert set(truth.positions[:, 2]) == {1.0}

    def test_a_mesh(self, shell):
        corners = np.array([[-0.2, -0.1, 0.8], [-0.2, 0.1, 0.8], [0.2, 0.1, 0.8]], np.float32)
        Mesh(corners, np.array([[0, 1, 2]], np.int32)).save("triangle.ply")
        words = "--mesh triangle.ply --material retroreflecting --wall-points 4"
        assert shell.figures(f"nlos simulate {words} --out capture.h5")["total"] > 0

    def test_truth_only_where_it_is(self, tmp_path, files):
        with h5py.File(tmp_path / "foreign.h5", "w") as file:
            file["data"] = [1.0]
        (tmp_path / "text.npz").write_text("no HDF5")
        for path in (tmp_path / "foreign.h5", tmp_path / "text.npz", files / "streak.h5", tmp_path):
            assert HiddenTruth.find(path) is None
        with pytest.raises(InputError, match="reach"):
            HiddenTruth(np.zeros((1, 3)), 0.0).mask_near(Grid([0.0], [0.0], [0.0]), 0.0)


class TestInfo:
    def test_a_curved_wall(self, shell):
        found = shell.figures("nlos info {curved}")
        wall = found["wall"]
        assert (wall["points"], wall["shape"], found["truth"]) == (576, "no planar lattice", True)
        assert wall["step_m"] == pytest.approx(0.8 / 23, rel=0.01)
        suits = {name for name, method in found["methods"].items() if method["suits"]}
        assert suits >= {"hybrid", "backprojection", "filtered-backprojection"}
        assert set(found["methods"]) - suits >= {"rsd", "lct", "fk"}
        assert "hybrid" in found["methods"]["rsd"]["reason"]
        wavelength_m = found["wavelength_mm"]["chosen"] * 1e-3
        assert found["resolution_m"]["x"] == pytest.approx(1.2 * wavelength_m * 0.75, rel=0.5)

    def test_a_confocal_scan_suits_every_method(self, shell):
        found = shell.figures("nlos info {confocal}")
        assert found["laser"] == "confocal"
        assert all(one["suits"] and one["memory_mib"] > 0 for one in found["methods"].values())
        people = shell("nlos info {confocal}")
        assert people.status == 0
        assert "\n  hybrid " in people.out

    def test_the_shortest_wavelength_is_just_not_undersampled(self, shell):
        chosen = shell.figures("nlos info {curved}")["wavelength_mm"]
        line = "nlos reconstruct {curved} --out volume.h5 --voxel-mm 100 --wavelength-mm"
        shell.figures(f"{line} {chosen['chosen']}")
        shorter = shell(f"{line.replace('volume', 'again')} {0.95 * chosen['shortest']}")
        assert shorter.status == 0
        assert shorter.err.startswith("tofclip: warning: wall points 0.0348 m apart are too coarse")
        assert shorter.err.count("\n") == 1

    def test_one_wall_point_and_many_lasers_are_sampled_by_the_lasers(self, confocal):
        scan = Capture.load(confocal)
        alone = np.broadcast_to(scan.wall[3, 4], scan.wall.shape)
        one_detector = Capture(scan.signal, alone, scan.wall, scan.bin_width)
        assert find_sampling_step(one_detector) == pytest.approx(scan.spacing)
        corner = scan.wall[0, 0]
        assert find_sampling_step(Capture(scan.signal[:, 0, 0], corner, corner, 1e-11)) == 0


class TestReconstruct:
    def test_the_point_is_found_by_two_images_without_a_word(self, shell, monkeypatch):
        made, imaged = [], []
        begin, image = Plan.__init__, Plan.image
        monkeypatch.setattr(Plan, "__init__", lambda *a: made.append(1) or begin(*a))
        monkeypatch.setattr(Plan, "image", lambda *a: imaged.append(1) or image(*a))
        found = shell.figures("nlos reconstruct {curved} --out volume.h5")
        assert found["method"] == "hybrid"
        # A third of the width of its image; the pulse of three waves is as long as the depth is
        # uncertain.
        assert peak(found) == pytest.approx(HIDDEN_POINT, abs=found["wavelength_mm"] / 3000)
        # coarse voxels, the bright part, and as coarse shuffled copies by the first plan: few voxels
        # take as many as there are at most
        assert (len(made), len(imaged)) == (2, 2 + MAX_DECOYS)

    @pytest.mark.parametrize("method", ["hybrid", "filtered-backprojection"])
    def test_its_settings_give_the_same_volume(self, shell, method):
        words = f"--gate-m 0.1 --bins-together 2 --voxel-mm 33.3 --method {method}"
        shell.figures(f"nlos reconstruct {{curved}} {words} --out one.h5")
        shell.figures("nlos reconstruct {curved} --settings one.toml --out two.h5")
        one, two = pair()
        assert one.values.tobytes() == two.values.tobytes()
        for axis in "xyz":
            assert getattr(one.grid, axis).tobytes() == getattr(two.grid, axis).tobytes()
        assert Path("one.toml").read_text() == Path("two.toml").read_text()

    @pytest.mark.parametrize("method", ["rsd", "lct", "fk"])
    def test_confocal_scans(self, shell, method):
        found = shell.figures(
            f"nlos reconstruct {{confocal}} --method {method} --voxel-mm 20 --out v.h5"
        )
        assert peak(found) == pytest.approx(HIDDEN_POINT, abs=0.04)
        kept = Path("v.toml").read_text()
        assert ("falloff = 4" in kept) == (method in ("lct", "fk"))
        assert "sigma_mm" not in kept

    @pytest.mark.parametrize("method", ["lct", "fk"])
    def test_noise_of_the_farthest_depths_is_not_looked_at(self, shell, method):
        """With the factor d^4 by which these methods brighten, photons of chance far away outshine
        the point.
        """
        scan = f"{HIDDEN_SCENE} --wall planar --scan confocal --wall-points 24 --seed 1"
        shell.figures(f"nlos simulate {scan} --peak-counts 15 --background 0.5 --out short.h5")
        short = Capture.load("short.h5")
        later = np.random.default_rng(1).poisson(0.5, (300, *short.signal.shape[1:]))
        replace(short, signal=np.concatenate([short.signal, later])).save("long.h5")
        found = shell.figures(
            f"nlos reconstruct long.h5 --method {method} --voxel-mm 25 --out volume.h5"
        )
        assert peak(found) == pytest.approx(HIDDEN_POINT, abs=0.05)
        # Where the method itself had looked, the box would end at 1.54 m.
        assert Volume.load("volume.h5").grid.z[-1] < 1.0

    def test_another_format(self, shell):
        shell.figures("nlos reconstruct {curved} --voxel-mm 60 --out volume.exr")
        assert Path("volume.exr").read_bytes().startswith(b"\x76\x2f\x31\x01")


class TestRefine:
    @pytest.mark.parametrize("prior", ["l1", "tv"])
    def test_a_prior_and_its_iterations_are_reported(self, shell, prior):
        """What they make of an image: see `tests/nlos/test_refinement.py`."""
        words = f"{BOX} --voxel-mm 20 --wavelength-mm 150 --refine {prior} --iterations 8"
        found = shell.figures(f"nlos reconstruct {{curved}} {words} --out volume.h5")
        assert (found["method"], found["refine"], found["iterations"]) == ("hybrid", prior, 8)
        assert found["stopped_because"] == "iterations done"
        assert peak(found) == pytest.approx(HIDDEN_POINT, abs=0.03)
        reported = Path("volume.toml").read_text()
        assert f'refine = "{prior}"\niterations = 8\nprior_weight = 0.02\n' in reported

    def test_photons_are_counted(self, shell):
        """What they show: see `tests/nlos/test_photon_refinement.py`."""
        words = "--wall-points 16 --peak-counts 4 --background 0.03 --out counts.h5"
        shell.figures(f"nlos simulate --points '0.1,0.05,0.7; -0.3,0.2,0.9' {words}")
        box = "--x-m -0.5 0.5 --y-m -0.4 0.4 --near-m 0.5 --far-m 1.1 --everywhere --voxel-mm 80"
        found = shell.figures(f"nlos reconstruct counts.h5 {box} --refine photons --out volume.h5")
        assert (found["refine"], found["iterations"]) == ("photons", 12)
        reported = Path("volume.toml").read_text()
        assert 'refine = "photons"\niterations = 12\nprior_weight = 1.0\n' in reported

    def test_voxels_that_the_wavelength_does_not_resolve(self, shell):
        words = f"{BOX} --refine l1 --wavelength-mm 100 --voxel-mm 50 --out volume.h5"
        outcome = shell(f"nlos reconstruct {{curved}} {words}")
        assert outcome.status == 2
        assert "too coarse to refine" in outcome.err.splitlines()[-1]
        assert not list(Path().iterdir())


@pytest.mark.parametrize(
    ("capture", "source"),
    [("confocal", "directional light-cone transform"), ("curved", "gradient of the volume")],
)
def test_surfaces_are_traced_with_normals(shell, capture, source):
    """Their depths, directions and files: see `tests/nlos/test_front_surface.py`."""
    words = f"{BOX} --voxel-mm 20 --point-fraction 0.3 --surface mesh.ply --out v.h5"
    found = shell.figures(f"nlos reconstruct {{{capture}}} {words}")
    assert found["surface_source"] == source
    assert f"element vertex {found['surface_points']}\n".encode() in Path("mesh.ply").read_bytes()


@pytest.mark.nightly
def test_the_examples_run_one_after_the_other(shell):
    verbs = walk_verbs()
    for verb in ("simulate", "info", "reconstruct", "film", "compare"):
        for example in split_docstring(verbs[f"nlos {verb}"].callback.__doc__)[1]:
            outcome = shell(shlex.join(shlex.split(example)[1:]))
            assert (outcome.status, outcome.err) == (0, ""), example
    assert "energy near truth" in outcome.out
    assert Path("volume.png").read_bytes().startswith(b"\x89PNG")
