"""The pages of the Python interface and of the instruments name what there is, and the notebooks run
and show what their words say.
"""

import importlib
import io
import json
import pkgutil
import re
import shutil
from pathlib import Path

import pytest
from matplotlib.image import imread
from notebooks import format_page, run_notebook

import devices
import nlos
import tofclip
from devices.address import Options
from devices.registry import SOURCES, list_endings, list_schemes

DOCS = Path(tofclip.__file__).parents[1] / "docs"
API = "\n".join(page.read_text("utf-8") for page in sorted((DOCS / "api").glob("*.md")))
SHOWN = re.findall(r"automodule:: (\S+)", API)


def test_every_room_with_public_names_has_a_page_that_shows_what_exists():
    rooms = {"tofclip", "nlos", "devices"}
    for package in (tofclip, nlos, devices):
        found = pkgutil.iter_modules(package.__path__, f"{package.__name__}.")
        packages = [importlib.import_module(room.name) for room in found if room.ispkg]
        rooms |= {one.__name__ for one in packages if getattr(one, "__all__", None)}
    assert rooms <= set(SHOWN)
    assert all(importlib.import_module(module).__doc__ for module in SHOWN)
    listed = set(re.findall(r"`tofclip\.(\w+) <", API))
    assert listed == set(tofclip.__all__) - {"__version__"}


def test_signatures_are_short_and_sentences_stay_sentences():
    conf = pytest.importorskip("conf", reason="pages: pip install 'tofclip[docs]'")
    array = "~numpy.ndarray[tuple[~typing.Any, ...], ~numpy.dtype[~numpy.float64]]"
    short = "~numpy.typing.NDArray[~numpy.float64]"
    given = None, "class", "", None, None, f"(x: {array} = <factory>)", array
    assert conf.shorten_signature(*given) == (f"(x: {short} = ...)", short)
    lines = ["Where it lives: library and device.", "", "    m.", "    R. Bach, 1750."]
    conf.protect_plain_text(None, "property", "", None, None, lines)
    protected = ["Where it lives -- library and device.", "", r"    \m.", r"    \R. Bach, 1750."]
    assert lines == protected


PAGES = {path.stem: path.read_text() for path in (DOCS / "instruments").glob("*.md")}


def list_values(text):
    """What the addresses of a page take; what only an emulated instrument takes is left out."""
    for scheme in {*re.findall(r"([\w+]+)://", text)} & {*SOURCES.own}:
        module = importlib.import_module(SOURCES.own[scheme].partition(":")[0])
        for name, kind in vars(module).items():
            if isinstance(kind, type) and issubclass(kind, Options) and "Emulat" not in name:
                yield from kind.names()


@pytest.mark.parametrize("page", PAGES)
def test_a_page_names_every_value_of_the_address(page):
    assert {*re.findall(r"`(\w+)`", PAGES[page])} >= {*list_values(PAGES[page])}
    assert f"instruments/{page}" in (DOCS / "instruments.md").read_text()


def test_every_address_is_on_a_page():
    text = "\n".join(PAGES.values())
    assert [scheme for scheme in list_schemes() if f"{scheme}://" not in text] == []
    assert [
        one for one in list_endings() if one not in (".tiff", ".hdf5") and one not in text
    ] == []


NOTEBOOKS = {
    "light_field": (1, 0.1, ["2048 readings of 262144 pixels in 64 views"]),
    # in the upright stroke of the L, on the left
    "wall": (2, 0.1, ["Volume, seen from the wall", "brightest at x -0.1", "z 1.0"]),
    "scene5": (3, 0.05, ["<b>PointCloud</b>"]),
}
"""Number of pictures of each, their least contrast, and what is printed."""


@pytest.mark.parametrize(
    "name",
    [pytest.param(one, marks=pytest.mark.nightly) for one in ("light_field", "wall", "scene5")],
)
def test_a_notebook_runs(name, tmp_path, request):
    for library in ("nbconvert", "ipykernel", "pandas", "xarray"):
        pytest.importorskip(library, reason="pip install 'tofclip[notebook]'")
    if name == "scene5":
        for picture in (request.getfixturevalue("shared_data") / "clip").glob("*.tif"):
            shutil.copy(picture, tmp_path)
    page = run_notebook(DOCS / "notebooks" / f"{name}.ipynb", tmp_path).read_text()
    pictures = sorted((tmp_path / f"{name}_files").glob("*.png"))
    number, contrast, printed = NOTEBOOKS[name]
    assert all(text in page for text in printed)
    assert len(pictures) == number
    assert all(imread(io.BytesIO(one.read_bytes())).std() > contrast for one in pictures)


@pytest.mark.parametrize("name", NOTEBOOKS)
def test_a_page_shows_its_notebook(name):
    """Every cell of the notebook is on its page as it stands, and its pictures are there."""
    folder = DOCS / "notebooks"
    page = (folder / f"{name}.md").read_text()
    for cell in json.loads((folder / f"{name}.ipynb").read_text())["cells"]:
        # a semicolon at the end only keeps a notebook from printing
        assert "".join(cell["source"]).strip().rstrip(";") in page
        assert not cell.get("outputs")
    pictures = list((folder / f"{name}_files").glob("*.png"))
    assert pictures
    assert all(f"{one.parent.name}/{one.name}" in page for one in pictures)


def test_pages_are_formatted_as_all_code_is(tmp_path):
    pytest.importorskip("ruff", reason="pip install 'tofclip[lint]'")
    page = tmp_path / "page.md"
    page.write_text("A plot:\n\n```python\nplt.plot(x,y)\nplt.ylabel('counts');\n```\n\n    1  2\n")
    format_page(page)
    expected = 'A plot:\n\n```python\nplt.plot(x, y)\nplt.ylabel("counts")\n```\n\n    1  2\n'
    assert page.read_text() == expected  # what a cell printed stays as it was
