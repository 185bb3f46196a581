"""Measurements from streak images made by hand, and sums of rectified rows."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from tofclip.camera import (
    Camera,
    ProjectiveSweep,
    Rectifier,
    SkewSweep,
    estimate_dark_level,
    measure,
)
from tofclip.camera.noise import MeasurementNoise
from tofclip.camera.rectifier import RowSums
from tofclip.errors import CalibrationError, InputError
from tofclip.threads import LANES

WIDTH, ROWS = 61, 80


def camera(**changes: object) -> Camera:
    settings = {
        "centres_px": [15.0, 45.0],
        "angles": [0.1, 0.2],
        "image_shape": (9, 9),
        "slit_width_px": WIDTH,
    }
    return Camera(**{**settings, **changes})


def streak(dark: float = 100.0) -> np.ndarray:
    counts = np.full((ROWS, WIDTH), dark, np.float32)
    counts[30:50] += np.random.default_rng(0).random((20, WIDTH)).astype(np.float32) * 500
    return counts


def test_the_dark_level_comes_off_and_time_becomes_the_last_axis():
    counts = streak()
    measured = measure(counts, None, camera())
    np.testing.assert_allclose(measured.values, (counts - 100).T)
    assert measured.valid.all()


def test_noise_about_the_dark_level_stays_centred():
    rng = np.random.default_rng(1)
    counts = (streak() + 8 * rng.standard_normal((ROWS, WIDTH))).astype(np.float32)
    # The quietest 4 of 60 dark rows: the median of their 244 pixels scatters by 8 * 1.25 /
    # sqrt(244) = 0.64, and choosing the quietest rows pulls it down by less than two standard
    # errors of a row's mean (2.0).
    assert estimate_dark_level(counts) == pytest.approx(100, abs=4)
    assert measure(counts, None, camera()).values.min() < 0


def test_a_given_dark_level_is_used():
    counts = streak()
    np.testing.assert_allclose(measure(counts, None, camera(), dark=90.0).values, (counts - 90).T)


def test_a_skew_is_undone():
    rows = np.arange(ROWS, dtype=float)[:, np.newaxis]
    column = np.arange(WIDTH)[np.newaxis]
    delay = 4.0 * (column - 15) / 30  # 0 rows at the first view's centre, 4 at the second's
    counts = np.exp(-((rows - 40 - delay) ** 2) / (2 * 6.0**2)).astype(np.float32)
    sweep = SkewSweep([15.0, 45.0], [0.0, 4.0], [0.0, 0.0])
    measured = measure(counts, None, camera(sweep=sweep), dark=0.0)
    expected = np.exp(-((rows - 40) ** 2) / (2 * 6.0**2)).T
    inside = measured.valid
    # Linear interpolation of a Gaussian is off by at most max|f''| / 8 = 1 / (8 * 36).
    np.testing.assert_allclose(
        measured.values[inside],
        np.broadcast_to(expected, (WIDTH, ROWS))[inside],
        atol=1 / 288,
    )
    assert not inside[-1, -6:].any()  # the late view's last instants lie beyond the picture
    assert inside[15].all()


def test_what_touches_a_saturated_pixel_is_masked():
    saturated = np.zeros((ROWS, WIDTH), bool)
    saturated[40, 20] = True
    plain = measure(streak(), saturated, camera())
    assert np.argwhere(~plain.valid).tolist() == [[20, 40]]
    sweep = SkewSweep([15.0, 45.0], [0.5, 0.5], [0.0, 0.0])
    shifted = measure(streak(), saturated, camera(sweep=sweep))
    assert np.argwhere(~shifted.valid[:, :-1]).tolist() == [[20, 39], [20, 40]]


def test_dead_columns_are_masked():
    dead = np.arange(WIDTH) == 33
    measured = measure(streak(), None, camera(dead_columns=dead))
    np.testing.assert_array_equal(~measured.valid, np.repeat(dead[:, np.newaxis], ROWS, axis=1))


def test_what_cannot_be_measured_is_refused():
    with pytest.raises(CalibrationError, match="61 columns but the camera's slit has 64"):
        measure(streak(), None, camera(slit_width_px=64))
    with pytest.raises(InputError, match="no measurement can be trusted"):
        measure(streak(), np.ones((ROWS, WIDTH), bool), camera())
    with pytest.raises(InputError, match="dark level"):
        measure(np.full((ROWS, WIDTH), 7, np.float32), None, camera())


@pytest.mark.parametrize("row", [0, ROWS - 1])
def test_light_in_a_single_row_is_light(row):
    counts = np.full((ROWS, WIDTH), 7, np.float32)
    counts[row, 5] = 9
    measured = Rectifier(camera(), ROWS).rectify(counts)
    assert measured[5, row] == 2
    assert np.count_nonzero(measured) == 1


def test_a_sweep_that_moves_light_across_columns_is_undone_bilinearly():
    matrix = np.array([[1.01, 0.02, -0.7], [-0.03, 0.98, 1.3], [1e-4, -2e-4, 1.0]])
    turned = camera(sweep=ProjectiveSweep(matrix), dead_columns=np.arange(WIDTH) == 20)
    counts, delay = streak(), 0.4
    saturated = np.zeros(counts.shape, bool)
    saturated[35, 30] = True
    found = Rectifier(turned, ROWS).measure(counts, saturated, delay=delay)
    row, column = turned.sweep.raw_position(*np.mgrid[:ROWS, :WIDTH].astype(float))
    row += delay
    inside = (row >= 0) & (row <= ROWS - 1) & (column >= 0) & (column <= WIDTH - 1)
    expected = np.where(
        inside, map_coordinates(counts - 100.0, [row, column], order=1, mode="nearest"), 0
    )
    expected[:, 20] = 0
    # positions in float32 are good to 1e-5 pixels, times steps of 500 counts
    np.testing.assert_allclose(found.values.T, expected, atol=0.02)
    np.testing.assert_array_equal(
        found.values, Rectifier(turned, ROWS).rectify(counts, delay=delay)
    )
    touched = map_coordinates(saturated.astype(float), [row, column], order=1, mode="nearest") > 0
    valid = inside & ~touched
    valid[:, 20] = False
    np.testing.assert_array_equal(found.valid.T, valid)
    assert (inside & touched).sum() >= 3


def test_a_single_row_or_column_is_sampled_too():
    low = camera(sweep=SkewSweep(np.array([15.0]), np.array([0.0]), np.array([0.0])))
    counts = np.arange(WIDTH, dtype=np.float32)[np.newaxis]
    np.testing.assert_array_equal(measure(counts, None, low, dark=0.0).values[:, 0], counts[0])
    narrow = Camera([0.0], [0.0], (1, 1), 1, sweep=ProjectiveSweep(np.diag([1.0, 1.0, 1.0])))
    np.testing.assert_array_equal(measure(counts.T, None, narrow, dark=0.0).values[0], counts[0])


def test_the_dark_level_is_that_of_the_quietest_rows():
    """Light in most of the rows does not raise it."""
    counts = np.full((40, 30), 100, np.float32)
    counts[4:] += 50
    assert estimate_dark_level(counts) == 100


def test_a_sweep_reads_the_picture_s_last_column_and_row():
    """Mirrored, the first pixel lies exactly on the last: nothing of it comes from beyond."""
    mirror = ProjectiveSweep(np.array([[-1.0, 0, 23], [0, -1.0, 19], [0, 0, 1.0]]))
    mirrored = Camera(np.array([12.0]), np.array([0.0]), (8, 8), 24, sweep=mirror)
    counts = np.random.default_rng(0).uniform(10, 200, (20, 24)).astype(np.float32)
    found = measure(counts, None, mirrored, dark=0.0)
    np.testing.assert_allclose(found.values, counts[::-1, ::-1].T, rtol=1e-5)
    assert found.valid.all()


def test_a_hot_column_does_not_raise_the_dark_level():
    counts = np.full((ROWS, WIDTH), 100.0, np.float32)
    counts[:, 7] = 60_000
    assert estimate_dark_level(counts) == 100


@pytest.mark.parametrize("columns", [7, 8])
def test_the_dark_level_is_the_median_of_the_quietest_rows(columns):
    counts = np.random.default_rng(columns).poisson(90, (60, columns)).astype(np.float32)
    counts[5:] += 1000
    assert estimate_dark_level(counts) == np.median(counts[np.argsort(counts.sum(axis=1))[:3]])


def test_the_variance_of_a_measurement_by_hand():
    """Floor and misfit are deviations, the gain is counts for each photon."""
    light = np.array([[0.0, 2.0], [30.0, 4.0]], np.float32)
    noise = MeasurementNoise(floor=3.0, gain=2.0, misfit=0.1)
    np.testing.assert_allclose(
        noise.compute_variance(light), [[9 + 4.5, 9 + 4 + 0.1], [9 + 60 + 4.5, 9 + 8 + 0.1]]
    )
    assert MeasurementNoise.from_figures(noise.list_figures()) == noise


LONG_ROWS, SUM_WIDTH, LENGTH = 200, 75, 5
SKEW = SkewSweep(np.array([20.0, 55.0]), np.array([-6.0, 9.5]), np.array([0.01, -0.02]))
TURNED = ProjectiveSweep(np.array([[1.01, 0.02, -0.7], [-0.03, 0.98, 1.3], [1e-5, -2e-5, 1.0]]))


def sum_camera(sweep=SKEW, dead: int = 20) -> Camera:
    return Camera(
        [37.0], [0.0], (8, 8), SUM_WIDTH, sweep=sweep, dead_columns=np.arange(SUM_WIDTH) == dead
    )


def long_streak(seed: int = 0) -> np.ndarray:
    counts = np.random.default_rng(seed).poisson(90, (LONG_ROWS, SUM_WIDTH)).astype(np.float32)
    counts[60:130] += 300
    return counts


@pytest.mark.parametrize("sweep", [SKEW, TURNED, None])
def test_sums_are_those_of_rectified_rows(sweep):
    rectifier, counts = Rectifier(sum_camera(sweep), LONG_ROWS), long_streak()
    # more than the threads' blocks; the last ones begin anew, as of instants that fill a vector up
    starts = np.append(np.arange(0, LONG_ROWS - LENGTH, 2), np.zeros(LANES, int))[: 4 * LANES]
    starts = np.pad(starts, (0, 4 * LANES - starts.size))
    sums = np.full((SUM_WIDTH, starts.size + 3), -1, np.float32)
    dark = RowSums(rectifier, starts, LENGTH).add_up(counts, sums)
    assert dark == estimate_dark_level(counts)
    rectified = rectifier.rectify(counts)
    expected = rectified[:, starts[:, np.newaxis] + np.arange(LENGTH)].sum(axis=2)
    # sums of 500 counts before the dark level is taken off
    np.testing.assert_allclose(sums[:, :-3], expected, atol=1e-3)
    assert np.all(sums[:, -3:] == -1)
    assert not sums[20, :-3].any()
    outside = ~rectifier.inside.T[:, starts[:, np.newaxis] + np.arange(LENGTH)].any(axis=2)
    assert outside.any() or sweep is None
    assert not sums[:, :-3][outside].any()


@pytest.mark.parametrize("sweep", [SKEW, TURNED])
def test_some_rows_are_rectified_as_all_are(sweep):
    rectifier, counts = Rectifier(sum_camera(sweep), LONG_ROWS), long_streak(1)
    numbers = np.array([0, 3, 4, 100, LONG_ROWS - 1])
    found = rectifier.rectify_rows(counts, 90.0, numbers)
    np.testing.assert_array_equal(found, rectifier.rectify(counts, dark=90.0)[:, numbers])


def test_a_dark_shot_and_one_of_another_size_are_refused():
    rectifier = Rectifier(sum_camera(), LONG_ROWS)
    adder = RowSums(rectifier, np.arange(LANES), LENGTH)
    sums = np.empty((SUM_WIDTH, LANES), np.float32)
    with pytest.raises(InputError, match="dark level"):
        adder.add_up(np.full((LONG_ROWS, SUM_WIDTH), 7, np.float32), sums)
    with pytest.raises(InputError, match="streak image of this camera"):
        adder.add_up(long_streak()[:-1], sums)
