"""Lenslet pitch and focus distance from known ranges."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tofclip.camera import Camera, Measurement
from tofclip.camera.parallax import (
    find_sharpest_shears,
    fit_parallax_to_centres,
    fit_parallax_to_shears,
    measure_sharpness,
)
from tofclip.errors import CalibrationError, InputError, ShapeError

CENTRES = 60.0 + 90 * np.arange(7)


def camera(**settings: object) -> Camera:
    return Camera(
        CENTRES, np.linspace(-0.7, 0.8, 7), (16, 16), 660, focal_length_px=250.0, **settings
    )


@settings(max_examples=40, deadline=None)
@given(
    pitch=st.floats(1e-4, 1e-2),
    focus=st.floats(0.3, 20.0),
    distances=st.lists(
        st.floats(0.3, 8.0), min_size=2, max_size=6, unique_by=lambda d: round(d, 2)
    ),
)
def test_the_camera_s_own_shears_give_its_parallax_back(pitch, focus, distances):
    made = camera(lenslet_pitch=pitch, focus_distance=focus)
    if np.ptp(1 / np.array(distances)) < 0.05:
        return
    found = fit_parallax_to_shears(made.shear_at(distances), distances).apply_to(camera())
    assert found.lenslet_pitch == pytest.approx(pitch, rel=1e-6)
    assert 1 / found.focus_distance == pytest.approx(1 / focus, abs=1e-6)


@pytest.mark.parametrize("sense", [1, -1])
def test_slit_centres_at_known_distances_give_the_parallax_and_its_sense(sense):
    distances = np.array([0.5, 0.8, 1.5, 4.0])
    truth = camera(lenslet_pitch=4e-3, focus_distance=1.2)
    moved = CENTRES[:, np.newaxis] + sense * np.outer(
        truth.view_positions, truth.shear_at(distances)
    )
    moved = moved + np.array([0.0, 3.0, -1.0, 2.0])  # the target was put up at other places
    found = fit_parallax_to_centres(camera(), moved, distances)
    assert found.misfit_px == pytest.approx(0, abs=1e-9)
    fitted = found.apply_to(camera())
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
    assert found.apply_to(camera()).focus_distance == np.inf


def test_wrong_numbers_are_refused():
    for shears, distances in (
        ([0.0, 1.0], [1.0, 1.0]),
        ([0.0, np.nan], [1.0, 2.0]),
        ([0.0, 1.0], [-1.0, 2.0]),
    ):
        with pytest.raises(CalibrationError, match="two or more"):
            fit_parallax_to_shears(shears, distances)
    with pytest.raises(ShapeError):
        fit_parallax_to_shears([0.0, 1.0], [1.0])
    with pytest.raises(ShapeError, match="slit centres"):
        fit_parallax_to_centres(camera(), np.zeros((6, 2)), [1.0, 2.0])
    dark = Measurement(np.zeros((660, 4), np.float32), np.ones((660, 4), bool))
    with pytest.raises(InputError, match="two finite shears"):
        find_sharpest_shears(dark, camera(), [slice(0, 4)], [0.0])
    curve = find_sharpest_shears(dark, camera(), [slice(0, 4)], [-1.0, 0.0, 1.0])
    assert not curve.agreement.any()
    assert not curve.weight.any()


def test_sharpness_counts_how_few_pixels_hold_the_light():
    picture = np.zeros((1, 8, 8), np.float32)
    assert measure_sharpness(picture) == 0
    assert measure_sharpness(picture + 1) == pytest.approx(1)
    picture[0, 2:4, 2:4] = 5
    assert measure_sharpness(picture) == pytest.approx(16)


def test_cameras_refuse_impossible_optics():
    for wrong in ({"lenslet_pitch": -1e-3}, {"lenslet_pitch": np.nan}, {"focus_distance": 0.0}):
        with pytest.raises(CalibrationError, match="pitch"):
            camera(**wrong)
    assert np.all(camera().shear_at([0.5, 5.0]) == 0)


def test_displacement_is_the_part_of_parallax_that_moves_the_picture():
    positions = np.arange(-3.0, 4.0)
    even = Camera(CENTRES, np.arctan(0.3 * positions + 0.05), (16, 16), 660)
    rows, columns = even.displacement_per_shear
    # slit: X - Y tan + s u with u = (tan - 0.05)/0.3, so Y shows up s/0.3 too high and X by -s/6
    # aside
    assert rows == pytest.approx(-1 / 0.3)
    assert columns == pytest.approx(-0.05 / 0.3)
    alone = Camera([60.0], [0.2], (16, 16), 121)
    assert alone.displacement_per_shear == (0.0, 0.0)


@pytest.mark.parametrize("noise", [0.0, 0.05])
def test_shears_that_do_not_change_with_distance_are_refused(noise):
    distances = np.linspace(1.0, 4.0, 12)
    shears = 0.3 + noise * np.random.default_rng(1).standard_normal(12)
    with pytest.raises(CalibrationError, match="do not determine a parallax"):
        fit_parallax_to_shears(shears, distances)


def test_a_parallax_above_its_errors_is_found():
    distances = np.linspace(1.0, 4.0, 12)
    noise = 0.02 * np.random.default_rng(2).standard_normal(12)
    found = fit_parallax_to_shears(-0.8 * (1 / distances - 0.4) + noise, distances)
    assert found.strength == pytest.approx(0.8, abs=0.1)
