"""LIFT archives: geometry against the formulas that come with the data, in its own 1-based pixels."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tofclip.camera import PolynomialSweep, ProjectiveSweep
from tofclip.errors import (
    FileFormatError,
    InputError,
    MissingTimeAxisError,
    StorageError,
    TofclipError,
)
from tofclip.io import read_streak
from tofclip.io.archive import Archive
from tofclip.io.lift import RelayWall, read_relay_wall

ROW, COLUMN = np.meshgrid([0.0, 4.0, 11.0], [0.0, 17.5, 59.0], indexing="ij")


def test_angles_and_centres_give_the_slit_columns_of_the_archives_formula(
    write_lift: Any, lift_entries: dict[str, Any]
) -> None:
    """``s = column cos(theta) + row sin(theta)``, slit column ``centre + s / cos(theta)``, theta =
    90 - lens angle.
    """
    camera = read_streak(write_lift()).camera
    theta = np.deg2rad(90.0 - lift_entries["lens_angle_deg"])
    assert camera.image_shape == (12, 12)
    assert np.all(np.abs(camera.angles) < np.pi / 2)
    for row, column in ((6, 6), (6, 9), (2, 6), (9, 4)):
        s = (column - 6) * np.cos(theta) + (row - 6) * np.sin(theta)
        expected_px = (
            lift_entries["lens_centre_px"] + s / np.cos(theta) - 1
        )  # from 1-based to 0-based
        picture = np.zeros((12, 12))
        picture[row, column] = 1
        for view in range(3):
            alone = camera.replace(
                centres_px=camera.centres_px[view : view + 1],
                angles=camera.angles[view : view + 1],
                gains=np.ones(1),
                view_positions=np.zeros(1),
                centre_uncertainty_px=np.zeros(1),
                angle_uncertainty=np.zeros(1),
            )
            slit = alone.operator(dtype=np.float64)(picture)
            # Linear interpolation keeps the centroid exactly.
            assert slit @ np.arange(60) == pytest.approx(expected_px[view], abs=1e-9)


@pytest.mark.parametrize(
    ("region_px", "width_px"), [(173, 174), (179, 180), (182, 182), (174, 174), (1, 2)]
)
def test_the_picture_width_rounds_halves_up(write_lift: Any, region_px: int, width_px: int) -> None:
    camera = read_streak(write_lift(region_size_px=np.array(region_px), wall_grid_m=None)).camera
    assert camera.image_shape == (width_px, width_px)


def test_the_polynomial_map_in_the_archives_own_pixels(
    write_lift: Any, lift_entries: dict[str, Any]
) -> None:
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


def test_the_projective_map_in_the_archives_own_pixels(write_lift: Any) -> None:
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


def test_a_single_row_was_not_swept(write_lift: Any) -> None:
    streak = read_streak(
        write_lift(streak_raw=np.arange(60, dtype=np.uint16)[np.newaxis], dt_s=np.array(np.nan))
    )
    raw_row, raw_column = streak.camera.sweep.raw_position(ROW, COLUMN)
    np.testing.assert_array_equal(raw_row, ROW)
    np.testing.assert_array_equal(raw_column, COLUMN)


def test_counts_times_and_metadata(write_lift: Any, lift_entries: dict[str, Any]) -> None:
    streak = read_streak(write_lift())
    np.testing.assert_array_equal(streak.counts, lift_entries["streak_raw"])
    np.testing.assert_allclose(streak.times, np.arange(12) * 4.6e-12, rtol=1e-15)
    assert streak.saturated is None
    assert streak.metadata["rectify_kind"] == "polynomial2"
    assert streak.metadata["region_size_px"] == "11"


def test_an_unknown_time_step_has_to_be_given(write_lift: Any) -> None:
    path = write_lift(dt_s=np.array(np.nan))
    with pytest.raises(MissingTimeAxisError):
        _ = read_streak(path).times
    np.testing.assert_allclose(
        read_streak(path, bin_width=1e-12).times, np.arange(12) * 1e-12, rtol=1e-15
    )


def test_the_relay_wall_travels_along(
    write_lift: Any, lift_entries: dict[str, Any], tmp_path: Path
) -> None:
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


def test_the_window_of_the_recorded_size_lies_where_the_data_says(write_lift: Any) -> None:
    """0-based rows and columns 25..149 of 174."""
    path = write_lift(
        wall_grid_m=np.random.default_rng(0).random((3, 125, 125)), region_size_px=np.array(173)
    )
    assert read_relay_wall(Archive(path), (174, 174)).offset_px == (25, 25)


@pytest.mark.parametrize("turn", [0.0, 0.7])
def test_the_focal_length_of_a_known_pinhole_is_found(turn: float) -> None:
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


def test_the_focal_length_reaches_the_camera(write_lift: Any) -> None:
    # The archive's pixels are ten times finer than those of its pinhole of 250 px.
    streak = read_streak(write_lift())
    assert streak.camera.focal_length_px == pytest.approx(25.0, rel=1e-5)
    assert float(streak.metadata["focal_length_residual_px"]) < 1e-3


REQUIRED = [
    "streak_raw dt_s resample_flag image_inverted_flag lens_centre_px lens_angle_deg region_size_px",
    "rectify_poly_u rectify_poly_v rectify_norm_xy rectify_norm_uv camera_pos_m laser_pos_m",
    "receive_delay_bins",
]


@pytest.mark.parametrize("name", " ".join(REQUIRED).split())
def test_a_missing_or_misshapen_field_is_named(write_lift: Any, name: str) -> None:
    with pytest.raises(FileFormatError, match=rf"shot\.npz: has no field '{name}'"):
        read_streak(write_lift(**{name: None}))
    with pytest.raises(
        FileFormatError, match=rf"shot\.npz: field '{name}' must be numbers of shape"
    ):
        read_streak(write_lift(**{name: np.ones((2, 3, 4, 5))}))
    with pytest.raises(FileFormatError, match=rf"shot\.npz: field '{name}' must be numbers"):
        read_streak(write_lift(**{name: np.array("word")}))


def test_noise_below_zero_is_kept(write_lift: Any) -> None:
    """Background was taken off: a third of the pixels of a published archive is negative."""
    noise = np.random.default_rng(1).normal(0.0, 1.0, (12, 60))
    noise[5, 30] = 40.0
    counts = read_streak(write_lift(streak_raw=noise)).counts
    assert np.mean(counts < 0) > 0.3
    assert np.array_equal(counts, noise.astype(np.float32)[: counts.shape[0], : counts.shape[1]])


@pytest.mark.parametrize(
    ("changes", "fault", "problem"),
    [
        ({"streak_raw": np.zeros((12, 60))}, InputError, "every pixel is zero"),
        ({"streak_raw": np.full((12, 60), np.nan)}, InputError, "NaN or infinite"),
        ({"streak_raw": np.full((12, 60), -1.0)}, InputError, "negative"),
        (
            {"streak_raw": np.zeros((0, 60))},
            FileFormatError,
            "'streak_raw' must be numbers of shape",
        ),
        ({"dt_s": np.array(-1e-12)}, FileFormatError, "'dt_s' must be positive"),
        ({"dt_s": np.array(np.inf)}, FileFormatError, "'dt_s' must be positive"),
        ({"resample_flag": np.array(0)}, FileFormatError, "'resample_flag' is 0"),
        ({"image_inverted_flag": np.array(1)}, FileFormatError, "'image_inverted_flag' is 1"),
        (
            {"lens_centre_px": np.array([11.0, np.nan, 50])},
            FileFormatError,
            "'lens_centre_px' must not hold NaN",
        ),
        ({"lens_centre_px": np.array([11.0, 30, 62])}, InputError, r"61\.0 px lies off the sensor"),
        (
            {"lens_angle_deg": np.array([45.0, 90])},
            FileFormatError,
            "'lens_angle_deg' must be numbers of shape",
        ),
        ({"lens_angle_deg": np.array([45.0, 90, 185])}, InputError, "within 90 degrees"),
        (
            {"region_size_px": np.array(-3)},
            FileFormatError,
            "'region_size_px' must be a picture width",
        ),
        ({"rectify_kind": np.array("affine")}, FileFormatError, "found 'affine'"),
        ({"rectify_kind": np.array(3)}, FileFormatError, "'rectify_kind' must be a string"),
        ({"rectify_norm_xy": np.zeros((3, 3))}, InputError, "scales must not be zero"),
        (
            {"rectify_kind": np.array("projective"), "rectify_matrix": np.ones((3, 3))},
            FileFormatError,
            "'rectify_matrix' is singular",
        ),
        ({"wall_grid_m": np.ones((3, 13, 13))}, FileFormatError, "wall points for at most"),
        ({"wall_grid_m": np.full((3, 5, 5), np.nan)}, FileFormatError, "wall points for at most"),
    ],
)
def test_impossible_content_is_refused(
    write_lift: Any, changes: dict[str, Any], fault: type[TofclipError], problem: str
) -> None:
    with pytest.raises(fault, match=rf"shot\.npz: .*{problem}"):
        read_streak(write_lift(**changes))


def test_pickled_objects_are_never_loaded(write_lift: Any) -> None:
    with pytest.raises(FileFormatError, match="truncated or damaged NumPy archive"):
        read_streak(write_lift(note=np.array([{"a": 1}], dtype=object)))


def test_an_absent_archive_is_named(tmp_path: Path) -> None:
    with pytest.raises(StorageError, match="no such file"):
        Archive(tmp_path / "absent.npz")


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
def test_recorded_archives(
    shared_data: Path, name: str, rows: int, bin_width: float | None, width_px: int
) -> None:
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


def test_recorded_pulse_in_a_fibre_agrees_between_views_once_rectified(shared_data: Path) -> None:
    """A pulse is a point (X, Y), so that seven views over-determine it: map, centres and angles
    must agree.
    """
    streak = read_streak(shared_data / "lift" / "lif_desense_CurveFiber.npz")
    camera = streak.camera
    rows = np.arange(0, 400, 4)
    views = np.stack([np.ones(7), -np.tan(camera.angles)], axis=1)
    disagreement = np.eye(7) - views @ np.linalg.pinv(views)
    window = np.arange(-90, 91)

    def median_error_px(rectified: bool) -> float:
        column = camera.centres_px[:, np.newaxis] + window
        errors = []
        for row in rows:
            raw_row, raw_column = (
                camera.sweep.raw_position(float(row), column) if rectified else (float(row), column)
            )
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
