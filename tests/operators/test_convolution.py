"""Convolution with a point-spread function and the sensors behind it, against sums written out."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tofclip.errors import InputError
from tofclip.operators import DenseSensor, MaskedSensor, PitchedSensor, PointSpreadConvolution

sizes = st.integers(1, 9)


@settings(max_examples=60, deadline=None)
@given(rows=sizes, columns=sizes, down=sizes, right=sizes, sensor_rows=sizes, sensor_columns=sizes)
def test_every_point_puts_the_point_spread_about_its_own_place(
    rows, columns, down, right, sensor_rows, sensor_columns
):
    """Every size of picture, PSF and sensor: no light wraps around, none is lost but beside the
    sensor.
    """
    spread = np.random.default_rng(0).random((min(down, rows), min(right, columns)))
    picture = np.random.default_rng(1).random((rows, columns))
    seen = PointSpreadConvolution(
        (rows, columns), spread, (sensor_rows, sensor_columns), np.float64
    )(picture)
    expected = np.zeros((sensor_rows, sensor_columns))
    first = rows // 2 - sensor_rows // 2, columns // 2 - sensor_columns // 2
    for (y, x), light in np.ndenumerate(picture):
        for (j, i), share in np.ndenumerate(spread):
            row, column = (
                y + j - spread.shape[0] // 2 - first[0],
                x + i - spread.shape[1] // 2 - first[1],
            )
            if 0 <= row < sensor_rows and 0 <= column < sensor_columns:
                expected[row, column] += light * share
    np.testing.assert_allclose(seen, expected, atol=1e-12)


def test_the_convolution_is_that_of_scipy():
    from scipy.signal import convolve2d

    random = np.random.default_rng(2)
    picture, spread = random.random((31, 40)), random.random((7, 9))
    seen = PointSpreadConvolution((31, 40), spread, dtype=np.float64)(picture)
    np.testing.assert_allclose(seen, convolve2d(picture, spread, mode="same"), rtol=1e-12)


def test_a_point_spread_larger_than_the_picture_is_refused_with_advice():
    with pytest.raises(InputError, match=r"larger than the picture of \(8, 8\) px; crop it"):
        PointSpreadConvolution((8, 8), np.ones((9, 8)))


def test_a_dense_sensor_reads_row_by_row():
    picture = np.arange(12.0).reshape(3, 4)
    np.testing.assert_array_equal(DenseSensor((3, 4))(picture), np.arange(12))


def test_a_pitched_sensor_reads_every_nth_pixel_from_its_offset():
    picture = np.random.default_rng(3).random((9, 11)).astype(np.float32)
    sensor = PitchedSensor((9, 11), (2, 3), (1, 2))
    np.testing.assert_array_equal(sensor(picture).reshape(sensor.grid_shape), picture[1::2, 2::3])


def test_a_pitch_that_is_no_whole_number_keeps_its_mean():
    # 13 pitches of 30 / 26 pixels are 15, but for a rounding error downwards.
    rounded = PitchedSensor((30, 15), (30 / 26, 1))
    assert 15 * 15 in rounded.pixels
    sensor = PitchedSensor((128, 128), (128 / 91, 128 / 90))
    assert sensor.grid_shape == (91, 90)
    assert np.unique(sensor.pixels).size == sensor.pixels.size


def test_a_masked_sensor_reads_live_pixels_only():
    live = np.array([[True, False, True], [False, False, True]])
    sensor = MaskedSensor(live)
    np.testing.assert_array_equal(sensor(np.arange(6.0).reshape(2, 3)), [0, 2, 5])
    np.testing.assert_array_equal(sensor.adjoint(np.array([1.0, 2, 3])), [[1, 0, 2], [0, 0, 3]])
