"""Measurements from streak images made by hand, sums of rectified rows, and calibration from pictures
of a point source whose geometry is known.
"""

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
from tofclip.camera.focus_pictures import calibrate_views
from tofclip.camera.noise import MeasurementNoise
from tofclip.errors import CalibrationError, InputError, ShapeError

WIDTH, ROWS = 61, 80
TURN = np.array([[1.01, 0.02, -0.7], [-0.03, 0.98, 1.3], [1e-4, -2e-4, 1.0]])


def camera(**changes):
    made = {"centres_px": [15.0, 45.0], "angles": [0.1, 0.2], "image_shape": (9, 9)}
    return Camera(**{**made, "slit_width_px": WIDTH, **changes})


def skew(*offsets):
    return SkewSweep([15.0, 45.0], offsets, [0.0, 0.0])


def streak(dark=100.0):
    counts = np.full((ROWS, WIDTH), dark, np.float32)
    counts[30:50] += np.random.default_rng(0).random((20, WIDTH)).astype(np.float32) * 500
    return counts


def test_the_dark_level_comes_off_and_time_becomes_the_last_axis():
    measured = measure(streak(), None, camera())
    np.testing.assert_allclose(measured.values, (streak() - 100).T)
    assert measured.valid.all()
    given = measure(streak(), None, camera(), dark=90.0)
    np.testing.assert_allclose(given.values, (streak() - 90).T)


def test_noise_about_the_dark_level_stays_centred():
    noise = 8 * np.random.default_rng(1).standard_normal((ROWS, WIDTH))
    counts = (streak() + noise).astype(np.float32)
    # The quietest 4 of 60 dark rows: the median of their 244 pixels scatters by 8 * 1.25 /
    # sqrt(244) = 0.64, and choosing the quietest rows pulls it down by less than two standard
    # errors of a row's mean (2.0).
    assert estimate_dark_level(counts) == pytest.approx(100, abs=4)
    assert measure(counts, None, camera()).values.min() < 0


def test_neither_light_in_most_rows_nor_a_hot_column_raises_the_dark_level():
    counts = np.full((40, 30), 100, np.float32)
    counts[4:] += 50
    counts[:, 7] = 60_000
    assert estimate_dark_level(counts) == 100


@pytest.mark.parametrize("background", [0.3, 2.0, 2.5])
def test_the_dark_level_is_the_mean_of_few_photons_times_a_gain(background):
    """Their median is a whole photon, and the quietest rows are so by their noise."""
    random = np.random.default_rng(3)
    photons = random.poisson(background, (600, 300))
    photons[200:] += random.poisson(40, (400, 300))
    counts = 9 * photons + random.normal(300, 7, photons.shape)
    # 30 rows of 300 readings: 0.1 to 0.17 counts, and as much is left out of the photons' tail; the
    # medians of the quietest rows are 1.1 to 2.6 counts lower
    assert estimate_dark_level(counts.astype(np.float32)) == pytest.approx(
        300 + 9 * background, abs=0.6
    )


@pytest.mark.parametrize("row", [0, ROWS - 1])
def test_light_in_a_single_row_is_light(row):
    counts = np.full((ROWS, WIDTH), 7, np.float32)
    counts[row, 5] = 9
    measured = Rectifier(camera(), ROWS).rectify(counts)
    assert measured[5, row] == 2
    assert np.count_nonzero(measured) == 1


def test_what_touches_a_saturated_pixel_and_dead_columns_are_masked():
    saturated = np.zeros((ROWS, WIDTH), bool)
    saturated[40, 20] = True
    plain = measure(streak(), saturated, camera())
    assert np.argwhere(~plain.valid).tolist() == [[20, 40]]
    shifted = measure(streak(), saturated, camera(sweep=skew(0.5, 0.5)))
    assert np.argwhere(~shifted.valid[:, :-1]).tolist() == [[20, 39], [20, 40]]
    dead = np.arange(WIDTH) == 33
    measured = measure(streak(), None, camera(dead_columns=dead))
    np.testing.assert_array_equal(~measured.valid, np.repeat(dead[:, np.newaxis], ROWS, axis=1))


@pytest.mark.parametrize("sweep", [ProjectiveSweep(TURN), skew(-3.17, 4.2)])
@pytest.mark.parametrize("delay", [0.0, 0.4, -7.3])
def test_sweeps_are_undone_bilinearly_however_late_a_shot_is(sweep, delay):
    turned = camera(sweep=sweep, dead_columns=np.arange(WIDTH) == 20)
    counts, saturated = streak(), np.zeros((ROWS, WIDTH), bool)
    saturated[35, 30] = saturated[50, 31] = True
    rectifier = Rectifier(turned, ROWS)
    found = rectifier.measure(counts, saturated, delay=delay)
    row, column = turned.sweep.raw_position(*np.mgrid[:ROWS, :WIDTH].astype(float))
    row += delay
    inside = (row >= 0) & (row <= ROWS - 1) & (column >= 0) & (column <= WIDTH - 1)
    inside[:, 20] = False

    def sample(picture):
        return map_coordinates(picture.astype(float), [row, column], order=1, mode="nearest")

    expected = np.where(inside, sample(counts - 100.0), 0)
    # positions in float32 are good to 1e-5 pixels, times steps of 500 counts
    np.testing.assert_allclose(found.values.T, expected, atol=0.02)
    np.testing.assert_array_equal(found.values, rectifier.rectify(counts, delay=delay))
    touched = sample(saturated) > 0
    np.testing.assert_array_equal(found.valid.T, inside & ~touched)
    assert (inside & touched).sum() >= 3


def test_pictures_of_a_single_row_or_column_and_their_last_pixels_are_sampled_too():
    low = camera(sweep=SkewSweep([15.0], [0.0], [0.0]))
    counts = np.arange(WIDTH, dtype=np.float32)[np.newaxis]
    np.testing.assert_array_equal(measure(counts, None, low, dark=0.0).values[:, 0], counts[0])
    narrow = Camera([0.0], [0.0], (1, 1), 1, sweep=ProjectiveSweep(np.eye(3)))
    np.testing.assert_array_equal(measure(counts.T, None, narrow, dark=0.0).values[0], counts[0])
    # Mirrored, the first pixel lies exactly on the last: nothing of it comes from beyond.
    mirror = ProjectiveSweep(np.array([[-1.0, 0, 23], [0, -1.0, 19], [0, 0, 1.0]]))
    mirrored = Camera([12.0], [0.0], (8, 8), 24, sweep=mirror)
    counts = np.random.default_rng(0).uniform(10, 200, (20, 24)).astype(np.float32)
    found = measure(counts, None, mirrored, dark=0.0)
    np.testing.assert_allclose(found.values, counts[::-1, ::-1].T, rtol=1e-5)
    assert found.valid.all()


def test_the_variance_of_a_measurement_by_hand():
    """Floor and misfit are deviations, the gain is counts for each photon."""
    light = np.array([[0.0, 2.0], [30.0, 4.0]], np.float32)
    noise = MeasurementNoise(floor=3.0, gain=2.0, misfit=0.1)
    expected = [[9 + 4.5, 9 + 4 + 0.1], [9 + 60 + 4.5, 9 + 8 + 0.1]]
    np.testing.assert_allclose(noise.compute_variance(light), expected)
    assert MeasurementNoise.from_figures(noise.list_figures()) == noise


def test_what_cannot_be_measured_is_refused():
    with pytest.raises(CalibrationError, match="61 columns but the camera's slit has 64"):
        measure(streak(), None, camera(slit_width_px=64))
    with pytest.raises(CalibrationError, match="or turn the picture"):
        measure(streak(), None, camera(slit_width_px=ROWS))
    with pytest.raises(InputError, match="no measurement can be trusted"):
        measure(streak(), np.ones((ROWS, WIDTH), bool), camera())
    with pytest.raises(InputError, match="dark level"):
        measure(np.full((ROWS, WIDTH), 7, np.float32), None, camera())
    with pytest.raises(ShapeError):
        Rectifier(camera(), ROWS).measure(streak()[:-1])


CENTRES = np.array([95.3, 250.8, 405.1, 560.6])
ANGLES = np.deg2rad([-42.0, -11.3, 0.4, 37.7])
SHAPE, SLIT_ROW = (220, 660), 108


def pictures(seed, noise=5.0):
    """Lines, their background, dots and theirs, as a camera with an offset and read noise takes
    them.
    """
    rng = np.random.default_rng(seed)
    row, column = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(float)
    lines, dots = np.zeros(SHAPE), np.zeros(SHAPE)
    for centre, angle in zip(CENTRES, ANGLES, strict=True):
        along = (row - SLIT_ROW) * np.cos(angle) + (column - centre) * np.sin(angle)
        across = (column - centre) * np.cos(angle) - (row - SLIT_ROW) * np.sin(angle)
        lines += 4000 * np.exp(-(across**2) / (2 * 2.5**2)) / (1 + np.exp((np.abs(along) - 60) / 2))
        dots += 400 * np.exp(-((row - SLIT_ROW) ** 2 + (column - centre) ** 2) / (2 * 2.5**2))
    return [100 + signal + noise * rng.standard_normal(SHAPE) for signal in (lines, 0, dots, 0)]


@pytest.mark.parametrize("seed", range(2))
def test_known_geometry_comes_back(seed):
    found = calibrate_views(*pictures(seed), views=4)
    # Centroids of well-exposed dots and lines are good to some hundredths of a pixel.
    np.testing.assert_allclose(found.centres_px, CENTRES, atol=0.1)
    np.testing.assert_allclose(np.rad2deg(found.angles), np.rad2deg(ANGLES), atol=0.1)
    np.testing.assert_allclose(found.line_columns_px, CENTRES, atol=0.3)
    np.testing.assert_allclose(found.dot_rows_px, SLIT_ROW, atol=0.3)


def test_uncertainties_match_the_spread():
    found = [calibrate_views(*pictures(seed, noise=15), views=4) for seed in range(12)]
    spread = np.std([f.centres_px - CENTRES for f in found])
    stated = np.mean([f.centre_uncertainty_px for f in found])
    # 48 draws know a standard deviation to 1 / sqrt(2 * 48), 10 %, and this is three of these; over
    # twelve such sets of seeds the ratio was 0.85 to 1.10, on average 0.99.
    assert stated / spread == pytest.approx(1, abs=3 / np.sqrt(2 * 48))


def test_the_camera_takes_over_every_number():
    found = calibrate_views(*pictures(0), views=4)
    made = found.camera(time_zero=1e-9)
    np.testing.assert_array_equal(made.centres_px, found.centres_px)
    assert (made.slit_width_px, made.time_zero) == (SHAPE[1], 1e-9)
    assert made.image_shape[0] == pytest.approx(120, abs=8)  # the lines are 120 px long
    assert made.image_shape[1] == pytest.approx(155, abs=2)  # the median pitch
    assert found.camera(image_shape=(64, 65)).image_shape == (64, 65)


def test_unusable_pictures_are_refused():
    lines, dark, dots, _ = pictures(0)
    for given, views, message in (
        ((lines, dark, dark, dark), 4, "found 0 dots"),
        ((lines, dark, dots, dark), 6, "found 4 dots on the slit, expected 6"),
        ((dark, dark, dots, dark), 4, r"no line|only"),
    ):
        with pytest.raises(CalibrationError, match=message):
            calibrate_views(*given, views=views)
    with pytest.raises(InputError, match="NaN"):
        calibrate_views(np.full(SHAPE, np.nan), dark, dots, dark, views=4)
    for position in range(4):
        wrong = pictures(0)
        wrong[position] = wrong[position][:, :-3]
        with pytest.raises(ShapeError):
            calibrate_views(*wrong, views=4)


def test_the_instrument_s_own_pictures(shared_data):
    import tifffile

    folder = shared_data / "clip"
    if not folder.is_dir():
        pytest.skip("no clip pictures in the recorded data")
    names = ("LinePattern", "LinePattern_bkg", "DotPattern", "DotPattern_bkg")
    found = calibrate_views(*(tifffile.imread(folder / f"{name}.tif") for name in names))
    # An independent trial on the same pictures; half a pixel and half a degree are its own
    # repeatability.
    centres = [147.7, 320.0, 490.2, 664.1, 835.5, 1011.5, 1192.3]
    angles = [-43.3, -25.7, -12.7, 0.6, 22.9, 37.5, 48.0]
    np.testing.assert_allclose(found.centres_px, centres, atol=0.5)
    np.testing.assert_allclose(np.rad2deg(found.angles), angles, atol=0.5)
    assert np.all(found.centre_uncertainty_px < 0.5)
    assert np.all(np.rad2deg(found.angle_uncertainty) < 0.5)
