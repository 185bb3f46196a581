"""How sharp hidden points become: against the diffraction limit of the wall and the length of the
pulse, and the energy that lies where they are.
"""

from functools import cache

import numpy as np
import pytest
from numpy.linalg import norm
from scenes import FIVE_POINTS, distance_to_nearest, energy_fraction, planar_wall, see
from scipy.optimize import brentq

from nlos import Grid, Hybrid, PlanarRSD
from nlos.capture import TimeAxis
from nlos.plane import Plane
from nlos.resolution import compute_diffraction_limit
from nlos.simulate import add_poisson_noise, build_relay_wall

WAVELENGTH, CYCLES, SIDE = 0.08, 6.0, 1.0
METHOD, HYBRID = PlanarRSD(WAVELENGTH, CYCLES, 1e-3), Hybrid(0.125, 4.24)
SINC_HALF = float(brentq(lambda u: np.sin(np.pi * u) / (np.pi * u) - 0.5, 0.1, 0.9))


def full_width_at_half_maximum(axis, values):
    fine = np.linspace(axis[0], axis[-1], 20001)
    bright = fine[np.interp(fine, axis, values) >= values.max() / 2]
    return float(bright[-1] - bright[0])


@pytest.mark.parametrize("depth", [0.8, 1.2, 1.6])
def test_a_point_is_as_wide_as_diffraction_and_the_pulse_make_it(depth):
    wall = planar_wall(51, 51)
    wall[..., :2] *= SIDE / 2 / np.array([0.6, 0.5])
    capture = see([[0.0, 0.0, depth]], wall, [0.0, 0.0, 0.0], TimeAxis(900, 16e-12))
    across = np.linspace(-0.25, 0.25, 51)
    along = depth + across
    lateral = METHOD.reconstruct(capture, Grid(across, [0.0], [depth])).values[0, 0]
    axial = METHOD.reconstruct(capture, Grid([0.0], [0.0], along)).values[:, 0, 0]
    # Of a square aperture seen under the half angle theta the amplitude is sinc(2 x sin(theta) /
    # wavelength).
    limit = SINC_HALF * WAVELENGTH / (SIDE / 2 / np.hypot(SIDE / 2, depth))
    assert full_width_at_half_maximum(across, lateral) == pytest.approx(limit, rel=0.1)
    # The envelope exp(-L^2 / 2 sigma^2) over the path there and back.
    pulse = np.sqrt(8 * np.log(2)) * METHOD.pulse.sigma / 2
    assert full_width_at_half_maximum(along, axial) == pytest.approx(pulse, rel=0.1)


def test_the_limit_is_the_width_of_the_sum_that_defines_it():
    """A wide wall, where it matters how light falls with distance."""
    wall, middle = Plane(*[np.linspace(-1, 1, 41)] * 2, 0.0).points, np.array([0.0, 0.0, 0.4])
    capture = see([middle], wall, [0.0, 0.0, 0.0], TimeAxis(200, 60e-12), 60e-12)
    points, pulse = wall.reshape(-1, 3), METHOD.pulse
    distance = norm(points - middle, axis=1)
    offsets, field = np.linspace(-0.08, 0.08, 321), []
    for offset in offsets:
        moved = middle + np.array([offset, 0, 0])
        detour = norm(points - moved, axis=1) - distance
        detour += norm(moved) - norm(middle)
        waves = np.exp(1j * pulse.wavenumber * detour - detour**2 / (2 * pulse.sigma**2))
        field.append(abs(np.sum(distance**-3.0 * waves)))
    expected = full_width_at_half_maximum(offsets, np.array(field))
    assert compute_diffraction_limit(capture, middle, pulse).x == pytest.approx(expected, rel=5e-3)


# --- the energy at hidden points

AXIS = np.linspace(-0.75, 0.75, 64)
GRID = Grid(AXIS, AXIS, np.linspace(0.5, 1.25, 64))
PULSE = 0.125, 4.243  # an envelope of sigma 0.0884 m
METHODS = {"planar": PlanarRSD(*PULSE), "cylinder": Hybrid(*PULSE)}


@cache
def see_five(wall):
    """Five hidden points, 64 x 64 wall points over 2 m, one laser spot, 512 bins of 32 ps."""
    return see(FIVE_POINTS, build_relay_wall(wall, 64), [0.0, 0.0, 0.0], TimeAxis(512, 32e-12))


def score(volume):
    """Energy fraction of the voxels within 4 cm of the points, the usual measure for waves of some
    12 cm, and their mean magnitude over that of all others: a bright spot in the wrong place scores
    badly, however bright.
    """
    near = distance_to_nearest(volume.grid, FIVE_POINTS) <= 0.04
    magnitude = volume.magnitude.astype(np.float64)
    return energy_fraction(magnitude, near), magnitude[near].mean() / magnitude[~near].mean()


@pytest.mark.parametrize(
    ("wall", "energy", "contrast"), [("planar", 0.3195, 66.5), ("cylinder", 0.2908, 59.2)]
)
def test_as_much_energy_as_ever_lies_at_the_hidden_points(wall, energy, contrast):
    """With the noise of 20 counts in the brightest bin.

    The values are means over four seeds; the tolerances, five times the spread over them, 0.00023
    and 0.4.
    """
    capture = add_poisson_noise(see_five(wall), 20.0, seed=1)
    found = score(METHODS[wall].reconstruct(capture, GRID))
    assert found[0] == pytest.approx(energy, abs=1.2e-3)
    assert found[1] == pytest.approx(contrast, abs=2.0)
