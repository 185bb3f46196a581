"""How sharp a hidden point becomes, against the diffraction limit of the wall and the length of the
pulse.
"""

from __future__ import annotations

import numpy as np
import pytest
from relay_walls import planar_wall
from scipy.optimize import brentq

from nlos import Grid, PlanarRSD
from nlos.capture import TimeAxis
from nlos.resolution import compute_diffraction_limit, measure_fwhm
from nlos.simulate import PointScene

WAVELENGTH, CYCLES, SIDE = 0.08, 6.0, 1.0
METHOD = PlanarRSD(WAVELENGTH, CYCLES, 1e-3)
SINC_HALF = float(brentq(lambda u: np.sin(np.pi * u) / (np.pi * u) - 0.5, 0.1, 0.9))


def full_width_at_half_maximum(axis: np.ndarray, values: np.ndarray) -> float:
    fine = np.linspace(axis[0], axis[-1], 20001)
    bright = fine[np.interp(fine, axis, values) >= values.max() / 2]
    return float(bright[-1] - bright[0])


@pytest.mark.parametrize("depth", [0.8, 1.2, 1.6])
def test_a_point_is_as_wide_as_diffraction_and_the_pulse_make_it(depth: float) -> None:
    wall = planar_wall(51, 51)
    wall[..., :2] *= SIDE / 2 / np.array([0.6, 0.5])
    capture = PointScene([[0.0, 0.0, depth]]).simulate_capture(
        wall, [0.0, 0.0, 0.0], TimeAxis(900, 16e-12), 20e-12
    )
    across = np.linspace(-0.25, 0.25, 51)
    along = depth + np.linspace(-0.25, 0.25, 51)
    lateral = METHOD.reconstruct(capture, Grid(across, [0.0], [depth])).values[0, 0]
    axial = METHOD.reconstruct(capture, Grid([0.0], [0.0], along)).values[:, 0, 0]
    # Of a square aperture seen under the half angle theta the amplitude is sinc(2 x sin(theta) /
    # wavelength).
    sine = SIDE / 2 / np.hypot(SIDE / 2, depth)
    limit = SINC_HALF * WAVELENGTH / sine
    assert full_width_at_half_maximum(across, lateral) == pytest.approx(limit, rel=0.1)
    # The envelope exp(-L^2 / 2 sigma^2) over the path there and back.
    pulse = np.sqrt(8 * np.log(2)) * METHOD.pulse.sigma / 2
    assert full_width_at_half_maximum(along, axial) == pytest.approx(pulse, rel=0.1)


def test_a_width_is_read_between_samples():
    axis = np.arange(11.0)
    assert measure_fwhm(axis, 1 - np.abs(axis - 5) / 3, 5) == pytest.approx(3.0)
    assert measure_fwhm(2 * axis, np.exp2(-(((axis - 5) / 2) ** 2)), 5) == pytest.approx(8.0)


def test_the_limit_is_the_width_of_the_sum_that_defines_it():
    """A wide wall, where it matters how light falls with distance."""
    x, y = np.meshgrid(np.linspace(-1, 1, 41), np.linspace(-1, 1, 41))
    wall = np.stack([x, y, np.zeros_like(x)], axis=-1)
    capture = PointScene([[0, 0, 0.4]]).simulate_capture(
        wall, [0.0, 0.0, 0.0], TimeAxis(200, 60e-12), 60e-12
    )
    points, pulse = wall.reshape(-1, 3), METHOD.pulse
    middle = np.array([0.0, 0.0, 0.4])
    distance = np.linalg.norm(points - middle, axis=1)
    offsets = np.linspace(-0.08, 0.08, 321)
    field = []
    for offset in offsets:
        moved = middle + np.array([offset, 0, 0])
        detour = np.linalg.norm(points - moved, axis=1) - distance
        detour += np.linalg.norm(moved) - np.linalg.norm(middle)
        waves = np.exp(1j * pulse.wavenumber * detour - detour**2 / (2 * pulse.sigma**2))
        field.append(abs(np.sum(distance**-3.0 * waves)))
    expected = full_width_at_half_maximum(offsets, np.array(field))
    found = compute_diffraction_limit(capture, middle, pulse).x
    assert found == pytest.approx(expected, rel=5e-3)
