"""How sharp the hybrid makes a hidden point behind a curved wall, against the limit that
diffraction sets for it.
"""

from __future__ import annotations

import numpy as np
import pytest

from nlos import Grid, Hybrid
from nlos.capture import TimeAxis
from nlos.resolution import PeakWidths, compute_diffraction_limit, measure_fwhm
from nlos.simulate import PointScene, build_relay_wall

METHOD = Hybrid(0.125, 4.24)
LASER = [0.1, 0.05, 0.0]


@pytest.mark.parametrize("depth", [0.7, 1.0, 1.4])
def test_a_point_behind_a_curved_wall_is_as_wide_as_diffraction_makes_it(depth: float) -> None:
    point = np.array([0.1, -0.05, depth])
    capture = PointScene([point]).simulate_capture(
        build_relay_wall("cylinder", 64), LASER, TimeAxis(512, 32e-12), 30e-12
    )
    limit = compute_diffraction_limit(capture, point, METHOD.pulse)
    offsets = np.linspace(-0.2, 0.2, 41)
    widths = []
    for i in range(3):
        axes = [[c] for c in point]
        axes[i] = point[i] + offsets
        line = METHOD.reconstruct(capture, Grid(*axes)).values.ravel()
        assert line.argmax() == 20  # where it is
        widths.append(measure_fwhm(offsets, line, 20))
    found = PeakWidths(*widths)
    assert found.x == pytest.approx(limit.x, rel=0.1)
    assert found.y == pytest.approx(limit.y, rel=0.1)
    assert found.z == pytest.approx(limit.z, rel=0.1)
