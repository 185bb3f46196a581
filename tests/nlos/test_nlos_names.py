from __future__ import annotations

import subprocess
import sys

import pytest

import nlos


def test_public_names() -> None:
    methods = {"Backprojection", "FKMigration", "FilteredBackprojection", "LightCone"}
    assert {"Capture", "Grid", "Volume", *methods} <= set(nlos.__all__)
    for name in nlos.__all__:
        assert getattr(nlos, name).__name__ == name
        assert name in dir(nlos)
    with pytest.raises(AttributeError, match="No nlos attribute Telepathy"):
        _ = nlos.Telepathy


def test_importing_the_package_loads_nothing_heavy() -> None:
    heavy = "numba", "scipy", "matplotlib", "h5py", "numpy"
    code = f"import sys, nlos; print([m for m in {heavy!r} if m in sys.modules])"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "[]"
