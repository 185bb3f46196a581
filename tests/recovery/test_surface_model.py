"""Surfaces step by step: patches in returns, the model with its adjoint and derivatives, steps on ranges
and on what is uncertain of the instrument, and which points are returned.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from surface_scene import BIN, BIN_M, CAMERA, INSTRUMENT, SCENE, SHAPE, make_model

from tofclip.camera import Camera
from tofclip.lidar import Detection, compute_ray_directions, depth
from tofclip.recovery.surfaces.amplitudes import AmplitudeSolver
from tofclip.recovery.surfaces.extents import find_usual_brightness
from tofclip.recovery.surfaces.fit import SurfaceFit, extrapolate_step
from tofclip.recovery.surfaces.growing import bend_patches, find_bodies
from tofclip.recovery.surfaces.model import SurfaceModel, weigh_measurements
from tofclip.recovery.surfaces.patches import Patch, find_plain_patches
from tofclip.recovery.surfaces.points import SurfaceState
from tofclip.recovery.surfaces.pulse import ShotPulse, make_pulse, measure_pulse
from tofclip.recovery.surfaces.ranges import (
    CLUSTER_COLUMNS,
    CLUSTER_ROWS,
    Derivatives,
    NormalEquations,
    Refinement,
    compute_objective,
    iterate_derivatives,
    refine_state,
)
from tofclip.recovery.surfaces.returns import (
    ROD_RADIUS_PX,
    estimate_displacement,
    list_returns,
    round_rod,
)
from tofclip.recovery.surfaces.shapes import (
    QuadricBasis,
    SmoothBasis,
    evaluate_monomials,
    guess_quadric,
)
from tofclip.recovery.surfaces.shifts import follow_local_shifts, measure_local_shifts
from tofclip.recovery.surfaces.straighten import straighten_surfaces
from tofclip.shots import Frames
from tofclip.simulate import simulate_shot


def find_patches_in(distance: np.ndarray, ray_length: np.ndarray):
    pixels = np.flatnonzero(np.isfinite(distance))
    sure = np.full(pixels.size, BIN_M / 10)
    plain = find_plain_patches(pixels, distance.ravel()[pixels], sure, ray_length, BIN_M)
    return bend_patches(plain, BIN_M)


def test_patches_are_planes_to_rounding_and_halves_of_one_are_joined():
    y, x = np.indices((40, 40))
    ray_length = np.sqrt(1 + ((x - 20) / 150) ** 2 + ((y - 20) / 150) ** 2)
    plane = ray_length / (0.5 + 1e-3 * x - 5e-4 * y)
    distance = plane.copy()
    distance[:, 18:21] = np.nan  # cut in two
    distance[5:12, 25:33] = 1.2 * ray_length[5:12, 25:33]
    distance[30, 30] = 1.0  # alone
    patches = find_patches_in(distance, ray_length)
    assert [patch.pixels.size for patch in patches] == [40 * 37 - 56 - 1, 56]
    everywhere = patches[0].basis.evaluate(np.arange(1600))
    fitted = ray_length.ravel() / (everywhere @ patches[0].coefficients)
    np.testing.assert_allclose(fitted, plane.ravel(), atol=1e-4)


def test_what_no_quadratic_follows_gets_splines():
    y, x = np.indices((64, 64))
    ray_length = np.sqrt(1 + ((x - 32) / 300) ** 2 + ((y - 32) / 300) ** 2)
    waves = 1.5 + 0.01 * np.sin(x / 8) * np.cos(y / 9)
    distance = waves + 3e-4 * np.random.default_rng(0).standard_normal(waves.shape)
    (patch,) = find_patches_in(distance, ray_length)
    # noise of a tenth of a bin; waves of three
    assert np.median(np.abs(patch.compute_ranges(patch.pixels) - waves.ravel())) < 0.15 * BIN_M


def meet(middle, radius, axes):
    """Ranges of a ball or a rod, (64, 64), m, NaN beside it; how far inside its limb a ray is; range over
    depth.
    """
    y, x = np.indices((64, 64))
    rays = np.stack([(x - 32) / 300, (y - 32) / 300, np.ones(x.shape)], axis=-1)
    middle, across = np.array(middle), np.array(axes)
    a, b = np.sum(across * rays**2, axis=-1), rays @ (across * middle)
    inside = b**2 - a * (np.sum(across * middle**2) - radius**2)
    ray_length = np.linalg.norm(rays, axis=-1)
    with np.errstate(invalid="ignore"):
        return ray_length * (b - np.sqrt(inside)) / a, inside, ray_length


def test_a_ball_and_the_cable_beside_it_are_parted():
    """Neighbours' ranges nowhere differ by more than a bin or two: they are one patch of returns, which
    one surface followed to 1.2 bins.
    """
    things = (meet((0.02, 0.0, 1.5), 0.09, (1, 1, 1)), meet((-0.07, 0.0, 1.48), 0.03, (1, 0, 1)))
    seen = [np.where(inside > 0.12 * inside.max(), ranges, np.nan) for ranges, inside, _ in things]
    truth = np.fmin(*seen)
    noise = 3e-4 * np.random.default_rng(0).standard_normal(truth.shape)
    for patch in find_patches_in(truth + noise, things[0][2]):
        error = patch.compute_ranges(patch.pixels) - truth.ravel()[patch.pixels]
        assert np.median(np.abs(error)) < 0.15 * BIN_M


def test_bodies_that_touch_grow_apart():
    """Six that touch, whose ranges a surface of second order follows to a bin and more, and no valley parts."""
    bodies = [
        ((0.0, -0.118, 1.5), (1 / 0.03, 1 / 0.04, 1 / 0.035)),  # each with half its sides
        ((0.0, 0.0, 1.5), (1 / 0.055, 1 / 0.085, 1 / 0.04)),
        *(((side * 0.07, 0.0, 1.5), (1 / 0.02, 1 / 0.08, 1 / 0.02)) for side in (-1, 1)),
        *(((side * 0.03, 0.11, 1.5), (1 / 0.025, 1 / 0.05, 1 / 0.025)) for side in (-1, 1)),
    ]
    seen = [meet(middle, 1, np.square(axes)) for middle, axes in bodies]
    ranges = np.array([np.where(inside > 0, distance, np.inf) for distance, inside, _ in seen])
    nearest, truth = ranges.argmin(axis=0).ravel(), ranges.min(axis=0)
    pixels, bin_m = np.flatnonzero(np.isfinite(truth)), BIN_M / 4
    noise = 0.3 * bin_m * np.random.default_rng(0).standard_normal(truth.shape)
    distance = (truth + noise).ravel()[pixels]
    patch = Patch.fit(pixels, distance, np.full(pixels.size, bin_m), seen[0][2])
    assert patch.compute_error() > bin_m
    parts = find_bodies([patch], bin_m)
    owners = [np.bincount(nearest[part.pixels], minlength=6) for part in parts]
    assert {int(owner.argmax()) for owner in owners} == set(range(6))
    assert sum(owner.max() for owner in owners) > 0.95 * pixels.size
    # what one surface follows as nearly is not taken apart
    for part in parts:
        assert find_bodies([part], bin_m) == []
    assert find_bodies(parts, bin_m) == []


@pytest.mark.parametrize("axes", [(1, 1, 1), (1, 0, 1)])
def test_the_nearest_round_surface_does_not_follow_what_is_off(axes):
    truth, inside, ray_length = meet((0.03, -0.02, 1.5), 0.12, axes)
    pixels = np.flatnonzero(inside > 0.1 * inside.max())
    distance = truth.ravel()[pixels]

    def measure_error(distance):
        basis, found = guess_quadric(pixels, ray_length.ravel()[pixels] / distance, truth.shape)
        fitted = ray_length.ravel()[pixels] / basis.compute_inverse(basis.evaluate(pixels), found)
        return np.median(np.abs(fitted - truth.ravel()[pixels]))

    assert measure_error(distance) < 0.01 * BIN_M
    distance[::10] += 5 * BIN_M  # 0.5 bins on average
    assert measure_error(distance) < 0.25 * BIN_M


@pytest.mark.parametrize("axes", [(1, 1, 1), (1, 0, 1)])
def test_a_ball_and_a_rod_are_followed_up_to_their_limbs(axes):
    """Frames' returns at a limb are far too near, all of them, and no polynomial is as steep."""
    truth, inside, ray_length = meet((0.03, -0.02, 1.5), 0.12, axes)
    limb = inside / inside.max() < 0.15
    random = np.random.default_rng(0)
    distance = truth + 3e-4 * random.standard_normal(truth.shape)
    distance[limb] -= random.uniform(0, 0.01, truth.shape)[limb]
    patch = max(find_patches_in(distance, ray_length), key=lambda one: one.pixels.size)
    # what a pixel at the limb sees is a mean of what is there
    seen = np.flatnonzero(inside > 0.05 * inside.max())
    error = patch.compute_ranges(seen) - truth.ravel()[seen]
    assert np.median(np.abs(error)) < 0.1 * BIN_M
    assert np.quantile(np.abs(error), 0.95) < BIN_M  # splines: 5 bins at the limb


def test_derivatives_of_a_round_surface_are_those_of_differences():
    basis = QuadricBasis((40, 50), (5, 8, 35, 42), unit=0.02)
    coefficients = np.array([0.3, 0.01, 0.02, 0.1, 0.01, 0.005, -0.1, 0.008, -0.12])
    functions = basis.evaluate(np.arange(40 * 50))  # within, at the limb, and beyond
    found = basis.differentiate(functions, coefficients)
    for number, step in enumerate(1e-6 * np.eye(coefficients.size)):
        ahead, behind = (
            basis.compute_inverse(functions, coefficients + sign * step) for sign in (1, -1)
        )
        np.testing.assert_allclose(found[:, number], (ahead - behind) / 2e-6, rtol=1e-4, atol=1e-6)


def test_a_round_surface_moves_as_its_derivatives_say():
    """l and q make up for each other nearly: what hardly changes a ball is a long way in both."""
    basis = QuadricBasis((40, 50), (5, 8, 35, 42), unit=0.02)
    coefficients = np.array([0.3, 0.0, 0.0, 0.1, 0.0, 0.0, -0.1, 0.0, -0.1])
    functions = basis.evaluate(np.arange(40 * 50))
    light = (functions @ coefficients[3:] > 0.01).astype(np.float32)
    derivatives = basis.differentiate(functions, coefficients)[light > 0]
    way = np.linalg.svd(derivatives / np.linalg.norm(derivatives, axis=0))[2][-1]
    way /= np.linalg.norm(derivatives, axis=0)
    change = 0.02 * way / abs(way[0])  # of l, where the ball rises by 0.06
    ends = coefficients + change, basis.take_step(functions, coefficients, change, light)
    aim = basis.compute_inverse(functions, coefficients)[light > 0] + derivatives @ change
    plain, taken = (
        np.abs(basis.compute_inverse(functions, end)[light > 0] - aim).mean() for end in ends
    )
    assert taken < 0.2 * plain


def test_splines_are_a_quadratic_and_what_bends():
    """Cubic splines hold every quadratic, so that taking it apart and together changes nothing."""
    shape = (40, 50)
    basis = SmoothBasis(shape, (-3, 5, 30, 45), (3, 4))
    coefficients, quadratic = basis.quadratic_parts
    np.testing.assert_allclose(quadratic @ coefficients, np.eye(6), atol=1e-8)
    pixels = np.ravel_multi_index(np.mgrid[2:28, 8:40].reshape(2, -1), shape)
    monomials = evaluate_monomials(pixels, shape)
    np.testing.assert_allclose(basis.evaluate(pixels) @ coefficients, monomials, atol=1e-8)


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
    split_over_slit(places, wide, high, tangent, first, shares)
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


def test_light_that_arrives_elsewhere_than_its_surface_shows_by_how_much():
    """Of two plates one is rendered 0.6 mm farther, a fifth of a row; a part of that goes into places
    where it lies before or behind the other one's light.
    """
    model = make_model(simulate_shot(SCENE, INSTRUMENT, seed=0).streak)
    amplitude = np.full(model.surface.size, 500, np.float32)
    away, state = 0.6e-3, model.state
    model.place(replace_farther(state, away))
    image = model.render(amplitude)
    model.place(state)
    shifts = measure_local_shifts(model, amplitude, image - model.render(amplitude))
    moved, still = shifts[model.parts[0]], shifts[model.parts[1]]
    assert np.median(moved) == pytest.approx(away, rel=0.2)
    assert np.median(still) < 0.1 * away


def test_ranges_follow_what_no_function_of_the_surface_does():
    """The right half of a plate is rendered a millimetre farther, a third of a row; the surface is a plane. Few
    iterations, which do not follow noise, lead half of the way or more.
    """
    model = make_model(simulate_shot(SCENE, INSTRUMENT, seed=0).streak)
    amplitude, away = np.full(model.surface.size, 500, np.float32), 1e-3
    plate, beside = model.masks
    right = plate & (np.arange(SHAPE[1]) > np.median(model.column[model.parts[0]]))
    farther = replace_farther(model.state, away).coefficients[0]
    shapes = [model.state.coefficients[0], farther, model.state.coefficients[1]]
    bases = [model.bases[number] for number in (0, 0, 1)]
    shading = np.zeros((3, CAMERA.views))
    state = replace(model.state, coefficients=shapes, shading=shading)
    truth = model.lay_out(np.stack([plate & ~right, right, beside]), bases, state)
    model.image = truth.render(amplitude)
    rest, usual = model.image - model.render(amplitude), np.full(amplitude.size, away)
    solver = AmplitudeSolver(model, amplitude, 0.0)
    shifts = follow_local_shifts(solver, rest, solver.estimate_local_variance(), usual)
    moved = right[model.row, model.column] & (model.surface == 0)
    assert 0.5 * away < np.median(shifts[moved]) < 1.1 * away
    assert np.median(np.abs(shifts[~moved])) < 0.01 * away


def replace_farther(state: SurfaceState, away: float) -> SurfaceState:
    other = state.copy()
    other.coefficients[0] = state.coefficients[0] * (1 - away * state.coefficients[0][0])
    return other


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


@pytest.mark.parametrize("blur_px", [0.0, 1.5])
def test_derivatives_are_those_of_the_image(shot, blur_px: float):
    """Central differences in every direction. What is used is the derivative of the smooth pulse;
    that of light between rows differs by (f / (1 - f))^2 at f cycles a row, 4 to 9 % where a pulse
    of 1.3 rows changes most, to and fro with the place between rows.
    """
    model = make_model(shot.streak).blur(blur_px)
    amplitude = np.random.default_rng(1).random(model.surface.size).astype(np.float32)
    state, found = model.state, {}
    for group in iterate_derivatives(model, amplitude):
        for name, image in zip(group.names, group.images, strict=True):
            found.setdefault(name, np.zeros_like(model.image))[group.area] += image
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


def compute_misfit(model: SurfaceModel, amplitude: np.ndarray) -> float:
    return float(np.sum(model.weights * (model.render(amplitude) - model.image) ** 2))


def test_a_refused_or_taken_step_never_raises_the_misfit(shot):
    model = make_model(shot.streak)
    amplitude = np.full(model.surface.size, 50, np.float32)
    before = compute_misfit(model, amplitude)
    refined = refine_state(model, amplitude)
    assert compute_misfit(model, refined.amplitude) <= before
    assert model.state.gains.mean() == pytest.approx(CAMERA.gains.mean())
    assert model.state.delays[3] == model.state.stretches[3] == 0


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


def test_views_that_are_all_late_do_not_pass_for_nearer_surfaces(shot):
    """Amplitudes explain much of both. Where that is left out for the views, the second step leaves
    36 and 20 um of it; the state is the true one but for them, and there is no noise.
    """
    model = make_model(shot.streak)
    y, x = np.divmod(model.pixel, SHAPE[1])
    amplitude = np.where((x // 6 + y // 6) % 2 == 0, 60, 30).astype(np.float32)
    model.fill_partly(amplitude)
    model.image = model.render(amplitude)
    model.weights = 1 / (model.image + 5)
    true = model.distance
    late = model.state.copy()
    late.delays[:] = 0.1
    late.delays[model.reference] = 0
    for coefficients in late.coefficients:
        coefficients[0] *= 1 + 0.1 * BIN_M / 1.5
    model.place(late)
    assert abs(np.mean(model.distance - true)) > 300e-6
    found = None
    for _ in range(2):
        found = refine_state(model, amplitude, found)
        amplitude = found.amplitude
    assert found.steps == 2
    for part in model.parts:
        assert abs(np.mean((model.distance - true)[part])) < 10e-6


def test_each_view_sees_its_own_part_of_what_shines_through(shot):
    """As through gauze: the view beside the lamp sees all that the lamp lights behind it."""
    model = make_model(shot.streak, overlap=True)
    amplitude = np.full(model.surface.size, 50, np.float32)
    model.find_behind(amplitude)
    hidden = model.masks[0].ravel()[model.pixel] & (model.surface == 1)
    np.testing.assert_array_equal(model.behind, hidden)
    even, shaded = model.state, model.state.copy()
    shaded.shading[1] = [-0.25, -0.1, 0.1, 0.4, 0.15, -0.1, -0.2]
    model.place(shaded)
    y = np.random.default_rng(0).standard_normal(model.image.shape).astype(np.float32)
    there, back = model.render(amplitude).astype(np.float64), model.gather(y).astype(np.float64)
    assert np.vdot(there, y) == pytest.approx(float(np.vdot(amplitude, back)), rel=1e-4)
    model.image = model.render(amplitude)
    model.weights = 1 / (model.image + 5)
    model.place(even)
    for _ in range(2):
        amplitude = refine_state(model, amplitude).amplitude
    # what amplitudes take of it in two steps is a few hundredths of the largest
    np.testing.assert_allclose(model.state.shading[1], shaded.shading[1], atol=0.03)
    assert not model.state.shading[0].any()


def test_what_all_views_see_alike_is_not_shaded(shot):
    model = make_model(shot.streak, overlap=True)
    amplitude = np.full(model.surface.size, 50, np.float32)
    model.find_behind(amplitude)
    clean = model.render(amplitude)
    model.image = np.random.default_rng(0).poisson(clean + 1).astype(np.float32) - 1
    model.weights = 1 / (clean + 1)
    refine_state(model, amplitude)
    assert not model.state.shading.any()
    assert not model.behind.any()


@pytest.mark.parametrize("bent", [False, True])
def test_splines_are_left_where_a_quadratic_explains_the_shot(shot, bent: bool):
    """Frames displace returns here and there, and splines follow them; the shot knows better."""
    masks = np.zeros((1, *SHAPE), bool)
    masks[0, 4:44, 4:44] = True
    pixels = np.flatnonzero(masks)
    y, x = np.divmod(pixels, SHAPE[1])
    bump = 3e-3 * np.exp(-((x - 18) ** 2 + (y - 20) ** 2) / 50)
    basis = SmoothBasis(SHAPE, (4, 4, 44, 44), (4, 4))
    design = basis.evaluate(pixels)
    flat = 1 / 1.5 + 1e-4 * x
    found, true = (
        np.linalg.lstsq(design, flat + part, rcond=None)[0] for part in (bump, bent * bump)
    )
    basis = replace(basis, bending=1e-3 * np.eye(design.shape[1]))
    state = SurfaceState.start([true], CAMERA)
    model = SurfaceModel(shot.streak, CAMERA, masks, [basis], state)
    board = np.where((x // 6 + y // 6) % 2 == 0, 60, 30).astype(np.float32)
    model.image = model.render(board)
    model.weights = 1 / (model.image + 5)
    model.place(SurfaceState.start([found], CAMERA))
    amplitude = refine_state(model, board).amplitude
    solver = AmplitudeSolver(model, amplitude, 2.0)
    straight, _ = straighten_surfaces(solver)
    assert straight.model.bases[0].is_quadratic != bent
    if not bent:
        error = straight.model.distance - straight.model.ray_length / flat
        assert np.median(np.abs(error)) < 0.1e-3  # 2.9 mm at the bump before


def test_where_the_shot_says_nothing_what_is_known_beforehand_decides(shot):
    """Of a bend of which nothing is seen: its variance is the inverse of what is known of it, and a
    step takes it back, as the least of ``c' bending c / 2``.
    """
    known, bend = np.array([2.5e5, 1e6, 4e5]), np.array([3e-3, -2e-3, 1e-3])
    model = make_model(shot.streak)
    bending = np.diag([0, 0, 0, *known])
    model.bases = [replace(basis, bending=bending) for basis in model.bases]
    bent = model.state.copy()
    for coefficients in bent.coefficients:
        coefficients[3:] = bend
    model.place(bent)
    model.weights = model.weights * np.float32(1e-9)
    found = refine_state(model, np.full(model.surface.size, 50, np.float32))
    for covariance, coefficients in zip(found.covariances, model.state.coefficients, strict=True):
        np.testing.assert_allclose(covariance[3:, 3:] * known, np.eye(3), atol=1e-3)
        np.testing.assert_allclose(coefficients[3:], 0, atol=1e-3 * np.abs(bend).max())
    assert compute_objective(model, found.rest) < 1e-3 * np.sum(
        known * bend**2
    )  # of both surfaces, half of each


def test_of_a_surface_that_is_dark_no_range_is_known(shot):
    """Its deviation was stated as 0 m."""
    model = make_model(shot.streak)
    dark = model.surface == 1
    found = refine_state(model, np.where(dark, 0, 50).astype(np.float32), robust=True)
    deviation = model.estimate_deviation(found.covariances)
    assert np.all(deviation[dark] > 1e3)
    assert np.all(deviation[~dark] < 10 * BIN_M)


def test_the_objective_holds_what_is_known_of_surfaces_beforehand(shot):
    """Bent surfaces that a shot without noise shows to be so: nothing but the bending is left."""
    model = make_model(shot.streak)
    bent = model.state.copy()
    for coefficients in bent.coefficients:
        coefficients[3:] = 3e-3, -2e-3, 1e-3
    model.place(bent)
    known = np.diag([0, 0, 0, 3e3, 1e3, 2e3])  # far less than the shot says
    model.bases = [replace(basis, bending=known) for basis in model.bases]
    amplitude = np.full(model.surface.size, 50, np.float32)
    model.image = model.render(amplitude)
    model.weights = 1 / (model.image + 5)
    expected = sum(float(one @ known @ one) / 2 for one in bent.coefficients)
    rest = refine_state(model, amplitude).rest
    assert compute_objective(model, rest) == pytest.approx(expected, rel=0.01)


def test_pixels_at_the_side_of_a_rod_see_it_farther_away():
    """Of one of radius R the mean depth that a pixel sees, less the mean over all its light."""
    y, x = np.indices((40, 5)).reshape(2, -1)
    inside = np.linspace(-1, 1, 100_001)[1:-1]  # places across it, radii
    depth = ROD_RADIUS_PX * (1 - np.sqrt(1 - inside**2))
    pixel = np.rint(ROD_RADIUS_PX * inside + 2)
    light = np.sqrt(1 - inside**2)  # of what faces the camera less and less
    seen = np.array([depth[pixel == one].mean() for one in (1, 2, 3)])
    bright = np.array([0, *(light[pixel == one].sum() for one in (1, 2, 3)), 0])
    found = round_rod(y + 7, x + 3, bright[x])
    line = np.average(depth, weights=light)
    np.testing.assert_allclose(
        found.reshape(40, 5)[:, 1:4], np.tile(seen - line, (40, 1)), atol=1e-3
    )
    # what is as wide as pixels shows its own shape
    assert not round_rod(y, x, np.ones(y.size)).any()


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


@pytest.mark.parametrize(
    ("moved", "earlier", "left"),
    [
        ([2, -2], [4, -4], 2.0),  # 1 + 1/2 + 1/4 ...
        ([-2, 2], [4, -4], 0.0),  # back again: about its end
        ([2, 2], [4, -4], 0.0),  # anywhere
        ([2, -2], [2, -2], 6.0),  # hardly shorter: three quarters
        ([2, -2], [0, 0], 0.0),
    ],
)
def test_what_steps_leave_is_a_geometric_series(moved, earlier, left):
    light = np.ones(2, np.float32)
    found = extrapolate_step(np.array(moved, float), np.array(earlier, float), light)
    np.testing.assert_allclose(found, left)


def test_what_steps_take_from_the_misfit_is_given_back():
    """Seven unknowns and sixteen clusters: their scores after the step say too little."""
    draw = np.random.default_rng(0)
    rows, columns = 4 * CLUSTER_ROWS, 4 * CLUSTER_COLUMNS
    images = draw.standard_normal((7, rows, columns)).astype(np.float32)
    images *= np.repeat(np.repeat(draw.uniform(0, 1, (7, 4, 4)) ** 2, 12, 1), 48, 2)
    group = Derivatives(0, 0, images, [("coefficients", 0, number) for number in range(7)])
    weights = np.ones((rows, columns), np.float32)
    flat = images.reshape(7, -1).astype(np.float64)
    inverse = np.linalg.inv(flat @ flat.T)
    stated, plain = np.zeros((2, 7))
    draws = 60
    for _ in range(draws):
        noise = draw.standard_normal((rows, columns)).astype(np.float32)
        change = inverse @ (flat @ noise.ravel())
        left = noise - np.tensordot(change.astype(np.float32), images, 1)
        found = NormalEquations.multiply([group], weights, left, left)
        np.testing.assert_allclose(found.normal, flat @ flat.T, rtol=1e-4, atol=0.1)
        np.testing.assert_allclose(found.slope, 0, atol=0.1)
        stated += np.diag(found.estimate_covariances(inverse, np.zeros((7, 7)))) / draws
        scores = np.array(
            [
                images[:, top : top + CLUSTER_ROWS, side : side + CLUSTER_COLUMNS].reshape(7, -1)
                @ left[top : top + CLUSTER_ROWS, side : side + CLUSTER_COLUMNS].ravel()
                for top in range(0, rows, CLUSTER_ROWS)
                for side in range(0, columns, CLUSTER_COLUMNS)
            ]
        )
        plain += np.diag(inverse @ (scores.T @ scores) @ inverse) / draws
    assert np.mean(stated / np.diag(inverse)) == pytest.approx(1, abs=0.08)
    assert np.mean(plain / np.diag(inverse)) < 0.9


def test_a_deviation_is_that_of_the_fit_of_further_steps_and_of_the_centres():
    """Of two planes of which all is known: r = length / (a + b x), so that
    dr = r^2 / length sqrt(var a + x^2 var b); to that what steps leave, and the displaced picture. Where
    the farther plane is seen through the nearer one, each view sees another part of a pixel.
    """
    model = make_model(simulate_shot(SCENE, INSTRUMENT, seed=0).streak)
    amplitude = np.full(model.surface.size, 500, np.float32)
    model.image = model.render(
        amplitude
    )  # nothing is left that would show a surface to be elsewhere
    one, along = 4e-4, 3e-4
    covariance = np.diag([one**2, along**2, 0, 0, 0, 0])
    remainder = np.array([0.7e-3, 0.2e-3])[model.surface]
    calibrated = CAMERA.centres_px + 0.1 * np.array([1, -1, 0, 1, 0, -1, 1])
    refinement = Refinement(
        [covariance] * 2, amplitude, np.zeros((6, amplitude.size), np.float32), 1, model.image, None
    )
    solver, nothing = (
        AmplitudeSolver(model, amplitude, 2.0),
        depth(Frames(np.zeros((9, *SHAPE), np.float32), BIN * np.arange(9), CAMERA)),
    )
    fit = SurfaceFit(solver, solver, refinement, remainder, 0.0, nothing, solver, nothing)
    found = list_returns(fit, Detection(), calibrated)
    assert len(found) == model.surface.size
    for surface, (first, slope) in enumerate([(1 / 1.4, 0.02), (1 / 1.7, -0.03)]):
        own = np.abs(found.range - 1 / first) < 0.1
        assert own.sum() == model.masks[surface].sum()
        y, x = found.y[own], found.x[own]
        across = 2 * x / SHAPE[1] - 1
        length = np.sqrt(1 + ((x - 24) ** 2 + (y - 24) ** 2) / CAMERA.focal_length_px**2)

        def reach(x: np.ndarray, y: np.ndarray, first=first, slope=slope) -> np.ndarray:
            ray = np.sqrt(1 + ((x - 24) ** 2 + (y - 24) ** 2) / CAMERA.focal_length_px**2)
            return ray / (first + slope * (2 * x / SHAPE[1] - 1))

        distance = reach(x, y)
        np.testing.assert_allclose(found.range[own], distance, rtol=1e-9)
        stated = distance**2 / length * np.hypot(one, across * along)
        right, down = estimate_displacement(found.camera, calibrated)
        moved = np.hypot(right * (reach(x + 1, y) - distance), down * (reach(x, y + 1) - distance))
        through = (surface == 1) & model.masks[0, y, x]
        steep = np.hypot(
            reach(x + 0.5, y) - reach(x - 0.5, y), reach(x, y + 0.5) - reach(x, y - 0.5)
        )
        # half of the light is the nearer one's
        hidden = through * 0.5 / np.sqrt(12 * CAMERA.views) * steep
        expected = np.sqrt(
            stated**2 + remainder[model.surface == surface] ** 2 + moved**2 + hidden**2
        )
        np.testing.assert_allclose(found.confidence[own], expected, rtol=1e-3)
        # light falls with the square of the range
        np.testing.assert_allclose(found.intensity[own], 500 * distance**2, rtol=1e-5)


def test_what_a_shot_shows_of_centres_says_how_far_the_rest_displaces_the_picture():
    """Of independent errors of seven views all but what looks like a displaced picture shows."""
    looks = np.stack([np.ones(CAMERA.views), -np.tan(CAMERA.angles)], axis=1)
    errors = np.random.default_rng(0).normal(0, 0.5, (2000, CAMERA.views))
    hidden = errors @ np.linalg.pinv(looks).T
    shown = CAMERA.centres_px - (errors - hidden @ looks.T)
    told = [
        estimate_displacement(CAMERA.replace(centres_px=one), CAMERA.centres_px) for one in shown
    ]
    # half of all displacements are smaller than 0.67 of their deviation; 2,000 know a median to 3 %
    ratio = np.median(np.abs(hidden) / told, axis=0)
    np.testing.assert_allclose(ratio, 0.6745, rtol=0.1)
    # of two views no error shows: what the calibration says of itself holds
    pair = Camera([20.0, 60.0], [-0.5, 0.5], (16, 16), 81, centre_uncertainty_px=[0.1, 0.1])
    right, down = estimate_displacement(pair, pair.centres_px)
    assert right == pytest.approx(0.1 / np.sqrt(2))
    assert down == pytest.approx(0.1 / np.sqrt(2) / np.tan(0.5))


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


def test_usual_brightness_is_that_of_the_surest_points():
    amplitude = np.array([1, 1, 9, 10, 11], np.float32)
    assert find_usual_brightness(amplitude, 3 * amplitude, 5.0) == 10
    # in little light none is twenty deviations out, and half of the upper ones' counts
    assert find_usual_brightness(amplitude, amplitude, 5.0) == 10
    assert find_usual_brightness(amplitude, amplitude / 10, 5.0) == np.inf


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
