"""Projections, codes and shears against what can be written down, beyond the contract of operators."""

from __future__ import annotations

import sys

import numpy as np
import pytest
import scipy.sparse
from hypothesis import given, settings
from hypothesis import strategies as st

from tofclip.arrays import ComputeDevice, to_numpy
from tofclip.camera import Camera
from tofclip.operators import (
    FourierShear,
    HadamardCodes,
    LinearShear,
    LineProjection,
    MeanWeighting,
    RadonProjection,
    SparseMatrix,
    estimate_squared_norm,
    sparse,
)
from tofclip.operators.sparse import make_product

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


def blob(shape: tuple[int, int], x: float, y: float) -> np.ndarray:
    rows, columns = np.indices(shape)
    return np.exp(-((columns - shape[1] // 2 - x) ** 2 + (rows - shape[0] // 2 - y) ** 2) / 18)


def test_at_right_angles_a_projection_sums_columns_and_rows():
    picture = np.random.default_rng(0).random((8, 8))
    measurements = RadonProjection((8, 8), 8, [0.0, np.pi / 2], [0.0, 0.0], np.float64)(picture)
    np.testing.assert_allclose(measurements[:8], picture.sum(axis=0), rtol=1e-12)
    np.testing.assert_allclose(measurements[8:], picture.sum(axis=1), rtol=1e-12)


def test_offsetting_the_detector_shears_the_picture():
    """A_k B_k by offset is A_k after the shear; linear interpolation twice or once on a blob of 3
    px differs by 1 %.
    """
    shear, view = -0.6, (-3, 2)
    angles = np.deg2rad([0, 23, 77, 140])
    picture = blob((61, 67), 4, -3)
    offsets = shear * (view[1] * np.cos(angles) + view[0] * np.sin(angles))
    offset = RadonProjection((61, 67), 67, angles, offsets, np.float64)(picture)
    plain = RadonProjection((61, 67), 67, angles, np.zeros(4), np.float64)
    sheared = plain(LinearShear((61, 67), shear, view, dtype=np.float64)(picture))
    assert np.linalg.norm(offset - sheared) < 0.01 * np.linalg.norm(sheared)
    assert np.linalg.norm(plain(picture) - sheared) > 0.1 * np.linalg.norm(sheared)


@pytest.mark.parametrize("count", [1, 2, 5])
def test_a_lone_picture_is_projected_as_by_the_matrix(count):
    """Without a matrix and with it; detectors so short and so far off that light is lost on both
    sides.
    """
    random = np.random.default_rng(count)
    offsets = random.uniform(-9, 9, count)
    operator = RadonProjection((12, 17), 9, random.uniform(0, np.pi, count), offsets, np.float64)
    picture, measurements = random.random((12, 17)), random.random(9 * count)
    np.testing.assert_allclose(operator(picture), operator.matrix @ picture.ravel(), atol=1e-13)
    np.testing.assert_allclose(
        operator.adjoint(measurements).ravel(), operator.matrix.T @ measurements, atol=1e-13
    )
    assert operator(picture).sum() < count * picture.sum()


def test_hadamard_codes_are_rows_of_a_hadamard_matrix_with_signs():
    """All codes of a picture, made -1 and 1, are orthogonal to each other."""
    codes = 2 * HadamardCodes((4, 8), 32, 7, np.float64)(np.eye(32).reshape(4, 8, 32)) - 1
    assert set(np.unique(codes)) == {-1.0, 1.0}
    np.testing.assert_allclose(codes @ codes.T, 32 * np.eye(32), atol=1e-12)


def test_codes_are_zeros_and_ones_half_of_them_open():
    codes = HadamardCodes((13, 16), 60, 3, np.float64)(np.eye(208).reshape(13, 16, 208))
    assert set(np.unique(codes)) == {0.0, 1.0}
    # 60 x 208 fair draws: the mean's standard deviation is 0.0045.
    assert codes.mean() == pytest.approx(0.5, abs=0.02)
    assert len(np.unique(codes, axis=0)) == 60


def test_the_seed_decides_the_codes():
    picture = np.random.default_rng(1).random((8, 8))
    np.testing.assert_array_equal(
        HadamardCodes((8, 8), 9, 5)(picture), HadamardCodes((8, 8), 9, 5)(picture)
    )
    assert not np.allclose(
        HadamardCodes((8, 8), 9, 5)(picture), HadamardCodes((8, 8), 9, 6)(picture)
    )


def test_every_view_keeps_its_own_share_of_its_mean():
    measurements = np.array([1.0, 3.0, 10.0, 20.0, 60.0])
    weighted = MeanWeighting([2, 3], 0.1, np.float64)(measurements)
    np.testing.assert_allclose(
        weighted, measurements - 0.9 * np.array([2, 2, 30, 30, 30]), rtol=1e-14
    )


both = pytest.mark.parametrize("kind", [LinearShear, FourierShear])


@both
def test_near_objects_move_against_the_view(kind):
    """Negative shear: a view to the right and below sees the object further left and up, by whole
    pixels.
    """
    picture = np.zeros((9, 12))
    picture[6, 8] = 1
    seen = kind((9, 12), -2.0, (1, 3), (0, 1), np.float64)(picture)
    expected = np.zeros((9, 12))
    expected[4, 4] = 1
    np.testing.assert_allclose(seen, expected, atol=1e-14)


def test_light_leaves_over_the_border_with_linear_and_returns_with_fourier():
    picture = np.zeros((5, 6))
    picture[2, 5] = 1
    assert LinearShear((5, 6), 1.0, (0, 1), dtype=np.float64)(picture).sum() == 0
    assert FourierShear((5, 6), 1.0, (0, 1), dtype=np.float64)(picture)[2, 0] == pytest.approx(1)


@settings(max_examples=40, deadline=None)
@given(s=st.floats(-0.9, 0.9), v=st.integers(-4, 3), u=st.integers(-4, 3), r=st.floats(-1.0, 1.0))
def test_the_centroid_moves_by_the_shear_times_the_distance_from_the_reference(s, v, u, r):
    picture = np.zeros((21, 23))
    picture[10, 11] = 1
    seen = LinearShear((21, 23), s, (v, u), (r, -r), np.float64)(picture)
    rows, columns = np.indices(picture.shape)
    assert np.sum(rows * seen) == pytest.approx(10 + s * (v - r), abs=1e-9)
    assert np.sum(columns * seen) == pytest.approx(11 + s * (u + r), abs=1e-9)


@both
def test_a_band_limited_picture_is_shifted(kind):
    x = 2 * np.pi * np.arange(32) / 32
    seen = kind((7, 32), 0.3, (0, 1), dtype=np.float64)(np.tile(np.cos(x), (7, 1)))
    # Linear interpolation of a sine with 32 pixels a period is off by at most (2 pi / 32)^2 / 8 =
    # 0.5 %.
    bound = 5e-3 if kind is LinearShear else 1e-12
    assert np.abs(seen - np.cos(x - 0.3 * 2 * np.pi / 32))[:, 1:].max() < bound


@pytest.mark.parametrize("shift", [0.3, 0.5, -1.2])
def test_the_finest_pattern_fades_with_a_fractional_shift_and_moves_no_other_way(shift):
    """A pattern at the Nyquist frequency has no phase: shifted, only its cosine is left."""
    rows, columns = np.indices((8, 16))
    finest, wave = (-1.0) ** rows, np.cos(2 * np.pi * 3 * columns / 16)
    seen = FourierShear((8, 16), shift, (1, 0), dtype=np.float64)(finest * wave)
    np.testing.assert_allclose(seen, np.cos(np.pi * shift) * finest * wave, atol=1e-12)
    finest, wave = (-1.0) ** columns, np.cos(2 * np.pi * 3 * rows / 8)
    seen = FourierShear((8, 16), shift, (0, 1), dtype=np.float64)(finest * wave)
    np.testing.assert_allclose(seen, np.cos(np.pi * shift) * finest * wave, atol=1e-12)


MATRIX = scipy.sparse.random_array((31, 17), density=0.2, rng=np.random.default_rng(1)).tocsr()
BLOCK = np.random.default_rng(2).random((17, 6))
STRICT = ComputeDevice("array_api_strict")


@pytest.mark.parametrize("rows_at_once", [1, 4, 1000])
def test_what_does_not_fit_at_once_is_gathered_in_pieces(rows_at_once, monkeypatch):
    longest = int(np.diff(MATRIX.indptr).max())
    monkeypatch.setattr(sparse, "GATHERED_NUMBERS", rows_at_once * longest * BLOCK.shape[1])
    product = make_product(MATRIX, STRICT)
    np.testing.assert_allclose(to_numpy(product(STRICT.put(BLOCK))), MATRIX @ BLOCK, rtol=1e-13)


def test_a_matrix_without_entries():
    empty = scipy.sparse.csr_array((3, 17), dtype=np.float32)
    result = to_numpy(make_product(empty, STRICT)(STRICT.put(BLOCK.astype(np.float32))))
    np.testing.assert_array_equal(result, np.zeros((3, 6)))


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
