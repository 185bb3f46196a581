"""What a range is off by: noise of its own, and what the recovery did to it and its neighbours."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from tofclip.lidar.neighbours import add_recovery_error

SHAPE = (64, 64)
GATE_M = 9e-3
FOCAL_PX = 300.0


def look_at_planes(seed, smooth, noise, px=2.3):
    """Two planes with errors that are alike over some pixels: correlations of 0.6 and 0.3 at 3 and 5.

    Total variation leaves 0.6 and 0.3 there on the demonstration's shot.
    """
    random = np.random.default_rng(seed)
    y, x = np.mgrid[:64, :64] - 32.0
    slant = np.sqrt(1 + (x / FOCAL_PX) ** 2 + (y / FOCAL_PX) ** 2)
    depth = np.where(x < 5, 1 / (0.5 + 4e-4 * x + 2e-4 * y), 2.4)
    field = gaussian_filter(random.normal(size=SHAPE), px)
    error = smooth * field / field.std() + noise * random.normal(size=SHAPE)
    distance = (depth * slant + error).ravel()
    sigma = np.full(distance.size, noise)
    pixel = np.arange(distance.size)
    return error.ravel(), (sigma, distance, 1 / slant.ravel(), pixel, SHAPE, GATE_M)


def compute_robust_z(error, sigma):
    return float(np.median(np.abs(error / sigma)) / 0.6745)


@pytest.mark.parametrize(
    ("smooth", "noise", "low", "high"),
    [
        # Noise alone is known to the trace; the scatter of 81 neighbours adds 6 % to it.
        (0.0, 3e-4, 0.87, 1.03),
        # As strong as the noise, twice and four times; three fields each, 5 % from field to field.
        (3e-4, 3e-4, 0.85, 1.15),
        (6e-4, 3e-4, 0.8, 1.25),
        (12e-4, 3e-4, 0.8, 1.3),
    ],
)
def test_the_deviation_is_true_with_and_without_the_recovery_s_errors(smooth, noise, low, high):
    z = []
    for seed in range(3):
        error, returns = look_at_planes(seed, smooth, noise)
        z.append(compute_robust_z(error, add_recovery_error(*returns)))
    assert low < np.mean(z) < high


def test_returns_without_neighbours_get_what_is_usual():
    _, returns = look_at_planes(0, 6e-4, 3e-4)
    sigma, distance, along, pixel, _, _ = returns
    x = pixel % 64
    # Pixels of their own beside the picture's first half, of which no eight are near each other.
    chosen = (x < 32) | ((x == 50) & (pixel // 64 % 12 == 0))
    total = add_recovery_error(
        *(part[chosen] for part in (sigma, distance, along, pixel)), SHAPE, GATE_M
    )
    alone = x[chosen] == 50
    assert np.all(total >= sigma[chosen])
    assert np.ptp(total[alone]) < 1e-12
    assert total[alone][0] == pytest.approx(np.median(total[~alone]), rel=0.05)
    few = slice(0, 10)
    np.testing.assert_array_equal(
        add_recovery_error(*(part[few] for part in (sigma, distance, along, pixel)), SHAPE, GATE_M),
        sigma[few],
    )


def test_a_second_surface_in_the_same_pixels_takes_no_part():
    _, returns = look_at_planes(1, 0.0, 3e-4)
    sigma, distance, along, pixel, _, _ = returns
    # Another return 0.3 m behind, in every pixel.
    twice = [np.repeat(part, 2) for part in (sigma, distance, along, pixel)]
    twice[1] = twice[1] + np.tile([0.0, 0.3], distance.size)
    total = add_recovery_error(*twice, SHAPE, GATE_M)
    # Rounding decides whether a neighbour at the limit counts.
    assert np.isclose(total[::2], add_recovery_error(*returns), rtol=1e-6).mean() > 0.995
