"""Point-spread functions: of apertures against geometric optics, measured ones, their convolutions against
sums written out, and the sensors behind them.
"""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tofclip.errors import InputError
from tofclip.operators import (
    DenseSensor,
    LinearShear,
    MaskedSensor,
    PitchedSensor,
    PointSpreadConvolution,
    SliceConvolution,
)
from tofclip.operators.convolution import make_coded_line
from tofclip.operators.point_spreads import (
    CodedAperture,
    CubicPhasePlate,
    Diffuser,
    MeasuredPointSpreads,
    shear_point_spreads,
    trace_view_point_spreads,
)

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


VIEWS = [(float(v), float(u)) for v in range(-4, 4) for u in range(-4, 4)]
SHAPE = (64, 72)


def spread_at(element, shear: float) -> np.ndarray:
    return shear_point_spreads(trace_view_point_spreads(element, VIEWS, SHAPE), VIEWS, shear).sum(
        axis=0
    )


@pytest.mark.parametrize("shear", [3.0, -2.0])
def test_a_coded_aperture_s_spread_is_its_code_mirrored_and_scaled_by_the_shear(shear):
    """Supplement Eq. 6; the code's cells are the views, so that at whole s each is one pixel of the
    PSF.
    """
    code = np.random.default_rng(0).integers(0, 2, (8, 8))
    spread = spread_at(CodedAperture(code), shear)
    expected = np.zeros(SHAPE)
    for v, u in VIEWS:
        # The aperture's middle lies at view -0.5: its mirror image of view v is -1 - v, cell 3 - v.
        expected[int(32 + shear * v), int(36 + shear * u)] = code[int(3 - v), int(3 - u)] / 64
    np.testing.assert_allclose(spread, expected, atol=1e-12)


def test_in_focus_a_coded_aperture_s_spread_is_a_point():
    code = np.random.default_rng(1).random((8, 8))
    spread = spread_at(CodedAperture(code), 0.0)
    assert spread[32, 36] == pytest.approx(code.mean(), rel=1e-12)
    assert np.count_nonzero(spread) == 1


def test_a_cubic_phase_plate_s_spread_hardly_changes_with_depth():
    """Against an open aperture, whose PSF grows with s: the likeness of two depths' PSFs."""

    def similarity(element) -> float:
        near, far = (np.abs(np.fft.fft2(spread_at(element, s))) for s in (0.0, 0.7))
        return float(np.vdot(near, far) / np.linalg.norm(near) / np.linalg.norm(far))

    assert similarity(CubicPhasePlate(24.0)) > 0.98
    assert similarity(CodedAperture(np.ones((8, 8)))) < 0.8


def test_a_cubic_phase_plate_s_spread_is_as_large_as_asked_and_brightest_in_a_corner():
    spread = spread_at(CubicPhasePlate(20.0), 0.0)
    rows = np.flatnonzero(spread.sum(axis=1) > 1e-9)
    assert 20 <= np.ptp(rows) <= 21
    assert np.unravel_index(spread.argmax(), SHAPE) == (22, 26)


def test_a_diffuser_s_spread_is_as_wide_as_asked_and_its_seed_decides_it():
    spread = spread_at(Diffuser(6.0, 0.15, 3), 0.0)
    rows, columns = np.indices(SHAPE)
    variance = np.sum(((rows - 32) ** 2 + (columns - 36) ** 2) * spread) / 2
    assert spread.sum() == pytest.approx(1, abs=1e-3)
    # The deflections' variance is the PSF's second moment about zero deflection; the pixels add 1/6
    # of a pixel.
    assert np.sqrt(variance) == pytest.approx(6.0, rel=0.1)
    np.testing.assert_array_equal(spread, spread_at(Diffuser(6.0, 0.15, 3), 0.0))
    assert not np.allclose(spread, spread_at(Diffuser(6.0, 0.15, 4), 0.0))


def test_a_diffuser_s_spread_grows_and_moves_with_depth_as_the_rays_do():
    """The mean of s (u + deflection) over the aperture: u's mean is -0.5 views on this grid."""
    rows, columns = np.indices(SHAPE)
    shift = []
    for shear in (0.0, -2.0):
        spread = spread_at(Diffuser(5.0, 0.2, 0), shear)
        shift.append([np.sum(rows * spread), np.sum(columns * spread)])
    np.testing.assert_allclose(np.subtract(shift[1], shift[0]), [1.0, 1.0], atol=1e-2)


def test_shearing_the_spread_is_shearing_the_picture():
    """A_k B_k h, for a picture and a PSF that stay off every border."""
    spreads = trace_view_point_spreads(Diffuser(2.0, 0.3, 0), [(0.0, 0.0), (1.0, 2.0)], (24, 25))
    picture = np.zeros((64, 65))
    picture[25:40, 25:40] = np.random.default_rng(4).random((15, 15))
    view, reference = (1.0, 2.0), (0.3, -0.4)
    moved = shear_point_spreads(spreads, [(0.0, 0.0), view], -0.7, reference)[1]
    together = PointSpreadConvolution((64, 65), moved, dtype=np.float64)(picture)
    sheared = LinearShear((64, 65), -0.7, view, reference, np.float64)(picture)
    np.testing.assert_allclose(
        together,
        PointSpreadConvolution((64, 65), spreads[1], dtype=np.float64)(sheared),
        atol=1e-12,
    )


def test_measured_spreads_are_returned_where_measured_and_mixed_between():
    stack = np.random.default_rng(5).random((3, 6, 7)) * np.array([1.0, 5.0, 2.0])[:, None, None]
    measured = MeasuredPointSpreads(stack, [0.5, -1.0, 0.0])
    unit = stack / stack.sum(axis=(1, 2), keepdims=True)
    np.testing.assert_allclose(measured.interpolate(-1.0), unit[1], rtol=1e-12)
    np.testing.assert_allclose(measured.interpolate(0.5), unit[0], rtol=1e-12)
    np.testing.assert_allclose(
        measured.interpolate(-0.25), 0.25 * unit[1] + 0.75 * unit[2], rtol=1e-12
    )
    np.testing.assert_allclose(
        MeasuredPointSpreads(stack[:1], [2.0]).interpolate(2.0), unit[0], rtol=1e-12
    )


@pytest.mark.parametrize(
    ("stack", "shears", "message"),
    [
        (np.ones((2, 3, 3)), [0.0], "must have shape"),
        (np.ones((2, 3, 3)), [0.0, 0.0], "same shear"),
        (np.zeros((1, 3, 3)), [0.0], "hold light"),
        (np.full((1, 3, 3), np.nan), [0.0], "hold light"),
        (np.ones((1, 3, 3)), [np.inf], "hold light"),
    ],
)
def test_measurements_that_cannot_be_used_are_refused(stack, shears, message):
    with pytest.raises(InputError, match=message):
        MeasuredPointSpreads(stack, shears)


def test_a_depth_that_was_not_measured_is_refused():
    with pytest.raises(InputError, match=r"beyond the measured 0 \.\.\. 1"):
        MeasuredPointSpreads(np.ones((2, 3, 3)), [0.0, 1.0]).interpolate(1.2)


def test_a_diffuser_without_grain_is_refused():
    with pytest.raises(InputError, match="grain"):
        trace_view_point_spreads(Diffuser(3.0, 0.0, 0), VIEWS, (8, 8))
