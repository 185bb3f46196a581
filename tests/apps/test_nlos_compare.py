"""`tofclip nlos compare` and `demo`: methods side by side, and what they cost."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hidden_point import POINT, object_of
from small_instrument import Run

from nlos import Capture, Volume
from nlos.known_scenes import HiddenTruth

PNG = b"\x89PNG"


def test_a_curved_wall(run: Run, curved: Path, tmp_path: Path) -> None:
    out, volumes = tmp_path / "compare.png", tmp_path / "volumes"
    found = object_of(run, "compare", curved, "--voxel-mm", 25, "--out", out, "--volumes", volumes)
    methods = found["methods"]
    assert list(methods) == ["hybrid", "backprojection", "filtered-backprojection"]
    assert set(found["left_out"]) == {"rsd", "lct", "fk"}
    assert methods["hybrid"]["correlation"] == pytest.approx(1)
    assert methods["backprojection"]["correlation"] > 0.999
    assert methods["filtered-backprojection"]["correlation"] < 0.999
    for name, figures in methods.items():
        stored = Volume.load(volumes / f"{name}.h5")
        assert stored.grid.shape == tuple(found["voxels"])
        assert figures["seconds"] > 0
        assert figures["sharpness"] > 1
        # The ball about the point is a small part of the box, and holds more than that part of the
        # energy: by the unsharpest method 2.5 times as much.
        share = (
            HiddenTruth(np.array([POINT]), 0.0)
            .mask_near(stored.grid, figures["truth_reach_m"])
            .mean()
        )
        assert figures["energy_near_truth"] > 2 * share
        assert figures["contrast_to_truth"] > 2
    assert out.read_bytes().startswith(PNG)


def test_its_settings_give_the_same_comparison(run: Run, confocal: Path, tmp_path: Path) -> None:
    words = ["compare", confocal, "--methods", "fk,rsd", "--voxel-mm", 60]
    one = object_of(run, *words, "--out", tmp_path / "one.png")
    two = object_of(
        run, "compare", confocal, "--settings", tmp_path / "one.toml", "--out", tmp_path / "two.png"
    )
    for figures in (*one["methods"].values(), *two["methods"].values()):
        del figures["seconds"], figures["peak_mib"]
    assert one == two


def test_memory_is_that_of_the_method() -> None:
    from apps.verbs.nlos_imaging import _reset_peak_memory, measure_imaging
    from nlos import Grid

    if _reset_peak_memory() is None:
        pytest.skip("this system does not tell how much memory a program took")

    class Greedy:
        """Takes 64 MiB for a moment."""

        cost = 1

        def plan(self, _: Capture, grid: Grid) -> Greedy:
            self.grid = grid
            return self

        def reconstruct(self, capture: Capture, grid: Grid) -> Volume:
            return self.plan(capture, grid).image(capture)

        def image(self, *_: object) -> Volume:
            taken = np.ones(64 << 17)
            return Volume(np.full(self.grid.shape, taken.mean(), np.float32), self.grid)

    capture = Capture(np.zeros((4, 2)), np.array([[0.0, 0, 0], [1, 0, 0]]), np.zeros(3), 1e-11)
    found = measure_imaging("greedy", Greedy(), capture, Grid([0.0], [0.0], [1.0]))
    assert found.peak_bytes is not None
    # The allocator may reuse memory that it holds already, and threads may take a little for
    # themselves.
    assert 48 << 20 < found.peak_bytes < 96 << 20


def test_the_demonstration(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As it is, with a coarser wall and fewer voxels."""
    from apps.verbs import nlos_scenes as demo

    for name, value in {
        "WALL_POINTS": 24,
        "FACET_M": 0.06,
        "WAVELENGTH_M": 0.34,
        "VOXEL_M": 0.06,
    }.items():
        monkeypatch.setattr(demo, name, value)
    found = object_of(run, "demo", "--out", tmp_path / "demo", "--png", tmp_path / "picture.png")
    assert found["hybrid"]["correlation"] > 0.999
    assert found["flat"]["correlation"] < 0.95
    assert found["flat"]["energy_near_truth"] < found["hybrid"]["energy_near_truth"]
    assert (tmp_path / "picture.png").read_bytes().startswith(PNG)
    assert {path.name for path in (tmp_path / "demo").iterdir()} == {
        "capture.h5",
        "hybrid.h5",
        "backprojection.h5",
    }
    assert HiddenTruth.load(tmp_path / "demo" / "capture.h5") is not None


def test_memory_is_foretold_within_a_factor(run: Run, confocal: Path, tmp_path: Path) -> None:
    """The estimate is within a factor of 4 of what is measured, and 32 MiB that libraries take when
    they are loaded.
    """
    box = ["--voxel-mm", 12, "--everywhere"]
    foretold = object_of(run, "info", confocal, *box[:2])["methods"]
    words = ["compare", confocal, "--methods", "rsd,fk", *box, "--out", tmp_path / "compare.png"]
    measured = object_of(run, *words)["methods"]
    for name, figures in measured.items():
        if figures["peak_mib"] is None:
            pytest.skip("this system does not tell how much memory a program took")
        assert foretold[name]["memory_mib"] < 4 * figures["peak_mib"] + 32
        assert figures["peak_mib"] < 4 * foretold[name]["memory_mib"] + 32


def test_figures_of_merit_of_volumes_that_need_no_computing() -> None:
    from nlos import Grid
    from nlos.known_scenes import compare_with_truth, measure_sharpness

    grid = Grid(np.arange(4) * 0.03, np.arange(3) * 0.03, [1.0, 1.03])
    even, single = np.ones(grid.shape, np.float32), np.zeros(grid.shape, np.float32)
    single[1, 2, 3] = 5
    assert measure_sharpness(Volume(even, grid)) == pytest.approx(1)
    assert measure_sharpness(Volume(single, grid)) == pytest.approx(12)  # pixels of the front view
    assert np.isnan(measure_sharpness(Volume(0 * even, grid)))
    truth = HiddenTruth(np.array([[0.09, 0.06, 1.03]]), 0.0)
    for values, share, contrast in (
        (even, 4 / 24, 1.0),
        (single, 1.0, float("nan")),
        (0 * even, None, None),
    ):
        figures = compare_with_truth(Volume(values, grid), truth)
        assert (
            figures["truth_reach_m"] == 0.04
        )  # from a corner: its own voxel and three neighbours, no diagonal
        assert figures["energy_near_truth"] == pytest.approx(
            float("nan") if share is None else share, nan_ok=True
        )
        assert figures["contrast_to_truth"] == pytest.approx(contrast or float("nan"), nan_ok=True)
    coarse = Grid(grid.x * 10, grid.y, grid.z)
    assert compare_with_truth(Volume(even, coarse), truth)["truth_reach_m"] == pytest.approx(
        0.3
    )  # no finer than voxels
