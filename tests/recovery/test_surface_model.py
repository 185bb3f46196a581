"""The surface model: adjoint, derivatives, and where light of points falls."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from surface_scene import BIN, CAMERA, INSTRUMENT, SCENE, SHAPE, make_model

from tofclip.recovery.surfaces.model import SUBROWS, SurfaceModel, SurfaceState, weigh_measurements
from tofclip.recovery.surfaces.patches import SmoothBasis
from tofclip.recovery.surfaces.pulse import make_pulse
from tofclip.recovery.surfaces.ranges import iterate_derivatives
from tofclip.simulate import simulate_shot


@pytest.fixture(scope="module")
def shot():
    return simulate_shot(SCENE, INSTRUMENT, seed=0)


def test_what_cannot_be_trusted_weighs_nothing(shot):
    streak = shot.streak
    saturated = np.zeros(streak.counts.shape, bool)
    saturated[20:24, 100:110] = True
    dead = np.zeros(CAMERA.slit_width_px, bool)
    dead[[7, 200]] = True
    _, weights = weigh_measurements(
        replace(streak, saturated=saturated), CAMERA.replace(dead_columns=dead)
    )
    np.testing.assert_array_equal(weights == 0, saturated | dead)


def test_the_adjoint_matches(shot):
    model = make_model(shot.streak)
    random = np.random.default_rng(0)
    x = random.random(model.surface.size).astype(np.float32)
    y = random.standard_normal(model.image.shape).astype(np.float32)
    there = np.vdot(model.render(x).astype(np.float64), y)
    assert there == pytest.approx(float(np.vdot(x.astype(np.float64), model.gather(y))), rel=1e-4)


def test_squares_of_the_entries_are_those_of_single_points(shot):
    model = make_model(shot.streak)
    information = model.gather(np.ones_like(model.image), squared=True)
    for point in (3, 200, 700):
        alone = np.zeros(model.surface.size, np.float32)
        alone[point] = 1
        # what is between rows and columns is exact only on average
        assert np.sum(model.render(alone) ** 2) == pytest.approx(information[point], rel=0.05)


def test_squares_of_entries_hold_what_a_view_sees_of_a_hidden_point(shot):
    model = make_model(shot.streak, overlap=True)
    model.find_behind(np.full(model.surface.size, 50, np.float32))
    shaded = model.state.copy()
    shaded.shading[1] = [-0.7, -0.4, 0.1, 0.6, 0.5, -0.3, 0.2]
    model.place(shaded)
    information = model.gather(np.ones_like(model.image), squared=True)
    hidden = np.flatnonzero(model.behind)
    for point in hidden[[5, hidden.size // 2, -5]]:
        alone = np.zeros(model.surface.size, np.float32)
        alone[point] = 1
        assert np.sum(model.render(alone) ** 2) == pytest.approx(information[point], rel=0.05)


@pytest.mark.parametrize("tangent", [0.0, -0.4, 0.9, -1.1])
def test_a_pixel_falls_on_the_slit_as_its_square_does(tangent: float):
    """A square of side 1, projected along lines of the view's slant and summed over each slit
    pixel; no slant moves its middle.
    """
    from tofclip.recovery.surfaces.kernels import split_over_slit

    places = np.linspace(20.0, 21.0, 9)
    first, shares = np.empty(places.size, np.int32), np.empty((places.size, 4), np.float32)
    split_over_slit(places, tangent, SUBROWS, first, shares)
    columns = first[:, np.newaxis] + np.arange(4)
    np.testing.assert_allclose(shares.sum(axis=1), 1, rtol=1e-6)
    np.testing.assert_allclose((shares * columns).sum(axis=1), places, atol=1e-5)
    # a square's points by the thousand, each spread over the width of a slit pixel
    height, width = (np.arange(2000) + 0.5) / 2000 - 0.5, (np.arange(50) + 0.5) / 50 - 0.5
    for place, start, share in zip(places, first, shares, strict=True):
        fallen = place + width - tangent * height[:, np.newaxis]
        exact = np.bincount(np.floor(fallen + 0.5).astype(int).ravel() - start, minlength=4)
        # three lines stand for the pixel's height: a third of the slant's width apart
        np.testing.assert_allclose(share, exact / exact.sum(), atol=0.02 + 0.05 * abs(tangent))


def test_slopes_of_ranges_are_differences_of_neighbours(shot):
    """Of a plane, whose inverse depth grows evenly, also where the picture ends."""
    masks = np.ones((1, *SHAPE), bool)
    coefficients = np.array([1 / 1.5, 0.08, -0.05, 0, 0, 0])
    state = SurfaceState.start([coefficients], CAMERA)
    model = SurfaceModel(shot.streak, CAMERA, masks, [SmoothBasis(SHAPE)], state)
    distance = model.distance.reshape(SHAPE)
    right, down = model.compute_slopes().reshape(2, *SHAPE)
    np.testing.assert_allclose(right[:-1, :-1], np.diff(distance, axis=1)[:-1], atol=1e-12)
    np.testing.assert_allclose(down[:-1, :-1], np.diff(distance, axis=0)[:, :-1], atol=1e-12)
    np.testing.assert_allclose(right[:, -1], distance[:, -1] - distance[:, -2], atol=1e-12)
    np.testing.assert_allclose(down[-1], distance[-1] - distance[-2], atol=1e-12)


def test_a_pulse_between_rows_is_the_pulse_over_each_row():
    """Three samples of a B-spline and the smoothing, against the Gaussian's integral over rows."""
    from scipy.special import ndtr

    from tofclip.recovery.surfaces.kernels import split_between_rows

    sigma, places = 1.27, np.linspace(19.5, 20.5, 11)
    first, shares = split_between_rows(places)
    edges = np.arange(42) - 0.5
    for place, start, share in zip(places, first, shares, strict=True):
        light = np.zeros(41)
        light[start : start + 3] = share
        smooth = np.convolve(light, make_pulse(sigma, 9), "same")
        np.testing.assert_allclose(smooth, np.diff(ndtr((edges - place) / sigma)), atol=4e-3)


def test_light_is_placed_on_an_uneven_time_axis(shot):
    """As a sweep that is faster at one end; light of a point is where its time of flight says."""
    even = shot.streak.times
    times = even + 0.04 * even * (even / even[-1] - 1)  # 4 % slower at the end than at the start
    uneven = replace(shot.streak, row_times=times)
    model = make_model(uneven)
    assert np.ptp(np.diff(model.times)) > 0.05 * BIN
    point = 19  # on the optical axis' column, where the reference view's sweep is none
    alone = np.zeros(model.surface.size, np.float32)
    alone[point] = 1
    light = model.project(3, alone, model.kernels[3]).sum(axis=1)
    there = 2 * model.distance[point] / 299_792_458 + CAMERA.time_zero
    expected = np.interp(there, times, np.arange(times.size))
    assert np.average(np.arange(light.size), weights=light) == pytest.approx(expected, abs=0.03)


@pytest.mark.parametrize("inverse", [1e3, 1e9, 1e-9])
def test_surfaces_that_run_off_take_no_more_memory(shot, inverse: float):
    """A millimetre before the camera the views spread a surface over a plane without end (2.5 TiB
    once), and a kilometre off it lies beyond the last row.
    """
    model = make_model(shot.streak)
    away = model.state.copy()
    away.coefficients[0][:] = 0
    away.coefficients[0][0] = inverse
    model.place(away)
    assert max(one.columns for one in model.footprints) < 1.1 * model.image.shape[1]
    seen = model.gather(np.ones_like(model.image))
    first, second = model.parts
    assert not seen[first].any()
    assert seen[second].all()


def test_derivatives_are_those_of_the_image(shot):
    """Central differences in every direction. What is used is the derivative of the smooth pulse;
    that of light between rows differs by (f / (1 - f))^2 at f cycles a row, 4 to 9 % where a pulse
    of 1.3 rows changes most, to and fro with the place between rows.
    """
    model = make_model(shot.streak)
    amplitude = np.random.default_rng(1).random(model.surface.size).astype(np.float32)
    state, found = model.state, {}
    for group in iterate_derivatives(model, amplitude):
        for name, image in zip(group.names, group.images, strict=True):
            found[name] = np.zeros_like(model.image)
            rows, columns = image.shape
            area = np.s_[group.row : group.row + rows, group.column : group.column + columns]
            found[name][area] = image
    # time zero is the reference view's
    assert ("delays", 0, 3) not in found
    assert ("stretches", 0, 3) not in found
    assert not any(name == "shading" for name, _, _ in found)
    for name, step in (
        (("coefficients", 0, 0), 2e-4), (("coefficients", 1, 2), 2e-4), (("gains", 0, 2), 1e-2),
        (("delays", 0, 4), 2e-2), (("stretches", 0, 1), 5e-2), (("widths", 0, 5), 2e-2),
    ):  # fmt: skip
        images = []
        for sign in (1, -1):
            moved = state.copy()
            field, surface, number = name
            values = (
                moved.coefficients[surface] if field == "coefficients" else getattr(moved, field)
            )
            values[number] += sign * step * (values[number] if field in ("gains", "widths") else 1)
            model.place(moved)
            images.append(model.render(amplitude))
        model.place(state)
        difference = (images[0] - images[1]) / (2 * step)
        assert np.linalg.norm(found[name] - difference) < 0.1 * np.linalg.norm(difference), name
