"""Sweep maps against pixels computed by hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tofclip.camera import PolynomialSweep, ProjectiveSweep, SkewSweep, Sweep
from tofclip.camera.sweep import sweep_from_record
from tofclip.errors import CalibrationError, FileFormatError, ShapeError
from tofclip.storage import Record

SKEW = SkewSweep(np.array([100.0, 300.0]), np.array([-4.0, 2.0]), np.array([0.01, -0.02]))
POLYNOMIAL = PolynomialSweep(
    column_coefficients=np.array([0.5, 1.0, 0.0, 0.25, -0.1, 0.2]),
    row_coefficients=np.array([-0.5, 0.1, 1.0, 0.0, 0.3, 0.0]),
    rectified_origin=np.array([10.0, 20.0]),
    rectified_scale=np.array([2.0, 4.0]),
    raw_origin=np.array([100.0, 200.0]),
    raw_scale=np.array([3.0, 5.0]),
)
PROJECTIVE = ProjectiveSweep(np.array([[1.0, 0.5, 3.0], [0.0, 2.0, -1.0], [0.001, 0.0, 1.0]]))


@pytest.mark.parametrize(
    ("column", "expected_row"),
    [
        (100.0, -4 + 1.01 * 50),
        (300.0, 2 + 0.98 * 50),
        (200.0, -1 + 0.995 * 50),  # half way: the means
        (350.0, 3.5 + (1 - 0.0275) * 50),  # a quarter beyond the outer centre: the line goes on
        (50.0, -5.5 + (1 + 0.0175) * 50),
    ],
)
def test_skew_by_hand(column: float, expected_row: float) -> None:
    raw_row, raw_column = SKEW.raw_position(np.array(50.0), np.array(column))
    assert raw_row == pytest.approx(expected_row, abs=1e-12)
    assert raw_column == column


def test_skew_of_a_single_view_is_the_same_everywhere() -> None:
    raw_row, _ = SkewSweep([7.0], [3.0], [0.5]).raw_position(
        np.array(10.0), np.array([0.0, 7.0, 900.0])
    )
    np.testing.assert_array_equal(raw_row, 18.0)


@given(st.floats(0, 1000), st.floats(-100, 500))
def test_no_skew_moves_nothing(row: float, column: float) -> None:
    still = SkewSweep([100.0, 200.0, 300.0], np.zeros(3), np.zeros(3))
    assert still.raw_position(np.array(row), np.array(column)) == (row, column)


def test_polynomial_by_hand() -> None:
    # x = (14 - 10) / 2 = 2 and y = (12 - 20) / 4 = -2:
    # u = 0.5 + 2 + 0 + 0.25 * -4 - 0.1 * 4 + 0.2 * 4 = 1.9, v = -0.5 + 0.2 - 2 + 0.3 * 4 = -1.1
    raw_row, raw_column = POLYNOMIAL.raw_position(np.array(12.0), np.array(14.0))
    assert raw_column == pytest.approx(1.9 * 3 + 100, abs=1e-12)
    assert raw_row == pytest.approx(-1.1 * 5 + 200, abs=1e-12)


def test_projective_by_hand() -> None:
    # Weight 0.001 * 100 + 1 = 1.1; column (100 + 0.5 * 10 + 3) / 1.1, row (2 * 10 - 1) / 1.1.
    raw_row, raw_column = PROJECTIVE.raw_position(np.array(10.0), np.array(100.0))
    assert raw_column == pytest.approx(108 / 1.1, abs=1e-12)
    assert raw_row == pytest.approx(19 / 1.1, abs=1e-12)


@pytest.mark.parametrize("sweep", [SKEW, POLYNOMIAL, PROJECTIVE])
def test_rows_and_columns_broadcast(sweep: Sweep) -> None:
    rows, columns = np.arange(5.0), np.linspace(0, 400, 7)
    grid = sweep.raw_position(rows[:, np.newaxis], columns[np.newaxis, :])
    for i, row in enumerate(rows):
        for j, column in enumerate(columns):
            one = sweep.raw_position(np.array(row), np.array(column))
            np.testing.assert_allclose([grid[0][i, j], grid[1][i, j]], one, rtol=1e-14)


@pytest.mark.parametrize("sweep", [SKEW, POLYNOMIAL, PROJECTIVE])
def test_a_sweep_survives_its_file(sweep: Sweep, tmp_path: Path) -> None:
    sweep.to_record().save(tmp_path / "sweep.h5")
    got = sweep_from_record(Record.load(tmp_path / "sweep.h5"))
    assert type(got) is type(sweep)
    here = np.array([3.0, 99.0]), np.array([250.0, 17.0])
    np.testing.assert_array_equal(got.raw_position(*here), sweep.raw_position(*here))


def test_an_unknown_sweep_is_refused() -> None:
    with pytest.raises(FileFormatError, match=r"a\.h5: holds an unknown sweep 'spline_sweep'"):
        sweep_from_record(Record("spline_sweep", origin="a.h5"))


def test_numbers_that_describe_no_map_are_refused() -> None:
    with pytest.raises(
        ShapeError, match=r"sweep skew must have shape \(views,\) in all three arrays"
    ):
        SkewSweep([1.0, 2.0], [0.0], [0.0, 0.0])
    with pytest.raises(ShapeError, match="sweep centres"):
        SkewSweep([], [], [])
    for centres in ([2.0, 1.0], [1.0, 1.0], [1.0, np.nan]):
        with pytest.raises(CalibrationError, match="centres must increase"):
            SkewSweep(centres, [0.0, 0.0], [0.0, 0.0])
    with pytest.raises(ShapeError, match=r"row_coefficients must have shape \(6,\), got \(5,\)"):
        PolynomialSweep(np.ones(6), np.ones(5), *np.ones((4, 2)))
    with pytest.raises(CalibrationError, match="scales must not be zero"):
        PolynomialSweep(np.ones(6), np.ones(6), *np.zeros((4, 2)))
    with pytest.raises(ShapeError, match=r"\(3, 3\)"):
        ProjectiveSweep(np.eye(2))


def test_a_skew_between_any_two_of_several_centres_is_theirs() -> None:
    sweep = SkewSweep(
        np.array([0.0, 10.0, 20.0, 40.0]), np.array([0.0, 5.0, -3.0, 1.0]), np.zeros(4)
    )
    columns = np.array([-2.0, 0.0, 5.0, 10.0, 15.0, 20.0, 30.0, 40.0, 50.0])
    raw_row, _ = sweep.raw_position(np.zeros(9), columns)
    assert raw_row == pytest.approx([-1.0, 0.0, 2.5, 5.0, 1.0, -3.0, -1.0, 1.0, 3.0])


def test_a_homography_that_leans_along_time() -> None:
    sweep = ProjectiveSweep(np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.01, 1.0]]))
    raw_row, raw_column = sweep.raw_position(np.array(50.0), np.array(30.0))
    assert (float(raw_row), float(raw_column)) == pytest.approx((50 / 1.5, 30 / 1.5))
