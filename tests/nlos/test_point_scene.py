from __future__ import annotations

import numpy as np
import pytest

from nlos.capture import TimeAxis
from nlos.simulate import PointScene
from tofclip.errors import InputError, ShapeError
from tofclip.units import SPEED_OF_LIGHT

AXIS = TimeAxis(bins=300, bin_width=10e-12, start=0.3)
WALL = np.array([[0.0, 0.0, 0.0], [0.3, -0.1, 0.05], [-0.2, 0.2, 0.0]])
HIDDEN = np.array([0.05, 0.1, 0.4])


@pytest.mark.parametrize("laser", [np.array([0.1, 0.0, 0.0]), WALL])
def test_light_arrives_after_its_path_with_inverse_squares(laser: np.ndarray) -> None:
    capture = PointScene([HIDDEN], [2.0]).simulate_capture(WALL, laser, AXIS, 15e-12)
    outward, back = (np.linalg.norm(end - HIDDEN, axis=-1) for end in (laser, WALL))
    total = capture.signal.sum(axis=0)
    # float32 signals.
    assert total == pytest.approx(2.0 / (outward * back) ** 2, rel=1e-5)
    centroid = (capture.axis.paths @ capture.signal) / total
    assert centroid == pytest.approx(outward + back, rel=1e-5)
    spread = np.sqrt(
        ((capture.axis.paths[:, None] - centroid) ** 2 * capture.signal).sum(axis=0) / total
    )
    # A bin's own width adds its variance, spacing^2 / 12.
    expected = np.hypot(SPEED_OF_LIGHT * 15e-12, capture.axis.spacing / np.sqrt(12))
    assert spread == pytest.approx(np.full(3, expected), rel=1e-4)


def test_points_add_up() -> None:
    scene = PointScene([HIDDEN, HIDDEN + 0.1], [1.0, 3.0])
    parts = [
        PointScene([p], [a]).simulate_capture(WALL, WALL[0], AXIS, 15e-12).signal
        for p, a in ((HIDDEN, 1), (HIDDEN + 0.1, 3))
    ]
    assert scene.simulate_capture(WALL, WALL[0], AXIS, 15e-12).signal == pytest.approx(
        parts[0] + parts[1], rel=1e-6
    )


def test_masked_wall_points_are_dark() -> None:
    wall = WALL.copy()
    wall[1] = np.nan
    capture = PointScene([HIDDEN]).simulate_capture(wall, WALL[0], AXIS, 15e-12)
    assert np.all(capture.signal[:, 1] == 0)
    assert capture.valid.tolist() == [True, False, True]


def test_nonsense_is_refused() -> None:
    with pytest.raises(ShapeError, match="hidden points"):
        PointScene([[1, 2]])
    with pytest.raises(ShapeError, match="albedo"):
        PointScene([HIDDEN], [1, 2])
    with pytest.raises(InputError, match="jitter"):
        PointScene([HIDDEN]).simulate_capture(WALL, WALL[0], AXIS, 0.0)
