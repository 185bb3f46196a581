"""Projections, codes, shears, convolutions and sensors against what can be written down, beyond the
contract of operators.
"""

import sys

import numpy as np
import pytest
import scipy.sparse
from hypothesis import given
from hypothesis import strategies as st

from tofclip.arrays import ComputeDevice
from tofclip.errors import InputError
from tofclip.operators import (
    DenseSensor,
    HadamardCodes,
    LinearShear,
    LineProjection,
    MeanWeighting,
    PitchedSensor,
    PointSpreadConvolution,
    RadonProjection,
    Selection,
    SliceConvolution,
    SparseMatrix,
    estimate_squared_norm,
)
from tofclip.operators.convolution import make_coded_line
from tofclip.operators.sparse import make_product

sizes = st.integers(1, 9)


def draw(seed, *shape):
    return np.random.default_rng(seed).random(shape)


def centroid(slit):
    return float(np.sum(slit * np.arange(slit.size)) / np.sum(slit))


def point(shape, x, y):
    picture = np.zeros(shape)
    picture[shape[0] // 2 + y, shape[1] // 2 + x] = 1
    return picture


def lines(shape, slit, *views):
    """Views as (centre, angle, gain)."""
    return LineProjection(shape, slit, *zip(*views, strict=True), np.float64)


def test_overlapping_views_add_their_light():
    picture, views = draw(1, 15, 15), ((15.2, 0.3, 1.0), (22.9, -0.4, 0.7))
    alone = [lines((15, 15), 40, view)(picture) for view in views]
    np.testing.assert_allclose(lines((15, 15), 40, *views)(picture), sum(alone), rtol=1e-13)


def test_light_beyond_the_slit_is_lost_and_only_that():
    operator = lines((5, 5), 10, (8.0, 0.0, 1.0))
    # columns 6..9 of 6..10 remain
    np.testing.assert_array_equal(operator(np.ones((5, 5))), [0] * 6 + [5] * 4)
    assert operator(point((5, 5), 2, 0)).sum() == 0


def test_squared_norm_is_the_largest_eigenvalue():
    operator = lines((9, 8), 30, (8.0, 0.4, 1.0), (20.0, -0.3, 1.3))
    largest = np.linalg.norm(operator.matrix.toarray(), 2) ** 2
    assert estimate_squared_norm(operator, 200) == pytest.approx(largest, rel=1e-6)
    # The largest eigenvector has entries of both signs, which a walk that drops them never finds.
    matrix = scipy.sparse.csr_array(np.array([[1.0, -0.9], [-0.9, 1.0]]))
    found = estimate_squared_norm(SparseMatrix(matrix, (2,), (2,)), 200)
    assert found == pytest.approx(1.9**2, rel=1e-3)
    with pytest.raises(InputError, match="to zero"):
        estimate_squared_norm(lines((3, 3), 5, (200.0, 0.0, 1.0)))


def test_at_right_angles_a_projection_sums_columns_and_rows():
    picture = draw(0, 8, 8)
    measurements = RadonProjection((8, 8), 8, [0.0, np.pi / 2], [0.0, 0.0], np.float64)(picture)
    expected = np.concatenate([picture.sum(axis=0), picture.sum(axis=1)])
    np.testing.assert_allclose(measurements, expected, rtol=1e-12)


def test_hadamard_codes_are_rows_of_a_hadamard_matrix_with_signs():
    """All codes of a picture, made -1 and 1, are orthogonal to each other."""
    codes = 2 * HadamardCodes((4, 8), 32, 7, np.float64)(np.eye(32).reshape(4, 8, 32)) - 1
    assert set(np.unique(codes)) == {-1.0, 1.0}
    np.testing.assert_allclose(codes @ codes.T, 32 * np.eye(32), atol=1e-12)


def test_codes_are_half_open_and_decided_by_their_seed():
    first, again, other = (
        HadamardCodes((13, 16), 60, seed, np.float64)(np.eye(208).reshape(13, 16, 208))
        for seed in (3, 3, 4)
    )
    assert set(np.unique(first)) == {0.0, 1.0}
    # 60 x 208 fair draws: the mean's standard deviation is 0.0045.
    assert first.mean() == pytest.approx(0.5, abs=0.02)
    assert len(np.unique(first, axis=0)) == 60
    np.testing.assert_array_equal(first, again)
    assert not np.allclose(first, other)


def test_every_view_keeps_its_own_share_of_its_mean():
    measurements = np.array([1.0, 3.0, 10.0, 20.0, 60.0])
    expected = measurements - 0.9 * np.array([2, 2, 30, 30, 30])
    weighted = MeanWeighting([2, 3], 0.1, np.float64)(measurements)
    np.testing.assert_allclose(weighted, expected, rtol=1e-14)


def test_light_leaves_over_the_border():
    picture = np.zeros((5, 6))
    picture[2, 5] = 1
    assert LinearShear((5, 6), 1.0, (0, 1), dtype=np.float64)(picture).sum() == 0


@given(s=st.floats(-0.9, 0.9), v=st.integers(-4, 3), u=st.integers(-4, 3), r=st.floats(-1.0, 1.0))
def test_the_centroid_moves_by_the_shear_times_the_distance_from_the_reference(s, v, u, r):
    seen = LinearShear((21, 23), s, (v, u), (r, -r), np.float64)(point((21, 23), 0, 0))
    rows, columns = np.indices(seen.shape)
    assert np.sum(rows * seen) == pytest.approx(10 + s * (v - r), abs=1e-9)
    assert np.sum(columns * seen) == pytest.approx(11 + s * (u + r), abs=1e-9)


@given(rows=sizes, columns=sizes, down=sizes, right=sizes, sensor_rows=sizes, sensor_columns=sizes)
def test_every_point_puts_the_point_spread_about_its_own_place(
    rows, columns, down, right, sensor_rows, sensor_columns
):
    """Every size of picture, PSF and sensor: no light wraps around, none is lost but beside the
    sensor.
    """
    spread, picture = draw(0, min(down, rows), min(right, columns)), draw(1, rows, columns)
    sensor = (sensor_rows, sensor_columns)
    seen = PointSpreadConvolution((rows, columns), spread, sensor, np.float64)(picture)
    expected = np.zeros(sensor)
    top = rows // 2 - sensor_rows // 2 + spread.shape[0] // 2
    left = columns // 2 - sensor_columns // 2 + spread.shape[1] // 2
    for (y, x), light in np.ndenumerate(picture):
        for (j, i), share in np.ndenumerate(spread):
            row, column = y + j - top, x + i - left
            if 0 <= row < sensor_rows and 0 <= column < sensor_columns:
                expected[row, column] += light * share
    np.testing.assert_allclose(seen, expected, atol=1e-12)


@pytest.mark.parametrize("sensor", [5, 14, 31])
@pytest.mark.parametrize(
    ("rows", "columns", "spread"), [(12, 9, (12, 9)), (11, 14, (11, 14)), (12, 14, (5, 6))]
)
def test_a_1d_sensor_reads_the_middle_row_of_the_convolution(rows, columns, spread, sensor):
    picture, spreads = draw(0, rows, columns), draw(1, 3, *spread)
    seen = SliceConvolution((rows, columns), spreads, sensor, np.float64)(picture)
    for line, each in zip(seen.reshape(3, sensor), spreads, strict=True):
        whole = PointSpreadConvolution((rows, columns), each, (rows, sensor), np.float64)(picture)
        np.testing.assert_allclose(line, whole[(rows - 1) // 2], atol=1e-12)


def test_behind_a_tilted_spread_a_point_falls_where_the_line_s_angle_says():
    """x = X - Y tan(angle), as for `LineProjection`; the sensor's row stands for Y = 0."""
    tilted = np.zeros((21, 21))
    for row in range(21):
        place = 10 + 0.5 * (row - 10)
        tilted[row] = np.interp(np.arange(21), [place - 1, place, place + 1], [0, 1, 0])
    seen = SliceConvolution((21, 31), tilted[None], dtype=np.float64)(point((21, 31), -3, 4))
    assert centroid(seen) - 15 == pytest.approx(-3 - 4 * 0.5, abs=1e-9)


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
    for width, angle in ((0, 0.0), (41, 0.0), (1, np.pi / 2)):
        with pytest.raises(InputError):
            make_coded_line((32, 40), width, angle, np.random.default_rng(0))


def test_sensors_read_the_pixels_that_they_say():
    picture, live = draw(3, 9, 11).astype(np.float32), np.flatnonzero(draw(4, 9, 11) < 0.6)
    np.testing.assert_array_equal(DenseSensor((9, 11))(picture), picture.ravel())
    masked = Selection((9, 11), (live.size,), live)
    np.testing.assert_array_equal(masked(picture), picture.ravel()[live])
    pitched = PitchedSensor((9, 11), (2, 3), (1, 2))
    np.testing.assert_array_equal(pitched(picture).reshape(pitched.grid_shape), picture[1::2, 2::3])
    # 13 pitches of 30 / 26 pixels are 15, but for a rounding error downwards; 26 are not on the plane.
    assert PitchedSensor((30, 15), (30 / 26, 1)).grid_shape == (26, 15)
    assert 15 * 15 in PitchedSensor((30, 15), (30 / 26, 1)).chosen
    uneven = PitchedSensor((128, 128), (128 / 91, 128 / 90))
    assert uneven.grid_shape == (91, 90)
    assert np.unique(uneven.chosen).size == 91 * 90


MATRIX = scipy.sparse.random_array((31, 17), density=0.2, rng=np.random.default_rng(1)).tocsr()
BLOCK = draw(2, 17, 6)
STRICT = ComputeDevice("array_api_strict")


def test_cupys_matrix_is_built_as_scipys_would_be(monkeypatch):
    """Where there is no CuPy, SciPy stands in for its sparse matrices, which have the same
    interface.
    """
    for name in ("cupyx", "cupyx.scipy"):
        monkeypatch.setitem(sys.modules, name, scipy)
    monkeypatch.setitem(sys.modules, "cupyx.scipy.sparse", scipy.sparse)
    monkeypatch.setattr(ComputeDevice, "put", lambda device, values: values)
    product = make_product(MATRIX, ComputeDevice("cupy"))
    np.testing.assert_allclose(product(BLOCK), MATRIX @ BLOCK, rtol=1e-14)
