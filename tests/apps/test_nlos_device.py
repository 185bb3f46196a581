"""`tofclip nlos reconstruct --device`: the same images wherever they are computed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hidden_point import object_of
from small_instrument import Run

from nlos import Volume

torch = pytest.importorskip("torch")

AGREEMENT = 1e-4
"""Promised; see the tests of nlos.portable for how near they are."""
WITHOUT_A_GRAPHICS_PROCESSOR = pytest.mark.skipif(
    torch.cuda.is_available(), reason="there is a graphics processor"
)


def imaged(run: Run, capture: Path, out: Path, *more: object) -> tuple[dict[str, object], Volume]:
    found = object_of(run, "reconstruct", capture, "--out", out, "--voxel-mm", 40, *more)
    return found, Volume.load(out)


@pytest.mark.parametrize(
    ("fixture", "method"), [("confocal", "rsd"), ("curved", "hybrid"), ("curved", "backprojection")]
)
def test_the_image_is_the_same_elsewhere(
    run: Run, request: pytest.FixtureRequest, tmp_path: Path, fixture: str, method: str
) -> None:
    capture = request.getfixturevalue(fixture)
    here, expected = imaged(run, capture, tmp_path / "here.h5", "--method", method)
    there, found = imaged(
        run, capture, tmp_path / "there.h5", "--method", method, "--device", "torch:cpu"
    )
    assert (here["device"], there["device"]) == ("cpu", "torch:cpu")
    assert found.provenance["settings"]["device"] == "torch:cpu"
    assert here["peak_m"] == there["peak_m"]
    difference = np.linalg.norm(found.values - expected.values) / np.linalg.norm(expected.values)
    assert difference < AGREEMENT
    # Where it was computed is none of the settings that make the volume.
    assert (tmp_path / "here.toml").read_text() == (tmp_path / "there.toml").read_text()


def test_what_has_compiled_loops_only_says_so(run: Run, confocal: Path, tmp_path: Path) -> None:
    words = ["nlos", "reconstruct", confocal, "--method", "lct", "--out", tmp_path / "volume.h5"]
    refused = run(*words, "--device", "torch:cpu")
    assert refused.status == 2
    assert "NumPy arrays only" in refused.err
    assert "--device cpu" in refused.err
    assert refused.err.count("\n") == 1
    found, _ = imaged(run, confocal, tmp_path / "volume.h5", "--method", "lct", "--device", "auto")
    assert found["device"] == "cpu"


@pytest.mark.parametrize(
    ("device", "reason"),
    [
        pytest.param("cuda", "no CUDA device 0 was found", marks=WITHOUT_A_GRAPHICS_PROCESSOR),
        pytest.param("cuda:3", "no CUDA device 3 was found", marks=WITHOUT_A_GRAPHICS_PROCESSOR),
        ("abacus", "'abacus' is not a device"),
        ("torch:abacus", "PyTorch finds no device 'abacus'"),
    ],
)
def test_a_device_that_is_not_there_is_refused_at_once(
    run: Run, curved: Path, tmp_path: Path, device: str, reason: str
) -> None:
    refused = run(
        "nlos", "reconstruct", curved, "--out", tmp_path / "volume.h5", "--device", device
    )
    assert refused.status == 2
    assert reason in refused.err
    assert refused.err.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_the_name_travels_with_a_folders_jobs(run: Run, curved: Path, tmp_path: Path) -> None:
    object_of(
        run,
        *("reconstruct", curved.parent, "--out", tmp_path / "volumes"),
        *("--voxel-mm", 80, "--device", "torch:cpu"),
    )
    volume = Volume.load(tmp_path / "volumes" / f"{curved.stem}.h5")
    assert volume.provenance["settings"]["device"] == "torch:cpu"
