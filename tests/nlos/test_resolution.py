from __future__ import annotations

import numpy as np
import pytest

from nlos import Backprojection, Grid
from nlos.resolution import diffraction_limit, point_spread, width_at_half
from nlos.simulate import PointScene, relay_wall
from nlos.time_axis import TimeAxis
from tofclip.errors import InputError

pytestmark = pytest.mark.filterwarnings("ignore::nlos.sampling.AliasingWarning")

METHOD = Backprojection(0.125)
AXIS = TimeAxis(512, 32e-12)


def lines_through(point: np.ndarray, half: float, voxel: float) -> list[Grid]:
    steps = voxel * np.arange(-round(half / voxel), round(half / voxel) + 1)
    return [Grid(*(c + steps if i == axis else [c] for i, c in enumerate(point))) for axis in range(3)]


@pytest.mark.parametrize("depth", [0.8, 1.2, 1.6])
@pytest.mark.parametrize("shape", ["planar", "cylinder"])
def test_points_at_three_depths_are_as_narrow_as_diffraction_allows(depth: float, shape: str) -> None:
    wall = relay_wall(shape, 64)
    point = np.array([0.1, -0.15, depth])
    capture = PointScene([point]).seen_from(wall, [0.0, 0.0, 0.0], AXIS, 16e-12)
    limit = diffraction_limit(capture, point, METHOD.pulse)
    found = [
        getattr(point_spread(METHOD.reconstruct(capture, line), point), axis)
        for axis, line in zip("xyz", lines_through(point, 0.3, 0.005), strict=True)
    ]
    assert found == pytest.approx([limit.x, limit.y, limit.z], rel=0.1)


@pytest.mark.parametrize("confocal", [False, True])
def test_the_limit_of_a_small_wall_is_the_textbooks(confocal: bool) -> None:
    """A square aperture gives |sinc|, whose width at half is 1.207 wavelength * distance / width."""
    wall = relay_wall("planar", 33, 0.3) * 33 / 32  # samples stand for cells, whose outer halves count
    capture = PointScene([[0, 0, 3.0]]).seen_from(wall, wall if confocal else [0.0, 0, 0], AXIS, 16e-12)
    limit = diffraction_limit(capture, [0, 0, 3.0], Backprojection(0.02, 12).pulse)
    expected = 1.207 * 0.02 * 3.0 / (0.3 * 33 / 32) / (2 if confocal else 1)
    assert limit.x == pytest.approx(expected, rel=0.05)
    assert limit.y == pytest.approx(expected, rel=0.05)
    # Light runs to the point and back: depth counts twice.
    assert limit.z == pytest.approx(2.355 * Backprojection(0.02, 12).pulse.sigma / 2, rel=0.02)


def test_widths_are_interpolated() -> None:
    axis = np.array([0.0, 1, 2, 3, 4])
    assert width_at_half(axis, np.array([0, 0.25, 1, 0, 0]), 2) == pytest.approx(0.5 + 2 / 3)
    assert np.isnan(width_at_half(axis, np.array([0.6, 0.7, 1, 0, 0]), 2))
    with pytest.raises(InputError, match="three finite"):
        diffraction_limit(None, [0, 1], METHOD.pulse)
