"""The public names are pinned, and importing them costs nothing until they are used."""

from __future__ import annotations

import ast
import doctest
import importlib
import inspect
import io
import pkgutil
import re
import subprocess
import sys
import typing
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest

ROOTS = ("tofclip", "nlos", "devices")
GOLDEN = Path(__file__).parent / "golden" / "names.txt"
CONTRACT = (
    *("tofclip.read_streak", "tofclip.recover", "tofclip.depth", "tofclip.point_cloud"),
    *("tofclip.nmse", "tofclip.load", "tofclip.recovery.open_shot"),
    *("tofclip.Camera", "tofclip.Frames", "tofclip.PointCloud"),
    *("nlos.Capture", "nlos.Grid", "nlos.Volume", "nlos.settings_for"),
    *("nlos.Hybrid", "nlos.PlanarRSD", "nlos.Backprojection", "nlos.FilteredBackprojection"),
    *("nlos.LightCone", "nlos.FKMigration", "devices.open", "devices.discover"),
)
"""Names that users write most: their arguments are held too, and the members of the classes."""

OF_METHODS = ("plan", "reconstruct")
"""The members that are held of a method of imaging around corners."""
HEAVY = {"h5py", "matplotlib", "numba", "numpy", "open3d", "pyvista", "scipy", "tifffile"}


def list_packages() -> Iterator[str]:
    for root in ROOTS:
        home = importlib.import_module(root)
        yield root
        for item in pkgutil.walk_packages(home.__path__, f"{root}."):
            if item.ispkg:
                yield item.name


def show_signature(value: Any) -> str:
    """Names, kinds and defaults of arguments; types may be put more exactly."""
    plain = inspect.signature(value)
    shown = [one.replace(annotation=inspect.Parameter.empty) for one in plain.parameters.values()]
    text = str(plain.replace(parameters=shown, return_annotation=inspect.Signature.empty))
    return re.sub(r"<(?:function|class) '?([\w.]+)[^>]*>", r"\1", text)


def list_members(name: str, home: type) -> Iterator[str]:
    """A class's public methods and properties, inherited ones of this project included."""
    for one in OF_METHODS if hasattr(home, "reconstruct") else sorted(dir(home)):
        owner = next((base for base in home.__mro__ if one in vars(base)), object)
        if one[0] == "_" or not owner.__module__.startswith(ROOTS):
            continue
        member = inspect.getattr_static(home, one)
        function = getattr(home, one) if callable(getattr(home, one)) else None
        is_method = isinstance(member, staticmethod | classmethod) or inspect.isfunction(member)
        yield f"{name}.{one}{show_signature(function) if is_method else ''}"


def list_names() -> Iterator[str]:
    """What every package exports, then the contract in full."""
    for package in list_packages():
        module = importlib.import_module(package)
        for name in sorted(getattr(module, "__all__", ())):
            assert name in dir(module)
            assert getattr(module, name) is not None
            yield f"{package}.{name}"
    for name in CONTRACT:
        package, _, one = name.rpartition(".")
        value = getattr(importlib.import_module(package), one)
        yield f"{name}{show_signature(value)}"
        if inspect.isclass(value):
            yield from list_members(name, value)


def test_public_names_and_signatures_are_those_of_the_file() -> None:
    made, kept = [*list_names()], GOLDEN.read_text("utf-8").splitlines()
    changed = [f"lost  {line}" for line in kept if line not in made]
    changed += [f"new   {line}" for line in made if line not in kept]
    assert not changed, "\n".join([f"against tests/golden/{GOLDEN.name}:", *changed])


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


API_PAGES = Path(__file__).parents[1] / "docs" / "api"


def public_names() -> dict[str, Any]:
    """What packages list in ``__all__`` and what the pages of the API document, by full name."""
    found: dict[str, Any] = {}
    for package in list_packages():
        module = importlib.import_module(package)
        found |= {
            f"{package}.{name}": getattr(module, name) for name in getattr(module, "__all__", ())
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


def list_examples() -> Iterator[doctest.DocTest]:
    """Of all public names, each once: many are listed in several places."""
    found: dict[tuple[str | None, int | None], doctest.DocTest] = {}
    for name, value in public_names().items():
        if str(getattr(value, "__module__", "")).startswith(ROOTS):
            for test in doctest.DocTestFinder().find(value, name):
                found[test.filename, test.lineno] = test
    yield from (test for test in found.values() if test.examples)


def test_examples_do_what_they_say() -> None:
    """And of those that need a file of one's own, what they import and call is there."""
    tests = [*list_examples()]
    assert len(tests) > 10
    for test in tests:
        trouble = io.StringIO()
        doctest.DocTestRunner().run(test, out=trouble.write, clear_globs=False)
        assert not trouble.getvalue()
        for example in test.examples:
            if doctest.SKIP not in example.options:
                continue
            for node in ast.walk(ast.parse(example.source)):
                if isinstance(node, ast.Import | ast.ImportFrom):
                    exec(ast.unparse(node), test.globs)
                elif isinstance(node, ast.Call):
                    assert callable(eval(ast.unparse(node.func), test.globs)), test.name


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


def list_signature_types(names: Mapping[str, Any]) -> Iterator[tuple[str, type]]:
    """Types of our own in the signatures of public names, each with the place where it stands."""
    # For annotations that are imported for the type checker only.
    by_name = {name.rpartition(".")[2]: value for name, value in names.items()}
    by_name |= {name: importlib.import_module(name) for name in ("h5py", "scipy")}
    for name, value in names.items():
        if not str(getattr(value, "__module__", "")).startswith(ROOTS):
            continue
        for where, item in signatures(name, value):
            own = vars(sys.modules[item.__module__])
            scope = {key: one for key, one in by_name.items() if key not in own}
            hints = typing.get_type_hints(item, localns=scope)
            for one in (part for hint in hints.values() for part in parts(hint)):
                if isinstance(one, type) and one.__module__.startswith(ROOTS):
                    yield where, one


def test_every_type_in_a_public_signature_can_be_imported_from_a_public_place() -> None:
    names = public_names()
    public = {id(value) for value in names.values()}
    found = [*list_signature_types(names)]
    hidden = {
        f"{one.__module__}.{one.__qualname__}": where
        for where, one in found
        if id(one) not in public
    }
    assert len(found) > 700
    assert not hidden
