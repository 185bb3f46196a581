"""Depths that are interpolated instead of computed: how many, and how far off."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from exact_phasor_field import compute_exact_phasor_field
from relay_walls import AXIS, HIDDEN, JITTER, planar_wall

import nlos.phasor.depth_steps
from nlos import Capture, Grid, PlanarRSD
from nlos.capture import TimeAxis
from nlos.phasor.depth_steps import AxialSpectrum, choose_depths
from nlos.phasor.to_depths_compiled import DEPTH_ERROR_FRACTION
from nlos.simulate import PointScene

pytestmark = pytest.mark.filterwarnings("ignore::nlos.illumination.AliasingWarning")
WAVENUMBERS = np.linspace(20.0, 80.0, 31)
STRENGTH = np.exp(-(((WAVENUMBERS - 50) / 14) ** 2))
SPECTRUM = AxialSpectrum.of(WAVENUMBERS, STRENGTH, 50.0, (0.0, 1.0))
METHOD = PlanarRSD(wavelength=0.125, cycles=3)
LONG = TimeAxis(560, AXIS.bin_width, 0.4)
# An eighth of a wavelength apart.
FINE = Grid(np.linspace(-0.3, 0.4, 5), np.linspace(-0.4, 0.2, 4), 0.4 + np.arange(32) / 64)


def relative_error(found: np.ndarray, expected: np.ndarray) -> float:
    return float(np.linalg.norm(found - expected) / np.linalg.norm(expected))


@pytest.mark.parametrize("error", [1e-2, 2e-3, 2e-4])
def test_waves_along_z_are_interpolated_within_the_promised_error(error: float) -> None:
    """Waves of all frequencies and directions at random phases, as the spectrum has them."""
    random, z = np.random.default_rng(0), 0.5 + np.arange(60) / 64
    chosen = choose_depths(z, SPECTRUM, error)
    assert chosen.nodes[0] == 0
    assert chosen.nodes[-1] == z.size - 1
    assert chosen.nodes.size < 0.7 * z.size
    steps = (np.arange(40) + 0.5) / 40
    field = np.zeros((200, z.size), np.complex128)
    for k, strength in zip(WAVENUMBERS, STRENGTH, strict=True):
        cosine, laser = random.choice(steps, (2, 200, 1))
        waves = np.exp(1j * (k * cosine + (k - 50) * laser) * z)
        field += strength * np.exp(2j * np.pi * random.random((200, 1))) * waves
    found = np.concatenate(
        [field[:, chosen.nodes[some.nodes]] @ some.weights.T for some in chosen.blocks], axis=1
    )
    errors = np.linalg.norm(found - field, axis=0) / np.linalg.norm(field, axis=0)
    # 200 draws know a root mean square to some 5 %, and float32 weights to 1e-6
    assert errors.max() < 1.15 * error
    assert errors[chosen.nodes].max() < 0.2 * error


def test_a_lower_error_takes_more_depths() -> None:
    z = 0.5 + np.arange(60) / 64
    counts = [choose_depths(z, SPECTRUM, error).nodes.size for error in (1e-1, 1e-2, 1e-3, 1e-4)]
    assert counts == sorted(counts)
    assert counts[0] < counts[-1] <= 60


@pytest.mark.parametrize(
    "z", [np.array([0.7]), np.linspace(0.5, 0.9, 8), np.linspace(0.5, 6.0, 60)]
)
def test_few_or_coarse_depths_are_all_computed(z: np.ndarray) -> None:
    chosen = choose_depths(z, SPECTRUM, 2e-3)
    assert np.array_equal(chosen.nodes, np.arange(z.size))
    assert not chosen.blocks


def test_what_is_far_from_its_neighbours_is_computed() -> None:
    z = np.concatenate([[0.3], 0.5 + np.arange(60) / 64, [2.0]])
    chosen = choose_depths(z, SPECTRUM, 2e-3)
    assert {0, 1, 60, 61} <= set(chosen.nodes.tolist())
    assert chosen.nodes.size < 50


@pytest.mark.parametrize("laser", ["single", "ahead"])
@pytest.mark.parametrize("tolerance", [1e-2, 1e-3])
def test_fine_depths_equal_the_exact_sum(laser: str, tolerance: float) -> None:
    capture = capture_of(laser)
    hidden = PointScene([HIDDEN, (-0.2, 0.1, 0.75)], [1.0, 0.6])
    capture = hidden.simulate_capture(capture.wall, capture.laser, LONG, JITTER)
    method = replace(METHOD, tolerance=tolerance)
    diffraction = method.plan(capture, FINE)._hold_diffraction(0)
    assert diffraction._depths.nodes.size < 28
    found = method.phasor_field(capture, FINE).values
    exact = compute_exact_phasor_field(capture, FINE, METHOD.pulse).values
    assert relative_error(found, exact) < tolerance


@pytest.mark.parametrize("laser", ["single", "ahead", "confocal"])
@pytest.mark.parametrize("tolerance", [1e-2, 1e-3])
def test_interpolated_depths_are_those_that_are_computed(
    laser: str, tolerance: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Signals of noise: light from everywhere at any time."""
    capture, method = capture_of(laser), replace(METHOD, tolerance=tolerance)
    found = method.phasor_field(capture, FINE).values
    monkeypatch.setattr(nlos.phasor.depth_steps, "SPACING_RATIOS", ())
    expected = method.phasor_field(capture, FINE).values
    assert 0 < relative_error(found, expected) < DEPTH_ERROR_FRACTION * tolerance


def capture_of(laser: str) -> Capture:
    """Noise, lit from a spot on the wall, from one between wall and scene, or confocally."""
    wall = planar_wall()
    spots = {"single": [0.12, 0.05, 0.0], "ahead": [0.1, 0.0, 0.3], "confocal": wall}
    signal = np.random.default_rng(1).normal(size=(LONG.bins, *wall.shape[:2])).astype(np.float32)
    return Capture(signal, wall, np.array(spots[laser]), LONG.bin_width, LONG.start)
