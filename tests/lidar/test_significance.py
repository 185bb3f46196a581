"""Which candidates of recovered frames are returns, and how far their ranges are off by what their neighbours
show.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

import tofclip
from tofclip.camera.noise import MeasurementNoise
from tofclip.lidar import Pulse
from tofclip.lidar.neighbours import add_recovery_error
from tofclip.lidar.significance import weigh_candidates

SIZE = 32
SURFACE, RAY = (slice(6, 26), 30, 2000.0), (slice(14, 18), 70, 100.0)
"""Rows and columns, frame, counts."""


def test_what_is_bright_is_not_dropped_for_what_is_dim_and_sure():
    """Where an instant is full of light, what the model does not explain of it makes every pixel
    uncertain; a dim ray in the dark is surer than a bright surface, and no reason to drop it.
    """
    camera = tofclip.Camera(
        [20.0, 60.0, 100.0], [-0.7, 0.0, 0.7], (SIZE, SIZE), 121, pulse_fwhm=60e-12
    )
    times = np.arange(100) * 10e-12
    cube = np.zeros((times.size, SIZE, SIZE), np.float32)
    for place, frame, brightness in (SURFACE, RAY):
        pulse = np.exp(-0.5 * ((times - times[frame]) / 25.5e-12) ** 2)
        cube[:, place, place] += brightness * pulse[:, np.newaxis, np.newaxis].astype(np.float32)
    figures = {
        "noise_floor_count": 4.0,
        "noise_gain_count": 1.0,
        "noise_dazzle_count": 1e6,
        "noise_misfit_fraction": 0.3,
    }
    measured = camera.operator()(np.moveaxis(cube, 0, -1))
    frames = tofclip.Frames(cube, times, camera, figures=figures, measured=measured)
    returns = tofclip.depth(frames)
    place, frame, _ = SURFACE
    found = np.zeros((SIZE, SIZE), bool)
    near = np.abs(returns.time - times[frame]) < camera.pulse_fwhm / 4
    found[returns.y[near].astype(int), returns.x[near].astype(int)] = True
    assert found[RAY[0], RAY[0]].all()
    assert found[place, place].mean() > 0.95  # corners have few neighbours


def test_the_significance_of_a_candidate_is_its_height_over_its_deviation():
    """In even noise, of one pixel whose light is known to have the pulse's course: the deviation of
    its height by least squares over all measurements of all frames.
    """
    camera = tofclip.Camera([20.3, 60.0, 99.6], [-0.7, 0.1, 0.6], (12, 12), 121, pulse_fwhm=60e-12)
    times, floor = np.arange(60) * 10e-12, 3.0
    pixel, pulse = np.array([40, 77]), Pulse.gaussian(camera.pulse_fwhm)
    arrival, signal = np.array([200e-12, 333e-12]), np.array([50.0, 80.0])
    measured = np.ones((121, 60), np.float32)
    measured[5] = np.nan  # not used
    frames = tofclip.Frames(np.zeros((60, 12, 12), np.float32), times, camera, measured=measured)
    noise = MeasurementNoise(floor, 0.0)
    found = weigh_candidates(frames, noise, pulse, pixel, arrival, signal)
    matrix = camera.operator().matrix.toarray()
    matrix[5] = 0
    for place, late, counts, stated, exceeds, explained in zip(
        pixel, arrival, signal, *found, strict=True
    ):
        course = pulse(times - late)
        seen = np.outer(matrix[:, place], course)  # of a height of one
        expected = counts / course.sum() * np.sqrt(np.sum(seen**2)) / floor
        assert stated == pytest.approx(expected, rel=0.01)  # the pulse's far ends are left out
        # every used measurement has a count that the dark frames do not explain
        assert exceeds == pytest.approx(counts / course.sum() * seen.sum() / floor**2, rel=0.01)
        assert explained == 0


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
