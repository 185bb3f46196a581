from __future__ import annotations

from pathlib import Path

import matplotlib.image
import numpy as np

from apps.figures.camera_geometry import OFF_AXIS_POINT_PX, draw_geometry, project_to_slit
from tofclip.simulate import make_default_camera


def test_the_drawn_dots_are_where_the_camera_sees_the_point(tmp_path: Path) -> None:
    camera = make_default_camera()
    row, column = camera.optical_axis_px
    scene = np.zeros(camera.image_shape, np.float32)
    scene[row + int(OFF_AXIS_POINT_PX[1]), column + int(OFF_AXIS_POINT_PX[0])] = 1
    seen = camera.operator()(scene).reshape(-1)
    for place in project_to_slit(OFF_AXIS_POINT_PX):
        around = np.arange(round(place) - 3, round(place) + 4)
        # The light of a pixel falls on the two nearest columns, whose mean is the place itself.
        assert abs(np.average(around, weights=seen[around]) - place) < 0.1
    draw_geometry(tmp_path / "geometry.png")
    assert matplotlib.image.imread(tmp_path / "geometry.png").shape[1] > 1000
