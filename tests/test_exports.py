"""The public names are pinned, and importing them costs nothing until they are used."""

from __future__ import annotations

import importlib
import subprocess
import sys

import pytest

NAMES = {
    "tofclip": [
        "Camera",
        "Frames",
        "PointCloud",
        "Streak",
        "TofclipError",
        "__version__",
        "depth",
        "load",
        "nmse",
        "point_cloud",
        "read_streak",
        "recover",
    ],
    "tofclip.io": ["read_streak"],
    "tofclip.shots": ["Frames", "Streak"],
    "nlos": [
        "Backprojection",
        "Capture",
        "FKMigration",
        "FilteredBackprojection",
        "Grid",
        "Hybrid",
        "LightCone",
        "Method",
        "Plan",
        "PlanarRSD",
        "Refinement",
        "Settings",
        "TransientImaging",
        "TransientVideo",
        "Volume",
        "propagate",
        "settings_for",
    ],
}
HEAVY = {"h5py", "matplotlib", "numba", "numpy", "open3d", "pyvista", "scipy", "tifffile"}


@pytest.mark.parametrize("module", NAMES)
def test_public_names(module: str) -> None:
    home = importlib.import_module(module)
    assert sorted(home.__all__) == NAMES[module]
    for name in home.__all__:
        assert getattr(home, name) is not None
        assert name in dir(home)


@pytest.mark.parametrize("module", ["tofclip", "nlos", "devices"])
def test_a_list_of_names_shows_the_public_ones_only(module: str) -> None:
    home = importlib.import_module(module)
    assert dir(home) == sorted(home.__all__)


@pytest.mark.parametrize("module", ["tofclip", "nlos"])
def test_an_unknown_name_is_an_attribute_error(module: str) -> None:
    with pytest.raises(AttributeError, match=f"{module} attribute lidar_magic"):
        _ = importlib.import_module(module).lidar_magic


def test_importing_the_packages_imports_nothing_heavy() -> None:
    listing = subprocess.run(
        [sys.executable, "-c", "import sys, tofclip, nlos; print(*sys.modules)"],
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    ).stdout.split()
    assert {"tofclip", "nlos"} <= set(listing)
    assert not HEAVY & set(listing)


def test_reading_a_streak_image_imports_no_compiler() -> None:
    """Reading has to be quick: neither numba nor scipy nor a plotting library is needed for it."""
    listing = subprocess.run(
        [sys.executable, "-c", "import sys, tofclip.io; print(*sys.modules)"],
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    ).stdout.split()
    assert not (HEAVY - {"numpy"}) & set(listing)
