"""LIFT archives: geometry against the formulas that come with the data, in its own 1-based pixels."""

import numpy as np
import pytest

from tofclip.camera import Camera, PolynomialSweep, ProjectiveSweep
from tofclip.errors import FileFormatError, InputError, MissingTimeAxisError
from tofclip.io import read_streak
from tofclip.io.lift import RelayWall

ROW, COLUMN = np.meshgrid([0.0, 4.0, 11.0], [0.0, 17.5, 59.0], indexing="ij")


def test_angles_and_centres_give_the_slit_columns_of_the_archives_formula(write_lift, lift_entries):
    """``s = column cos(theta) + row sin(theta)``, slit column ``centre + s / cos(theta)``, theta =
    90 - lens angle.
    """
    camera = read_streak(write_lift()).camera
    theta = np.deg2rad(90.0 - lift_entries["lens_angle_deg"])
    assert camera.image_shape == (12, 12)
    assert np.all(np.abs(camera.angles) < np.pi / 2)
    for row, column in ((6, 6), (6, 9), (2, 6), (9, 4)):
        s = (column - 6) * np.cos(theta) + (row - 6) * np.sin(theta)
        # from 1-based to 0-based
        expected_px = lift_entries["lens_centre_px"] + s / np.cos(theta) - 1
        picture = np.zeros((12, 12))
        picture[row, column] = 1
        for view in range(3):
            only = slice(view, view + 1)
            alone = Camera(camera.centres_px[only], camera.angles[only], (12, 12), 60)
            slit = alone.operator(dtype=np.float64)(picture)
            # Linear interpolation keeps the centroid exactly.
            assert slit @ np.arange(60) == pytest.approx(expected_px[view], abs=1e-9)


def test_the_polynomial_map_in_the_archives_own_pixels(write_lift, lift_entries):
    sweep = read_streak(write_lift()).camera.sweep
    assert isinstance(sweep, PolynomialSweep)
    xy, uv = lift_entries["rectify_norm_xy"], lift_entries["rectify_norm_uv"]
    x = (COLUMN + 1 - xy[2, 0]) / xy[0, 0]
    y = (ROW + 1 - xy[2, 1]) / xy[1, 1]
    terms = np.stack([np.ones_like(x), x, y, x * y, x**2, y**2])
    u = np.tensordot(lift_entries["rectify_poly_u"], terms, 1) * uv[0, 0] + uv[2, 0]
    v = np.tensordot(lift_entries["rectify_poly_v"], terms, 1) * uv[1, 1] + uv[2, 1]
    raw_row, raw_column = sweep.raw_position(ROW, COLUMN)
    np.testing.assert_allclose(raw_column, u - 1, atol=1e-11)
    np.testing.assert_allclose(raw_row, v - 1, atol=1e-11)


def test_the_projective_map_in_the_archives_own_pixels(write_lift):
    """``[u v 1] @ matrix ~ [x y 1]`` leads from raw to rectified pixels; the sweep goes the other
    way.
    """
    matrix = np.array([[1.04, 2e-3, 4e-6], [-0.011, 0.98, -2.3e-5], [-3.2, 2.6, 1.0]])
    changes = {"rectify_kind": np.array("projective"), "rectify_matrix": matrix}
    sweep = read_streak(write_lift(**changes)).camera.sweep
    assert isinstance(sweep, ProjectiveSweep)
    raw_row, raw_column = sweep.raw_position(ROW, COLUMN)
    x, y, weight = np.moveaxis(
        np.stack([raw_column + 1, raw_row + 1, np.ones_like(ROW)], -1) @ matrix, -1, 0
    )
    np.testing.assert_allclose(x / weight, COLUMN + 1, atol=1e-10)
    np.testing.assert_allclose(y / weight, ROW + 1, atol=1e-10)


def test_a_single_row_was_not_swept(write_lift):
    row = np.arange(60, dtype=np.uint16)[np.newaxis]
    streak = read_streak(write_lift(streak_raw=row, dt_s=np.array(np.nan)))
    raw_row, raw_column = streak.camera.sweep.raw_position(ROW, COLUMN)
    np.testing.assert_array_equal(raw_row, ROW)
    np.testing.assert_array_equal(raw_column, COLUMN)


def test_counts_times_and_metadata(write_lift, lift_entries):
    """Also of an archive that does not know its time step, and of one with negative noise."""
    # Background was taken off: a third of the pixels of a published archive is negative.
    noise = np.random.default_rng(1).normal(0.0, 1.0, (12, 60))
    noise[5, 30] = 40.0
    streak = read_streak(write_lift(streak_raw=noise))
    np.testing.assert_array_equal(streak.counts, noise.astype(np.float32))
    np.testing.assert_allclose(streak.times, np.arange(12) * 4.6e-12, rtol=1e-15)
    assert streak.saturated is None
    assert streak.metadata["rectify_kind"] == "polynomial2"
    assert streak.metadata["region_size_px"] == "11"
    # The archive's pixels are ten times finer than those of its pinhole of 250 px.
    assert streak.camera.focal_length_px == pytest.approx(25.0, rel=1e-5)
    assert float(streak.metadata["focal_length_residual_px"]) < 1e-3
    path = write_lift(dt_s=np.array(np.nan))
    with pytest.raises(MissingTimeAxisError):
        _ = read_streak(path).times
    given = read_streak(path, bin_width=1e-12).times
    np.testing.assert_allclose(given, np.arange(12) * 1e-12, rtol=1e-15)


def test_the_relay_wall_travels_along(write_lift, lift_entries, tmp_path):
    read_streak(write_lift()).save(tmp_path / "shot.h5")
    wall = read_streak(tmp_path / "shot.h5").attachments["relay_wall"]
    assert wall.kind == "relay_wall"
    np.testing.assert_array_equal(
        wall.array("wall", np.float64, 3, "m")[1, 3], lift_entries["wall_grid_m"][:, 1, 3]
    )
    np.testing.assert_array_equal(wall.array("camera", np.float64, 1, "m"), [1.0, -0.3, -1.4])
    np.testing.assert_array_equal(wall.array("laser", np.float64, 1, "m"), [0, 0, 0])
    # The 5 x 5 window has pixel 6 of the 12 x 12 picture in its middle.
    assert wall.attributes == {"row_offset": 4, "column_offset": 4, "receive_delay_bins": 100}
    assert "relay_wall" not in read_streak(write_lift(wall_grid_m=None)).attachments
    # Of the recorded size the window lies where the data says: 0-based rows and columns 25..149.
    grid = np.random.default_rng(0).random((3, 125, 125))
    wide = read_streak(write_lift(wall_grid_m=grid, region_size_px=np.array(173)))
    found = wide.attachments["relay_wall"].attributes
    assert (found["row_offset"], found["column_offset"]) == (25, 25)


@pytest.mark.parametrize("turn", [0.0, 0.7])
def test_the_focal_length_of_a_known_pinhole_is_found(turn):
    """Also for a camera that is turned against the wall's frame, a bent wall, and pixels without a
    wall point.
    """
    focal_length_px, generator = 250.0, np.random.default_rng(1)
    rows, columns = np.indices((31, 41), dtype=float)
    sight = np.stack([columns - 20, rows - 15, np.full(rows.shape, focal_length_px)], axis=-1)
    rotation = np.array(
        [[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]]
    )
    points = sight @ rotation.T * generator.uniform(0.005, 0.007, (31, 41, 1)) + [1.0, -0.3, -1.4]
    points[3:9, 4:7] = np.nan
    wall = RelayWall(points, np.array([1.0, -0.3, -1.4]), np.zeros(3), (72, 67), (87, 87), 0.0)
    found_px, residual_px = wall.fit_focal_length()
    # The search ends at a relative width of 1e-6.
    assert found_px == pytest.approx(focal_length_px, rel=1e-5)
    assert residual_px < 1e-3


REQUIRED = """
    streak_raw dt_s resample_flag image_inverted_flag lens_centre_px lens_angle_deg region_size_px
    rectify_poly_u rectify_poly_v rectify_norm_xy rectify_norm_uv camera_pos_m laser_pos_m
    receive_delay_bins
"""


@pytest.mark.parametrize("name", REQUIRED.split())
def test_a_missing_or_misshapen_field_is_named(write_lift, name):
    for value, problem in (
        (None, f"has no field '{name}'"),
        (np.ones((2, 3, 4, 5)), f"field '{name}' must be numbers of shape"),
        (np.array("word"), f"field '{name}' must be numbers"),
    ):
        with pytest.raises(FileFormatError, match=rf"shot\.npz: {problem}"):
            read_streak(write_lift(**{name: value}))


@pytest.mark.parametrize(
    ("name", "value", "problem"),
    [
        ("streak_raw", np.zeros((12, 60)), "every pixel is zero"),
        ("streak_raw", np.full((12, 60), np.nan), "NaN or infinite"),
        ("streak_raw", np.full((12, 60), -1.0), "negative"),
        ("streak_raw", np.zeros((0, 60)), "'streak_raw' must be numbers of shape"),
        ("dt_s", -1e-12, "'dt_s' must be positive"),
        ("dt_s", np.inf, "'dt_s' must be positive"),
        ("resample_flag", 0, "'resample_flag' is 0"),
        ("image_inverted_flag", 1, "'image_inverted_flag' is 1"),
        ("lens_centre_px", [11.0, np.nan, 50], "'lens_centre_px' must not hold NaN"),
        ("lens_centre_px", [11.0, 30, 62], r"61\.0 px lies off the sensor"),
        ("lens_angle_deg", [45.0, 90], "'lens_angle_deg' must be numbers of shape"),
        ("lens_angle_deg", [45.0, 90, 185], "within 90 degrees"),
        ("region_size_px", -3, "'region_size_px' must be a picture width"),
        ("rectify_kind", "affine", "found 'affine'"),
        ("rectify_kind", 3, "'rectify_kind' must be a string"),
        ("rectify_norm_xy", np.zeros((3, 3)), "scales must not be zero"),
        ("rectify_matrix", np.ones((3, 3)), "'rectify_matrix' is singular"),
        ("wall_grid_m", np.ones((3, 13, 13)), "wall points for at most"),
        ("wall_grid_m", np.full((3, 5, 5), np.nan), "wall points for at most"),
        ("note", np.array([{"a": 1}], dtype=object), "truncated or damaged NumPy archive"),
    ],
)
def test_impossible_content_is_refused(write_lift, name, value, problem):
    changes = {"rectify_kind": np.array("projective")} if name == "rectify_matrix" else {}
    path = write_lift(**changes, **{name: np.asarray(value)})
    with pytest.raises((InputError, FileFormatError), match=rf"shot\.npz: .*{problem}"):
        read_streak(path)


@pytest.mark.parametrize(
    ("name", "rows", "bin_width", "width_px"),
    [
        ("nlos_LetterN", 1016, 4.6e-12, 174),
        ("nlos_LetterVI", 1016, 4.6e-12, 174),
        ("nlos_Circle_Square", 1016, 10e-12, 174),
        ("lif_desense_HelicalFiber", 801, None, 182),
        ("lif_desense_CurveFiber", 400, None, 182),
        ("lif_desense_SpotPattern", 1, None, 182),
        ("lif_dof_HelicalFiber", 1016, None, 180),
    ],
)
def test_recorded_archives(shared_data, name, rows, bin_width, width_px):
    streak = read_streak(shared_data / "lift" / f"{name}.npz")
    assert streak.counts.shape == (rows, 1344)
    assert streak.camera.views == 7
    assert streak.camera.image_shape == (width_px, width_px)
    if bin_width is None:
        assert streak.row_times is None
    else:
        np.testing.assert_allclose(np.diff(streak.times), bin_width, rtol=1e-9)
        wall = streak.attachments["relay_wall"]
        assert wall.fields["wall"].values.shape == (125, 125, 3)
        assert (wall.attributes["row_offset"], wall.attributes["column_offset"]) == (25, 25)
        # Same instrument, three alignments; the wall was measured to a few pixels.
        assert 230 < streak.camera.focal_length_px < 290
        assert float(streak.metadata["focal_length_residual_px"]) < 4


def test_recorded_pulse_in_a_fibre_agrees_between_views_once_rectified(shared_data):
    """A pulse is a point (X, Y), so that seven views over-determine it: map, centres and angles
    must agree.
    """
    streak = read_streak(shared_data / "lift" / "lif_desense_CurveFiber.npz")
    camera = streak.camera
    rows = np.arange(0, 400, 4)
    views = np.stack([np.ones(7), -np.tan(camera.angles)], axis=1)
    disagreement = np.eye(7) - views @ np.linalg.pinv(views)
    window = np.arange(-90, 91)

    def median_error_px(rectified):
        column = camera.centres_px[:, np.newaxis] + window
        errors = []
        for row in rows:
            raw_row, raw_column = float(row), column
            if rectified:
                raw_row, raw_column = camera.sweep.raw_position(raw_row, column)
            r = np.clip(np.rint(raw_row), 0, 399).astype(int)
            light = streak.counts[r, np.clip(np.rint(raw_column), 0, 1343).astype(int)]
            peak, offset = light.max(axis=1), window[light.argmax(axis=1)]
            if peak.min() > 60 and np.abs(offset).max() < 88:
                errors.append(disagreement @ offset)
        assert len(errors) > 40
        return float(np.median(np.abs(errors)))

    # The brightest pixel of a streak a few pixels wide; raw columns are off by up to 40 px.
    assert median_error_px(rectified=True) < 2
    assert median_error_px(rectified=False) > 8
