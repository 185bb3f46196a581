"""The studies of seeing through occluders, each on a corner of its table."""

from __future__ import annotations

import numpy as np
import pytest

from apps.occlusion.probe import ProbeResult
from apps.studies import occlusion
from apps.studies.cases import Library, read_cases
from apps.studies.report import find_studies
from tofclip.simulate.light_fields import CameraArray

FITTED = ProbeResult(0.1, 1.2, 0.9, 7, np.zeros((4, 4)), np.zeros((4, 4)))


def test_the_sweep_recovers_what_the_formula_promises_and_nothing_else(monkeypatch):
    """The hardest corners: the return nearest to its occluder's, and the occluder nearly as wide as
    the baseline.
    """
    monkeypatch.setattr(occlusion, "WIDTHS_MM", (2.0, 14.0))
    monkeypatch.setattr(occlusion, "DISTANCES_MM", (30.0,))
    monkeypatch.setattr(occlusion, "DISPLAYED_BAR_MM", (2.0, 30.0))
    steps: list[int] = []
    outcome = occlusion.run_inactive_region(Library(), 1, steps.append)
    assert sum(steps) == len(outcome.rows) == 6
    for row in outcome.rows:
        assert (row.mean >= 0.8) == (row.labels[-1] == "visible")
        assert len(row.labels) == len(outcome.columns)
    assert [row.labels[-1] for row in outcome.rows] == ["hidden", "visible", "visible"] * 2
    assert len(outcome.panels[0]) == 4


def test_a_fixed_camera_finds_its_own_gates_and_sees_what_the_formula_promises(monkeypatch):
    """A part of its picture: 16 cells of the strip, which correlate by chance with a standard
    deviation of a quarter.
    """
    monkeypatch.setattr("apps.occlusion.probe.FIXED_PICTURE_PX", 64)
    monkeypatch.setattr("apps.occlusion.probe.FIXED_FIELD_OF_VIEW_RAD", 0.225)
    monkeypatch.setattr("apps.occlusion.probe.BOARD_ROWS", 16)
    monkeypatch.setattr(occlusion, "WIDTHS_MM", (6.0,))
    monkeypatch.setattr(occlusion, "DISTANCES_MM", (50.0,))
    monkeypatch.setattr(occlusion, "DISTANCE_FACTORS", (0.8, 1.2))
    monkeypatch.setattr(occlusion, "probe_target", lambda *_: FITTED)
    steps: list[int] = []
    outcome = occlusion.run_inactive_region(Library(), 1, steps.append)
    assert sum(steps) == 4
    assert len(outcome.rows) == 4
    hidden, visible = (row for row in outcome.rows if row.labels[-2] == occlusion.FIXED_CAMERA)
    assert hidden.labels[-1] == "hidden"
    assert hidden.mean < 0.25
    assert visible.mean > 0.5


def test_knowing_the_occluder_is_what_makes_the_target_bright(monkeypatch):
    plates = [one for one in read_cases("table7-flash") if one.scene == "plate"][::2]
    monkeypatch.setattr(occlusion, "read_cases", lambda _: plates)
    steps: list[int] = []
    small = Library(array=CameraArray((48, 48)))
    outcome = occlusion.run_flash_occlusion(small, 1, steps.append)
    assert sum(steps) == 2
    knowing, ignorant = outcome.rows[0], outcome.rows[1]
    assert knowing.mean < 0.5 * ignorant.mean
    assert knowing.paper is not None
    assert ignorant.paper is None


@pytest.mark.parametrize("name", ["fig14", "inactive-region", "table7-flash"])
def test_they_are_called_by_name(name):
    assert len(find_studies(name)) == 1
