"""The surface model: adjoint, derivatives, and where light of points falls."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from surface_scene import BIN, CAMERA, INSTRUMENT, SCENE, make_model

from tofclip.recovery.surfaces.derivatives import iterate_derivatives
from tofclip.recovery.surfaces.pulse import make_pulse
from tofclip.recovery.surfaces.weights import weigh_measurements
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
