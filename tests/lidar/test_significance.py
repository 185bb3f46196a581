"""Which candidates of recovered frames are returns."""

from __future__ import annotations

import numpy as np
import pytest

import tofclip
from tofclip.camera.noise import MeasurementNoise
from tofclip.lidar import Pulse
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
