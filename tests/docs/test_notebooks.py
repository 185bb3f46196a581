"""The notebooks run, and show what their words say."""

from __future__ import annotations

import io
import json
import shutil
from pathlib import Path

import pytest
from matplotlib.image import imread
from notebooks import format_page, run_notebook

import tofclip

NOTEBOOKS = Path(tofclip.__file__).parents[1] / "docs" / "notebooks"


def execute(name: str, folder: Path) -> tuple[str, list[float]]:
    """Run a notebook; return its page and the contrast of each picture on it."""
    pytest.importorskip("nbconvert", reason="pip install 'tofclip[notebook]'")
    pytest.importorskip("ipykernel", reason="pip install 'tofclip[notebook]'")
    page = run_notebook(NOTEBOOKS / f"{name}.ipynb", folder)
    pictures = sorted((folder / f"{name}_files").glob("*.png"))
    contrasts = [float(imread(io.BytesIO(one.read_bytes())).std()) for one in pictures]
    return page.read_text(), contrasts


def test_the_notebook_of_a_light_field(tmp_path: Path) -> None:
    page, contrasts = execute("light_field", tmp_path)
    assert "2048 readings of 262144 pixels in 64 views" in page
    assert len(contrasts) == 1
    assert min(contrasts) > 0.1


@pytest.mark.nightly
def test_the_notebook_of_a_wall(tmp_path: Path) -> None:
    page, contrasts = execute("wall", tmp_path)
    assert "Volume, seen from the wall" in page
    assert "brightest at x -0.1" in page  # in the upright stroke of the L, on the left
    assert "z 1.0" in page
    assert len(contrasts) == 2
    assert min(contrasts) > 0.1


@pytest.mark.nightly
def test_the_notebook_of_the_recorded_scene(tmp_path: Path, shared_data: Path) -> None:
    pytest.importorskip("pandas")
    pytest.importorskip("xarray")
    for picture in (shared_data / "clip").glob("*.tif"):
        shutil.copy(picture, tmp_path)
    page, contrasts = execute("scene5", tmp_path)
    assert "<b>PointCloud</b>" in page
    assert len(contrasts) == 3
    assert min(contrasts) > 0.05


@pytest.mark.parametrize("name", ["light_field", "scene5", "wall"])
def test_a_page_shows_its_notebook(name: str) -> None:
    """Every cell of the notebook is on its page as it stands, and its pictures are there."""
    page = (NOTEBOOKS / f"{name}.md").read_text()
    for cell in json.loads((NOTEBOOKS / f"{name}.ipynb").read_text())["cells"]:
        # a semicolon at the end only keeps a notebook from printing
        assert "".join(cell["source"]).strip().rstrip(";") in page
        assert not cell.get("outputs")
    pictures = list((NOTEBOOKS / f"{name}_files").glob("*.png"))
    assert pictures
    assert all(f"{one.parent.name}/{one.name}" in page for one in pictures)


def test_pages_are_formatted_as_all_code_is(tmp_path: Path) -> None:
    pytest.importorskip("ruff", reason="pip install 'tofclip[lint]'")
    page = tmp_path / "page.md"
    page.write_text("A plot:\n\n```python\nplt.plot(x,y)\nplt.ylabel('counts');\n```\n\n    1  2\n")
    format_page(page)
    expected = 'A plot:\n\n```python\nplt.plot(x, y)\nplt.ylabel("counts")\n```\n\n    1  2\n'
    assert page.read_text() == expected  # what a cell printed stays as it was
