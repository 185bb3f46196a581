"""Which points of fitted surfaces are returned, and how far off each may be."""

from __future__ import annotations

import numpy as np
import pytest
from surface_scene import CAMERA

from tofclip.recovery.surfaces.returns import estimate_displacement, find_usual_brightness


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
