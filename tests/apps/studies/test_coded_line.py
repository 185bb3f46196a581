"""The study of coded lines: ranks against the theory, and the gain of rotation on the rendered
letters.
"""

from __future__ import annotations

import numpy as np
import pytest

from apps.studies.coded_line import (
    LINES,
    MAX_ANGLE_RAD,
    LineArm,
    compute_column_ranks,
    compute_psnr_db,
    make_coded_line_sensors,
    measure_arm,
    recover_from_lines,
    select_views,
)
from tofclip.errors import InputError
from tofclip.light_field import LightField


@pytest.mark.parametrize("steepest", [0.0, MAX_ANGLE_RAD])
@pytest.mark.parametrize("width", [1, 16])
def test_a_slice_gives_each_column_of_the_spectrum_one_equation(steepest, width):
    """Supplement Eq. 15 and 16: M slices give M, whatever the PSF; the column has as many unknowns
    as rows.
    """
    for lines in (1, 4):
        sensors = make_coded_line_sensors((24, 20), lines, width, steepest, 0)
        assert np.unique(compute_column_ranks(sensors)).tolist() == [lines]


def test_the_sensors_are_long_enough_for_all_light_of_rotated_lines():
    """An even picture puts each row's light on the sensor as often as it has columns, at any angle."""
    sensors = make_coded_line_sensors((24, 20), 2, 1, MAX_ANGLE_RAD, 1)
    along = np.stack([one(np.ones((24, 20))) for one in sensors]).reshape(2, -1).sum(axis=1)
    np.testing.assert_allclose(
        along, 20, rtol=1e-5
    )  # 20 points to a row, and each line's light has the sum 1


@pytest.mark.nightly
def test_rotation_gains_four_decibels_on_the_letters(shared_data):
    """Acceptance at N_p = 1, M = 10: the mean of five seeds."""
    from tofclip.io.light_fields import read_light_field

    whole = read_light_field(shared_data / "lightfields" / "render_letters.npz")
    light_field = select_views(whole, LINES)
    upright, rotated = (
        measure_arm(light_field, -0.3, 5, LineArm("", 1, angle)) for angle in (0.0, MAX_ANGLE_RAD)
    )
    gain_db = np.subtract(rotated[0], upright[0])
    assert gain_db.shape == (5,)
    assert gain_db.mean() >= 4.0
    assert gain_db.min() > 2.0


LINE_VIEWS = np.array([[0.0, -1.0], [0.0, 1.0]])


def make_two_views(difference: float) -> LightField:
    """Two views whose sum is the same whatever their difference: so is what shift-and-add makes of
    them at s = 0.
    """
    common, other = np.random.default_rng(3).random((2, 16, 16)).astype(np.float32)
    return LightField(
        np.stack([common + difference * other, common - difference * other]), LINE_VIEWS
    )


def test_every_line_measures_its_own_view_and_not_the_picture_that_is_sought():
    """Measurements computed from the truth, A x, would be the same for both light fields."""
    sensors = make_coded_line_sensors((16, 16), 2, 1, MAX_ANGLE_RAD, 0)
    even, uneven = make_two_views(0.0), make_two_views(0.5)
    np.testing.assert_allclose(even.refocus(0.0), uneven.refocus(0.0), atol=1e-6)
    first, second = (recover_from_lines(one, 0.0, sensors, 1e-3)[0] for one in (even, uneven))
    assert np.abs(first - second).max() > 0.1 * first.max()


def test_the_weight_is_chosen_without_the_truth(monkeypatch):
    """Shift-and-add of the true views is the truth of this study: nobody may ask for it here."""

    def refuse(*_: object) -> None:
        pytest.fail("the truth was looked at")

    monkeypatch.setattr(LightField, "refocus", refuse)
    monkeypatch.setattr("apps.studies.coded_line.SEARCH_ITERATIONS", 10)
    monkeypatch.setattr("apps.studies.coded_line.ITERATIONS", 20)
    sensors = make_coded_line_sensors((16, 16), 2, 1, MAX_ANGLE_RAD, 0)
    _, weight = recover_from_lines(make_two_views(0.1), 0.0, sensors)
    assert weight > 0


def test_psnr_of_a_known_error():
    truth = np.zeros((4, 5), np.float32)
    truth[0, 0] = 2
    assert compute_psnr_db(truth + 0.2, truth) == pytest.approx(20)
    with pytest.raises(InputError, match="infinite"):
        compute_psnr_db(truth, truth)
