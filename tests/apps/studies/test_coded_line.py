"""The study of coded lines: ranks against the theory, and the gain of rotation on the rendered
letters.
"""

from __future__ import annotations

import numpy as np
import pytest

from apps.studies.coded_line import (
    MAX_ANGLE_RAD,
    compute_column_ranks,
    compute_psnr_db,
    make_coded_line_sensors,
    sweep_rotation,
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
    along = sensors(np.ones((24, 20))).reshape(2, -1).sum(axis=1)
    np.testing.assert_allclose(
        along, 20, rtol=1e-5
    )  # 20 points to a row, and each line's light has the sum 1


def test_rotation_gains_four_decibels_on_the_letters(shared_data):
    """Acceptance at N_p = 1, M = 10: the mean of five seeds."""
    from tofclip.io.light_fields import read_light_field

    light_field = read_light_field(shared_data / "lightfields" / "render_letters.npz")
    reference = int(np.flatnonzero((light_field.views == 0).all(axis=1))[0])
    sweep = sweep_rotation(
        light_field.pictures[reference], widths_px=(1,), lines=10, seeds=range(5)
    )
    assert sweep.upright_db.shape == sweep.rotated_db.shape == (1, 5)
    assert sweep.gain_db.mean() >= 4.0
    assert sweep.gain_db.min() > 2.0


def test_psnr_of_a_known_error():
    truth = np.zeros((4, 5), np.float32)
    truth[0, 0] = 2
    assert compute_psnr_db(truth + 0.2, truth) == pytest.approx(20)
    with pytest.raises(InputError, match="infinite"):
        compute_psnr_db(truth, truth)
