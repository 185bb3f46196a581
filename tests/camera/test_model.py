from __future__ import annotations

import numpy as np
import pytest

from tofclip.camera import Camera, ProjectiveSweep, SkewSweep
from tofclip.errors import CalibrationError, FileFormatError

CENTRES = [20.5, 50.0, 80.25]


def camera(**changes: object) -> Camera:
    settings = {
        "centres_px": CENTRES,
        "angles": [-0.5, 0.0, 0.5],
        "image_shape": (21, 25),
        "slit_width_px": 101,
    }
    return Camera(**{**settings, **changes})


def test_defaults():
    made = camera()
    assert made.views == 3
    np.testing.assert_array_equal(made.gains, 1)
    np.testing.assert_array_equal(made.view_positions, [-1, 0, 1])
    assert made.optical_axis_px == (10, 12)
    assert not made.dead_columns.any()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"centres_px": [20.0, 50.0, 101.0]}, "lies off the sensor"),
        ({"centres_px": [-1.0, 50.0, 80.0]}, "lies off the sensor"),
        ({"centres_px": [20.0, np.nan, 80.0]}, "finite"),
        ({"angles": [0.0, 0.1]}, "angles must be 3 finite numbers"),
        ({"angles": [0.0, 0.1, np.pi / 2]}, "90 degrees"),
        ({"gains": [1.0, 0.0, 1.0]}, "positive"),
        ({"view_positions": [0.0, 1.0]}, "view_positions"),
        ({"image_shape": (0, 5)}, "empty"),
        ({"dead_columns": np.zeros(7, bool)}, "dead_columns"),
        ({"pulse_fwhm": 0.0}, "pulse"),
        ({"focal_length_px": -1.0}, "focal"),
        ({"time_zero": np.nan}, "time zero"),
        ({"centres_px": [], "angles": []}, "at least one view"),
    ],
)
def test_contradictions_are_refused(changes, message):
    with pytest.raises(CalibrationError, match=message):
        camera(**changes)


def test_a_camera_is_not_changed_by_accident():
    with pytest.raises(ValueError, match="read-only"):
        camera().gains[0] = 2


@pytest.mark.parametrize(
    "sweep",
    [None, SkewSweep(CENTRES, [1.0, 0.0, -2.0], [0.01, 0.0, 0.002]), ProjectiveSweep(np.eye(3))],
)
def test_saved_and_loaded_again(tmp_path, sweep):
    made = camera(
        gains=[0.9, 1.0, 1.1],
        sweep=sweep,
        time_zero=-1.5e-9,
        pulse_fwhm=7e-11,
        focal_length_px=400.5,
        dead_columns=np.arange(101) == 17,
        centre_uncertainty_px=[0.1, 0.2, 0.3],
        angle_uncertainty=[0.01, 0.02, 0.03],
    )
    made.save(tmp_path / "camera.h5")
    back = Camera.load(tmp_path / "camera.h5")
    for name in (
        "centres_px",
        "angles",
        "gains",
        "view_positions",
        "dead_columns",
        "centre_uncertainty_px",
    ):
        np.testing.assert_array_equal(getattr(back, name), getattr(made, name))
    for name in ("image_shape", "slit_width_px", "time_zero", "pulse_fwhm", "focal_length_px"):
        assert getattr(back, name) == getattr(made, name)
    assert type(back.sweep) is type(sweep)


def test_another_file_is_no_camera(tmp_path):
    (tmp_path / "camera.h5").write_bytes(b"not a camera")
    with pytest.raises(FileFormatError, match="not an HDF5 file"):
        Camera.load(tmp_path / "camera.h5")
