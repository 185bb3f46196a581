"""Cameras by hand: where points fall, sweeps, parallax, and their files."""

from functools import partial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tofclip.camera import (
    Camera,
    Measurement,
    PolynomialSweep,
    ProjectiveSweep,
    SkewSweep,
)
from tofclip.camera.model import sweep_from_record
from tofclip.camera.registration import (
    find_sharpest_shears,
    fit_parallax_to_centres,
    fit_parallax_to_shears,
)
from tofclip.errors import CalibrationError, FileFormatError, InputError
from tofclip.storage import Record

CENTRES = [20.5, 50.0, 80.25]


def camera(**changes):
    made = {"centres_px": CENTRES, "angles": [-0.5, 0.0, 0.5], "image_shape": (21, 25)}
    return Camera(**{**made, "slit_width_px": 101, **changes})


def test_defaults():
    made = camera()
    assert made.views == 3
    np.testing.assert_array_equal(made.gains, 1)
    np.testing.assert_array_equal(made.view_positions, [-1, 0, 1])
    assert made.optical_axis_px == (10, 12)
    assert not made.dead_columns.any()
    with pytest.raises(ValueError, match="read-only"):
        made.gains[0] = 2


UNEVEN = Camera(
    centres_px=[41.3, 104.9, 163.2, 228.6, 290.1, 357.7, 418.4],
    angles=np.deg2rad([-43.3, 22.9, -12.7, 0.6, 48.0, -25.7, 37.5]),
    image_shape=(15, 19),
    slit_width_px=460,
    gains=[0.92, 1.08, 1.02, 0.90, 1.05, 0.96, 1.10],
    view_positions=[-3.3, -1.8, -1.1, 0.0, 0.7, 2.2, 2.9],
)


@pytest.mark.parametrize("shape", [(15, 19), (16, 19), (15, 20), (16, 20)])
@pytest.mark.parametrize("shear", [-2.5, -0.6, 0.0, 1.7])
@pytest.mark.parametrize("view", range(7))
def test_a_point_falls_where_the_convention_says(view, shear, shape):
    """``x = X - Y tan(angle) + s u`` from the view's centre, of points all over the picture, and as
    bright as the view's gain; the optical axis is the middle pixel, the later one of an even number.
    """
    rows, columns = shape
    operator = UNEVEN.replace(image_shape=shape).operator(shear, np.float64)
    middle = UNEVEN.centres_px[view]
    own = np.abs(np.arange(UNEVEN.slit_width_px) - middle) < 29  # views lie 58 px apart at least
    for row, column in ((0, 0), (0, 18), (7, 9), (4, 13), (14, 0), (14, 18)):
        picture = np.zeros(shape)
        picture[row, column] = 1
        light = np.where(own, operator(picture), 0)
        down, right = row - rows // 2, column - columns // 2
        slant = down * np.tan(UNEVEN.angles[view])
        expected = middle + right - slant + shear * UNEVEN.view_positions[view]
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
        ({"lenslet_pitch": -1e-3}, "pitch"),
        ({"lenslet_pitch": np.nan}, "pitch"),
        ({"focus_distance": 0.0}, "pitch"),
    ],
)
def test_contradictions_are_refused(changes, message):
    with pytest.raises(CalibrationError, match=message):
        camera(**changes)


SKEW = SkewSweep(np.array([100.0, 300.0]), np.array([-4.0, 2.0]), np.array([0.01, -0.02]))
POLYNOMIAL = PolynomialSweep(
    column_coefficients=np.array([0.5, 1.0, 0.0, 0.25, -0.1, 0.2]),
    row_coefficients=np.array([-0.5, 0.1, 1.0, 0.0, 0.3, 0.0]),
    rectified_origin=np.array([10.0, 20.0]),
    rectified_scale=np.array([2.0, 4.0]),
    raw_origin=np.array([100.0, 200.0]),
    raw_scale=np.array([3.0, 5.0]),
)
PROJECTIVE = ProjectiveSweep(np.array([[1.0, 0.5, 3.0], [0.0, 2.0, -1.0], [0.001, 0.0, 1.0]]))
LEANING = ProjectiveSweep(np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.01, 1.0]]))
FOUR_CENTRES = np.array([0.0, 10, 20, 40])
# (column / 10)^2 - 1, and 1 % for each 10 columns
CURVED = SkewSweep(FOUR_CENTRES, np.array([-1.0, 0, 3, 15]), np.array([0.0, 0.01, 0.02, 0.04]))
# offsets of no parabola: what is left of the nearest, 1/11 of -3, 8, -6, 1 away, is interpolated
JUMPS = np.array([-3.0, 8, -6, 1]) / 11
JUMPING = SkewSweep(FOUR_CENTRES, CURVED.offsets_bin + JUMPS, np.zeros(4))


@pytest.mark.parametrize(
    ("sweep", "rectified", "raw"),
    [
        (SKEW, (50, 100), (-4 + 1.01 * 50, 100)),
        (SKEW, (50, 300), (2 + 0.98 * 50, 300)),
        (SKEW, (50, 200), (-1 + 0.995 * 50, 200)),  # half way: the means
        # a quarter beyond the outer centre: the line goes on
        (SKEW, (50, 350), (3.5 + (1 - 0.0275) * 50, 350)),
        (SKEW, (50, 50), (-5.5 + (1 + 0.0175) * 50, 50)),
        (SkewSweep([7.0], [3.0], [0.5]), (10, 900), (18, 900)),
        (CURVED, (100, 5), (-0.75 + 1.005 * 100, 5)),
        (CURVED, (100, -5), (-0.75 + 0.995 * 100, -5)),
        (CURVED, (100, 50), (24 + 1.05 * 100, 50)),
        (JUMPING, (0, 20), (3 - 6 / 11, 20)),
        (JUMPING, (0, 15), (1.25 + 1 / 11, 15)),
        (JUMPING, (0, 50), (24 + 4.5 / 11, 50)),
        # x = (14 - 10) / 2 = 2 and y = (12 - 20) / 4 = -2:
        # u = 0.5 + 2 + 0 + 0.25 * -4 - 0.1 * 4 + 0.2 * 4 = 1.9, v = -0.5 + 0.2 - 2 + 0.3 * 4 = -1.1
        (POLYNOMIAL, (12, 14), (-1.1 * 5 + 200, 1.9 * 3 + 100)),
        # Weight 0.001 * 100 + 1 = 1.1; column (100 + 0.5 * 10 + 3) / 1.1, row (2 * 10 - 1) / 1.1.
        (PROJECTIVE, (10, 100), (19 / 1.1, 108 / 1.1)),
        (LEANING, (50, 30), (50 / 1.5, 30 / 1.5)),
    ],
)
def test_sweeps_by_hand(sweep, rectified, raw):
    found = sweep.raw_position(*np.array(rectified, float))
    assert tuple(map(float, found)) == pytest.approx(raw, abs=1e-12)


def test_other_files_are_no_camera(tmp_path):
    (tmp_path / "camera.h5").write_bytes(b"not a camera")
    with pytest.raises(FileFormatError, match="not an HDF5 file"):
        Camera.load(tmp_path / "camera.h5")
    with pytest.raises(FileFormatError, match=r"a\.h5: holds an unknown sweep 'spline_sweep'"):
        sweep_from_record(Record("spline_sweep", origin="a.h5"))


@pytest.mark.parametrize(
    ("kind", "settings", "message"),
    [
        (SkewSweep, ([1.0, 2.0], [0.0], [0.0, 0.0]), r"\(views,\) in all three arrays"),
        (SkewSweep, ([], [], []), "sweep centres"),
        (SkewSweep, ([2.0, 1.0], [0.0, 0.0], [0.0, 0.0]), "centres must increase"),
        (SkewSweep, ([1.0, 1.0], [0.0, 0.0], [0.0, 0.0]), "centres must increase"),
        (SkewSweep, ([1.0, np.nan], [0.0, 0.0], [0.0, 0.0]), "centres must increase"),
        (PolynomialSweep, (np.ones(6), np.ones(5), *np.ones((4, 2))), r"\(6,\), got \(5,\)"),
        (PolynomialSweep, (np.ones(6), np.ones(6), *np.zeros((4, 2))), "must not be zero"),
        (ProjectiveSweep, (np.eye(2),), r"\(3, 3\)"),
    ],
)
def test_numbers_that_describe_no_sweep_are_refused(kind, settings, message):
    with pytest.raises(InputError, match=message):
        kind(*settings)


SEVEN = 60.0 + 90 * np.arange(7)
optical = partial(Camera, SEVEN, np.linspace(-0.7, 0.8, 7), (16, 16), 660, focal_length_px=250.0)


@given(
    pitch=st.floats(1e-4, 1e-2),
    focus=st.floats(0.3, 20.0),
    distances=st.lists(
        st.floats(0.3, 8.0), min_size=2, max_size=6, unique_by=lambda d: round(d, 2)
    ),
)
def test_the_camera_s_own_shears_give_its_parallax_back(pitch, focus, distances):
    made = optical(lenslet_pitch=pitch, focus_distance=focus)
    if np.ptp(1 / np.array(distances)) < 0.05:
        return
    found = fit_parallax_to_shears(made.shear_at(distances), distances).apply_to(optical())
    assert found.lenslet_pitch == pytest.approx(pitch, rel=1e-6)
    assert 1 / found.focus_distance == pytest.approx(1 / focus, abs=1e-6)


@pytest.mark.parametrize("sense", [1, -1])
def test_slit_centres_at_known_distances_give_the_parallax_and_its_sense(sense):
    distances = np.array([0.5, 0.8, 1.5, 4.0])
    truth = optical(lenslet_pitch=4e-3, focus_distance=1.2)
    moved = sense * np.outer(truth.view_positions, truth.shear_at(distances))
    moved += SEVEN[:, np.newaxis] + [0.0, 3.0, -1.0, 2.0]  # the target was put up at other places
    found = fit_parallax_to_centres(optical(), moved, distances)
    assert found.misfit_px == pytest.approx(0, abs=1e-9)
    fitted = found.apply_to(optical())
    assert fitted.lenslet_pitch == pytest.approx(4e-3)
    assert fitted.focus_distance == pytest.approx(1.2)
    np.testing.assert_array_equal(fitted.view_positions, sense * truth.view_positions)


@pytest.mark.parametrize("name", ["lif_desense_HelicalFiber", "lif_dof_HelicalFiber"])
def test_the_fibre_recordings_centres_follow_the_inverse_of_distance(shared_data, name):
    with np.load(shared_data / "lift" / f"{name}.npz") as archive:
        centres = archive["lens_centre_px_by_depth"] - 1.0
        lens, _, pitch = archive["depth_fit_coeff"] * 1e-3
        pixel = float(archive["pixel_size_mm"]) * 1e-3
    spacing = np.diff(centres, axis=0).mean(axis=0)
    distances = lens * pitch / (spacing * pixel - pitch)  # the authors' own formula
    made = Camera(centres[:, -1], np.zeros(7), (180, 180), 1344, focal_length_px=lens / pixel)
    found = fit_parallax_to_centres(made, centres, distances)
    assert found.strength < 0  # seen through lenses: near objects move the other way along the slit
    fitted = found.apply_to(made)
    # the least-squares spacing of seven views is not quite the mean one of the authors; centres are
    # good to 1 px
    assert fitted.lenslet_pitch == pytest.approx(pitch, rel=0.03)
    assert found.misfit_px < 1.0
    assert fitted.focus_distance == pytest.approx(distances[-1], rel=0.05)
    assert fitted.shear_at(distances[0]) < fitted.shear_at(distances[-1])


def test_a_focus_beyond_infinity_counts_as_infinity():
    found = fit_parallax_to_shears([-2.1, -1.1, -0.6], [0.5, 1.0, 2.0])
    assert found.focus_dioptres < 0
    assert found.apply_to(optical()).focus_distance == np.inf
    assert np.all(optical().shear_at([0.5, 5.0]) == 0)


def test_a_parallax_is_found_above_its_errors_only():
    distances = np.linspace(1.0, 4.0, 12)
    noise = np.random.default_rng(2).standard_normal(12)
    found = fit_parallax_to_shears(-0.8 * (1 / distances - 0.4) + 0.02 * noise, distances)
    assert found.strength == pytest.approx(0.8, abs=0.1)
    for deviation in (0.0, 0.05):
        with pytest.raises(CalibrationError, match="do not determine a parallax"):
            fit_parallax_to_shears(0.3 + deviation * noise, distances)


DARK = Measurement(np.zeros((660, 4), np.float32), np.ones((660, 4), bool))


@pytest.mark.parametrize(
    ("attempt", "message"),
    [
        (lambda: fit_parallax_to_shears([0.0, 1.0], [1.0, 1.0]), "two or more"),
        (lambda: fit_parallax_to_shears([0.0, np.nan], [1.0, 2.0]), "two or more"),
        (lambda: fit_parallax_to_shears([0.0, 1.0], [-1.0, 2.0]), "two or more"),
        (lambda: fit_parallax_to_shears([0.0, 1.0], [1.0]), "must have shape"),
        (lambda: fit_parallax_to_centres(optical(), np.zeros((6, 2)), [1.0, 2.0]), "slit centres"),
        (lambda: find_sharpest_shears(DARK, optical(), [slice(0, 4)], [0.0]), "two finite shears"),
    ],
)
def test_numbers_that_give_no_parallax_are_refused(attempt, message):
    with pytest.raises(InputError, match=message):
        attempt()


def test_shears_of_a_dark_shot_have_no_weight():
    curve = find_sharpest_shears(DARK, optical(), [slice(0, 4)], [-1.0, 0.0, 1.0])
    assert not curve.agreement.any()
    assert not curve.weight.any()


def test_displacement_is_the_part_of_parallax_that_moves_the_picture():
    even = Camera(SEVEN, np.arctan(0.3 * np.arange(-3.0, 4.0) + 0.05), (16, 16), 660)
    # slit: X - Y tan + s u with u = (tan - 0.05)/0.3, so Y shows up s/0.3 too high and X by -s/6
    # aside
    assert even.displacement_per_shear == pytest.approx((-1 / 0.3, -0.05 / 0.3))
    assert Camera([60.0], [0.2], (16, 16), 121).displacement_per_shear == (0.0, 0.0)
