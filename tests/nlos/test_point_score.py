from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from point_score import score_points

from nlos import Backprojection, Capture, Grid, Hybrid, PlanarRSD
from nlos.capture import TimeAxis
from nlos.simulate import PointScene, add_poisson_noise, build_relay_wall

POINTS = np.array(
    [[0.0, 0.05, 0.7], [0.3, -0.25, 0.8], [-0.35, 0.2, 0.85], [0.2, 0.4, 0.95], [-0.3, -0.4, 1.05]]
)
SIDE = np.linspace(-0.75, 0.75, 64)
GRID = Grid(SIDE, SIDE, np.linspace(0.5, 1.25, 64))
PULSE = 0.125, 4.243  # an envelope of sigma 0.0884 m
EXACT = Backprojection(*PULSE)
METHODS = {"planar": PlanarRSD(*PULSE), "cylinder": Hybrid(*PULSE)}


@cache
def seen(wall: str) -> Capture:
    """Five hidden points, 64 x 64 wall points over 2 m, one laser spot, 512 bins of 32 ps."""
    return PointScene(POINTS).simulate_capture(
        build_relay_wall(wall, 64), [0.0, 0.0, 0.0], TimeAxis(512, 32e-12), 20e-12
    )


@pytest.mark.parametrize(
    ("wall", "energy", "contrast"), [("planar", 0.3211, 66.8), ("cylinder", 0.2924, 59.4)]
)
def test_as_much_energy_as_ever_lies_at_the_hidden_points(
    wall: str, energy: float, contrast: float
) -> None:
    """With the noise of 20 counts in the brightest bin.

    The values are means over four seeds; the tolerances, five times the spread over them, 0.00023
    and 0.4.
    """
    capture = add_poisson_noise(seen(wall), 20.0, seed=1)
    score = score_points(METHODS[wall].reconstruct(capture, GRID), POINTS)
    assert score.energy == pytest.approx(energy, abs=1.2e-3)
    assert score.contrast == pytest.approx(contrast, abs=2.0)


def test_the_score_is_that_of_back_projection() -> None:
    few = Grid(SIDE[::4], SIDE[::4], GRID.z[8:56:4])
    found, expected = (
        score_points(m.reconstruct(seen("cylinder"), few), POINTS) for m in (Hybrid(*PULSE), EXACT)
    )
    assert found.energy == pytest.approx(expected.energy, abs=3e-3)
    assert found.contrast == pytest.approx(expected.contrast, rel=5e-3)
