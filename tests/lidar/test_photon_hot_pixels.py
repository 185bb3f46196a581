"""Hot pixels among counted photons: found, and without a say in what is learnt."""

from __future__ import annotations

import numpy as np
import pytest

from tofclip.errors import InputError
from tofclip.lidar.photons import PhotonImage
from tofclip.lidar.photons.image import find_hot_pixels, leave_out_pixels
from tofclip.lidar.photons.scene import measure_pulse_width

BIN = 50e-12
ROWS, COLUMNS, BINS = 32, 40, 200
FWHM_BINS = 4.0


@pytest.fixture(scope="module")
def counts() -> np.ndarray:
    """A tilted wall, 4 signal and 4 background photons a pixel."""
    after = np.arange(BINS) - (70 + 0.5 * np.arange(COLUMNS))[:, np.newaxis]
    pulse = np.exp2(-((2 * after / FWHM_BINS) ** 2))
    shape = 4 * pulse / pulse.sum(axis=1, keepdims=True) + 0.02
    return np.random.default_rng(0).poisson(shape, (ROWS, COLUMNS, BINS))


@pytest.mark.parametrize("photons", [150, 1_000_000])
def test_hot_pixels_are_found_and_do_not_say_what_the_pulse_is(counts, photons) -> None:
    cube, hot = counts.copy(), np.zeros((ROWS, COLUMNS), bool)
    assert not find_hot_pixels(PhotonImage.from_cube(cube, BIN)).any()
    noise = np.random.default_rng(1)
    hot.ravel()[noise.choice(hot.size, 30, replace=False)] = True
    cube[hot, noise.integers(0, BINS, 30)] += photons
    image = PhotonImage.from_cube(cube, BIN)
    np.testing.assert_array_equal(find_hot_pixels(image), hot)
    rest = leave_out_pixels(image, hot)
    assert rest.photons == counts[~hot].sum()
    # pairs of 5000 photons say it to a few hundredths
    assert measure_pulse_width(rest) == pytest.approx(FWHM_BINS * BIN, rel=0.15)


def test_bright_surfaces_are_not_hot(counts) -> None:
    cube = counts.copy()
    cube[5, 5, 100:105] += (500, 2500, 4000, 2500, 500)  # a retroreflector of one pixel
    cube[20:22, 20, 90] += 4000  # two pixels of a surface, a pulse shorter than a bin
    assert not find_hot_pixels(PhotonImage.from_cube(cube, BIN)).any()


def test_hot_pixels_alone_are_told() -> None:
    cube = np.zeros((ROWS, COLUMNS, BINS), int)
    cube[3, 4, 5] = 1000
    image = PhotonImage.from_cube(cube, BIN)
    hot = find_hot_pixels(image)
    assert hot.sum() == 1
    with pytest.raises(InputError, match="only hot pixels"):
        leave_out_pixels(image, hot)
