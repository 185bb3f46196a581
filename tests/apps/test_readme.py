"""The README's commands do what it says, on the files of a small instrument."""

from __future__ import annotations

import os
import re
import shlex
import shutil
from pathlib import Path

import numpy as np
import pytest
from small_instrument import Run

import tofclip
from devices import aravis
from nlos import backprojection
from nlos.phasor import arrays as library
from nlos.phasor import to_depths as diffraction
from tofclip.solvers import methods

ROOT = Path(tofclip.__file__).parents[1]
README = ROOT / "README.md"


def commands(start: str) -> list[str]:
    """Lines of the README's shell blocks that begin with `start`."""
    blocks = re.findall(r"```sh\n(.*?)```", README.read_text(encoding="utf-8"), flags=re.DOTALL)
    return [line for block in blocks for line in block.splitlines() if line.startswith(start)]


def write_light_field(path: Path) -> None:
    """A bright card on a dark ground, without parallax, in 8 x 8 views."""
    card = np.zeros((48, 48), np.uint16)
    card[14:34, 16:30] = 60000
    steps = np.arange(-4, 4)
    np.savez(path, lf=np.tile(card, (8, 8, 1, 1)), scale=1 / 65535, v=steps, u=steps)


def write_photons(path: Path) -> None:
    """A wall at bin 60, 5 signal photons a pixel."""
    noise = np.random.default_rng(0)
    cube = noise.poisson(0.05, (24, 32, 150))
    cube[..., 57:64] += noise.poisson(0.7, (24, 32, 7))
    np.save(path, cube.astype(np.uint8))


MEMORY = re.compile(r"(?<![\d.])(\d[\d.,]*)\s+([KMG]i?B)\b(?!/s)")
LIMITS = {
    "docs/gpu.md": {"2 GiB": methods.WORKING_BYTES},
    "docs/nlos.md": {
        "32 MiB": backprojection.TABLE_BYTES,
        "8 MiB": library.CPU_CHUNK_BYTES,
        "256 MiB": library.GPU_CHUNK_BYTES,
        "1 GiB": diffraction.MAX_CACHE_BYTES,
    },
    "docs/instruments/aravis.md": {"64 MiB": aravis.HELD_BYTES},
}
"""Memory that a page does not measure but promises never to exceed: what the code has for it."""
BYTES = {"MiB": 1 << 20, "GiB": 1 << 30}


def read_prose(name: str) -> str:
    """A page without its commands."""
    return re.sub(r"```.*?```", "", (ROOT / name).read_text("utf-8"), flags=re.DOTALL)


def find_claims(pattern: re.Pattern[str], text: str) -> set[str]:
    return {f"{number} {unit}" for number, unit in pattern.findall(text)}


def test_memory_limits_are_those_of_the_code() -> None:
    for name, limits in LIMITS.items():
        claims = find_claims(MEMORY, read_prose(name))
        assert set(limits) <= claims  # a limit that is not stated any more leaves the table
        for claim, limit in limits.items():
            number, unit = claim.split()
            assert int(number) * BYTES[unit] == limit, (name, claim)


def test_the_walk_through(
    run: Run, files: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("line", "line_background", "dot", "dot_background"):
        shutil.copy(files / f"{name}.tif", tmp_path)
    # A shot whose file has a time axis, under the README's names: files are known by content, not
    # by suffix.
    shutil.copy(files / "streak.h5", tmp_path / "shot.tif")
    shutil.copy(files / "wall.h5", tmp_path / "wall.npz")
    write_light_field(tmp_path / "light_field.npz")
    write_photons(tmp_path / "cube.npy")
    monkeypatch.chdir(tmp_path)
    walk = commands("tofclip ")
    assert len(walk) == 20
    for command in walk:
        outcome = run(*shlex.split(command)[1:])
        assert outcome.status == 0, command
        # The small wall hides nothing, and the program says that its brightest voxel is the wall's.
        expected_warnings = ["brightest voxel lies on the wall"] if "nlos recon" in command else []
        lines = outcome.err.splitlines()
        assert all(any(text in line for text in expected_warnings) for line in lines), command
    expected = "camera.h5 camera.png frames.h5 frames.png mip.png scene.ply volume.h5 wall.h5 wall_frames.h5"
    expected += " scene.png clouds occlusion-output nlos-demo-output"
    assert {
        *expected.split(),
        "measurements.h5",
        "picture.png",
        "run.h5",
        "photons.h5",
        "photons.ply",
        "range.npz",
    } <= {path.name for path in tmp_path.iterdir()}


def test_the_python_example(files: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.copy(files / "camera.h5", tmp_path)
    shutil.copy(files / "streak.h5", tmp_path / "shot.tif")
    wall = tofclip.recover(tofclip.read_streak(files / "wall.h5"), method="linear")
    wall.save(tmp_path / "wall_frames.h5")
    monkeypatch.chdir(tmp_path)
    code = re.search(r"```python\n(.*?)```", README.read_text(encoding="utf-8"), flags=re.DOTALL)
    assert code is not None
    (recover,) = commands("tofclip recover shot.tif")
    zero = shlex.split(recover)[-1]
    assert f"time_zero={zero}e-9" in code[1]  # the same ranges as by the commands
    names: dict[str, object] = {}
    exec(code[1], names)
    assert names["frames"].camera.time_zero == pytest.approx(float(zero) * 1e-9)  # type: ignore[attr-defined]
    assert Path("scene.ply").stat().st_size > 0
    assert names["volume"].values.shape == names["grid"].shape  # type: ignore[attr-defined]


def test_continuous_integration_runs_the_readmes_test_command() -> None:
    promised = next(line for line in commands("python3 -m venv") if "pytest" in line).split(" && ")
    script = (ROOT / ".ci" / "run").read_text(encoding="utf-8")
    assert promised[0] in script
    assert script.rstrip().endswith(promised[-1])  # last, so that its summary is the last line


@pytest.mark.skipif("PYTEST_XDIST_WORKER" not in os.environ, reason="one process has no workers")
def test_the_tests_of_a_file_stay_on_one_worker(request: pytest.FixtureRequest) -> None:
    # what the scheduler of pytest-xdist goes by: not added with pytest 9.2
    assert request.node.nodeid.endswith("@test_readme")


def test_the_picture_is_there_and_small() -> None:
    with open(ROOT / "docs" / "pictures" / "gallery" / "preview.png", "rb") as file:
        assert file.read(8) == b"\x89PNG\r\n\x1a\n"
    assert (ROOT / "docs" / "pictures" / "gallery" / "preview.png").stat().st_size < 300_000
