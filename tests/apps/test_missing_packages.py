"""The program without one of the packages that it installs: one line says which, where it is
needed, and everything else works.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

import tofclip
from tofclip.files import describe_missing_package

ROOT = Path(tofclip.__file__).parents[1]
LONGEST_WAIT_S = 120.0
Run = Callable[..., subprocess.CompletedProcess[str]]
ABSENT = """
import os, sys
class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in os.environ["ABSENT"].split():
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
sys.meta_path.insert(0, Absent())
"""


@pytest.fixture(scope="module")
def run_without(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Run the program where some packages cannot be imported, by it or by what it starts."""
    folder = tmp_path_factory.mktemp("absent")
    (folder / "sitecustomize.py").write_text(ABSENT)

    def run(packages: str, *words: object) -> subprocess.CompletedProcess[str]:
        path = f"{folder}{os.pathsep}{ROOT}"
        return subprocess.run(
            [sys.executable, "-m", "tofclip", *map(str, words)],
            cwd=ROOT,
            env={**os.environ, "PYTHONPATH": path, "ABSENT": packages},
            capture_output=True,
            text=True,
            timeout=LONGEST_WAIT_S,
            check=False,
        )

    return run


RECOVER = ("recover", "{files}/streak.h5", "--out", "{new}/frames.h5", "--method", "linear")
CLOUD = ("cloud", "{frames}", "--out", "{new}/scene.ply")
NEEDED = {
    "h5py": ("h5py", ("info", "{files}/camera.h5")),
    "matplotlib": ("matplotlib", RECOVER),
    "numba": ("numba", RECOVER),
    "numpy": ("numpy", ("info", "{files}/camera.h5")),
    "open3d": (
        None,
        (*CLOUD, "--drop-outliers"),
    ),  # it fits planes and finds normals, in Python only
    "OpenEXR": ("OpenEXR", ("cloud", "{frames}", "--out", "{new}/depth.exr")),
    "pyfftw": (None, ("info", "{files}/camera.h5")),  # images: tests/nlos/test_diffraction.py
    "pyvista": (None, ("view", "{frames}", "--png", "{new}/view.png")),
    "scipy": ("scipy", RECOVER),
    "tifffile": ("tifffile", ("info", "{files}/streak.tif")),
    "typer": ("typer", ("--version",)),
    "usb": ("pyusb", ("devices", "info", "timetag://1")),
    "viser": ("viser", ("view", "{frames}", "--no-browser")),
}
"""For each package, a command that needs it and the name to install, or None if it works without."""


@pytest.fixture(scope="module")
def frames(files: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("frames") / "frames.h5"
    tofclip.recover(tofclip.read_streak(files / "streak.h5"), method="linear").save(out)
    return out


@pytest.mark.parametrize("package", NEEDED)
def test_without_a_package(
    run_without: Run, package: str, files: Path, frames: Path, tmp_path: Path
) -> None:
    distribution, words = NEEDED[package]
    done = run_without(
        package, *(word.format(files=files, frames=frames, new=tmp_path) for word in words)
    )
    if distribution is None:
        assert (done.returncode, done.stderr) == (0, "")
    else:
        assert (done.returncode, done.stderr.count("\n")) == (2, 1), done.stderr
        assert done.stderr.startswith("tofclip: error: ")
        assert f"install {distribution}" in done.stderr
        assert "unforeseen" not in done.stderr


def test_help_needs_none_of_them(run_without: Run) -> None:
    done = run_without(" ".join(set(NEEDED) - {"typer"}), "--help")
    assert (done.returncode, done.stderr) == (0, "")
    assert "recover" in done.stdout


def test_a_module_of_our_own_that_is_missing_is_a_defect() -> None:
    assert describe_missing_package(ModuleNotFoundError("gone", name="tofclip.gone")) is None
    assert describe_missing_package(ImportError("no name")) is None
    broken = describe_missing_package(ImportError("libGL.so.1: not found", name="pyvista"))
    assert broken == "the package 'pyvista' does not load on this machine: libGL.so.1: not found"
