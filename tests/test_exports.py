"""The public names are pinned, and importing them costs nothing until they are used."""

from __future__ import annotations

import importlib
import inspect
import pkgutil
import re
import subprocess
import sys
import typing
from collections.abc import Iterator
from pathlib import Path
from typing import Any

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
    "tofclip.io": ["StreakStack", "read_streak", "save_stack"],
    "tofclip.shots": ["Frames", "Returns", "Streak"],
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


ROOTS = ("tofclip", "nlos", "devices")
API_PAGES = Path(__file__).parents[1] / "docs" / "api"


def public_names() -> dict[str, Any]:
    """What packages list in ``__all__`` and what the pages of the API document, by full name."""
    found: dict[str, Any] = {}
    for root in ROOTS:
        home = importlib.import_module(root)
        packages = [
            item.name for item in pkgutil.walk_packages(home.__path__, f"{root}.") if item.ispkg
        ]
        for package in (root, *packages):
            module = importlib.import_module(package)
            found |= {
                f"{package}.{name}": getattr(module, name)
                for name in getattr(module, "__all__", ())
            }
    text = "".join(page.read_text("utf-8") for page in API_PAGES.glob("*.md"))
    for name in re.findall(r"automodule:: (\S+)", text):
        module = importlib.import_module(name)
        own = [
            one for one, value in vars(module).items() if getattr(value, "__module__", "") == name
        ]
        for one in getattr(module, "__all__", own):
            if not one.startswith("_"):
                found[f"{name}.{one}"] = getattr(module, one)
    for name in re.findall(r"auto(?:class|function):: (\S+)", text):
        module, _, one = name.rpartition(".")
        found[name] = getattr(importlib.import_module(module), one)
    return found


def signatures(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    """The annotated things that a public name consists of: itself, and a class's public methods."""
    if inspect.isclass(value) or inspect.isfunction(value):
        yield name, value
    if inspect.isclass(value):
        for own, member in vars(value).items():
            function = (
                member.fget if isinstance(member, property) else getattr(member, "__func__", member)
            )
            if inspect.isfunction(function) and (own in ("__init__", "__call__") or own[0] != "_"):
                yield f"{name}.{own}", function


def parts(annotation: Any) -> Iterator[Any]:
    """A type and all that it is made of."""
    yield annotation
    for part in typing.get_args(annotation):
        yield from (
            (one for item in part for one in parts(item)) if isinstance(part, list) else parts(part)
        )


def test_every_type_in_a_public_signature_can_be_imported_from_a_public_place() -> None:
    names = public_names()
    public = {id(value) for value in names.values()}
    # For annotations that are imported for the type checker only.
    by_name = {name.rpartition(".")[2]: value for name, value in names.items()}
    by_name |= {name: importlib.import_module(name) for name in ("h5py", "scipy")}
    hidden: dict[str, str] = {}
    audited = 0
    for name, value in names.items():
        if not str(getattr(value, "__module__", "")).startswith(ROOTS):
            continue
        for where, item in signatures(name, value):
            own = vars(sys.modules[item.__module__])
            scope = {key: one for key, one in by_name.items() if key not in own}
            hints = typing.get_type_hints(item, localns=scope)
            audited += 1
            for one in (part for hint in hints.values() for part in parts(hint)):
                if (
                    isinstance(one, type)
                    and one.__module__.startswith(ROOTS)
                    and id(one) not in public
                ):
                    hidden[f"{one.__module__}.{one.__qualname__}"] = where
    assert audited > 800
    assert not hidden
