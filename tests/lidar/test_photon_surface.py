"""Surfaces from few photons: simulated scenes with known ranges, a recorded face, and hot pixels."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest

from tofclip.camera import Camera
from tofclip.errors import InputError
from tofclip.lidar import Pulse
from tofclip.lidar.photons import (
    PhotonImage,
    estimate_surface,
    matching,
)
from tofclip.lidar.photons.image import find_hot_pixels, leave_out_pixels
from tofclip.lidar.photons.scene import BinnedResponse, Scene, measure_pulse_width
from tofclip.units import SPEED_OF_LIGHT

BIN = 80e-12
FWHM = 400e-12
BIN_M = SPEED_OF_LIGHT / 2 * BIN


def compute_robust_z(error, sigma):
    ratio = error / sigma
    return float(1.4826 * np.median(np.abs(ratio - np.median(ratio))))


def count_single(*places, photons=1):
    cube = np.zeros((6, 8, 100))
    cube[tuple(np.transpose(places))] = photons
    return cube


@pytest.mark.parametrize(
    ("cube", "problem"),
    [
        (count_single((2, 3, 50), (4, 3, 50)), r"2 photons are too few.*`single_pixel`"),
        (np.random.default_rng(0).poisson(0.02, (20, 20, 400)), "`pulse`"),
        # Scaled: pairs of less than one photon are no pulse, and no warning.
        (0.4 * np.random.default_rng(0).poisson(0.05, (6, 8, 100)), "no pulse"),
        (count_single((3, 4, 5), photons=1000), "only hot pixels"),
        (np.zeros((4, 5)), "must have shape"),
        (np.full((2, 2, 4), -1), "negative"),
        (np.full((2, 2, 4), np.nan), "finite"),
        (np.zeros((2, 2, 4)), "no pixel counted a photon"),
    ],
)
def test_photons_that_show_no_surface_are_refused_for_what_they_are(cube, problem):
    pulse = None if "pulse" in problem else Pulse.gaussian(FWHM)
    with pytest.raises(InputError, match=problem):
        estimate_surface(PhotonImage.from_cube(cube, BIN), pulse)


def test_two_layers_are_both_found_and_none_twice():
    noise = np.random.default_rng(4)
    y, x = np.mgrid[:48, :64]
    layers = (150 + 0.2 * x, np.where(np.hypot(y - 24, x - 30) < 14, 240 + 0.3 * y, 330.0))
    pixels, times = [], []
    for layer in layers:
        pixel = np.repeat(np.arange(layer.size), noise.poisson(25, layer.size))
        pixels.append(pixel)
        times.append(layer.ravel()[pixel] + noise.normal(0, FWHM / BIN / 2.3548, pixel.size))
    dark = np.repeat(np.arange(layers[0].size), noise.poisson(5, layers[0].size))
    times.append(noise.uniform(0, 511, dark.size))
    photons = PhotonImage.from_events(
        np.concatenate([*pixels, dark]), np.rint(np.concatenate(times)), (48, 64), BIN, 512
    )
    for number in (2, 3):
        found = estimate_surface(photons, Pulse.gaussian(FWHM), max_returns=number)
        ranges = np.stack([one.range for one in (found, *found.further)]) / BIN_M
        hits = [np.sum(np.abs(ranges - layer) < 3, axis=0) for layer in layers]
        assert np.mean((hits[0] > 0) & (hits[1] > 0)) >= 0.95
        assert np.mean((hits[0] > 1) | (hits[1] > 1)) <= 0.02
        assert np.mean(np.isfinite(ranges).sum(axis=0) > 2) <= 0.02
    returns = found.to_returns(Camera.pinhole(found.range.shape, 60.0, FWHM))
    assert len(returns) == np.isfinite(ranges).sum()
    assert returns.return_number.max() >= 2
    one_pixel = (returns.y == 24) & (returns.x == 30)
    assert np.all(np.diff(returns.range[one_pixel]) > 0)


def test_times_in_steps_of_the_counter_are_no_pulse():
    """94,000 photons in 200,000 bins of 1 ps, counted in steps of 16 ps: pairs of equal times were
    taken for a pulse of a bin, and deviations 9000 times too small.
    """
    noise = np.random.default_rng(0)
    y, x = np.mgrid[:96, :96]
    surface = 80000 + 20 * x - np.where(np.hypot(y - 50, x - 60) < 30, 15000, 0.0)
    pixel = noise.integers(0, surface.size, 94000)
    time = np.where(
        np.arange(pixel.size) < 55000,
        surface.ravel()[pixel] + noise.normal(0, 400 / 2.3548, pixel.size),
        noise.uniform(0, 200000, pixel.size),
    )
    steps = 16 * np.rint(time / 16)
    found = estimate_surface(PhotonImage.from_events(pixel, steps, surface.shape, 1e-12, 200_001))
    assert found.pulse.fwhm == pytest.approx(400e-12, rel=0.15)
    error = found.range / (SPEED_OF_LIGHT / 2 * 1e-12) - surface
    near = np.abs(error) < 400
    assert near.mean() > 0.99
    assert np.sqrt(np.mean(error[near] ** 2)) < 400 / 8
    sigma = found.range_sigma / (SPEED_OF_LIGHT / 2 * 1e-12)
    assert 0.7 < compute_robust_z(error[near], sigma[near]) < 1.3
    assert error.std() < 2000


def test_the_search_keeps_to_its_memory(monkeypatch):
    """Tables of tiles on a long axis, and the labels that they leave: a 64th of the usual limit."""
    limit = matching.MAX_VOLUME_BYTES // 64
    monkeypatch.setattr(matching, "MAX_VOLUME_BYTES", limit)
    noise = np.random.default_rng(0)
    shape, bins = (128, 128), 100_000
    pixel = noise.integers(0, 128 * 128, 20_000)
    photons = PhotonImage.from_events(
        pixel, np.floor(noise.uniform(0, bins, pixel.size)), shape, 1e-12, bins
    )
    scene = Scene(BinnedResponse(Pulse.gaussian(4e-12).integrate_bins(1e-12), 1e-12), 1e-6)
    tracemalloc.start()
    axis = matching.choose_label_axis(photons, scene)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < limit
    assert 8 * 128 * 128 * axis.numbers.size <= limit


ROWS, COLUMNS, HOT_BINS = 32, 40, 200
FWHM_BINS = 4.0


@pytest.fixture(scope="module")
def counts():
    """A tilted wall, 4 signal and 4 background photons a pixel."""
    after = np.arange(HOT_BINS) - (70 + 0.5 * np.arange(COLUMNS))[:, np.newaxis]
    pulse = np.exp2(-((2 * after / FWHM_BINS) ** 2))
    shape = 4 * pulse / pulse.sum(axis=1, keepdims=True) + 0.02
    return np.random.default_rng(0).poisson(shape, (ROWS, COLUMNS, HOT_BINS))


@pytest.mark.parametrize("photons", [150, 1_000_000])
def test_hot_pixels_are_found_and_do_not_say_what_the_pulse_is(counts, photons):
    cube, hot = counts.copy(), np.zeros((ROWS, COLUMNS), bool)
    assert not find_hot_pixels(PhotonImage.from_cube(cube, BIN)).any()
    noise = np.random.default_rng(1)
    hot.ravel()[noise.choice(hot.size, 30, replace=False)] = True
    cube[hot, noise.integers(0, HOT_BINS, 30)] += photons
    image = PhotonImage.from_cube(cube, BIN)
    np.testing.assert_array_equal(find_hot_pixels(image), hot)
    rest = leave_out_pixels(image, hot)
    assert rest.photons == counts[~hot].sum()
    # pairs of 5000 photons say it to a few hundredths
    assert measure_pulse_width(rest) == pytest.approx(FWHM_BINS * BIN, rel=0.15)


def test_bright_surfaces_are_not_hot(counts):
    cube = counts.copy()
    cube[5, 5, 100:105] += (500, 2500, 4000, 2500, 500)  # a retroreflector of one pixel
    cube[20:22, 20, 90] += 4000  # two pixels of a surface, a pulse shorter than a bin
    assert not find_hot_pixels(PhotonImage.from_cube(cube, BIN)).any()
