"""Which points of fitted surfaces are returned, and how far off each may be."""

from __future__ import annotations

import numpy as np
import pytest
from surface_scene import CAMERA, INSTRUMENT, SCENE, SHAPE, make_model

from tofclip.lidar import Detection
from tofclip.recovery.surfaces.amplitudes import AmplitudeSolver
from tofclip.recovery.surfaces.fit import (
    SurfaceFit,
    estimate_displacement,
    find_usual_brightness,
    list_returns,
)
from tofclip.recovery.surfaces.ranges import Refinement
from tofclip.simulate import simulate_shot


def test_a_deviation_is_that_of_the_fit_of_further_steps_and_of_the_centres():
    """Of two planes of which all is known: r = length / (a + b x), so that
    dr = r^2 / length sqrt(var a + x^2 var b); to that what steps leave, and the displaced picture.
    """
    model = make_model(simulate_shot(SCENE, INSTRUMENT, seed=0).streak)
    amplitude = np.full(model.surface.size, 500, np.float32)
    one, along = 4e-4, 3e-4
    covariance = np.diag([one**2, along**2, 0, 0, 0, 0])
    remainder, centre_error = np.array([0.7e-3, 0.2e-3]), 0.4
    refinement = Refinement(
        [covariance] * 2, amplitude, np.zeros((6, amplitude.size), np.float32), 1, 0.0, None
    )
    fit = SurfaceFit(model, AmplitudeSolver(model, amplitude, 2.0), refinement, remainder, 0.0)
    found = list_returns(fit, Detection(), centre_error)
    assert len(found) == model.surface.size
    for surface, (first, slope) in enumerate([(1 / 1.4, 0.02), (1 / 1.7, -0.03)]):
        own = np.abs(found.range - 1 / first) < 0.1
        assert own.sum() == model.masks[surface].sum()
        y, x = found.y[own], found.x[own]
        across = 2 * x / SHAPE[1] - 1
        length = np.sqrt(1 + ((x - 24) ** 2 + (y - 24) ** 2) / CAMERA.focal_length_px**2)

        def reach(x: np.ndarray, y: np.ndarray, first=first, slope=slope) -> np.ndarray:
            ray = np.sqrt(1 + ((x - 24) ** 2 + (y - 24) ** 2) / CAMERA.focal_length_px**2)
            return ray / (first + slope * (2 * x / SHAPE[1] - 1))

        distance = reach(x, y)
        np.testing.assert_allclose(found.range[own], distance, rtol=1e-9)
        stated = distance**2 / length * np.hypot(one, across * along)
        right, down = estimate_displacement(CAMERA, centre_error)
        moved = np.hypot(right * (reach(x + 1, y) - distance), down * (reach(x, y + 1) - distance))
        expected = np.sqrt(stated**2 + remainder[surface] ** 2 + moved**2)
        np.testing.assert_allclose(found.confidence[own], expected, rtol=1e-4)
        # light falls with the square of the range
        np.testing.assert_allclose(found.intensity[own], 500 * distance**2, rtol=1e-5)


def test_errors_that_alternate_displace_the_picture_by_their_mean():
    """And hardly up or down, as lines of either slant take part alike."""
    right, down = estimate_displacement(CAMERA, 0.49)
    assert right == pytest.approx(0.49 / 7, rel=0.05)
    assert down < 0.2 * right


def test_usual_brightness_is_that_of_the_surest_points():
    amplitude = np.array([1, 1, 9, 10, 11], np.float32)
    assert find_usual_brightness(amplitude, 3 * amplitude, 5.0) == 10
    # in little light none is twenty deviations out, and half of the upper ones' counts
    assert find_usual_brightness(amplitude, amplitude, 5.0) == 10
    assert find_usual_brightness(amplitude, amplitude / 10, 5.0) == np.inf
