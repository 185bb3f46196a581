"""The best of ours beside the paper's figures: solved once, kept, and counted on the page."""

from __future__ import annotations

import numpy as np
import pytest

from apps.studies.best import SEED, BestFigure, choose_settings, list_best_cases, solve_best
from apps.studies.cases import BORDER_PX, Case, Library, measure_case
from apps.studies.report import STUDIES, add_best, count_below, render_section, write_page
from tofclip.metrics import nmse
from tofclip.recovery import all_in_focus
from tofclip.recovery.light_field import ClipRecovery
from tofclip.simulate.light_fields import CameraArray

ARRAY = CameraArray((48, 48), 4, focal_length_px=60.0, view_step=0.04, samples=1)


@pytest.fixture(scope="module")
def library() -> Library:
    return Library(array=ARRAY)


def test_every_row_of_tables_2_to_10_with_a_figure_of_the_paper_has_its_best():
    named = {study.name: list_best_cases(study.name) for study in STUDIES if study.has_best}
    assert set(named) == {f"table{number}" for number in range(2, 11)}
    assert sum(map(len, named.values())) == 201
    for cases in named.values():
        assert len({case.key for case in cases}) == len(cases)
        assert all(case.paper is not None and case.encoder != "line" for case in cases)


def test_what_is_known_is_not_solved_again_and_rows_share_a_measurement(library, monkeypatch):
    cases = [
        choose_settings(Case((f"{shear:g}",), "letters", "line", 1.0, shear, paper))
        for shear, paper in ((-1.0, 100.0), (0.2, 0.0))
    ]
    runs, kept, steps = [], [], []

    def solve(measurement, shears, recovery):
        runs.append(measurement)
        return all_in_focus.recover_on_depth_map(
            measurement, np.full(measurement.image_shape, -0.4), 1e-3, recovery
        )

    monkeypatch.setattr("apps.studies.best.recover_all_in_focus", solve)
    monkeypatch.setattr("apps.studies.best.PRESETS", ("fast",))
    found = solve_best(cases, library, {}, kept.append, steps.append)
    assert len(runs) == 1
    assert sum(steps) == 2
    assert kept[-1] == found
    assert found["-1"].setting == "surfaces"
    # the second is not below the paper's, so that the presets are tried
    measured = measure_case(cases[1], library, SEED)
    truth = library.light_field("letters").refocus(0.2)
    plain = 100 * nmse(ClipRecovery().recover(measured, 0.2).picture, truth, BORDER_PX)
    assert found["0.2"].percent <= plain * 1.001
    assert solve_best(cases, library, found, kept.append, steps.append) == found
    assert len(runs) == 1


def test_the_page_marks_each_row_and_counts_them(tmp_path):
    rows = [
        {"labels": [name], "ours": [mean], "mean": mean, "spread": 0.0, "paper": paper}
        for name, mean, paper in (
            ("a", 3.0, 2.0),
            ("b", 1.0, 2.0),
            ("c", 9.0, 2.0),
            ("d", 1.0, None),
        )
    ]
    # the same case with another data term counts as the table's own
    robust = {"labels": ["c", "huber"], "ours": [8.0], "mean": 8.0, "spread": 0.0, "paper": None}
    rows = [row | {"labels": [*row["labels"], "squares"]} for row in rows] + [robust]
    result = {
        "name": "table2",
        "also": [],
        "title": "T",
        "note": "N.",
        "weight": "w",
        "command": "c",
        "columns": ["row", "data term"],
        "figure": "%",
        "rows": rows,
        "seconds": 1.0,
    }
    known = {
        "a | squares": BestFigure(1.5, "surfaces"),
        "b | squares": BestFigure(1.2, "quality"),
    }
    partial = add_best(result, known, 12.0)
    assert "| c | squares | 9.00 |  | 2.00 | 8.00 | the table's (others not tried) | above |" in (
        render_section(partial)
    )
    full = add_best(result, known | {"c | squares": BestFigure(2.5, "quality")}, 12.0)
    assert count_below([full]) == (2, 3)
    section = render_section(full)
    assert "| a | squares | 3.00 |  | 2.00 | 1.50 | surfaces | below |" in section
    assert "| b | squares | 1.00 |  | 2.00 | 1.00 | the table's | below |" in section
    assert "| c | squares | 9.00 |  | 2.00 | 2.50 | quality | above |" in section
    assert "| d | squares | 1.00 |  |  |  |  |  |" in section
    assert "in 2 of 3 rows, 12 s of processor time" in section
    page = write_page([full], tmp_path).read_text("utf-8")
    assert "below the paper's figure in 2 of 3 rows (67 %)" in page
    assert "best of ours" not in render_section(result)
