"""`tofclip nlos reconstruct --refine`: the hybrid, iterated."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hidden_point import POINT, object_of
from small_instrument import Run

from nlos import Volume
from nlos.known_scenes import HiddenTruth, compare_with_truth

BOX = ["--x-m", -0.15, 0.25, "--y-m", -0.2, 0.2, "--near-m", 0.4, "--far-m", 0.7, "--everywhere"]


def energy_near_the_point(volume: Volume) -> float:
    axes = np.meshgrid(volume.grid.z, volume.grid.y, volume.grid.x, indexing="ij")
    near = np.linalg.norm(np.stack(axes[::-1], axis=-1) - POINT, axis=-1) < 0.04
    return float(np.sum(volume.values[near] ** 2) / np.sum(volume.values**2))


@pytest.mark.parametrize("prior", ["l1", "tv"])
def test_iterations_gather_the_light(run: Run, curved: Path, tmp_path: Path, prior: str) -> None:
    words = ["reconstruct", curved, *BOX, "--voxel-mm", 20, "--wavelength-mm", 150]
    object_of(run, *words, "--method", "hybrid", "--out", tmp_path / "plain.h5")
    found = object_of(
        run, *words, "--refine", prior, "--iterations", 8, "--out", tmp_path / "refined.h5"
    )
    assert (found["method"], found["refine"], found["iterations"]) == ("hybrid", prior, 8)
    assert found["stopped_because"] == "iteration limit"
    plain, refined = (Volume.load(tmp_path / f"{name}.h5") for name in ("plain", "refined"))
    assert refined.values.min() >= 0
    assert energy_near_the_point(refined) > 1.5 * energy_near_the_point(plain)
    assert [found["peak_m"][axis] for axis in "xyz"] == pytest.approx(POINT, abs=0.03)
    reported = (tmp_path / "refined.toml").read_text()
    assert f'refine = "{prior}"\niterations = 8\nprior_weight = 0.02\n' in reported


def test_photons_gather_the_light(run: Run, tmp_path: Path) -> None:
    """One photon and a half for each wall point and thing hidden, and ten of background."""
    words = ["--points", "0.1,0.05,0.7; -0.3,0.2,0.9", "--wall-points", 16, "--peak-counts", 4]
    made = run("nlos", "simulate", *words, "--background", 0.03, "--out", tmp_path / "counts.h5")
    assert made.status == 0
    box = ["--x-m", -0.5, 0.5, "--y-m", -0.4, 0.4, "--near-m", 0.5, "--far-m", 1.1, "--everywhere"]
    words = ["reconstruct", tmp_path / "counts.h5", *box, "--voxel-mm", 40]
    object_of(run, *words, "--out", tmp_path / "plain.h5")
    found = object_of(run, *words, "--refine", "photons", "--out", tmp_path / "refined.h5")
    assert (found["refine"], found["iterations"]) == ("photons", 12)
    truth = HiddenTruth(np.array([[0.1, 0.05, 0.7], [-0.3, 0.2, 0.9]]), 0.0)
    plain, refined = (
        compare_with_truth(Volume.load(tmp_path / f"{name}.h5"), truth)["energy_near_truth"]
        for name in ("plain", "refined")
    )
    assert refined > 0.7 > 0.3 > plain
    assert (
        'refine = "photons"\niterations = 12\nprior_weight = 1.0\n'
        in (tmp_path / "refined.toml").read_text()
    )


def test_its_settings_give_the_same_volume(run: Run, curved: Path, tmp_path: Path) -> None:
    (tmp_path / "mine.toml").write_text(
        "refine = 'l1'\niterations = 2\nprior_weight = 0.1\nvoxel_mm = 30\n"
    )
    words = ["reconstruct", curved, "--wavelength-mm", 200]
    object_of(run, *words, *BOX, "--settings", tmp_path / "mine.toml", "--out", tmp_path / "one.h5")
    object_of(
        run,
        "reconstruct",
        curved,
        "--settings",
        tmp_path / "one.toml",
        "--out",
        tmp_path / "two.h5",
    )
    one, two = (Volume.load(tmp_path / f"{name}.h5") for name in ("one", "two"))
    np.testing.assert_array_equal(one.values, two.values)


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (["--refine", "l1", "--wavelength-mm", 100, "--voxel-mm", 50], "too coarse to refine"),
    ],
)
def test_what_makes_no_sense_is_refused(
    run: Run, curved: Path, tmp_path: Path, words: list[object], reason: str
) -> None:
    refused = run("nlos", "reconstruct", curved, *BOX, *words, "--out", tmp_path / "volume.h5")
    assert refused.status == 2
    assert reason in refused.err.splitlines()[-1]
    assert list(tmp_path.iterdir()) == []


def test_it_stays_with_the_compiled_loops(run: Run, curved: Path, tmp_path: Path) -> None:
    pytest.importorskip("torch")
    words = [
        "reconstruct",
        curved,
        *BOX,
        "--voxel-mm",
        50,
        "--wavelength-mm",
        300,
        "--refine",
        "l1",
        "--iterations",
        1,
    ]
    refused = run("nlos", *words, "--out", tmp_path / "volume.h5", "--device", "torch:cpu")
    assert refused.status == 2
    assert "iterative refinement works on NumPy arrays only" in refused.err
    assert (
        object_of(run, *words, "--out", tmp_path / "volume.h5", "--device", "auto")["device"]
        == "cpu"
    )
