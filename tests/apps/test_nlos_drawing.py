from __future__ import annotations

from pathlib import Path

import matplotlib.image
import numpy as np

from apps.figures.nlos_geometry import HIDDEN, SPOT, WALL, _figure, draw_geometry


def test_the_drawn_signal_arrives_after_the_drawn_path(tmp_path: Path) -> None:
    record = _figure().axes[1]
    path, signal = record.lines[0].get_data()
    expected = sum(np.hypot(HIDDEN[0] - end[0], HIDDEN[1] - end[1]) for end in (SPOT, WALL))
    # A bin is 1 cm of path.
    assert abs(path[np.argmax(signal)] - expected) < 0.01
    draw_geometry(tmp_path / "geometry.png")
    assert matplotlib.image.imread(tmp_path / "geometry.png").shape[1] > 1000
