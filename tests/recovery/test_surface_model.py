"""The model of surfaces before a shot: where their light falls, its adjoint, its pulse, and its amplitudes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from surface_scene import BIN, CAMERA, INSTRUMENT, SCENE, SHAPE, make_model

from tofclip.lidar import compute_ray_directions
from tofclip.recovery.surfaces import points
from tofclip.recovery.surfaces.amplitudes import AmplitudeSolver
from tofclip.recovery.surfaces.model import SurfaceModel, weigh_measurements
from tofclip.recovery.surfaces.points import SurfaceState
from tofclip.recovery.surfaces.pulse import ShotPulse, make_pulse, measure_pulse
from tofclip.recovery.surfaces.shapes import SmoothBasis, guess_quadric
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
        replace(streak, saturated=saturated), CAMERA.replace(dead_columns=dead), dark=1.0
    )
    np.testing.assert_array_equal(weights == 0, saturated | dead)


@pytest.mark.parametrize("blur_px", [0.0, 1.5])
def test_the_adjoint_matches(shot, blur_px: float):
    model = make_model(shot.streak).blur(blur_px)
    random = np.random.default_rng(0)
    x = random.random(model.surface.size).astype(np.float32)
    y = random.standard_normal(model.image.shape).astype(np.float32)
    there = np.vdot(model.render(x).astype(np.float64), y)
    assert there == pytest.approx(float(np.vdot(x.astype(np.float64), model.gather(y))), rel=1e-4)


def test_threads_share_out_the_same_light(shot, monkeypatch):
    """As of large shots, which no test has."""
    model = make_model(shot.streak)
    light = np.random.default_rng(0).random(model.surface.size).astype(np.float32)
    seen, found = model.render(light), model.gather(model.image)
    monkeypatch.setattr(points, "PARALLEL_POINTS", 0)
    monkeypatch.setenv("TOFCLIP_THREADS", "3")
    model.place(model.state)
    assert model.is_large
    for one, other in ((model.render(light), seen), (model.gather(model.image), found)):
        np.testing.assert_allclose(one, other, rtol=1e-5, atol=1e-5 * float(np.abs(other).max()))


@pytest.mark.parametrize("tail", [False, True])
def test_few_rows_show_a_long_pulse_as_all_rows_smoothed_do(shot, tail: bool):
    model = make_model(shot.streak)
    if tail:
        lags, shares = np.array([0, 3, 11]), np.array([0.7, 0.2, 0.1])
        model = model.respond(ShotPulse(model.pulse.sigma, lags, shares))
    uneven, random = model.state.copy(), np.random.default_rng(0)
    uneven.delays[:], uneven.stretches[:] = random.uniform(-3, 3, (2, CAMERA.views))
    model.place(uneven)
    light = random.random(model.surface.size).astype(np.float32)
    model.image = model.render(light)
    longer = model.lengthen(12 * model.pulse.sigma, light)
    assert 3 * len(longer.image) < len(model.image)
    assert longer.image.max() > 0.1 * model.image.max()
    np.testing.assert_allclose(
        longer.render(light), longer.image, atol=0.02 * float(longer.image.max())
    )


def compare_squares(model, points):
    """Sum of squares of each point's own image, over what the model gathers of squares."""
    information = model.gather(np.ones_like(model.image), squared=True)
    seen = [
        model.render((np.arange(model.surface.size) == one).astype(np.float32)) for one in points
    ]
    return np.array([np.sum(one**2) for one in seen]) / information[points]


# Where a point lies between rows and columns decides what of it is in one pixel: sums of squares are exact only on
# average, and a blurred pixel is taken for a Gaussian. Single points of two parts are off by up to 0.15.
@pytest.mark.parametrize(("blur_px", "near"), [(0.0, 0.04), (1.5, 0.08)])
def test_squares_of_the_entries_are_those_of_single_points(shot, blur_px: float, near: float):
    model = make_model(shot.streak).blur(blur_px)
    ratios = compare_squares(model, np.arange(3, model.surface.size, 7))
    assert np.mean(ratios) == pytest.approx(1, abs=near)
    assert np.max(np.abs(ratios - 1)) < 0.2


def test_squares_of_entries_hold_what_a_view_sees_of_a_hidden_point(shot):
    model = make_model(shot.streak, overlap=True)
    model.find_behind(np.full(model.surface.size, 50, np.float32))
    shaded = model.state.copy()
    shaded.shading[1] = [-0.7, -0.4, 0.1, 0.6, 0.5, -0.3, 0.2]
    model.place(shaded)
    ratios = compare_squares(model, np.flatnonzero(model.behind)[::5])
    # some views see more of it than others: fewer places count
    assert np.mean(ratios) == pytest.approx(1, abs=0.07)
    assert np.max(np.abs(ratios - 1)) < 0.2


@pytest.mark.parametrize("sides", [(1.0, 1.0), (0.25, 1.0), (0.5, 0.2)])
@pytest.mark.parametrize("tangent", [0.0, -0.4, 0.9, -1.1])
def test_a_part_of_a_pixel_falls_on_the_slit_as_its_rectangle_does(tangent: float, sides: tuple):
    """A rectangle, projected along lines of the view's slant and summed over each slit
    pixel; no slant moves its middle.
    """
    from tofclip.recovery.surfaces.kernels import split_over_slit

    places = np.linspace(20.0, 21.0, 9)
    first, shares = np.empty(places.size, np.int32), np.empty((places.size, 4), np.float32)
    wide, high = (np.full(places.size, side) for side in sides)
    split_over_slit(places, wide, high, tangent, 40, first, shares)
    columns = first[:, np.newaxis] + np.arange(4)
    np.testing.assert_allclose(shares.sum(axis=1), 1, rtol=1e-6)
    # what is narrower than a slit pixel has its middle only on average
    off = 0.0 if sides[0] == 1 else 0.5 * (1 - sides[0])
    np.testing.assert_allclose((shares * columns).sum(axis=1), places, atol=off + 1e-5)
    # its points by the ten thousand
    width, height = (
        side * ((np.arange(count) + 0.5) / count - 0.5)
        for side, count in zip(sides, (200, 2000), strict=True)
    )
    for place, start, share in zip(places, first, shares, strict=True):
        fallen = place + width - tangent * height[:, np.newaxis]
        exact = np.bincount(np.floor(fallen + 0.5).astype(int).ravel() - start, minlength=4)
        # 200 points along the width
        np.testing.assert_allclose(share, exact / exact.sum(), atol=6e-3)


def test_slopes_of_ranges_are_differences_of_neighbours(shot):
    """Of a plane, whose inverse depth grows evenly, also where the picture ends."""
    masks = np.ones((1, *SHAPE), bool)
    coefficients = np.array([1 / 1.5, 0.08, -0.05, 0, 0, 0])
    state = SurfaceState.start([coefficients], CAMERA)
    model = SurfaceModel(shot.streak, CAMERA, masks, [SmoothBasis(SHAPE)], state)
    distance = model.distance.reshape(SHAPE)
    down, right = np.gradient(distance)
    expected = np.stack([right, down]).reshape(2, -1)
    np.testing.assert_allclose(model.compute_slopes(), expected, atol=1e-12)


def test_a_pulse_between_rows_is_the_pulse_over_each_row():
    """Three samples of a B-spline and the smoothing, against the Gaussian's integral over rows."""
    from scipy.special import ndtr

    from tofclip.recovery.surfaces.kernels import split_between_rows

    sigma, places = 1.27, np.linspace(19.5, 20.5, 11)
    first, shares = np.empty(places.size, np.int32), np.empty((places.size, 3), np.float32)
    whole = np.ones(places.size, np.float32)
    split_between_rows(places, whole, 10, first, shares, np.zeros(61, bool))
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
    seen = model.receive(3, alone, model.kernels[3])
    light = seen.images.sum(axis=(0, 2))
    there = 2 * model.distance[point] / 299_792_458 + CAMERA.time_zero
    expected = np.interp(there, times, np.arange(times.size))
    assert seen.row + np.average(np.arange(light.size), weights=light) == pytest.approx(
        expected, abs=0.03
    )


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
    assert max(one.shape[1] for one in model.footprints) < 1.1 * model.image.shape[1]
    seen = model.gather(np.ones_like(model.image))
    first, second = model.parts
    assert not seen[first].any()
    assert seen[second].all()


def test_light_lies_where_a_surface_fills_its_pixels(shot):
    """A fifth of the pixels before the end is filled, of light that fades evenly all of them."""
    model = make_model(shot.streak)
    own, (y, x) = model.surface == 0, np.divmod(model.pixel, SHAPE[1])
    first, last = x[own].min(), x[own].max()
    amplitude = np.where(x < last - 3, 50, np.where(x == last - 3, 10, 0)).astype(np.float32)
    model.fill_partly(amplitude)
    line = own & (y == int(np.median(y[own])))
    right, down = model.aside[:, line]
    expected = np.where(np.arange(first, last + 1) == last - 3, -(1 - 0.2) / 2, 0)
    np.testing.assert_allclose(right, expected, atol=1e-6)
    np.testing.assert_allclose(down, 0, atol=1e-6)
    model.fill_partly((10 * (last + 1 - x)).clip(0).astype(np.float32))
    right, _ = model.aside[:, line]
    np.testing.assert_allclose(right[2:], 0, atol=1e-6)  # what lies before the first is not known


def test_a_pixel_of_a_ball_is_where_its_range_is_on_average(shot):
    """The middle of one is nearer, everywhere alike: two parts a side leave a quarter of that."""

    def look(right, down):
        rays = compute_ray_directions(CAMERA, row + down, column + right)
        along = rays @ middle
        return along - np.sqrt(along**2 - middle @ middle + 0.1**2)

    middle, mask = np.array([0, 0, 1.5]), np.zeros((1, *SHAPE), bool)
    row, column = np.indices(SHAPE).reshape(2, -1)
    with np.errstate(invalid="ignore"):
        within = np.isfinite([look(x, y) for x in (-1, 1) for y in (-1, 1)]).all(axis=0)
    mask.ravel()[:] = within
    row, column = row[within], column[within]
    near = look(0, 0)
    places = (np.arange(8) - 3.5) / 8
    average = np.mean([look(x, y) for x in places for y in places], axis=0)
    length = 1 / compute_ray_directions(CAMERA, row, column)[:, 2]
    basis, found = guess_quadric(np.flatnonzero(within), length / near, SHAPE)
    state = SurfaceState.start([found], CAMERA)
    model = SurfaceModel(shot.streak, CAMERA, mask, [basis], state)
    rows = np.hypot(*model.compute_slopes()) / model.row_m
    level = (rows > 0.7) & (rows < 1.5)
    assert np.count_nonzero(level) > 50
    left, before = (np.mean(one[level] - average[level]) for one in (model.distance, near))
    assert before < 0
    assert 0.6 * before < left < 0


def test_a_pulse_is_measured_alike_whatever_it_was_taken_for():
    """So what seemed a tail, as first ranges were off, may go once they are right."""
    model = make_model(simulate_shot(SCENE, INSTRUMENT, seed=0).streak)
    amplitude = np.full(model.surface.size, 500, np.float32)
    late = ShotPulse(model.pulse.sigma, np.array([0, 9]), np.array([0.7, 0.3]))
    image = model.respond(late).render(amplitude)
    for taken_for in (model, model.respond(late)):
        light, width = taken_for.render_instants(amplitude), CAMERA.pulse_fwhm / model.bin_width
        found = measure_pulse(light, image, np.ones_like(image), width, 0.05)
        assert found.tail_share == pytest.approx(0.3, abs=0.03)


def test_light_of_a_level_line_gathers_where_dim_light_is_costly():
    """Of a wire of one range that runs level light may lie in a lens about it between its ends, where no
    view tells and total variation leaves it; a plate whose borders are level as well stays as it is.
    """
    bright = 600  # far out of the noise
    model = make_model(simulate_shot(SCENE, INSTRUMENT, seed=0).streak)
    state = model.state.copy()
    state.coefficients = [np.array([1 / z, 0, 0, 0, 0, 0]) for z in (1.45, 1.68)]
    masks = np.zeros(model.masks.shape, bool)
    y, x = np.indices(SHAPE)
    lens = 3.2 * np.cos(np.pi * np.clip((x - 23.5) / 34, -0.5, 0.5)) + 1.1
    masks[0] = (np.abs(y - 30) < lens) & (np.abs(x - 23.5) < 22)
    masks[1, 8:20, 10:38] = True
    model = model.cover(masks)
    model.place(state)
    wire = (model.surface == 0) & (np.abs(model.row - 30) < 1.1)
    plate = model.surface == 1
    expected = model.render(np.where(wire | plate, bright, 0).astype(np.float32)) + 2
    model.image = np.random.default_rng(0).poisson(expected).astype(np.float32) - 2
    model.weights = 1 / (expected + 0.015 * expected.max())
    # the same light in each column
    high = np.bincount(model.column[model.surface == 0], minlength=SHAPE[1])[model.column]
    light = np.where(plate, bright, bright * 3 / np.maximum(high, 3)).astype(np.float32)
    lens = (model.surface == 0) & ~wire
    evenly, gathered = AmplitudeSolver(model, light, 2.0), AmplitudeSolver(model, light, 2.0)
    evenly.run(60)
    gathered.run(90, against_dim=10.0)
    total = bright * wire.sum()
    # 0.35, none and 0.95 of it, with the noise of five seeds
    assert evenly.amplitude[lens].sum() > 0.3 * total
    assert gathered.amplitude[lens].sum() < 0.02 * total
    assert gathered.amplitude[wire].sum() == pytest.approx(total, rel=0.1)
    np.testing.assert_allclose(gathered.amplitude[plate].mean(), bright, rtol=0.03)
