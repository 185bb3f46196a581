"""`tofclip reproduce`: what it writes, resumes and refuses."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import pytest
from small_instrument import Run

from apps.studies.cases import Library
from apps.verbs import reproduce
from tofclip.simulate.light_fields import CameraArray

SMALL = CameraArray((40, 40), 4, focal_length_px=50.0, view_step=0.04, samples=1)


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Scenes of 40 x 40 pixels instead of 128 x 128."""
    monkeypatch.setattr("apps.studies.cases.Library", lambda data: Library(data, SMALL))


@pytest.mark.usefixtures("small")
@pytest.mark.nightly  # half a minute; tests of sequences run a quick study through the same folder
def test_a_study_is_written_and_not_made_again(run: Run, tmp_path: Path) -> None:
    words = ("reproduce", "fig15", "--out", tmp_path / "made", "--seeds", "1", "--json")
    first = run(*words)
    assert first.status == 0
    figures = json.loads(first.out)
    assert figures["table7"]["rows"] == 20
    assert figures["table7"]["mean_paper"] == pytest.approx(
        3.65, abs=0.05
    )  # of the paper's sixteen
    folder = tmp_path / "made" / "reproduction"
    made = {path.name for path in folder.iterdir()}
    assert made == {"table7.md", "table7.csv", "table7.png", "table7.json"}
    with (folder / "table7.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 20
    assert float(rows[0]["paper"]) == 2.14
    page = (tmp_path / "made" / "reproduction.md").read_text()
    assert "tofclip reproduce table7 --out made --seeds 1" in page
    assert "| CLIP-1D | figure-behind-bars | 1 |" in page
    assert "![Through occluders](reproduction/table7.png)" in page
    again = run(*words)
    assert json.loads(again.out) == figures
    assert "kept from an earlier run" in again.err


def test_a_damaged_or_other_result_is_made_again(tmp_path: Path) -> None:
    from apps.studies.report import load_result

    path = tmp_path / "table7.json"
    assert load_result(path, {"seeds": 1}) is None
    for text in ("{", "[]", '{"settings": {"seeds": 2}}'):
        path.write_text(text)
        assert load_result(path, {"seeds": 1}) is None
    path.write_text('{"settings": {"seeds": 1}}')
    assert load_result(path, {"seeds": 1}) is not None


def test_help_says_what_it_writes(run: Run) -> None:
    outcome = run("reproduce", "--help")
    assert "NAME.csv" in outcome.out
    assert reproduce.reproduce.__doc__ is not None
