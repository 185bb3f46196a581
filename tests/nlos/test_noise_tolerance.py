"""Noise comes from everywhere at any time, by grazing ways too: there tolerances are hardest to keep."""

from dataclasses import replace

import numpy as np
import pytest
from exact_phasor_field import compute_exact_phasor_field
from scenes import (
    SHAPED_JITTER,
    SHAPED_POINTS,
    SHAPED_SPOT,
    relative_error,
    see,
)

from nlos import Grid, Hybrid, PlanarRSD
from nlos.capture import TimeAxis
from nlos.simulate import WALLS, build_relay_wall

# As wide as the wall, so that voxels and points stand in opposite corners; so many depths that some
# are interpolated.
GRID = Grid(np.linspace(-1, 1, 6), np.linspace(-1, 1, 4), np.linspace(0.6, 1.6, 16))
FINE_DEPTHS = Grid(np.linspace(-1, 1, 4), np.linspace(-1, 1, 3), np.linspace(0.6, 1.6, 100))
METHODS = [(shape, Hybrid if shape != "planar" else PlanarRSD) for shape in WALLS]
# The wall samples half of either twice: a confocal scan sees it by both ways.
WAVELENGTHS = {"single": 0.3, "confocal": 0.4}
LONG, SHORT = 700, 360  # bins: any path by way of the voxels, and less than some
NOISE, COUNTS, POINTS_AND_COUNTS = "noise of mean 0", "counts of a background", "points above it"
PHOTONS, BACKGROUND = 20.0, 5.0


def count_photons(background, light):
    """Signals of the shape of the light of some hidden points."""
    random, bright = np.random.default_rng(1), PHOTONS * light / np.nanmax(light)
    if background == NOISE:
        return random.normal(size=light.shape)
    return random.poisson(BACKGROUND + (bright if background == POINTS_AND_COUNTS else 0 * bright))


def see_noise(shape, count, bins, background, scan="single"):
    """Counts of light that four hidden points send to a wall, or of none, or noise alone."""
    wall = build_relay_wall(shape, count)
    spot = wall if scan == "confocal" else SHAPED_SPOT
    capture = see(SHAPED_POINTS, wall, spot, TimeAxis(bins, 32e-12), SHAPED_JITTER)
    light = np.nan_to_num(capture.signal)
    return replace(capture, signal=count_photons(background, light).astype(np.float32))


def list_errors(method, capture, grid, wavelength):
    """Errors against the plain sum over the record and the silence after it, as multiples of what
    tolerances of 1e-2 and 1e-3 allow.
    """
    truth = compute_exact_phasor_field(capture, grid, method(wavelength, 4.0).pulse).values
    made = (method(wavelength, 4.0, tolerance=tolerance) for tolerance in (1e-2, 1e-3))
    return [
        relative_error(one.phasor_field(capture, grid).values, truth) / one.tolerance
        for one in made
    ]


NARROWEST = (PlanarRSD, "planar", "confocal"), (Hybrid, "wavy", "confocal")
"""Where errors are the largest part of what is allowed."""


@pytest.mark.parametrize("bins", [LONG, SHORT])
@pytest.mark.parametrize(
    ("method", "shape", "scan"),
    [
        pytest.param(*one, marks=[pytest.mark.nightly] * (one not in NARROWEST))
        for one in ((method, shape, scan) for shape, method in METHODS for scan in WAVELENGTHS)
    ],
)
def test_a_tolerance_is_kept(method, shape, scan, bins):
    for background in (NOISE, COUNTS, POINTS_AND_COUNTS) if bins == LONG else (NOISE,):
        capture = see_noise(shape, 24, bins, background, scan)
        errors = list_errors(method, capture, GRID, WAVELENGTHS[scan])
        assert max(errors) < 1, (background, errors)


@pytest.mark.parametrize(
    ("shape", "method"),
    [pytest.param(*METHODS[0], marks=pytest.mark.nightly), ("cylinder", Hybrid)],
)
def test_a_tolerance_is_kept_where_many_depths_are_interpolated(shape, method):
    capture = see_noise(shape, 24, SHORT, POINTS_AND_COUNTS)
    assert max(list_errors(method, capture, FINE_DEPTHS, WAVELENGTHS["single"])) < 1


@pytest.mark.nightly
@pytest.mark.parametrize("nearest", [0.3, 0.45, 0.6])
@pytest.mark.parametrize("scan", WAVELENGTHS)
@pytest.mark.parametrize(("shape", "method"), METHODS)
def test_a_tolerance_is_kept_on_64_x_64_points(shape, method, scan, nearest):
    depths = nearest + np.array([0, 0.15, 1.0])
    grid = Grid(np.linspace(-1, 1, 8), np.linspace(-1, 1, 7), depths)
    wavelength = {"single": 0.125, "confocal": 0.25}[scan]
    for background in (NOISE, POINTS_AND_COUNTS):
        capture = see_noise(shape, 64, LONG, background, scan)
        assert max(list_errors(method, capture, grid, wavelength)) < 1
