"""Noise comes from everywhere at any time, by grazing ways too: there tolerances are hardest to keep."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from exact_phasor_field import compute_exact_phasor_field
from scene_shapes import JITTER, POINTS, SPOT, shaped_wall

from nlos import Capture, Grid, Hybrid, PlanarRSD
from nlos.capture import TimeAxis
from nlos.rsd.transfer import SphericalWaves, TransferFunction, Window, find_lateral_limits
from nlos.simulate import PointScene

pytestmark = pytest.mark.filterwarnings("ignore::nlos.illumination_groups.AliasingWarning")
# As wide as the wall, so that voxels and points stand in opposite corners; longer than any path.
GRID = Grid(np.linspace(-1, 1, 8), np.linspace(-1, 1, 7), [0.6, 0.75, 1.6])
AXIS = TimeAxis(700, 32e-12)


def capture_noise(shape: str, count: int) -> Capture:
    capture = PointScene(POINTS).simulate_capture(shaped_wall(shape, count), SPOT, AXIS, JITTER)
    noise = np.random.default_rng(1).normal(size=capture.signal.shape)
    return replace(capture, signal=noise.astype(np.float32))


@pytest.mark.parametrize(
    ("shape", "count"),
    [
        ("planar", 32),
        ("relief", 32),
        pytest.param("planar", 64, marks=pytest.mark.nightly),
        pytest.param("relief", 64, marks=pytest.mark.nightly),
    ],
)
def test_every_tolerance_is_kept(shape: str, count: int) -> None:
    method = (PlanarRSD if shape == "planar" else Hybrid)(wavelength=8 / count, cycles=4.24)
    capture = capture_noise(shape, count)
    exact = compute_exact_phasor_field(capture, GRID, method.pulse).values
    for tolerance in (1e-2, 1e-3, 1e-4):
        found = replace(method, tolerance=tolerance).phasor_field(capture, GRID).values
        assert np.linalg.norm(found - exact) < tolerance * np.linalg.norm(exact)


def test_weak_waves_are_left_out_up_to_the_error() -> None:
    """Narrower at the pulse's edges, wider for smaller errors and nearer voxels."""
    waves = SphericalWaves(20.0, 2.0, 21, continued=False)
    window = Window(2.0, 2.5, 1.6)
    strength = np.exp(-(((waves.wavenumbers - 40) / 10) ** 2))
    limits, strict, far = (
        find_lateral_limits(waves, window, strength, distance, error)
        for distance, error in ((0.6, 1e-2), (0.6, 1e-3), (3.0, 1e-2))
    )
    assert np.all(np.diff(limits) >= 0)
    assert np.all(strict >= limits)
    assert far.sum() < limits.sum()
    assert limits[10] > 40
    assert limits[-1] < 60
    transfer = TransferFunction(waves, window.without_cut, 120.0, 0.6)
    real, imaginary = np.moveaxis(transfer.evaluate(0.6, np.zeros(2)), 1, 0)
    lateral = np.maximum(transfer.nodes, 0)[:, np.newaxis]
    energy = (real**2 + imaginary**2) * strength**2 * lateral
    assert energy[lateral[:, 0] > 0][lateral[lateral > 0][:, np.newaxis] > limits].sum() < (
        1.1e-2**2 * energy.sum()
    )
