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
    select_views,
)
from tofclip.errors import InputError


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
    gain_db = np.subtract(rotated.psnr_db, upright.psnr_db)
    assert gain_db.shape == (5,)
    assert gain_db.mean() >= 4.0
    assert gain_db.min() > 2.0


def test_psnr_of_a_known_error():
    truth = np.zeros((4, 5), np.float32)
    truth[0, 0] = 2
    assert compute_psnr_db(truth + 0.2, truth) == pytest.approx(20)
    with pytest.raises(InputError, match="infinite"):
        compute_psnr_db(truth, truth)
