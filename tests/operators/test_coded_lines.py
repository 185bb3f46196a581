"""1D sensors behind point-spread functions against rows of the whole convolution."""

from __future__ import annotations

import numpy as np
import pytest

from tofclip.errors import InputError
from tofclip.operators import PointSpreadConvolution, SliceConvolution
from tofclip.operators.convolution import make_coded_line


@pytest.mark.parametrize("sensor", [5, 14, 31])
@pytest.mark.parametrize(
    ("rows", "columns", "spread"), [(12, 9, (12, 9)), (11, 14, (11, 14)), (12, 14, (5, 6))]
)
def test_a_1d_sensor_reads_the_middle_row_of_the_convolution(rows, columns, spread, sensor):
    random = np.random.default_rng(0)
    picture, spreads = random.random((rows, columns)), random.random((3, *spread))
    seen = SliceConvolution((rows, columns), spreads, sensor, np.float64)(picture).reshape(
        3, sensor
    )
    for line, each in zip(seen, spreads, strict=True):
        whole = PointSpreadConvolution((rows, columns), each, (rows, sensor), np.float64)(picture)
        np.testing.assert_allclose(line, whole[(rows - 1) // 2], atol=1e-12)


@pytest.mark.parametrize("rows", [10, 11])
def test_a_spread_as_high_as_the_picture_sees_every_row(rows):
    seen = SliceConvolution((rows, 8), np.ones((1, rows, 1)), dtype=np.float64)(np.ones((rows, 8)))
    np.testing.assert_allclose(seen, rows, rtol=1e-12)


def test_a_point_falls_where_the_line_s_angle_says():
    """x = X - Y tan(angle), as for `LineProjection`; the sensor's row stands for Y = 0."""
    angle = np.arctan(0.5)
    tilted = np.zeros((21, 21))
    for row in range(21):
        place = 10 + 0.5 * (row - 10)
        tilted[row] = np.interp(np.arange(21), [place - 1, place, place + 1], [0, 1, 0])
    picture = np.zeros((21, 31))
    picture[10 + 4, 15 - 3] = 1
    seen = SliceConvolution((21, 31), tilted[None], dtype=np.float64)(picture)
    centroid = np.sum(seen * np.arange(31)) / seen.sum()
    assert centroid - 15 == pytest.approx(-3 - 4 * np.tan(angle), abs=1e-9)


@pytest.mark.parametrize("angle", [0.0, -np.pi / 4, 0.6])
def test_a_coded_line_runs_along_its_angle_and_about_half_of_it_is_open(angle):
    line = make_coded_line((64, 128), 1, angle, np.random.default_rng(1))
    rows, columns = np.nonzero(line > 1e-12)
    # Each row's light lies on the two columns nearest to the line.
    assert np.abs(columns - 64 - np.tan(angle) * (rows - 32)).max() < 1
    assert line.sum() == pytest.approx(1)
    # 64 fair draws: four standard deviations are a quarter.
    assert np.unique(rows).size / 64 == pytest.approx(0.5, abs=0.25)


def test_a_wide_code_fills_its_width_and_is_cut_at_the_border():
    line = make_coded_line((32, 40), 40, 0.5, np.random.default_rng(2))
    assert np.count_nonzero(line.sum(axis=0)) == 40
    narrow = make_coded_line((32, 40), 5, 0.0, np.random.default_rng(2))
    np.testing.assert_array_equal(np.flatnonzero(narrow.any(axis=0)), np.arange(18, 23))


@pytest.mark.parametrize(("width", "angle"), [(0, 0.0), (9, 0.0), (1, np.pi / 2)])
def test_lines_that_cannot_be_are_refused(width, angle):
    with pytest.raises(InputError):
        make_coded_line((8, 8), width, angle, np.random.default_rng(0))
