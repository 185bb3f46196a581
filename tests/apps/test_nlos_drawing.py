from __future__ import annotations

from pathlib import Path

import matplotlib.image
import numpy as np

from apps.figures.nlos_geometry import (
    HIDDEN_POINT_M,
    LASER_SPOT_M,
    WALL_POINT_M,
    _make_geometry_figure,
    draw_geometry,
)


def test_the_drawn_signal_arrives_after_the_drawn_path(tmp_path: Path) -> None:
    record = _make_geometry_figure().axes[1]
    path, signal = record.lines[0].get_data()
    expected = sum(
        np.hypot(HIDDEN_POINT_M[0] - end[0], HIDDEN_POINT_M[1] - end[1])
        for end in (LASER_SPOT_M, WALL_POINT_M)
    )
    # A bin is 1 cm of path.
    assert abs(path[np.argmax(signal)] - expected) < 0.01
    draw_geometry(tmp_path / "geometry.png")
    assert matplotlib.image.imread(tmp_path / "geometry.png").shape[1] > 1000
