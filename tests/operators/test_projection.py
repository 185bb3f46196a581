"""The line projection against geometry worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse
from hypothesis import given, settings
from hypothesis import strategies as st

from tofclip.camera import Camera
from tofclip.operators import LineProjection, SparseMatrix, estimate_squared_norm

angles = st.floats(-1.0, 1.0)
centres = st.floats(40.0, 60.0)
offsets = st.integers(-8, 8)


def centroid(slit: np.ndarray) -> float:
    return float(np.sum(slit * np.arange(slit.size)) / np.sum(slit))


def point(shape: tuple[int, int], x: int, y: int) -> np.ndarray:
    picture = np.zeros(shape)
    picture[shape[0] // 2 + y, shape[1] // 2 + x] = 1
    return picture


@settings(max_examples=60, deadline=None)
@given(angle=angles, centre=centres, x=offsets, y=offsets, gain=st.floats(0.2, 3.0))
def test_a_point_falls_where_the_geometry_says(angle, centre, x, y, gain):
    operator = LineProjection((17, 19), 101, [centre], [angle], [gain], np.float64)
    slit = operator(point((17, 19), x, y))
    assert centroid(slit) == pytest.approx(centre + x - y * np.tan(angle), abs=1e-9)
    assert slit.sum() == pytest.approx(gain, rel=1e-12)
    assert np.count_nonzero(slit) <= 2


@settings(max_examples=30, deadline=None)
@given(angle=angles, shear=st.floats(-2.0, 2.0), x=offsets, y=offsets)
def test_refocusing_moves_each_view_by_its_position(angle, shear, x, y):
    camera = Camera([30.0, 90.0, 150.0], [angle] * 3, (17, 19), 181)
    slit = camera.operator(shear, np.float64)(point((17, 19), x, y))
    for centre, position in zip(camera.centres_px, (-1, 0, 1), strict=True):
        window = slice(int(centre) - 30, int(centre) + 30)
        seen = centroid(slit[window]) + window.start
        assert seen == pytest.approx(centre + x - y * np.tan(angle) + shear * position, abs=1e-9)


@pytest.mark.parametrize("shape", [(20, 20), (21, 20), (20, 21), (21, 21)])
def test_the_optical_axis_of_even_and_odd_pictures_is_their_middle_pixel(shape):
    projection = LineProjection(shape, 101, [50.0], [0.5], [1.0], np.float64)
    for row, column in ((10, 10), (3, 5), (0, 19)):
        picture = np.zeros(shape)
        picture[row, column] = 1
        expected = 50 + (column - 10) - (row - 10) * np.tan(0.5)
        assert centroid(projection(picture)) == pytest.approx(expected, abs=1e-12)


def test_a_vertical_line_response_sums_columns():
    picture = np.random.default_rng(0).random((7, 9))
    slit = LineProjection((7, 9), 9, [4.0], [0.0], [1.0], np.float64)(picture)
    np.testing.assert_allclose(slit, picture.sum(axis=0), rtol=1e-14)


def test_overlapping_views_add_their_light():
    picture = np.random.default_rng(1).random((15, 15))
    both = LineProjection((15, 15), 40, [15.2, 22.9], [0.3, -0.4], [1.0, 0.7], np.float64)(picture)
    first = LineProjection((15, 15), 40, [15.2], [0.3], [1.0], np.float64)(picture)
    second = LineProjection((15, 15), 40, [22.9], [-0.4], [0.7], np.float64)(picture)
    np.testing.assert_allclose(both, first + second, rtol=1e-13)


def test_light_beyond_the_slit_is_lost_and_only_that():
    operator = LineProjection((5, 5), 10, [8.0], [0.0], [1.0], np.float64)
    slit = operator(np.ones((5, 5)))
    assert slit.sum() == 5 * 4  # columns 6..9 of 6..10 remain
    assert operator(point((5, 5), 2, 0)).sum() == 0


def test_the_sign_of_the_angles_mirrors_the_picture():
    picture = np.random.default_rng(2).random((9, 9))
    plus = LineProjection((9, 9), 40, [20.0], [0.5], [1.0], np.float64)
    minus = LineProjection((9, 9), 40, [20.0], [-0.5], [1.0], np.float64)
    np.testing.assert_allclose(plus(picture), minus(picture[::-1]), rtol=1e-12)


def test_squared_norm_is_the_largest_eigenvalue():
    operator = LineProjection((9, 8), 30, [8.0, 20.0], [0.4, -0.3], [1.0, 1.3], np.float64)
    dense = operator.matrix.toarray()
    assert estimate_squared_norm(operator, 200) == pytest.approx(
        np.linalg.norm(dense, 2) ** 2, rel=1e-6
    )


def test_squared_norm_refuses_a_blind_operator():
    from tofclip.errors import InputError

    with pytest.raises(InputError, match="to zero"):
        estimate_squared_norm(LineProjection((3, 3), 5, [200.0], [0.0], [1.0]))


def test_squared_norm_of_a_matrix_with_both_signs():
    """The largest eigenvector has entries of both signs, which a walk that drops them never finds."""
    matrix = scipy.sparse.csr_array(np.array([[1.0, -0.9], [-0.9, 1.0]]))
    found = estimate_squared_norm(SparseMatrix(matrix, (2,), (2,)), 200)
    assert found == pytest.approx(1.9**2, rel=1e-3)
