"""Sections of docstrings (Parameters, Returns, Raises...) stand where users read them, and only there.

Public are the names that packages export, what their signatures take and return, and the public
methods of these. Internals say in a sentence or two what one cannot see.
"""

from __future__ import annotations

import ast
import inspect
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from test_exports import list_packages, list_signature_types, public_names

import tofclip

ROOT = Path(tofclip.__file__).parents[1]
SECTION = re.compile(
    r"^ *(Parameters|Returns|Yields|Raises|Attributes|Notes|See Also)\n *-{3,}", re.M
)
PACKAGES = ("tofclip", "nlos", "devices", "apps")


@pytest.fixture(scope="module")
def public() -> dict[str, Any]:
    """Public names by the place where they are defined."""
    packages, names = set(list_packages()), public_names()
    exported = {name: one for name, one in names.items() if name.rpartition(".")[0] in packages}
    reached = [
        one
        for where, one in list_signature_types(names)
        if where in exported or where.rpartition(".")[0] in exported
    ]
    found = [one for one in (*exported.values(), *reached) if hasattr(one, "__qualname__")]
    return {f"{one.__module__}.{one.__qualname__}": one for one in found}


def list_docstrings() -> Iterator[tuple[str, str]]:
    """Every docstring with the full name that it belongs to."""
    for path in (path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))):
        module = ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
        yield from walk(ast.parse(path.read_text("utf-8")), module)


def walk(node: ast.AST, name: str) -> Iterator[tuple[str, str]]:
    documented = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    if isinstance(node, documented):
        yield name, ast.get_docstring(node) or ""
    for child in ast.iter_child_nodes(node):
        own = f"{name}.{child.name}" if isinstance(child, documented[1:]) else name
        yield from walk(child, own)


def is_public(name: str, public: dict[str, Any]) -> bool:
    """A public name, or a method of one that is not private."""
    home, _, own = name.rpartition(".")
    return name in public or (home in public and (own[0] != "_" or own.startswith("__")))


@pytest.mark.xfail(reason="docstrings of some internals have sections still", strict=False)
def test_sections_stand_in_public_names_only(public: dict[str, Any]) -> None:
    wrong = [
        name
        for name, text in list_docstrings()
        if SECTION.search(text) and not is_public(name, public)
    ]
    assert not wrong, f"{len(wrong)}: {', '.join(wrong[:20])}, ..."


def list_undocumented(name: str, value: Any) -> Iterator[str]:
    """Arguments that no Parameters section names; a class may describe those of its fields anywhere."""
    if inspect.isclass(value):
        described = inspect.getdoc(value) or ""
        functions = {own: one for own, one in vars(value).items() if own[0] != "_"}
        functions = {own: getattr(one, "__func__", one) for own, one in functions.items()}
        own_fields = "\n".join(filter(None, (inspect.getdoc(base) for base in value.__mro__[:-1])))
        fields = getattr(value, "__dataclass_fields__", {})
        yield from (
            f"{name}({field})"
            for field, one in fields.items()
            if one.init
            and field[0] != "_"
            and not re.search(rf"\b{field}\b", described + own_fields)
        )
    else:
        functions = {"": value}
    for own, function in functions.items():
        if not inspect.isfunction(function):
            continue
        text = inspect.getdoc(function) or ""
        if own and inspect.isclass(value):  # an overridden method has the docstring of its base
            text = inspect.getdoc(getattr(value, own)) or ""
        for one in inspect.signature(function).parameters:
            if one not in ("self", "cls") and not re.search(
                rf"^ *\**[\w, *]*\b{one}\b[\w, *]*( : |$)", text, re.M
            ):
                yield f"{name}{'.' * bool(own)}{own}({one})"


@pytest.mark.xfail(
    reason="arguments of public names are not all in a Parameters section yet",
    strict=False,
)
def test_every_public_name_has_its_parameters_documented(public: dict[str, Any]) -> None:
    missing = [
        line
        for name, value in public.items()
        if inspect.isclass(value) or inspect.isfunction(value)
        for line in list_undocumented(name, value)
    ]
    assert not missing, f"{len(missing)}: {', '.join(missing[:40])}, ..."
