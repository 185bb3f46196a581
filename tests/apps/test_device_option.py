"""`--device`: the same files from arrays elsewhere; PyTorch on this processor stands in for a
graphics processor.
"""

import shutil
from pathlib import Path

import numpy as np
import pytest

from nlos import Volume
from tofclip import Frames, arrays, recover

torch = pytest.importorskip("torch", reason="PyTorch is optional")
torch.set_num_threads(1)  # waking others up takes longer than what there is to do

DEVICES = {"cpu": "cpu", "torch": "torch:cpu"}


@pytest.fixture
def _no_graphics(monkeypatch):
    monkeypatch.setattr(arrays, "GRAPHICS_LIBRARIES", ("a_library_that_nobody_has",))


def test_frames_of_a_file_to_a_cloud(shell, streak):
    recover(streak, method="l1").save("frames.h5")
    here, there = (
        shell.figures(f"cloud frames.h5 --out {name}.npz --device {device}")
        for name, device in DEVICES.items()
    )
    assert (there["device"], here["device"]) == ("torch:cpu", "cpu")
    assert there["points"] == here["points"] > 50
    np.testing.assert_allclose(there["range_m"], here["range_m"], atol=1e-5)


def test_a_folder_belongs_to_one_device(shell, files):
    Path("shots").mkdir()
    shutil.copy(files / "streak.h5", "shots")
    line = "recover shots --out frames --method linear"
    assert shell.figures(f"{line} --device torch:cpu")["device"] == "torch:cpu"
    assert Frames.load("frames/streak.h5").figures["device"] == "torch:cpu"
    shell.refuses(line, "device torch:cpu instead of None")
    for clouds, device in DEVICES.items():
        found = shell.figures(f"cloud frames --out {clouds} --device {device}")
        assert (found["results"], found["device"]) == (1, device)


def test_what_has_compiled_loops_only_says_so(shell):
    line = "nlos reconstruct {confocal} --method lct --voxel-mm 40 --out volume.h5 --device"
    assert "--device cpu" in shell.refuses(f"{line} torch:cpu", "NumPy arrays only")
    assert shell.figures(f"{line} auto")["device"] == "cpu"


@pytest.mark.nightly
def test_the_name_travels_with_a_folders_jobs(shell, curved):
    words = "--out volumes --voxel-mm 80 --device torch:cpu"
    shell.figures(f"nlos reconstruct {{curved.parent}} {words}")
    volume = Volume.load(f"volumes/{curved.stem}.h5")
    assert volume.provenance["settings"]["device"] == "torch:cpu"


@pytest.mark.usefixtures("_no_graphics")
@pytest.mark.parametrize("device", ["cuda", "cuda:1", "gpu", "torch:nonsense"])
@pytest.mark.parametrize(
    "line",
    ["recover {files}/streak.h5", "cloud {files}/streak.h5", "nlos reconstruct {curved}"],
)
def test_a_device_that_is_not_there_is_refused_in_one_line(shell, line, device):
    shell.refuses(f"{line} --out out.h5 --device {device}", "cpu")
    assert not list(Path().iterdir())


@pytest.mark.usefixtures("_no_graphics")
def test_auto_is_this_processor_where_there_is_no_other(shell):
    words = "recover {files}/streak.h5 --out frames.h5 --method adjoint --device auto"
    assert shell.figures(words)["device"] == "cpu"
    assert shell.figures("cloud frames.h5 --out cloud.ply --device auto")["device"] == "cpu"
