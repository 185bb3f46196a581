"""The pages of the Python interface name what there is."""

from __future__ import annotations

import importlib
import pkgutil
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

import devices
import nlos
import tofclip

API = Path(tofclip.__file__).parents[1] / "docs" / "api"
PAGES = "\n".join(page.read_text(encoding="utf-8") for page in sorted(API.glob("*.md")))
SHOWN = re.findall(r"automodule:: (\S+)", PAGES)
WITHOUT_PAGE = {"apps.studies"}  # its verb, reproduce, tells what it makes


def public_rooms() -> list[str]:
    return list(_found())


def _found() -> Iterator[str]:
    for package in (tofclip, nlos, devices):
        yield package.__name__
        for room in pkgutil.iter_modules(package.__path__, f"{package.__name__}."):
            if room.ispkg and getattr(importlib.import_module(room.name), "__all__", None):
                yield room.name


@pytest.mark.parametrize("room", public_rooms())
def test_every_room_with_public_names_has_a_page(room: str) -> None:
    assert room in SHOWN or room in WITHOUT_PAGE


@pytest.mark.parametrize("module", SHOWN)
def test_what_a_page_shows_exists(module: str) -> None:
    assert importlib.import_module(module).__doc__


def test_names_of_the_package_itself_are_listed() -> None:
    listed = set(re.findall(r"`tofclip\.(\w+) <", PAGES))
    assert listed == set(tofclip.__all__) - {"__version__"}


def test_signatures_are_short_and_sentences_stay_sentences() -> None:
    conf = pytest.importorskip("conf", reason="pages: pip install 'tofclip[docs]'")
    array = "~numpy.ndarray[tuple[~typing.Any, ...], ~numpy.dtype[~numpy.float64]]"
    assert conf.shorten_signature(
        None, "class", "", None, None, f"(x: {array} = <factory>)", array
    ) == (
        "(x: ~numpy.typing.NDArray[~numpy.float64] = ...)",
        "~numpy.typing.NDArray[~numpy.float64]",
    )
    lines = ["Where it lives: library and device.", "", "    m.", "    R. Bach, 1750."]
    conf.protect_plain_text(None, "property", "", None, None, lines)
    assert lines == [
        "Where it lives -- library and device.",
        "",
        r"    \m.",
        r"    \R. Bach, 1750.",
    ]
