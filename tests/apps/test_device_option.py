"""`--device`: the same files from arrays elsewhere; PyTorch on this processor stands in for a
graphics processor.
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from small_instrument import Run

from tofclip import Frames, PointCloud, Streak, arrays, recover
from tofclip.recovery import DepthLockedFocus, Focus, SharpestFocus


@pytest.fixture(scope="module")
def torch() -> Any:
    library = pytest.importorskip("torch", reason="PyTorch is optional")
    library.set_num_threads(1)  # waking others up takes longer than what there is to do
    return library


@pytest.fixture
def no_graphics(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(arrays, "GRAPHICS_LIBRARIES", ("a_library_that_nobody_has",))


def object_of(run: Run, *words: object) -> dict[str, Any]:
    outcome = run(*words, "--json")
    assert (outcome.status, outcome.err) == (0, ""), outcome.out
    found: dict[str, Any] = json.loads(outcome.out)
    return found


def difference(found: Frames, expected: Frames) -> float:
    return float(np.linalg.norm(found.values - expected.values) / np.linalg.norm(expected.values))


@pytest.mark.usefixtures("torch")
@pytest.mark.parametrize("method", ["tv", "linear"])
def test_frames_and_cloud_are_those_of_the_compiled_loops(
    run: Run, files: Path, tmp_path: Path, method: str
) -> None:
    frames, points, devices = {}, {}, {}
    for device in ("cpu", "torch:cpu"):
        out, cloud = (tmp_path / f"{device.replace(':', '-')}{end}" for end in (".h5", ".npz"))
        words = ("--method", method, "--cloud", cloud, "--device", device)
        found = object_of(run, "recover", files / "streak.h5", "--out", out, *words)
        frames[device], points[device] = Frames.load(out), PointCloud.load(cloud)
        devices[device] = found["device"], frames[device].figures["device"]
    assert devices == {"cpu": ("cpu", "cpu"), "torch:cpu": ("torch:cpu", "torch:cpu")}
    there, here = frames["torch:cpu"], frames["cpu"]
    assert (
        difference(there, here) < 1e-4
    )  # what is promised; sums in another order differ by some 1e-6
    for name in ("iterations", "stopped_because"):
        assert there.figures[name] == here.figures[name]
    assert there.figures["relative_residual"] == pytest.approx(
        here.figures["relative_residual"], rel=1e-4
    )
    # Many points share one estimate of their false alarms, which may fall on either side of the limit.
    limit = {"tv": 0.4, "linear": np.inf}[method]
    sure = {device: cloud[~(cloud.false_alarm >= limit)] for device, cloud in points.items()}
    assert 100 < len(sure["cpu"]) == len(sure["torch:cpu"])
    off = np.abs(sure["torch:cpu"].range - sure["cpu"].range)
    # Compiled loops fit lone returns by a table of phases, which errs by less than a tenth of their
    # own deviation; a tenth of a millimetre is for sums in another order.
    assert np.all(off < 1e-4 + 0.1 * sure["cpu"].range_sigma)


@pytest.mark.usefixtures("torch")
def test_frames_of_a_file_to_a_cloud(run: Run, files: Path, streak: Streak, tmp_path: Path) -> None:
    recover(streak, method="l1").save(tmp_path / "frames.h5")
    reported = {}
    for device in ("cpu", "torch:cpu"):
        out = tmp_path / f"{device[:3]}.npz"
        reported[device] = object_of(
            run, "cloud", tmp_path / "frames.h5", "--out", out, "--device", device
        )
    there, here = reported["torch:cpu"], reported["cpu"]
    assert (there.pop("device"), here.pop("device")) == ("torch:cpu", "cpu")
    assert there["points"] == here["points"] > 50
    np.testing.assert_allclose(there["range_m"], here["range_m"], atol=1e-5)


@pytest.mark.usefixtures("torch")
@pytest.mark.parametrize("focus", [DepthLockedFocus(), SharpestFocus(-0.2, 0.2, 2)], ids=str)
@pytest.mark.parametrize("method", ["l1", "linear"])
def test_pieces_of_their_own_shear(streak: Streak, focus: Focus, method: str) -> None:
    assert streak.camera is not None
    shot = Streak(streak.counts, camera=streak.camera.replace(lenslet_pitch=1e-3)).with_bin_width(
        20e-12
    )
    here, there = (
        recover(shot, method=method, focus=focus, device=device) for device in ("cpu", "torch:cpu")
    )
    assert len(set(here.shears)) > 1
    np.testing.assert_array_equal(there.shears, here.shears)
    assert difference(there, here) < 1e-4


@pytest.mark.usefixtures("torch")
def test_a_folder_belongs_to_one_device(run: Run, files: Path, tmp_path: Path) -> None:
    shots = tmp_path / "shots"
    shots.mkdir()
    shutil.copy(files / "streak.h5", shots)
    words = ("recover", shots, "--out", tmp_path / "frames", "--method", "linear")
    assert object_of(run, *words, "--device", "torch:cpu")["device"] == "torch:cpu"
    assert Frames.load(tmp_path / "frames" / "streak.h5").figures["device"] == "torch:cpu"
    outcome = run(*words)
    assert outcome.status == 2
    assert "device torch:cpu instead of None" in outcome.err
    for clouds, device in (("clouds", "torch:cpu"), ("more", "cpu")):
        found = object_of(
            run, "cloud", tmp_path / "frames", "--out", tmp_path / clouds, "--device", device
        )
        assert (found["results"], found["device"]) == (1, device)


@pytest.mark.usefixtures("no_graphics")
@pytest.mark.parametrize("verb", ["recover", "cloud"])
@pytest.mark.parametrize("device", ["cuda", "cuda:1", "gpu", "torch:nonsense"])
def test_a_device_that_is_not_there_is_refused_in_one_line(
    run: Run, files: Path, tmp_path: Path, verb: str, device: str
) -> None:
    outcome = run(verb, files / "streak.h5", "--out", tmp_path / "frames.h5", "--device", device)
    assert (outcome.status, outcome.out, outcome.err.count("\n")) == (2, "", 1)
    assert "cpu" in outcome.err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.usefixtures("no_graphics")
def test_auto_is_this_processor_where_there_is_no_other(
    run: Run, files: Path, tmp_path: Path
) -> None:
    words = ("recover", files / "streak.h5", "--out", tmp_path / "frames.h5", "--method", "adjoint")
    assert object_of(run, *words, "--device", "auto")["device"] == "cpu"
    words = ("cloud", tmp_path / "frames.h5", "--out", tmp_path / "cloud.ply")
    assert object_of(run, *words, "--device", "auto")["device"] == "cpu"
