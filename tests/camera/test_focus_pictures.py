"""Calibration from pictures of a point source whose geometry is known."""

from __future__ import annotations

import numpy as np
import pytest

from tofclip.camera import focus_pictures
from tofclip.camera.focus_pictures import calibrate_views
from tofclip.errors import CalibrationError, InputError, ShapeError

CENTRES = np.array([95.3, 250.8, 405.1, 560.6])
ANGLES = np.deg2rad([-42.0, -11.3, 0.4, 37.7])
SHAPE, SLIT_ROW = (220, 660), 108


def pictures(seed: int, noise: float = 5.0) -> list[np.ndarray]:
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


@pytest.mark.parametrize("seed", range(5))
def test_known_geometry_comes_back(seed):
    found = calibrate_views(*pictures(seed), views=4)
    # Centroids of well-exposed dots and lines are good to some hundredths of a pixel.
    np.testing.assert_allclose(found.centres_px, CENTRES, atol=0.1)
    np.testing.assert_allclose(np.rad2deg(found.angles), np.rad2deg(ANGLES), atol=0.1)
    np.testing.assert_allclose(found.line_columns_px, CENTRES, atol=0.3)
    np.testing.assert_allclose(found.dot_rows_px, SLIT_ROW, atol=0.3)


def test_the_stated_error_of_an_angle_follows_from_that_of_the_slope(monkeypatch):
    """d arctan(s) = ds / (1 + s^2): at 45 degrees half of it."""
    monkeypatch.setattr(focus_pictures, "_fit_principal_line", lambda *_: (1.0, 100.0, 0.02))
    found = calibrate_views(*pictures(0), views=4)
    np.testing.assert_allclose(found.angles, np.pi / 4)
    np.testing.assert_allclose(found.angle_uncertainty, 0.01)


def test_uncertainties_match_the_spread():
    found = [calibrate_views(*pictures(seed, noise=15), views=4) for seed in range(12)]
    spread = np.std([f.centres_px - CENTRES for f in found])
    stated = np.mean([f.centre_uncertainty_px for f in found])
    # 48 draws know a standard deviation to 1 / sqrt(2 * 48), 10 %, and this is three of these; over
    # twelve such sets of seeds the ratio was 0.85 to 1.10, on average 0.99.
    assert stated / spread == pytest.approx(1, abs=3 / np.sqrt(2 * 48))


def test_the_camera_takes_over_every_number():
    found = calibrate_views(*pictures(0), views=4)
    camera = found.camera(time_zero=1e-9)
    np.testing.assert_array_equal(camera.centres_px, found.centres_px)
    assert camera.slit_width_px == SHAPE[1]
    assert camera.time_zero == 1e-9
    assert camera.image_shape[0] == pytest.approx(120, abs=8)  # the lines are 120 px long
    assert camera.image_shape[1] == pytest.approx(155, abs=2)  # the median pitch
    assert found.camera(image_shape=(64, 65)).image_shape == (64, 65)


@pytest.mark.parametrize("position", range(4))
def test_pictures_that_do_not_belong_together_are_refused(position):
    wrong = pictures(0)
    wrong[position] = wrong[position][:, :-3]
    with pytest.raises(ShapeError):
        calibrate_views(*wrong, views=4)


def test_unusable_pictures_are_refused():
    lines, lines_dark, dots, dots_dark = pictures(0)
    with pytest.raises(CalibrationError, match="found 0 dots"):
        calibrate_views(lines, lines_dark, dots_dark, dots_dark, views=4)
    with pytest.raises(CalibrationError, match="found 4 dots on the slit, expected 6"):
        calibrate_views(lines, lines_dark, dots, dots_dark, views=6)
    with pytest.raises(CalibrationError, match=r"no line|only"):
        calibrate_views(lines_dark, lines_dark, dots, dots_dark, views=4)
    with pytest.raises(InputError, match="NaN"):
        calibrate_views(np.full(SHAPE, np.nan), lines_dark, dots, dots_dark, views=4)


def test_the_instrument_s_own_pictures(shared_data):
    import tifffile

    folder = shared_data / "clip"
    if not folder.is_dir():
        pytest.skip("no clip pictures in the recorded data")
    names = ("LinePattern", "LinePattern_bkg", "DotPattern", "DotPattern_bkg")
    found = calibrate_views(*(tifffile.imread(folder / f"{name}.tif") for name in names))
    # An independent trial on the same pictures; half a pixel and half a degree are its own
    # repeatability.
    np.testing.assert_allclose(
        found.centres_px, [147.7, 320.0, 490.2, 664.1, 835.5, 1011.5, 1192.3], atol=0.5
    )
    np.testing.assert_allclose(
        np.rad2deg(found.angles), [-43.3, -25.7, -12.7, 0.6, 22.9, 37.5, 48.0], atol=0.5
    )
    assert np.all(found.centre_uncertainty_px < 0.5)
    assert np.all(np.rad2deg(found.angle_uncertainty) < 0.5)
