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


UNEVEN = Camera(
    centres_px=[41.3, 104.9, 163.2, 228.6, 290.1, 357.7, 418.4],
    angles=np.deg2rad([-43.3, 22.9, -12.7, 0.6, 48.0, -25.7, 37.5]),
    image_shape=(15, 19),
    slit_width_px=460,
    gains=[0.92, 1.08, 1.02, 0.90, 1.05, 0.96, 1.10],
    view_positions=[-3.3, -1.8, -1.1, 0.0, 0.7, 2.2, 2.9],
)


@pytest.mark.parametrize("shear", [-2.5, -0.6, 0.0, 1.7])
@pytest.mark.parametrize("view", range(7))
def test_a_point_falls_where_the_convention_says(view: int, shear: float):
    """``x = X - Y tan(angle) + s u`` from the view's centre, of points all over the picture, and as
    bright as the view's gain.
    """
    rows, columns = UNEVEN.image_shape
    operator = UNEVEN.operator(shear, np.float64)
    middle = UNEVEN.centres_px[view]
    own = np.abs(np.arange(UNEVEN.slit_width_px) - middle) < 29  # views lie 58 px apart at least
    for row, column in ((0, 0), (0, 18), (7, 9), (4, 13), (14, 0), (14, 18)):
        picture = np.zeros(UNEVEN.image_shape)
        picture[row, column] = 1
        light = np.where(own, operator(picture), 0)
        down, right = row - rows // 2, column - columns // 2
        expected = (
            middle
            + right
            - down * np.tan(UNEVEN.angles[view])
            + shear * UNEVEN.view_positions[view]
        )
        found = np.average(np.arange(light.size), weights=light)
        where = f"view {view} at shear {shear}: the point {right} right and {down} down of the axis"
        assert found == pytest.approx(expected, abs=1e-9), where
        assert light.sum() == pytest.approx(UNEVEN.gains[view]), where


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


@pytest.mark.parametrize("rows", [40, 41])
def test_no_shot_settles_the_sign_of_all_angles(rows: int) -> None:
    """With every sign turned round, the picture upside down explains any shot as well, however
    unequal the angles are and whatever the shear: nothing can be warned of.
    """
    angles = np.deg2rad([-55.0, -30, -18, 3, 22, 35, 60])
    camera = Camera(np.linspace(80.0, 320.0, 7), angles, (rows, 50), 400)
    turned = camera.replace(angles=-angles)
    picture = np.zeros((rows, 50))
    picture[5:-5, 5:-5] = np.random.default_rng(0).random((rows - 10, 40))
    # About the optical axis, which is the row rows // 2.
    upside_down = np.roll(picture[::-1], 1 - rows % 2, axis=0)
    for shear in (0.0, 1.5):
        seen = camera.operator(shear, np.float64)(picture)
        np.testing.assert_allclose(
            turned.operator(shear, np.float64)(upside_down), seen, atol=1e-9 * seen.max()
        )
        assert np.abs(turned.operator(shear, np.float64)(picture) - seen).max() > 0.1 * seen.max()
