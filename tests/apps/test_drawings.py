"""The guides' drawings of coordinates and light paths agree with what is computed."""

from __future__ import annotations

from pathlib import Path

import camera_geometry
import matplotlib.image
import nlos_geometry
import numpy as np

from tofclip.simulate import make_default_camera


def test_the_drawn_dots_are_where_the_camera_sees_the_point(tmp_path: Path) -> None:
    camera = make_default_camera()
    row, column = camera.optical_axis_px
    scene = np.zeros(camera.image_shape, np.float32)
    scene[
        row + int(camera_geometry.OFF_AXIS_POINT_PX[1]),
        column + int(camera_geometry.OFF_AXIS_POINT_PX[0]),
    ] = 1
    seen = camera.operator()(scene).reshape(-1)
    for place in camera_geometry.project_to_slit(camera_geometry.OFF_AXIS_POINT_PX):
        around = np.arange(round(place) - 3, round(place) + 4)
        # The light of a pixel falls on the two nearest columns, whose mean is the place itself.
        assert abs(np.average(around, weights=seen[around]) - place) < 0.1
    camera_geometry.draw_geometry(tmp_path / "geometry.png")
    assert matplotlib.image.imread(tmp_path / "geometry.png").shape[1] > 1000


def test_the_drawn_signal_arrives_after_the_drawn_path(tmp_path: Path) -> None:
    record = nlos_geometry._make_geometry_figure().axes[1]
    path, signal = record.lines[0].get_data()
    expected = sum(
        np.hypot(nlos_geometry.HIDDEN_POINT_M[0] - end[0], nlos_geometry.HIDDEN_POINT_M[1] - end[1])
        for end in (nlos_geometry.LASER_SPOT_M, nlos_geometry.WALL_POINT_M)
    )
    # A bin is 1 cm of path.
    assert abs(path[np.argmax(signal)] - expected) < 0.01
    nlos_geometry.draw_geometry(tmp_path / "geometry.png")
    assert matplotlib.image.imread(tmp_path / "geometry.png").shape[1] > 1000
